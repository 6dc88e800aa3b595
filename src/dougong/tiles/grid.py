"""Which tile a point belongs to: arithmetic only, no files.

Tiles are nodes of the octree whose leaves are the voxels of a grid. A tile of level k is 2**k
voxels wide; its eight children are the tiles of level k - 1 inside it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.typing import Index, Points

MOST_LEVELS = 40


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
    # The same division and floor as the voxels' own: no rounding can part a voxel.
    columns = [
        np.floor((points[:, axis] - grid.low[axis]) / grid.voxel_m).astype(np.int64) >> grid.level
        for axis in range(3)
    ]
    keys = _keys(columns)
    order = np.argsort(keys, kind="stable") if keys is not None else np.lexsort(columns[::-1])
    ordered = np.stack([column[order] for column in columns])
    is_first = np.ones(len(points), np.bool_)
    is_first[1:] = np.logical_or.reduce(ordered[:, 1:] != ordered[:, :-1])
    starts = np.flatnonzero(is_first)
    return Parts(order, np.append(starts, len(points)), np.ascontiguousarray(ordered[:, starts].T))


def _keys(columns: list[NDArray[np.int64]]) -> NDArray[np.uint16] | None:
    """Return one short number per tile, in the order of the tiles; None where they are too many.

    NumPy sorts short numbers by radix, twenty times faster than by three columns.
    """
    lows = [int(column.min()) for column in columns]
    sizes = [int(column.max()) - low + 1 for column, low in zip(columns, lows, strict=True)]
    if sizes[0] * sizes[1] * sizes[2] > 1 << 16:
        return None
    x, y, z = (column - low for column, low in zip(columns, lows, strict=True))
    keys: NDArray[np.uint16] = ((x * sizes[1] + y) * sizes[2] + z).astype(np.uint16)
    return keys
