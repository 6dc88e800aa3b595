"""Clouds of a project that have no unit: their scale is found first, then they are filtered.

A filter's lengths are metres, so a cloud is not touched before its metre is known. Its scale is
searched on its raw points against the reference, which is in metres (METHOD.md 2.2).
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from dougong.cloud import Cloud
from dougong.formats import describe, iterate
from dougong.pipeline.control import control_of
from dougong.pipeline.loading import Loader
from dougong.pipeline.movers import Mover, bare, require_one_system
from dougong.pipeline.project import Entry, Project, files_of
from dougong.pipeline.reduced import most_points, reduced
from dougong.pipeline.registering import find_unit
from dougong.registration import Register
from dougong.registration.control_solve import ControlPoints
from dougong.registration.free_scale import ScaleSearch, without_unit
from dougong.registration.free_scale_result import refusal


def load_all(project: Project, loader: Loader, control: Mapping[str, ControlPoints]) -> list[Mover]:
    """Return what moves in a project, read and filtered, in the order of its clouds.

    Clouds in known units come first, since those without one are measured by the reference.
    """
    found = {entry.name: loader.movers(entry) for entry in project.cloud if entry.scale_known}
    unscaled = [entry for entry in project.cloud if not entry.scale_known]
    if unscaled:
        reference = found[project.reference()][0]
        most = most_points(len(project.cloud))
        for entry in unscaled:
            points = control_of(control, entry.name)
            scale = _scale_of(entry, reference, loader, project.registration, points, most)
            found[entry.name] = loader.movers(entry, scale)
    return [mover for entry in project.cloud for mover in found[entry.name]]


def _scale_of(
    entry: Entry,
    reference: Mover,
    loader: Loader,
    params: Register,
    control: ControlPoints | None,
    most: int,
) -> ScaleSearch:
    """Find the scale of a cloud that has none, on its raw points."""
    files = files_of(entry, loader.folder)
    with loader.clock.measure("read"):
        raw = _raw_points(files, entry.name, most)
    loader.progress.stage(f"searching the scale of {entry.name} by {reference.name}")
    with loader.clock.measure("scale"):
        found = find_unit(
            raw,
            reference.reduced(most).cloud,
            params,
            source_kind=entry.kind,
            target_kind=reference.kind,
            control=control,
        )
    why = refusal(found)
    if why is None:
        size = found.candidates[0].metres_per_unit
        loader.progress.note(f"{entry.name}: one unit is {size:.6g} m")
    else:
        loader.progress.note(f"{entry.name} is not filtered, since filters need metres: {why}")
    return found


def _raw_points(files: Sequence[Path], name: str, most: int) -> Cloud:
    """Return the coordinates of a cloud, reduced, in its own units: no others are believed."""
    firsts = [without_unit(next(iter(iterate(file)))) for file in files]
    require_one_system(firsts, name)
    frame = firsts[0].frame

    def pieces() -> Iterator[Cloud]:
        for file in files:
            yield from (bare(without_unit(chunk), frame, name) for chunk in iterate(file))

    return reduced(pieces, sum(describe(file).points for file in files), most).cloud
