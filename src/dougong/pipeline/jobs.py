"""The jobs on single files: filter one, move one, register one onto another."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dougong.cloud import Cloud, Frame
from dougong.errors import InputError, OutputError
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.selection import Reason
from dougong.formats import (
    WRITABLE,
    can_reissue,
    describe,
    faults_of,
    in_system,
    is_same_crs,
    read,
    reissue,
    scans_in,
    write,
)
from dougong.params import Parameters
from dougong.pipeline.control import read_control, require_control_of
from dougong.pipeline.distances import distances_document, measure, write_distances
from dougong.pipeline.exports import Ends, write_registration
from dougong.pipeline.guess import guess_kind
from dougong.pipeline.marking import GROUND_CLASS, marked, with_classes
from dougong.pipeline.memory import Room, refuse_too_large
from dougong.pipeline.outputs import refuse_existing, watched, write_json
from dougong.pipeline.pairs import read_pairs
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import stem
from dougong.pipeline.provenance import Clock, peak_memory_bytes, sha256, software
from dougong.pipeline.recipes import (
    LidarRecipe,
    PhotogrammetryRecipe,
    Recipe,
    filter_cloud,
    lidar_after_grid,
)
from dougong.pipeline.registering import register
from dougong.pipeline.registrations import finite, read_registration, to_document
from dougong.pipeline.removed import detail_counts
from dougong.pipeline.settings import parse_overrides, updated, validated
from dougong.pipeline.single import filter_name, filter_single, single_fields, single_parameters
from dougong.pipeline.steps import Filtered
from dougong.pipeline.tiled import (
    FilteredOnTiles,
    GridFirst,
    filter_chunks,
    is_too_large,
    stations_of,
)
from dougong.registration import Register
from dougong.registration.free_scale_result import in_found_unit
from dougong.typing import Kind

DISTANCES = "distances.laz"


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterJob:
    """A sensor's recipe, or one filter alone."""

    kind: Kind | None
    only: str | None
    params: Parameters

    def run(self, cloud: Cloud, progress: Progress) -> Filtered:
        """Filter `cloud`."""
        if self.only is not None:
            return filter_single(cloud, self.only, self.params, progress)
        assert self.kind is not None
        recipe = Recipe().model_copy(update={self.kind: self.params})
        return filter_cloud(cloud, self.kind, recipe, progress)

    def grid_first(self) -> GridFirst | None:
        """Return the job as tiles can do it, or None where it does not begin with a voxel grid."""
        if isinstance(self.params, OctreeVoxelGrid):
            return GridFirst(grid=self.params, after=lambda _: None)
        if self.only is None and isinstance(self.params, LidarRecipe):
            recipe = self.params
            return GridFirst(
                grid=recipe.octree_voxel_grid, after=lambda bench: lidar_after_grid(bench, recipe)
            )
        return None


def filter_job(kind: Kind | None, only: str | None, settings: Sequence[str]) -> FilterJob:
    """Return what ``dougong filter`` was asked for.

    Raises
    ------
    InputError
        Neither a kind nor a filter is named, or a setting is wrong.
    """
    if only is not None:
        name = filter_name(only)
        values = parse_overrides(settings, {name: single_fields(name)})
        return FilterJob(kind=kind, only=name, params=single_parameters(name, values.get(name, {})))
    if kind is None:
        msg = (
            "--kind is missing: say which sensor made the cloud, --kind lidar or "
            "--kind photogrammetry, or name one filter with --only."
        )
        raise InputError(msg)
    recipe: LidarRecipe | PhotogrammetryRecipe = getattr(Recipe(), kind)
    fields = {name: list(type(getattr(recipe, name)).model_fields) for name in _filters_of(recipe)}
    changes = {
        name: updated(getattr(recipe, name), values, name)
        for name, values in parse_overrides(settings, fields).items()
    }
    return FilterJob(kind=kind, only=None, params=recipe.model_copy(update=changes))


def _filters_of(recipe: Parameters) -> list[str]:
    return list(type(recipe).model_fields)


def refuse_output(input: Path, output: Path, files: Sequence[Path], overwrite: bool) -> None:
    """Refuse an output that could not be written, before any work is done.

    Raises
    ------
    InputError
        It is the input, one of `files` exists already, the folder is missing, or the suffix is
        not one that is written.
    OutputError
        The folder may not be written.
    """
    if output.exists() and input.exists() and output.samefile(input):
        msg = f"{output} is the input itself; inputs are never overwritten. Name another output."
        raise InputError(msg)
    if output.is_dir():
        msg = f"{output} is a folder. Name a file in it."
        raise InputError(msg)
    refuse_existing(files, overwrite)
    if not output.name.lower().endswith(WRITABLE):
        msg = f"{output.name} cannot be written: clouds are written as {', '.join(WRITABLE)}."
        raise InputError(msg)
    if not output.parent.is_dir():
        msg = f"{output.parent} is not a folder, so {output.name} cannot be written. Make it first."
        raise InputError(msg)
    if not os.access(output.parent, os.W_OK):
        msg = f"{output.parent} may not be written by this user. Change its permissions."
        raise OutputError(msg)


