"""What each stage of a run holds, writes meanwhile, and takes: upper bounds and rough rates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from dougong.pipeline.left_out import PLACE_BYTES
from dougong.pipeline.memory import (
    Room,
    estimated_bytes,
    registering_bytes,
    tiles_bytes,
)
from dougong.pipeline.reduced import most_points
from dougong.pipeline.sides import HALO_SHARE, TILE_ROW_BYTES
from dougong.typing import Kind

Way = Literal["in memory", "on tiles", "too large"]

# CPU seconds per million points, measured on one core (LAZ, a scanned hall of 3e6 points; what
# follows the filters: benchmarks/large_site.py at 1e7).
_READ, _TILES, _WRITE, _MERGE, _HASH = 0.6, 1.2, 1.4, 1.5, 0.4
_FILTER = {"lidar": 3.6, "photogrammetry": 3.9}
_PAIR_SECONDS, _DISTANCE_SECONDS, _REPORT_SECONDS = 20.0, 4.0, 5.0
_SPOOL_ROW_BYTES = 24
"""Of a point on disk beside its record: its coordinates."""
_CUT_ROW_BYTES = 76
"""Of a point on disk besides, while it is cut or filtered: in two cuts, or in its tile with what
the filters said of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFile:
    """One input file and how it would be worked on."""

    path: str
    cloud: str
    kind: Kind
    points: int
    bytes: int
    stations: int
    way: Way
    tile_points: int | None
    """Most points of a tile; None: no tiles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedStage:
    """One stage of a run."""

    name: str
    tiles: int
    """About so many; 0: in memory."""
    memory_bytes: int
    work_bytes: int
    """Disk in use meanwhile."""
    seconds: float
    """CPU seconds."""


def every_point(file: PlannedFile) -> int:
    """Return the points that the filters leave at most."""
    return file.points


def surely_kept(file: PlannedFile) -> int:
    """Return the points that the filters leave at least: a voxel grid may take nearly all."""
    return 0 if file.kind == "lidar" else file.points // 2


def planned_stages(
    files: Sequence[PlannedFile],
    row_bytes: Mapping[str, int],
    room: Room,
    *,
    full: bool,
    kept: Callable[[PlannedFile], int] = every_point,
) -> tuple[PlannedStage, ...]:
    """Return the stages of a run in order.

    Parameters
    ----------
    files : sequence of PlannedFile
    row_bytes : mapping of str to int
        Bytes of a record, by path.
    room : Room
    full : bool
        Every file is written again at full resolution.
    kept : callable
        Returns how many points the filters leave of a file.
    """
    stages: list[PlannedStage] = []
    left = [replace(file, points=kept(file)) for file in files]
    waiting = kept_bytes = 0
    for file, after in zip(files, left, strict=True):
        stages.append(_filter_stage(file, row_bytes[file.path], waiting, kept_bytes))
        if file.way == "on tiles":
            kept_bytes += after.points * (row_bytes[file.path] + _SPOOL_ROW_BYTES)
        else:
            waiting += file.points
    return (*stages, *stages_after(left, row_bytes, room, kept_bytes, full=full))


def _filter_stage(file: PlannedFile, row: int, waiting: int, kept_bytes: int) -> PlannedStage:
    millions = file.points / 1e6
    seconds = (_READ + _FILTER[file.kind]) * millions
    books = 2 * file.points
    if file.tile_points is None:
        memory = estimated_bytes([file.points, waiting])
        return PlannedStage(
            name=f"filter {file.cloud}",
            tiles=0,
            memory_bytes=memory,
            work_bytes=kept_bytes + books,
            seconds=seconds,
        )
    return PlannedStage(
        name=f"filter {file.cloud}",
        tiles=_tiles(file.points, file.tile_points),
        memory_bytes=tiles_bytes(file.tile_points, waiting),
        work_bytes=kept_bytes + books + file.points * (row + _SPOOL_ROW_BYTES + _CUT_ROW_BYTES),
        seconds=seconds + (_TILES + _READ) * millions,
    )


def _tiles(points: int, most: int) -> int:
    """Return about how many tiles hold `points`, each with its halo at most `most`."""
    return max(1, -(-points * HALO_SHARE // most))


def stages_after(
    files: Sequence[PlannedFile],
    row_bytes: Mapping[str, int],
    room: Room,
    kept_bytes: int,
    *,
    full: bool,
) -> list[PlannedStage]:
    """Return the stages behind the filters, which left `files` of `kept_bytes` on disk."""
    held = [file.points for file in files if file.way != "on tiles"]
    points = sum(file.points for file in files)
    records = sum(file.points * row_bytes[file.path] for file in files)
    largest = max((file.points * row_bytes[file.path] for file in files), default=0)
    clouds = len({file.cloud for file in files})
    most = room.held_points(sum(held))
    whole = estimated_bytes(held)
    parts = tiles_bytes(min(points, most), sum(held))
    reduced = sum(min(file.points, most_points(clouds)) for file in files if file.way == "on tiles")
    registering = max(whole, registering_bytes(reduced, sum(held)))
    is_cut = points > most
    millions = points / 1e6
    pairs = max(clouds - 1, 0)
    rows: list[tuple[str, int, int, int, float]] = []
    if pairs:
        rows += [
            ("register", 0, registering, 0, _PAIR_SECONDS * pairs + 0.3 * millions),
            ("distances", 0, registering, 0, _DISTANCE_SECONDS * pairs),
        ]
        tiles = _tiles(points, most) if is_cut else 0
        disk = points * (TILE_ROW_BYTES + PLACE_BYTES) if is_cut else 0
        rows.append(("merge", tiles, parts if is_cut else whole, disk, _MERGE * millions))
    tail = parts if is_cut else whole
    rows.append(("write", 0, tail, 2 * records if is_cut else 0, 2.0 * _WRITE * millions))
    if full:
        rows.append(("full resolution", 0, whole, 0, (_READ + _WRITE) * millions))
    rows.append(("hash", 0, tail, largest if is_cut else 0, _HASH * millions))
    rows.append(("report", 0, whole, 0, _REPORT_SECONDS))
    books = 2 * points
    return [
        PlannedStage(
            name=name,
            tiles=tiles,
            memory_bytes=memory,
            work_bytes=kept_bytes + books + disk,
            seconds=seconds,
        )
        for name, tiles, memory, disk, seconds in rows
    ]
