"""What a task reads of a tiled cloud: the points of a tile that a stage is asked about, its halo.

Files of other tiles are read whole, so of them only the arrays that are needed are read.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import are_within
from dougong.filters.selection import DETAILS, Reason
from dougong.params import Parameters
from dougong.tiles.cloud import INDEX, POINTS, Arrays, Tile, TiledCloud, load_tiles, read_arrays
from dougong.tiles.folder import Folder
from dougong.typing import Index, Mask, Points

Among = Literal["left", "off_ground"]
_ASKED_BY = ("code", "ground")
_STATE = (*_ASKED_BY, "height", *DETAILS)
_GROUND = 2


@dataclass(frozen=True, slots=True)
class Job:
    """A stage on one tile."""

    folder: Folder
    tile: Tile
    before: str
    """Key of the stage whose state it starts from; empty: every point is left."""
    params: Parameters
    among: Among = "left"
    asked: int = 0
    """Points of the whole cloud that the stage is asked about."""
    known: Any = None
    """What the stage knows of the whole cloud, or the file where it is."""


class Part(NamedTuple):
    """The points of a tile that a stage is asked about, and its halo."""

    points: Points
    own: int
    """The first so many are the tile's own."""
    more: dict[str, NDArray[Any]]
    """What else was asked for of them, by name; what is not there is left out."""
    place: Index
    """(n - own,) of the halo's points: their places among the asked ones of their tile, ..."""
    tile: Index
    """... and the number of that tile."""


def state_of(folder: Folder, tile: Tile, stage: str) -> Arrays:
    """Return the codes of a tile's points and what else is known of them after a stage."""
    if not stage:
        zeros = np.zeros(tile.points, np.uint8)
        return {"code": zeros, "ground": zeros.copy()}
    return _held(folder, tile, stage, _STATE)


def is_asked(state: Arrays, among: Among) -> Mask:
    """Return which points of a tile a stage is asked about."""
    asked: Mask = state["code"] == Reason.KEPT
    return asked if among == "left" else asked & (state["ground"] != _GROUND)


def asked_of(folder: Folder, tile: Tile, before: str, among: Among) -> Mask:
    """Return which points of a tile a stage is asked about that starts from the state `before`."""
    if not before:
        return np.ones(tile.points, bool)
    return is_asked(read_arrays(folder, tile, before, *_ASKED_BY), among)


def asked_points(job: Job, tile: Tile) -> Points:
    """Return the points of a tile that the stage is asked about."""
    xyz: Points = read_arrays(job.folder, tile, POINTS, "xyz")["xyz"]
    chosen = asked_of(job.folder, tile, job.before, job.among)
    return xyz if chosen.all() else xyz[chosen]


def cloud_of(job: Job) -> TiledCloud:
    """Return the tiled cloud that a job's tile belongs to."""
    return _read_tiles(job.folder, job.folder.stamp(INDEX))


@lru_cache(4)
def _read_tiles(folder: Folder, stamp: Hashable) -> TiledCloud:
    """Return the tiles of a folder, read once: a cloud may have thousands."""
    del stamp
    cloud = load_tiles(folder)
    assert cloud is not None
    return cloud


def with_halo(
    job: Job, halo_m: float, *, more: tuple[str, ...] = (), step: str = "", found: str = ""
) -> Part:
    """Return the points of the job's tile and those within `halo_m` of its box.

    Parameters
    ----------
    more : tuple of str
        What else is wanted of every point of a tile: ``voxel_count`` or ``height``.
    step, found : str, optional
        An earlier step of the stage and an array of it, one value per point that was asked about.
    """
    points = [asked_points(job, job.tile)]
    places, tiles = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    values = {name: [held] for name, held in _more(job, job.tile, more, step, found).items()}
    for number, tile in enumerate(cloud_of(job).tiles):
        if tile == job.tile or not job.tile.is_near(tile, halo_m):
            continue
        xyz, place = _asked_in_box(job, tile, halo_m)
        points.append(xyz)
        places.append(place)
        tiles.append(np.full(len(place), number))
        if len(place):
            for name, held in _more(job, tile, more, step, found).items():
                values[name].append(held[place])
    return Part(
        points=np.ascontiguousarray(np.concatenate(points)),
        own=len(points[0]),
        more={name: np.concatenate(held) for name, held in values.items()},
        place=np.concatenate(places),
        tile=np.concatenate(tiles),
    )


def _asked_in_box(job: Job, tile: Tile, wider_m: float) -> tuple[Points, Index]:
    """Return the asked points of another tile within `wider_m` of the job's tile, and their places.

    A place is one among the points of their tile that are asked about.
    """
    xyz: Points = read_arrays(job.folder, tile, POINTS, "xyz")["xyz"]
    rows = np.flatnonzero(in_box(xyz, job.tile, wider_m))
    if not len(rows):
        return xyz[:0], rows
    chosen = asked_of(job.folder, tile, job.before, job.among)
    rows = rows[chosen[rows]]
    return xyz[rows], (np.cumsum(chosen) - 1)[rows]


def _more(job: Job, tile: Tile, more: tuple[str, ...], step: str, found: str) -> Arrays:
    """Return what else is wanted of the asked points of a tile."""
    held: Arrays = {}
    if "voxel_count" in more:
        held |= _held(job.folder, tile, POINTS, ("voxel_count",))
    if "height" in more and job.before:
        held |= _held(job.folder, tile, job.before, ("height",))
    if held:
        chosen = asked_of(job.folder, tile, job.before, job.among)
        held = {name: values[chosen] for name, values in held.items()}
    if step:
        held |= read_arrays(job.folder, tile, step, found)
    return held


def _held(folder: Folder, tile: Tile, stage: str, names: tuple[str, ...]) -> Arrays:
    """Return those of the arrays `names` that a stage of a tile has."""
    return read_arrays(folder, tile, stage, *names, if_there=True)


def in_box(xyz: Points, tile: Tile, wider_m: float) -> Mask:
    """Return which points (n, 3) lie within `wider_m` of a tile's box, per axis."""
    return are_within(xyz, np.array(tile.low) - wider_m, np.array(tile.high) + wider_m)
