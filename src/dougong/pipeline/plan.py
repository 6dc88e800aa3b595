"""What a run would do: which clouds are held and which go on tiles, memory, disk, time.

Nothing is decoded but what counting needs. The numbers are upper bounds or rough: how many points
the voxel grid leaves is known only once it ran.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dougong._words import counted
from dougong.formats import FileInfo, describe
from dougong.formats.stream import refuse_empty
from dougong.pipeline.memory import Room, estimated_bytes
from dougong.pipeline.plan_stages import (
    PlannedFile,
    PlannedStage,
    Way,
    planned_stages,
    surely_kept,
)
from dougong.pipeline.project import Entry, Project, files_of
from dougong.threads import get_threads

_PARALLEL = 0.8
"""Share of that work which threads divide."""

_OUT_BYTES_PER_POINT = 12
"""Of compressed points with colour; every kept point is written twice (its cloud, merged)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a run would do."""

    files: tuple[PlannedFile, ...]
    reference: str
    """Name of the project's cloud whose frame the result is in."""
    stages: tuple[PlannedStage, ...]
    memory_bytes: int
    """Peak, estimated."""
    memory_limit_bytes: int | None
    """What ``--memory`` allows, or four fifths of what is free; None: unknown."""
    work_bytes: int
    """Temporary, at most."""
    sure_work_bytes: int
    """Temporary, at least: as if nothing were left of the scans and half of the drone clouds."""
    out_bytes: int
    """Of the result, at most: as if the filters took nothing."""
    seconds: float
    """Rough, from rates measured on one machine, for the threads in use."""
    refusal: str | None
    """Why the run would be refused; None: it would start."""

    def document(self) -> dict[str, Any]:
        """Return the plan as plain data."""
        return {**asdict(self), "duration": minutes(self.seconds)}

    def in_words(self) -> str:
        """Return the plan in one sentence."""
        tiled = sum(file.way == "on tiles" for file in self.files)
        return (
            f"{counted(sum(file.points for file in self.files))} in "
            f"{counted(len(self.files), 'file')}"
            f"{f', {tiled} of them on tiles' if tiled else ''}: about "
            f"{self.memory_bytes / 1e9:.1f} GB of memory and {minutes(self.seconds)} "
            "(rough; `dougong plan` says more)"
        )


def minutes(seconds: float) -> str:
    """Return a rough duration in words."""
    if seconds < 90:
        return f"{max(10, 10 * round(seconds / 10))} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def plan_run(
    project: Project, folder: Path, room: Room, shown: Callable[[Path], str] = str
) -> Plan:
    """Return what `run` would do with `project`, whose paths are relative to `folder`.

    Raises
    ------
    InputError, FormatError
        A pattern finds no file, or a file cannot be read or holds no points.
    """
    files: list[PlannedFile] = []
    row_bytes: dict[str, int] = {}
    refusals: list[str] = []
    for entry in project.cloud:
        for path in files_of(entry, folder):
            told = describe(path)
            refuse_empty(told.points, path)
            planned, refusal = _planned(entry, told, room, _held(files), shown(path))
            files.append(planned)
            row_bytes[planned.path] = _row_bytes(told)
            refusals += [refusal] if refusal else []
    full = project.project.full_resolution
    stages = planned_stages(files, row_bytes, room, full=full)
    surely = planned_stages(files, row_bytes, room, full=full, kept=surely_kept)
    most = max(stages, key=lambda stage: stage.memory_bytes)
    if room.is_asked and most.memory_bytes > room.bytes:
        refusals.append(
            f"the stage {most.name!r} needs about {most.memory_bytes / 1e9:.1f} GB, more than "
            f"{room.name()}, however small the tiles. Raise it."
        )
    return Plan(
        files=tuple(files),
        reference=project.reference(),
        stages=stages,
        memory_bytes=max(stage.memory_bytes for stage in stages),
        memory_limit_bytes=None if room.bytes == float("inf") else int(room.bytes),
        work_bytes=max(stage.work_bytes for stage in stages),
        sure_work_bytes=max(stage.work_bytes for stage in surely),
        out_bytes=_out_bytes(files, full),
        seconds=_wall(sum(stage.seconds for stage in stages)),
        refusal=refusals[0] if refusals else None,
    )


def _held(files: Sequence[PlannedFile]) -> int:
    """Return the points known to wait in memory behind `files`."""
    return sum(file.points for file in files if file.way == "in memory")


def _planned(
    entry: Entry, told: FileInfo, room: Room, waiting: int, path: str
) -> tuple[PlannedFile, str | None]:
    way: Way = "in memory"
    tile_points, refusal = None, None
    if not room.holds(told.points, waiting):
        most = room.most_tile_points(waiting)
        if most is not None:
            way, tile_points = "on tiles", most
        else:
            way = "too large"
            need = estimated_bytes([told.points, waiting])
            refusal = (
                f"{path}: {told.points:,} points need about {need / 1e9:.1f} GB, more than "
                f"{room.name()}, however small the tiles. Raise it."
            )
    planned = PlannedFile(
        path=path,
        cloud=entry.name,
        kind=entry.kind,
        points=told.points,
        bytes=told.bytes,
        stations=told.stations,
        way=way,
        tile_points=tile_points,
    )
    # What only most of the free memory speaks against is tried all the same.
    return planned, refusal if room.is_asked else None


def _row_bytes(told: FileInfo) -> int:
    """Return how many bytes one record takes at most: packed bits count as bytes."""
    return sum(np.dtype(layout).itemsize for layout in told.attributes.values())


def _out_bytes(files: Sequence[PlannedFile], full: bool) -> int:
    copies = sum(file.bytes for file in files) if full else 0
    return 2 * _OUT_BYTES_PER_POINT * sum(file.points for file in files) + copies


def _wall(cpu_seconds: float) -> float:
    return cpu_seconds * (1.0 - _PARALLEL + _PARALLEL / get_threads())
