"""The spacing that a scan has hereabouts: the yardstick of the protective rule.

Sums are of whole numbers, so nothing depends on the order of the points or on the tile.
Kernels are imported when called.
"""

import numpy as np
from numpy.typing import NDArray

from dougong.filters.octree_voxel_grid import cells_of, runs_of_cells
from dougong.threads import for_blocks
from dougong.typing import Index, Points, Values

NEAR_CELLS, FAR_CELLS = 0.5, 2.0
"""Cells, in reaches, in which the spacing is averaged: out to 1.5 cells round a point. The far ones
must show a flock that hovers before a wall the wall: no group smaller than its gap is taken for
small beyond two reaches."""
FEW = 25.0
"""The far average counts like this many near points."""
STEPS = 1 << 16
"""Steps per unit in which logarithms are summed, exactly."""
SMALLEST_M = 2.0**-14
_BLOCK = 1 << 13


def local_spacing(
    points: Points, own_m: Values, reach_m: float, first: int, low: NDArray[np.float64]
) -> Values:
    """Return the spacing usual round the `first` of the points: the mean over their surroundings.

    points (n, 3) and the spacing that each shows itself, own_m (n,); low (3,): the `robust_low` of
    the whole cloud, where its cells begin. Returns (first,), metres.

    A geometric mean by points: noise is few and hardly counts. Where few points are near, the
    wider surroundings count more, so a flock of birds is not measured by itself.
    """
    steps = np.rint(np.log2(np.maximum(own_m, SMALLEST_M) / SMALLEST_M) * STEPS)
    steps = steps.astype(np.int64)
    near, mean_near = _smooth(points, steps, NEAR_CELLS * reach_m, first, low)
    _, mean_far = _smooth(points, steps, FAR_CELLS * reach_m, first, low)
    mean = (near * mean_near + FEW * mean_far) / (near + FEW)
    spacing: Values = SMALLEST_M * np.exp2(mean / STEPS)
    return spacing


def _smooth(
    points: Points, steps: Index, edge: float, first: int, low: NDArray[np.float64]
) -> tuple[Values, Values]:
    """Return smoothed count and mean (first,) of `steps` (n,) over cells of `edge` metres."""
    from dougong.kernels.local_spacing import smooth_means

    # What hovers outermost lies in the middle of a cell: a surface behind it has its say there.
    low = low - edge / 2.0
    keys, axes, cell = _occupied(cells_of(points, low, edge))
    around = _around(keys, axes)
    held = np.bincount(cell, minlength=len(keys))
    sums = np.bincount(cell, weights=steps, minlength=len(keys)).astype(np.int64)
    count, mean = np.empty(first), np.empty(first)
    for_blocks(
        first,
        _BLOCK,
        lambda start, stop: smooth_means(
            points, low, edge, cell, around, held, sums, start, stop, count, mean
        ),
    )
    return count, mean


def _occupied(cells: Points) -> tuple[Index, list[Index], Index]:
    """Return the occupied cells and that of every point, a place among them, by `cells` (n, 3).

    A cell is its key, ascending: which of the coordinates that occur along each axis it has.
    """
    low = cells.min(axis=0, initial=np.inf)
    places, starts = runs_of_cells(cells, low, 1.0) if len(cells) else (np.zeros(0, int),) * 2
    occupied = cells[places[starts[:-1]]].astype(np.int64)
    axes = [np.unique(occupied[:, axis]) for axis in range(3)]
    at = [np.searchsorted(axis, occupied[:, k]) for k, axis in enumerate(axes)]
    keys = (at[0] * len(axes[1]) + at[1]) * len(axes[2]) + at[2]
    order = np.argsort(keys)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    cell = np.empty(len(cells), np.int64)
    cell[places] = np.repeat(rank, np.diff(starts))
    return keys[order], axes, cell


def _around(keys: Index, axes: list[Index]) -> Index:
    """Return the places (m, 27) in `keys` (m,) of the cells round each cell; -1 where empty."""
    sizes = [len(axis) for axis in axes]
    at = (keys // (sizes[1] * sizes[2]), keys // sizes[2] % sizes[1], keys % sizes[2])
    around = np.full((len(keys), 27), -1, np.int64)
    for k in range(27):
        found = np.ones(len(keys), bool)
        key = np.zeros(len(keys), np.int64)
        for axis, by in enumerate((k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1)):
            wanted = axes[axis][at[axis]] + by
            place = np.minimum(np.searchsorted(axes[axis], wanted), sizes[axis] - 1)
            found &= axes[axis][place] == wanted
            key = key * sizes[axis] + place
        place = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        found &= keys[place] == key
        around[found, k] = place[found]
    return around