def filter_file(
    input: Path,
    output: Path,
    *,
    job: FilterJob,
    mark: bool,
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
) -> dict[str, Any]:
    """Filter one file into another and write its books beside it (``OUTPUT.json``).

    Raises
    ------
    InputError
        An output exists, or the job needs more memory than it may use.
    FormatError, OutputError
        The input cannot be read, the output not written (a full disk).
    """
    books = output.with_name(output.name + ".json")
    refuse_output(input, output, [output, books], overwrite)
    clock = Clock()
    progress.stage(f"reading {input.name}")
    with clock.measure("read"):
        digest = sha256(input)
    room, tiled = Room.of(memory_bytes), job.grid_first()
    if tiled is not None and not mark and is_too_large(input, room, 0):
        progress.note(f"{input.name} is larger than memory: its voxel grid runs on tiles")
        with clock.measure("filter"):
            found = _filtered_on_tiles(input, tiled, room, output.parent, progress)
        filtered, noticed, result = found.filtered, found.notes, found.filtered.cloud
    else:
        refuse_too_large([input], memory_bytes)
        with clock.measure("read"):
            cloud = read(input)
            noticed = (*cloud.notes, *faults_of(cloud))
        with clock.measure("filter"):
            filtered = job.run(cloud, progress)
        result = _chosen(job, cloud, filtered, mark)
    points_in = len(filtered.codes)
    progress.stage(f"writing {output.name}")
    with watched(output, books):
        with clock.measure("write"):
            written = write(result, output, overwrite=overwrite)
        document: dict[str, Any] = {
            "input": {"path": str(input), "sha256": digest, "points": points_in},
            "output": str(output),
            "kind": job.kind,
            "only": job.only,
            "is_marked": mark,
            "points_in": points_in,
            "points_kept": len(filtered.cloud),
            "points_written": len(result),
            "reduction": 1.0 - len(filtered.cloud) / points_in,
            "stages": [
                {
                    "name": stage.name,
                    "points_in": stage.points_in,
                    "points_out": stage.points_out,
                    "reduction": stage.reduction,
                    "seconds": stage.seconds,
                }
                for stage in filtered.stages
            ],
            "reasons": reason_table(filtered),
            "ground_points": int(filtered.is_ground.sum()),
            "parameters": job.params.model_dump(mode="json"),
            "notes": [*noticed, *filtered.notes, *written.notes],
            "seconds": {**clock.seconds, "total": clock.total()},
            "peak_memory_bytes": peak_memory_bytes(),
            "software": software(),
        }
        document = finite(document)
        write_json(books, document)
    return document


def _filtered_on_tiles(
    input: Path, job: GridFirst, room: Room, scratch: Path, progress: Progress
) -> FilteredOnTiles:
    (chunks,) = stations_of(input, split=False)
    return filter_chunks(
        chunks,
        job,
        points=describe(input).points,
        room=room,
        waiting=0,
        scratch=scratch,
        progress=progress,
    )


def reason_table(filtered: Filtered) -> dict[str, dict[str, Any]]:
    """Return per reason its code in ``dougong_reason`` and the points it took, in detail too."""
    table: dict[str, dict[str, Any]] = {}
    for reason in Reason:
        chosen = filtered.codes == reason
        if not chosen.any():
            continue
        row: dict[str, Any] = {"code": int(reason), "points": int(chosen.sum())}
        if reason == Reason.CURVATURE_WEIGHTED:
            row["details"] = detail_counts(filtered.codes, filtered.details)
        table[reason.name.lower()] = row
    return table


def _chosen(job: FilterJob, cloud: Cloud, filtered: Filtered, mark: bool) -> Cloud:
    """Return what is written: the kept points, or all points with their marks."""
    if mark:
        return marked(cloud, filtered.codes, filtered.ground_class, filtered.details)
    if job.only == "cloth_simulation" and getattr(job.params, "keep", "") == "all":
        # Alone, the cloth takes nothing out: its answer is the class.
        return with_classes(filtered.cloud, [(filtered.is_ground, GROUND_CLASS)])
    return filtered.cloud


