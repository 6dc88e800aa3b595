"""Two sensors' points of one site, tile by tile: whole, or cut on disk with halos.

Small sets are one tile that is held.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from dougong._boxes import are_within, corners_of
from dougong.cloud import Cloud, Frame
from dougong.tiles.cloud import (
    POINTS,
    Tile,
    TiledCloud,
    name_of,
    read_arrays,
    tile_of,
    write_arrays,
)
from dougong.tiles.folder import LocalFolder
from dougong.tiles.grid import grid_for
from dougong.tiles.spool import Spool
from dougong.typing import Index, Points

HALO_SHARE = 3
"""A tile holds at most this share of the points that fit: the others are for its halo."""
TILE_ROW_BYTES = 56
"""Of a point on disk while the tiles are cut: twice its coordinates, once its place."""
_STEP_M = 0.1
"""Tiles are whole numbers of such steps wide."""


class Sides(NamedTuple):
    """The points of two sensors in one tile and about it."""

    points: tuple[Points, Points]
    """Metres; the tile's own come first, behind them those of its halo."""
    rows: tuple[Index, Index]
    """Place of each of the tile's own points among all of its sensor."""

    def own(self, side: int) -> Points:
        """Return a sensor's points without the halo."""
        return self.points[side][: len(self.rows[side])]


Tiles: TypeAlias = Callable[[float], Iterator[Sides]]
"""Yields the tiles, each with a halo of so many metres, from the first one at every call."""


def whole(one: Points, other: Points) -> Tiles:
    """Return two sets of points (n, 3), (m, 3) as one tile."""
    sides = Sides((one, other), (np.arange(len(one)), np.arange(len(other))))
    return lambda _halo_m: iter((sides,))


def cut(sets: tuple[Iterable[Points], Iterable[Points]], folder: Path, most: int) -> Tiles:
    """Cut two sets of points that come in pieces into tiles in `folder`.

    Parameters
    ----------
    sets : pair of iterables of ndarray, shape (n, 3)
        Metres, in one frame.
    folder : Path
    most : int
        At most so many points of both make a tile.

    Raises
    ------
    OutputError
        The disk is full, or the folder cannot be written.
    """
    # In the cut the points of the second set come behind those of the first.
    first = 0

    def clouds() -> Iterator[Cloud]:
        nonlocal first
        for side, pieces in enumerate(sets):
            for xyz in pieces:
                first += len(xyz) if side == 0 else 0
                if len(xyz):
                    yield Cloud(xyz=xyz, records=np.empty(len(xyz), dtype=[]), frame=Frame())

    spool, kept = Spool(clouds(), folder), LocalFolder(folder)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for block in spool.coordinates():
        lowest, highest = corners_of(block)
        low, high = np.minimum(low, lowest), np.maximum(high, highest)
    grid = grid_for(low, float((high - low).max()), _STEP_M, spool.points, most)
    tiles: list[Tile] = []
    for file in spool.cut(grid, most):
        rows = file.read()
        tile = tile_of(file.path.stem, rows.xyz)
        side = rows.row >= first
        arrays = {"xyz": rows.xyz, "side": side, "row": rows.row - first * side}
        write_arrays(kept, name_of(tile, POINTS), arrays, {})
        file.remove()
        tiles.append(tile)
    spool.remove()
    cloud = TiledCloud(kept, tuple(tiles), {})
    return lambda halo_m: (_sides(cloud, tile, halo_m) for tile in cloud.tiles)


def _sides(cloud: TiledCloud, tile: Tile, halo_m: float) -> Sides:
    held = read_arrays(cloud.folder, tile, POINTS)
    points: tuple[list[Points], list[Points]] = ([], [])
    for side in (0, 1):
        points[side].append(held["xyz"][held["side"] == side])
    rows = (held["row"][held["side"] == 0], held["row"][held["side"] == 1])
    for other in cloud.near(tile, halo_m) if halo_m > 0 else ():
        more = read_arrays(cloud.folder, other, POINTS, "xyz", "side")
        wider = np.array(tile.low) - halo_m, np.array(tile.high) + halo_m
        is_near = are_within(more["xyz"], *wider)
        for side in (0, 1):
            points[side].append(more["xyz"][is_near & (more["side"] == side)])
    one, two = (np.ascontiguousarray(np.concatenate(parts)) for parts in points)
    return Sides((one, two), rows)
