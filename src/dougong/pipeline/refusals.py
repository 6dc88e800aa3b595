"""What a run is refused for before it starts, and again when it is known what the filters left."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from dougong.errors import InputError, OutputError
from dougong.pipeline.memory import Room
from dougong.pipeline.movers import Mover
from dougong.pipeline.plan import Plan, plan_run
from dougong.pipeline.plan_stages import PlannedFile, stages_after
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import Project, files_of

LONG_SECONDS = 120.0
"""A run that may take longer is announced with its plan."""
_QUICK_BYTES = 100_000_000
_FULL_ROOM = 1.1
"""Part of the inputs' size that their new issue may need: LAZ of floats can be larger."""


def refuse_or_announce(
    project: Project, folder: Path, room: Room, work: Path, progress: Progress
) -> None:
    """Plan a run whose files are many bytes: refuse what cannot be, say what takes long.

    Raises
    ------
    InputError, OutputError
        It needs more memory than the user allows, or more disk than there is.
    """
    files = [file for entry in project.cloud for file in files_of(entry, folder)]
    size = sum(file.stat().st_size for file in files if file.is_file())
    if not room.is_asked and size < _QUICK_BYTES:
        return  # counting the points of some formats takes a pass over them
    plan = plan_run(project, folder, room)
    if plan.refusal is not None:
        raise InputError(plan.refusal)
    _refuse_full_work_disk(plan, work, progress)
    if plan.seconds > LONG_SECONDS:
        progress.note(plan.in_words())


def _refuse_full_work_disk(plan: Plan, work: Path, progress: Progress) -> None:
    """Refuse a run for which the disk surely has no room, before it starts.

    Where only the upper bound does not fit, which is as if the filters took nothing, the run goes
    on, says so, and asks again when they are done.

    Raises
    ------
    OutputError
        The disk of `work`, beside which the result lies as a rule, has less free than is needed.
    """
    folder, free = _free(work)
    if plan.sure_work_bytes > free:
        raise _too_full(folder, free, "the run needs", plan.sure_work_bytes, "--work")
    # The bound of the result counts on points that compress badly: half of it is usual.
    most = max(plan.work_bytes, (plan.work_bytes + plan.out_bytes) // 2)
    if most > free:
        progress.note(
            f"{folder} has {free / 1e9:.1f} GB free, and the run needs up to {most / 1e9:.1f} GB, "
            "less where the filters take much; that is looked at again when they are done"
        )


def refuse_full_disk_after_filters(
    movers: Sequence[Mover], room: Room, work: Path, *, full: bool
) -> None:
    """Refuse to go on where the disk has no room for what the filters left.

    Raises
    ------
    OutputError
        The finished filters stay where they are: the same command goes on from there.
    """
    left, row_bytes = [], {}
    for mover in movers:
        for number, source in enumerate(mover.sources):
            path = f"{mover.name} {number}"
            left.append(_left(path, mover, source.kept.points, is_held=source.kept.is_held))
            row_bytes[path] = source.kept.first.records.dtype.itemsize
    need = max(s.work_bytes for s in stages_after(left, row_bytes, room, 0, full=full))
    folder, free = _free(work)
    if need > free:
        raise _too_full(folder, free, "what the filters left need", need, "--work")


def _left(path: str, mover: Mover, points: int, *, is_held: bool) -> PlannedFile:
    return PlannedFile(
        path=path,
        cloud=mover.name,
        kind=mover.kind,
        points=points,
        bytes=0,
        stations=1,
        way="in memory" if is_held else "on tiles",
        tile_points=None,
    )


def refuse_full_disk(files: Sequence[Path], out: Path) -> None:
    """Refuse a run whose files at full resolution do not fit the disk, before it starts.

    Raises
    ------
    OutputError
        They do not: the message says what is needed and what is free.
    """
    need = int(sum(file.stat().st_size for file in files) * _FULL_ROOM)
    folder, free = _free(out)
    if need > free:
        options = "--out, or leave --full-resolution out"
        raise _too_full(folder, free, "the clouds at full resolution need", need, options)


def _free(path: Path) -> tuple[Path, int]:
    """Return the nearest folder of `path` that is there, and the bytes free on its disk."""
    folder = next(p for p in (path.absolute(), *path.absolute().parents) if p.is_dir())
    return folder, shutil.disk_usage(folder).free


def _too_full(folder: Path, free: int, what: str, need: int, options: str) -> OutputError:
    return OutputError(
        f"{folder} has {free / 1e9:.3g} GB free, and {what} about {need / 1e9:.3g} GB. "
        f"Free some space or pass another {options}."
    )
