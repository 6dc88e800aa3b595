"""``dougong transform``: one file moved by a registration."""

from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Frame
from dougong.errors import FormatError, FrameError, InputError
from dougong.formats import (
    can_reissue,
    describe,
    is_same_crs,
    metric_problem,
    read,
    reissue,
    scans_in,
    system_in,
    units_of,
    write,
)
from dougong.formats.stream import opened, stem_of
from dougong.formats.unfinished import watched
from dougong.formats.units import METRES
from dougong.pipeline.memory import refuse_too_large
from dougong.pipeline.outputs import finite, refuse_output
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import Stamp, require_unchanged, sha256, stamp_of
from dougong.pipeline.registrations import Known, Unit, read_registration


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
        The registration is not sure and `accept_best` is False, the output exists, or the file is
        the one that stays.
    RegistrationError
        The registration failed: there is no pose.
    FormatError
        The file cannot be read, or is replaced meanwhile.
    FrameError
        The file is in degrees or earth-centred coordinates, or in other units than the matrix.
    """
    known = read_registration(matrix, accept_best=accept_best)
    refuse_output(input, output, [output], overwrite)
    with opened(input):  # what cannot be is said as every command says it
        stamp = stamp_of(input)
    scans = scans_in(input)[0]
    notes = _doubts(input, scans, known)
    frame = Frame(crs=known.target_crs, unit_m=known.target_unit_m)
    with watched(output):
        if can_reissue(input, output):
            progress.stage(f"moving {input.name} in chunks")
            matrices = [known.matrix] * scans
            written = reissue(input, output, matrices, frame, overwrite=overwrite)
        else:
            refuse_too_large([input], memory_bytes)
            progress.stage(f"reading {input.name}")
            cloud = read(input)
            notes += cloud.notes
            progress.stage(f"writing {output.name}")
            written = write(cloud.moved(known.matrix, frame), output, overwrite=overwrite)
        _require_unchanged(input, stamp, output)
    document: dict[str, Any] = finite(
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
    return document


def _require_unchanged(input: Path, stamp: Stamp, output: Path) -> None:
    """Take back what was made of a file that was replaced meanwhile.

    Raises
    ------
    FormatError
        It was: it is passed over twice, and the output may hold some of both.
    """
    try:
        require_unchanged(input, stamp)
    except FormatError:
        output.unlink(missing_ok=True)
        raise


def _doubts(input: Path, scans: int, known: Known) -> list[str]:
    """Return why the file may not be what the matrix is for, in words.

    Raises
    ------
    FrameError
        As `transform_file`.
    """
    digest = sha256(input) if known.inputs else ""
    _refuse_target(input, digest, known)
    crs, unit_m = system_in(input)
    _require_unit(input, crs, unit_m, known)
    notes = [
        *known.notes,
        *_file_notes(input, digest, known),
        *_system_notes(input, crs, unit_m, known),
    ]
    is_place = known.target_crs is not None and not units_of(known.target_crs).is_local
    if is_place and is_same_crs(crs, known.target_crs):
        notes.append(
            f"{input.name} is in {known.target}'s coordinate system already; check that it is "
            "not moved twice"
        )
    if known.status != "ok":
        notes.append(
            f"the registration is {known.status}; its best pose is applied: {known.reason}"
        )
    if scans > 1 and known.source != stem_of(input):
        notes.append(
            f"{input.name} holds {scans} scans, and the registration is that of {known.source}: "
            "all of them are moved by it, which is right only if they lie in one frame"
        )
    return notes


def _refuse_target(input: Path, digest: str, known: Known) -> None:
    """Refuse the file, of this SHA-256, onto which another one was registered.

    Raises
    ------
    InputError
        It is that.
    """
    registered = {stem_of(Path(str(one.get("path")))): one.get("sha256") for one in known.inputs}
    if registered.get(known.target) != digest or registered.get(known.source) == digest:
        return
    msg = (
        f"{input.name} is {known.target}, onto which {known.source} was registered: it stays, and "
        f"the matrix is for {known.source}."
    )
    raise InputError(msg)


def _require_unit(input: Path, crs: str | None, unit_m: Unit | None, known: Known) -> None:
    """Refuse a file in other units than the coordinates that the matrix takes.

    Raises
    ------
    FrameError
        As `transform_file`.
    """
    units = units_of(crs)
    if units.is_geographic or units.is_geocentric:
        info, nowhere = describe(input), (0.0, 0.0, 0.0)
        low, high = info.extent_min or nowhere, info.extent_max or nowhere
        raise FrameError(metric_problem(crs, low, high, input.name))
    if unit_m is None or known.source_unit_m is None:
        return
    # A foot differs in its last digits with the text that names it; US and international by 2e-6.
    if np.allclose(unit_m, known.source_unit_m, rtol=1e-9, atol=0.0):
        return
    own = _unit_name(unit_m) + (f" ({units.name})" if units.name else "")
    source = known.source or "its source"
    told = f" {known.without_source}: metres are expected." if known.without_source else ""
    msg = (
        f"{input.name} is in {own}, and the matrix takes the coordinates of {source}, in "
        f"{_unit_name(known.source_unit_m)}. Convert {input.name} to those, or register it "
        f"itself.{told}"
    )
    raise FrameError(msg)


def _unit_name(unit_m: Unit) -> str:
    """Return metres per unit of plan and heights in words."""
    plan, height = (
        "metres" if value == 1.0 else f"units of {value:.9g} m" for value in (unit_m[0], unit_m[2])
    )
    return plan if plan == height else f"{plan} with heights in {height}"


def _file_notes(input: Path, digest: str, known: Known) -> list[str]:
    """Return what is to be said of a file that is called as a registered one, and is another."""
    # By the name alone: the path is as it was given then, and may be of another machine.
    digests = [
        one.get("sha256") for one in known.inputs if Path(str(one.get("path"))).name == input.name
    ]
    if not digests or digest in digests:
        return []
    return [
        f"{input.name} is not the file that was registered under this name (its SHA-256 is "
        "another): the matrix is right only if its coordinates are those of that one"
    ]


def _system_notes(input: Path, crs: str | None, unit_m: Unit | None, known: Known) -> list[str]:
    """Return what is to be said of a file that is in another system, or names none."""
    if crs is not None and known.source_crs is not None and not is_same_crs(crs, known.source_crs):
        names = [units_of(one).name or "an unnamed system" for one in (crs, known.source_crs)]
        return [
            f"{input.name} is in {names[0]}, and the matrix takes coordinates in {names[1]}: that "
            "is right only if the numbers of both mean the same places"
        ]
    if unit_m is None and known.source_unit_m not in (None, METRES):
        return [
            f"{input.name} names no coordinate system: its numbers are taken for those of "
            f"{known.source}, in {_unit_name(known.source_unit_m)}"
        ]
    return []
