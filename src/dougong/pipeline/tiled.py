"""Filtering a cloud that does not fit in memory: every filter runs on tiles on disk.

The result is that of the whole cloud, point by point.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters import FILTERS
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.pass_through import PassThrough
from dougong.filters.selection import DETAILS
from dougong.formats import describe, iterate, require_metric
from dougong.pipeline.books import Binder, Books
from dougong.pipeline.memory import Room
from dougong.pipeline.progress import Progress
from dougong.pipeline.sides import HALO_SHARE
from dougong.pipeline.steps import StageCount, Step, doubts, nothing_kept
from dougong.tiles.cloud import POINTS, TiledCloud, load_tiles, read_arrays
from dougong.tiles.engine import engine_in_use
from dougong.tiles.folder import Folder
from dougong.tiles.partition import partition
from dougong.tiles.parts import state_of
from dougong.tiles.spool import Spool, remove_spool
from dougong.tiles.stages import TileBench

CHUNK_POINTS = 1_000_000
_LEAST_BYTES_PER_POINT = 4
"""No format packs points of a real scan into less."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TiledJob:
    """Filters as tiles do them."""

    grid: OctreeVoxelGrid | None
    """The voxel grid that comes first; None: every point goes on."""
    steps: tuple[Step, ...]
    """The filters behind it, in order."""


def tiled_job(steps: Sequence[Step]) -> TiledJob:
    """Return the filters of a recipe as tiles do them."""
    first = steps[0].params if steps else None
    if isinstance(first, OctreeVoxelGrid):
        return TiledJob(grid=first, steps=tuple(steps[1:]))
    return TiledJob(grid=None, steps=tuple(steps))


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
    """
    if not split:
        yield decoded(file)
        return
    chunks = iterate(file, CHUNK_POINTS)
    for _, group in groupby(chunks, lambda cloud: getattr(cloud.header, "station", 0)):
        yield group


def decoded(file: Path) -> Iterator[Cloud]:
    """Return the chunks of a file, all its scans as one cloud.

    Raises
    ------
    FormatError
        As `stations_of`.
    """
    return iterate(file, CHUNK_POINTS, as_one=True)


def filter_chunks(
    chunks: Iterator[Cloud],
    job: TiledJob,
    *,
    points: int,
    room: Room,
    waiting: int,
    folder: Folder,
    scratch: Path,
    progress: Progress,
) -> tuple[Books, Spool | None]:
    """Filter a cloud that comes in `chunks` without ever holding it.

    Returns
    -------
    books : Books
        They lie in `scratch`.
    spool : Spool or None
        The cloud once more, faster than it is decoded; whoever gets it removes it. None: the tiles
        were there, and of `chunks` nothing was taken.

    Parameters
    ----------
    chunks : iterator of Cloud
        In one frame.
    job : TiledJob
    points : int
        At most so many come.
    room : Room
    waiting : int
        Points of clouds that are held meanwhile.
    folder : Folder
        Gets the tiles. Those that an earlier run left there are gone on with, if there is room for
        tiles of their size.
    scratch : Path
        Gets the cloud and, while it is cut, its coordinates once more, then the books; may be the
        same folder.
    progress : Progress

    Raises
    ------
    InputError
        Even tiles do not fit, or no point is left.
    FormatError, OutputError, TileError
        The file cannot be read, a folder cannot be written (a full disk), a tile failed.
    """
    start = time.perf_counter()
    with engine_in_use() as engine:
        tiles, spool = load_tiles(folder), None
        if tiles is None or not room.holds_tiles(
            tiles.facts["most_points"] * HALO_SHARE * engine.width, waiting
        ):
            most = room.tile_points(points, waiting)
            kept = max(most // (HALO_SHARE * engine.width), 1)
            spool = _spooled(chunks, folder, scratch)
            tiles = _cut(spool, job, most, kept, folder, progress)
        else:
            remove_spool(scratch)
        name = tiles.facts["name"]
        stages = [_grid_stage(tiles, time.perf_counter() - start)] if job.grid is not None else []
        bench = TileBench(tiles, engine)
        notes = _run_steps(bench, job, stages, progress)
    if stages and not stages[-1].points_out:
        raise InputError(nothing_kept(name, tiles.facts["points_in"], stages))
    noticed = (*tiles.facts["notes"], *tiles.facts["faults"])
    return _books(bench, tuple(stages), tuple(notes), noticed, scratch / "books"), spool


def _run_steps(
    bench: TileBench, job: TiledJob, stages: list[StageCount], progress: Progress
) -> list[str]:
    """Run the filters behind the grid; add to `stages`, and return what was said."""
    name, notes = bench.cloud.facts["name"], []
    for step in job.steps:
        progress.stage(f"{name}: {step.name.replace('_', ' ')} on tiles")
        params = step.params
        if isinstance(params, PassThrough):
            params = params.shifted(bench.cloud.facts["origin"])
        done = bench.apply(step.name, params, step.among)
        said = [*done.notes, *doubts(FILTERS[step.name].reason, done.taken, done.asked)]
        notes += [f"{step.name}: {note}" for note in said]
        stages.append(
            StageCount(
                name=step.name,
                points_in=done.left,
                points_out=done.left - done.taken,
                seconds=done.seconds,
                found=done.found,
            )
        )
    return notes


def _spooled(chunks: Iterator[Cloud], folder: Folder, scratch: Path) -> Spool:
    """Write the cloud to `scratch`."""
    # What a killed run left is of no use before its last file, the list of tiles.
    folder.remove()
    shutil.rmtree(scratch, ignore_errors=True)
    return Spool(chunks, scratch)


def _cut(
    spool: Spool, job: TiledJob, most: int, most_kept: int, folder: Folder, progress: Progress
) -> TiledCloud:
    """Thin the cloud where the job begins with a grid, and cut it."""
    first = spool.first
    assert first is not None
    require_metric(first)
    if job.grid is not None:
        progress.stage(f"{first.name}: octree voxel grid on tiles")
    told = {
        "name": first.name,
        "notes": list(first.notes),
        "most_points": most_kept,
    }
    return partition(spool, job.grid, folder, most, most_kept, told)


def _grid_stage(tiles: TiledCloud, seconds: float) -> StageCount:
    return StageCount(
        name="octree_voxel_grid",
        points_in=tiles.facts["points_in"],
        points_out=tiles.points,
        seconds=seconds,
    )


def _books(
    bench: TileBench,
    stages: tuple[StageCount, ...],
    notes: tuple[str, ...],
    noticed: Sequence[str],
    scratch: Path,
) -> Books:
    """Return what the stages decided about every point of the whole cloud, in its order."""
    points, folder = bench.cloud.facts["points_in"], bench.cloud.folder
    binder = Binder(scratch, points)
    for tile in bench.cloud.tiles:
        row = read_arrays(folder, tile, POINTS, "row")["row"]
        state = state_of(folder, tile, bench.state)
        details = {name: state[name] for name in DETAILS if name in state}
        binder.add(row, {"codes": state["code"], "ground_class": state["ground"], **details})
    return Books(
        points=points, page=binder.page, stages=stages, notes=notes, noticed=tuple(noticed)
    )