def transform_file(
    input: Path,
    output: Path,
    matrix: Path,
    *,
    accept_best: bool,
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
) -> dict[str, Any]:
    """Move one file by a registration.

    Raises
    ------
    InputError
        The registration is not sure and `accept_best` is False, or the output exists.
    RegistrationError
        The registration failed: there is no pose.
    """
    known = read_registration(matrix, accept_best=accept_best)
    refuse_output(input, output, [output], overwrite)
    notes = []
    if known.target_crs is not None and is_same_crs(scans_in(input)[1], known.target_crs):
        notes.append(
            f"{input.name} is in {known.target}'s coordinate system already; check that it is "
            "not moved twice"
        )
    if known.status != "ok":
        notes.append(f"the pose is the best of several ({known.status}): {known.reason}")
    frame = Frame(crs=known.target_crs, unit_m=known.target_unit_m)
    with watched(output):
        if can_reissue(input, output):
            progress.stage(f"moving {input.name} in chunks")
            matrices = [known.matrix] * scans_in(input)[0]
            written = reissue(input, output, matrices, frame, overwrite=overwrite)
        else:
            refuse_too_large([input], memory_bytes)
            progress.stage(f"reading {input.name}")
            cloud = read(input)
            notes += cloud.notes
            progress.stage(f"writing {output.name}")
            written = write(cloud.moved(known.matrix, frame), output, overwrite=overwrite)
    return finite_document(
        {
            "input": str(input),
            "output": str(output),
            "points": written.points,
            "status": known.status,
            "matrix": known.matrix,
            "source": known.source,
            "target": known.target,
            "notes": [*notes, *written.notes],
        }
    )


def finite_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document as JSON can hold it."""
    cleaned: dict[str, Any] = finite(document)
    return cleaned


def register_files(
    source: Path,
    target: Path,
    out: Path,
    *,
    options: Mapping[str, Any],
    source_kind: Kind | None,
    target_kind: Kind | None,
    memory_bytes: int | None,
    progress: Progress,
    pairs: Path | None = None,
    control: Path | None = None,
    crs: tuple[str | None, str | None] = (None, None),
) -> dict[str, Any]:
    """Register one file onto another; write ``registration.json`` into the folder `out`.

    Raises
    ------
    InputError
        A setting, the file of picked pairs or the control file is wrong, or the job needs more
        memory than it may use.
    FormatError, FrameError, RegistrationError
        The clouds cannot be read or combined.
    """
    params = validated(Register, options, "register")
    picked = None if pairs is None else read_pairs(pairs, stem(source))
    surveyed = None
    if control is not None:
        surveyed = require_control_of(read_control(control), control, stem(source))
    refuse_too_large([source, target], memory_bytes)
    clouds: list[Cloud] = []
    kinds: list[Kind] = []
    inputs = []
    notes = []
    asked = ((source, source_kind, crs[0]), (target, target_kind, crs[1]))
    for path, kind, system in asked:
        progress.stage(f"reading {path.name}")
        cloud = in_system(read(path), system)
        clouds.append(replace(cloud, name=stem(path)))
        if kind is None:
            kind, why = guess_kind(describe(path))
            notes.append(f"{path.name} is taken for {kind} ({why})")
        kinds.append(kind)
        inputs.append({"path": str(path), "sha256": sha256(path), "points": len(cloud)})
        notes += [f"{path.name}: {note}" for note in (*cloud.notes, *faults_of(cloud))]
    progress.stage(f"registering {source.name} onto {target.name}")
    result = register(
        clouds[0],
        clouds[1],
        params,
        source_kind=kinds[0],
        target_kind=kinds[1],
        pairs=picked,
        control=surveyed,
    )
    document = to_document(
        replace(result, notes=(*notes, *result.notes)),
        source=clouds[0].name,
        target=clouds[1].name,
        target_frame=clouds[1].frame,
        inputs=inputs,
    )
    measured = None
    if result.status == "ok" or params.accept_best:
        progress.stage(f"measuring {source.name} against {target.name}")
        one, two, metric = in_found_unit(result, clouds)
        measured = measure(one, two, metric)
    if measured is not None:
        write_distances(measured, out / DISTANCES)
    document |= {
        "distances": None if measured is None else distances_document(measured, DISTANCES),
        "kinds": {"source": kinds[0], "target": kinds[1]},
        "peak_memory_bytes": peak_memory_bytes(),
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "software": software(),
    }
    ends = Ends(
        source=clouds[0].name,
        target=clouds[1].name,
        source_frame=clouds[0].frame,
        target_frame=clouds[1].frame,
        files=[str(source.resolve())],
    )
    write_registration(out, "registration", document, ends)
    return document
