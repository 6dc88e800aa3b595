"""``dougong transform``: one file moved by a registration."""

from pathlib import Path
from typing import Any

from dougong.cloud import Frame
from dougong.formats import (
    can_reissue,
    is_same_crs,
    read,
    reissue,
    scans_in,
    write,
)
from dougong.pipeline.memory import refuse_too_large
from dougong.pipeline.outputs import refuse_output, watched
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import stem
from dougong.pipeline.registrations import finite, read_registration


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
        notes.append(
            f"the registration is {known.status}; its best pose is applied: {known.reason}"
        )
    scans = scans_in(input)[0]
    if scans > 1 and known.source != stem(input):
        notes.append(
            f"{input.name} holds {scans} scans, and the registration is that of {known.source}: "
            "all of them are moved by it, which is right only if they lie in one frame"
        )
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
