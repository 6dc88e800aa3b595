"""Which tile a point belongs to: arithmetic only, no files.

Tiles are nodes of the octree whose leaves are the voxels of a grid. A tile of level k is 2**k
voxels wide; its eight children are the tiles of level k - 1 inside it.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import keys_of_rows
from dougong.filters.octree_voxel_grid import cells_of
from dougong.typing import Index, Points

MOST_LEVELS = 40
_FINER = 3
"""So many levels at once are looked into when crowded tiles are halved."""


class TileGrid(NamedTuple):
    """The voxels of a cloud, gathered into tiles of one level."""

    low: NDArray[np.float64]
    """(3,) where voxel (0, 0, 0) begins, local metres."""
    voxel_m: float
    level: int
    """A tile is 2**level voxels wide."""

    def children(self) -> "TileGrid":
        """Return the grid whose tiles are half as wide."""
        return self._replace(level=self.level - 1)


class Parts(NamedTuple):
    """Points in the order of their tiles."""

    order: Index
    """(n,) places that put the points of one tile together, in their order within it."""
    starts: Index
    """(tiles + 1,) where each tile's points begin in `order`."""
    tiles: NDArray[np.int64]
    """(tiles, 3) their coordinates: whole numbers of tiles from `low`, negative ones too."""


def grid_for(
    low: NDArray[np.float64], edge_m: float, voxel_m: float, points: int, tile_points: int
) -> TileGrid:
    """Return a grid over a cube of `edge_m` whose tiles hold about `tile_points`.

    Buildings are surfaces: halving the tiles' width quarters what they hold. Crowded tiles are
    halved again by whoever fills them.
    """
    halvings = 0.5 * np.log2(max(points / tile_points, 1.0))
    widest = np.ceil(np.log2(max(edge_m / voxel_m, 1.0)))
    level = int(np.clip(np.ceil(widest - halvings), 0, MOST_LEVELS))
    return TileGrid(low, voxel_m, level)


def part(points: Points, grid: TileGrid) -> Parts:
    """Sort `points` (n, 3), local metres, by the tile whose voxels they lie in."""
    # The voxels' own rule: no rounding can part a voxel.
    voxels = cells_of(points, grid.low, grid.voxel_m)
    columns = [voxels[:, axis].astype(np.int64) >> grid.level for axis in range(3)]
    keys = _keys(columns)
    order = np.argsort(keys, kind="stable") if keys is not None else np.lexsort(columns[::-1])
    is_first = np.zeros(len(points), np.bool_)
    is_first[:1] = True
    for values in columns if keys is None else (keys,):
        ordered = values[order]
        is_first[1:] |= ordered[1:] != ordered[:-1]
    starts = np.flatnonzero(is_first)
    tiles = np.column_stack([column[order[starts]] for column in columns])
    return Parts(order, np.append(starts, len(points)), tiles)


def _keys(columns: list[NDArray[np.int64]]) -> NDArray[Any] | None:
    """Return one number per tile, in the order of the tiles; None where they are too far apart.

    NumPy sorts short numbers by radix, twenty times faster than by three columns.
    """
    keys = keys_of_rows(columns)
    if keys is None or keys.max(initial=0) >= 1 << 16:
        return keys
    return keys.astype(np.uint16)


class Leaves(NamedTuple):
    """Tiles of several levels: the widest that hold no more points than they may."""

    grid: TileGrid
    """Whose tiles, as narrow as any of them, are `nodes`."""
    nodes: NDArray[np.int64]
    """(m, 3) all that hold points, sorted."""
    leaf: Index
    """(m,) the place in `names` of the tile that each is a part of."""
    names: tuple[tuple[int, int, int, int], ...]
    """Level and coordinates of each tile, in the order of coordinates."""
    counts: Index
    """Points of each tile: more than allowed only in the narrowest ones."""

    def part(self, points: Points) -> Parts:
        """Sort `points` (n, 3) of the cloud by their tile; `tiles` are places in `names`."""
        parts = part(points, self.grid)
        leaf = self.leaf[_rows_in(self.nodes, parts.tiles)]
        short = np.uint16 if len(self.names) <= 1 << 16 else np.int64
        of_point = np.empty(len(points), short)
        of_point[parts.order] = np.repeat(leaf, np.diff(parts.starts))
        order = np.argsort(of_point, kind="stable")
        held = np.bincount(of_point, minlength=len(self.names))
        tiles = np.flatnonzero(held)
        return Parts(order, np.concatenate([[0], np.cumsum(held[tiles])]), tiles)


def leaves_of(blocks: Iterable[Points], grid: TileGrid, most: int) -> Leaves:
    """Return the tiles of a cloud that comes in blocks, at most `_FINER` levels below the grid's.

    One pass. A tile of more than `most` points is halved along every axis.
    """
    fine = grid._replace(level=max(0, grid.level - _FINER))
    nodes, counts = np.empty((0, 3), np.int64), np.empty(0, np.int64)
    for block in blocks:
        if not len(block):
            continue
        parts = part(block, fine)
        nodes, of_node = np.unique(
            np.concatenate([nodes, parts.tiles]), axis=0, return_inverse=True
        )
        counts = np.bincount(
            of_node.reshape(-1), np.concatenate([counts, np.diff(parts.starts)])
        ).astype(np.int64)
    level = np.full(len(nodes), fine.level)
    for wider in range(fine.level + 1, grid.level + 1):
        _, inside = np.unique(nodes >> (wider - fine.level), axis=0, return_inverse=True)
        inside = inside.reshape(-1)
        level[np.bincount(inside, counts)[inside] <= most] = wider
    tiles = np.column_stack([level, nodes >> (level - fine.level)[:, None]])
    found, leaf = np.unique(tiles, axis=0, return_inverse=True)
    names = [tuple(name) for name in found.tolist()]
    order = sorted(range(len(names)), key=lambda i: _path(names[i], grid.level))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    leaf = rank[leaf.reshape(-1)]
    held = np.bincount(leaf, counts).astype(np.int64)
    return Leaves(fine, nodes, leaf, tuple(names[i] for i in order), held)


def _path(name: tuple[int, ...], top: int) -> list[tuple[int, ...]]:
    """Return the coordinates of the tiles that hold a tile, from the widest level down."""
    level, *at = name
    return [tuple(axis >> up for axis in at) for up in range(top - level, -1, -1)]


def _rows_in(nodes: NDArray[np.int64], wanted: NDArray[np.int64]) -> Index:
    """Return the rows of sorted `nodes` (m, 3) that `wanted` (k, 3) are."""
    both, inverse = np.unique(np.concatenate([nodes, wanted]), axis=0, return_inverse=True)
    assert len(both) == len(nodes)
    rows: Index = inverse.reshape(-1)[len(nodes) :]
    return rows
