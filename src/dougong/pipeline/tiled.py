"""Filtering a laser scan that does not fit in memory.

The voxel grid runs on tiles, the other filters on what it leaves. The result is that of the whole
cloud, point by point.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.selection import Reason
from dougong.formats import describe, iterate, require_metric
from dougong.pipeline.memory import Room
from dougong.pipeline.progress import Progress
from dougong.pipeline.removed import removed_sample
from dougong.pipeline.steps import Bench, Filtered, StageCount
from dougong.tiles.decimate import Decimated, Spool, decimate

CHUNK_POINTS = 1_000_000
_LEAST_BYTES_PER_POINT = 4
"""No format packs points of a real scan into less."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridFirst:
    """A job that begins with the voxel grid: what tiles can do."""

    grid: OctreeVoxelGrid
    after: Callable[[Bench], None]
    """The filters behind it, on the points that it leaves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredOnTiles:
    """A filtered cloud, and what was noticed on the way."""

    filtered: Filtered
    notes: tuple[str, ...]
    """Of the reader, then the faults that were handled."""
    removed: Cloud
    """A sample of what was taken out, see `removed_sample`."""


def is_too_large(file: Path, room: Room, waiting: int) -> bool:
    """Say whether `file` as a whole does not fit beside clouds of `waiting` points.

    Only a file of many bytes is looked into: counting the points of some formats is a pass over it.
    """
    most = file.stat().st_size // _LEAST_BYTES_PER_POINT if file.is_file() else 0
    return not room.holds(most, waiting) and not room.holds(describe(file).points, waiting)


def stations_of(file: Path, *, split: bool) -> Iterator[Iterator[Cloud]]:
    """Yield the chunks of each cloud of `file`: of each scan of an E57 file, or of all as one.

    Raises
    ------
    FormatError
        The file cannot be read.
    InputError
        Its scans are wanted as one cloud, but have different attributes.
    """
    chunks = iterate(file, CHUNK_POINTS)
    if split:
        for _, group in groupby(chunks, lambda cloud: getattr(cloud.header, "station", 0)):
            yield group
    elif len_stations(file) > 1:
        yield _marked_with_station(chunks, file)
    else:
        yield chunks


def len_stations(file: Path) -> int:
    """Return how many scans a file keeps apart."""
    return describe(file).stations if file.suffix.lower() in (".e57", ".ptx") else 1


def _marked_with_station(chunks: Iterator[Cloud], file: Path) -> Iterator[Cloud]:
    """Give each point its station, as the whole file's reader does; all scans need one layout."""
    layout = None
    for chunk in chunks:
        station = np.full(len(chunk), chunk.header.station, dtype="<u2")
        marked = chunk.with_attribute("station", station)
        layout = layout or marked.records.dtype
        if marked.records.dtype != layout:
            msg = (
                f"{file.name} is larger than the memory that may be used, and its stations have "
                "different attributes, which tiles cannot join. Set registered = false for it, "
                "or raise --memory."
            )
            raise InputError(msg)
        yield marked


def filter_chunks(
    chunks: Iterator[Cloud],
    job: GridFirst,
    *,
    points: int,
    room: Room,
    waiting: int,
    scratch: Path,
    progress: Progress,
) -> FilteredOnTiles:
    """Filter a cloud that comes in `chunks` without ever holding it.

    Parameters
    ----------
    chunks : iterator of Cloud
        In one frame.
    job : GridFirst
    points : int
        At most so many come.
    room : Room
    waiting : int
        Points of clouds that are held meanwhile.
    scratch : Path
        Gets a temporary folder with the cloud in it, once as decoded and once in tiles.
    progress : Progress

    Raises
    ------
    InputError
        Even tiles do not fit, or what the grid leaves does not.
    FormatError, OutputError
        The file cannot be read, `scratch` cannot be written (a full disk).
    """
    most = room.tile_points(points, waiting)
    decimated, seconds = _decimated(chunks, job.grid, most, scratch, progress)
    room.refuse_kept(len(decimated.cloud), waiting, decimated.cloud.name)
    filtered = _finished(decimated, seconds, job.after, progress)
    return FilteredOnTiles(
        filtered=filtered,
        removed=removed_sample(
            decimated.cloud,
            filtered.codes[decimated.row],
            details={name: values[decimated.row] for name, values in filtered.details.items()},
        ),
        notes=(*decimated.cloud.notes, *decimated.faults),
    )


def undecimated(
    chunks: Iterator[Cloud], codes: NDArray[np.uint8]
) -> tuple[Cloud, NDArray[np.uint8]]:
    """Return the points of `chunks` that the voxel grid left, and their codes, of all codes (n,).

    Raises
    ------
    InputError
        The codes are of another cloud.
    """
    parts, done = [], 0
    for chunk in chunks:
        is_left = codes[done : done + len(chunk)] != Reason.DECIMATED
        done += len(chunk)
        if done <= len(codes):
            parts.append(chunk.select(is_left))
    if done != len(codes):
        msg = (
            f"the finished step that --work keeps is of {len(codes):,} points, the cloud has "
            f"{done:,}. Delete the --work folder."
        )
        raise InputError(msg)
    cloud = replace(
        parts[0],
        xyz=np.concatenate([part.xyz for part in parts]),
        records=np.concatenate([part.records for part in parts]),
    )
    return cloud, codes[codes != Reason.DECIMATED]


def left_of(
    details: Mapping[str, NDArray[Any]], codes: NDArray[np.uint8]
) -> dict[str, NDArray[Any]]:
    """Return `details` (n,) of the points that the voxel grid left, by all codes (n,)."""
    is_left = codes != Reason.DECIMATED
    return {name: values[is_left] for name, values in details.items()}


def _decimated(
    chunks: Iterator[Cloud],
    grid: OctreeVoxelGrid,
    tile_points: int,
    scratch: Path,
    progress: Progress,
) -> tuple[Decimated, float]:
    scratch.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="tiles-", dir=scratch) as folder:
        spool = Spool(chunks, Path(folder))
        require_metric(spool.first)
        progress.stage(f"{spool.first.name}: octree voxel grid on tiles")
        start = time.perf_counter()
        decimated = decimate(spool, grid, tile_points)
    return decimated, time.perf_counter() - start


def _finished(
    decimated: Decimated, seconds: float, after: Callable[[Bench], None], progress: Progress
) -> Filtered:
    """Run the filters behind the grid, and book them on the whole cloud."""
    bench = Bench(decimated.cloud, progress)
    bench.voxel_count = decimated.voxel_count
    bench.stages.append(
        StageCount(
            name="octree_voxel_grid",
            points_in=decimated.points_in,
            points_out=len(decimated.cloud),
            seconds=seconds,
        )
    )
    after(bench)
    left = bench.result()
    codes = np.full(decimated.points_in, Reason.DECIMATED, dtype=np.uint8)
    codes[decimated.row] = left.codes
    ground_class = np.zeros(decimated.points_in, dtype=np.uint8)
    ground_class[decimated.row] = left.ground_class
    details = {}
    for name, values in left.details.items():
        details[name] = np.zeros(decimated.points_in, dtype=values.dtype)
        details[name][decimated.row] = values
    return replace(left, codes=codes, ground_class=ground_class, details=details)
