"""Whether a noise filter took whole places, in words: something may have stood there.

Noise is thin. Where a cell held many points and most of them went, a filter took a thing: a flock,
a passer-by, or the stele that it should have left. Totals do not show that, so it is said, with
the place to look at.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.filters.octree_voxel_grid import runs_of_cells
from dougong.typing import Index, Points

EDGE_M = 0.5
"""Edge of the cells that are looked at."""
LEAST_HELD = 20
"""A cell with fewer points was no place of anything."""
SHARE = 0.6
"""A place is lost where more than this share of its points went."""
LEAST_POINTS = 200
"""Fewer points in all are not spoken of."""
_SPAN = 1 << 20
"""Cells farther apart than this are left out: 500 km."""


class Cells(NamedTuple):
    """Some cells, each once, and how many points each has."""

    cells: NDArray[np.int64]
    """(m, 3) whole numbers of `EDGE_M`."""
    counts: Index
    """(m,)."""

    def where(self, chosen: NDArray[np.bool_]) -> Cells:
        """Return some of them."""
        return Cells(self.cells[chosen], self.counts[chosen])


Taken = Callable[[], Iterable[Points]]
"""Yields points of a cloud, a part at a time, from the first one at every call."""


def lost_places(taken: Taken, asked: Taken, origin: NDArray[np.float64]) -> str | None:
    """Return what is to be said where most points of whole cells were taken, else None.

    Parameters
    ----------
    taken, asked : callable
        Yield the points (n, 3), local metres, that a filter took, and those that it judged; `asked`
        is called only where many points of one cell were taken.
    origin : ndarray, shape (3,)
        Of the local frame: places are told in the file's coordinates.
    """
    crowded = _dense(_together([_counted(points) for points in taken() if len(points)]))
    if not len(crowded.counts):
        return None
    held = sum((_held(points, crowded.cells) for points in asked()), np.zeros(1, np.int64))
    is_lost = (held >= LEAST_HELD) & (crowded.counts > SHARE * held)
    lost = crowded.where(is_lost)
    points = int(lost.counts.sum())
    if points < LEAST_POINTS:
        return None
    most = (lost.cells[np.argmax(lost.counts)] + 0.5) * EDGE_M + origin
    x, y, z = (f"{value:,.1f}" for value in most.tolist())
    places = f"{len(lost.counts):,} places" if len(lost.counts) > 1 else "one place"
    return (
        f"took most of the points in {places} of {EDGE_M} m, {points:,} in all, most at x {x}, "
        f"y {y}, z {z}: noise is seldom so dense. Look there with --mark, whether something stood "
        "in it."
    )


def _counted(points: Points) -> Cells:
    cells = np.floor(points / EDGE_M)
    middle = np.median(cells, axis=0)
    cells = cells[(np.abs(cells - middle) < _SPAN / 2).all(axis=1)]
    return _summed(cells, np.ones(len(cells), np.int64))


def _summed(cells: Points, counts: Index) -> Cells:
    if not len(cells):
        return Cells(np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    places, starts = runs_of_cells(cells, cells.min(axis=0), 1.0)
    firsts = places[starts[:-1]]
    return Cells(cells[firsts].astype(np.int64), np.add.reduceat(counts[places], starts[:-1]))


def _together(parts: list[Cells]) -> Cells:
    if not parts:
        return Cells(np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    cells = np.concatenate([part.cells for part in parts]).astype(np.float64)
    return _summed(cells, np.concatenate([part.counts for part in parts]))


def _dense(found: Cells) -> Cells:
    return found.where(found.counts > SHARE * LEAST_HELD)


def _held(points: Points, cells: NDArray[np.int64]) -> Index:
    """Return how many of `points` (n, 3) each of the cells (m, 3) holds."""
    low, high = cells.min(axis=0), cells.max(axis=0)
    spans = (high - low + 1).tolist()
    if math.prod(spans) >= 1 << 63:
        return np.full(len(cells), np.iinfo(np.int64).max // 2)
    at = np.floor(points / EDGE_M)
    at = at[((at >= low) & (at <= high)).all(axis=1)].astype(np.int64)
    strides = np.array([spans[1] * spans[2], spans[2], 1])
    keys, mine = (at - low) @ strides, (cells - low) @ strides
    order = np.argsort(mine)
    place = np.searchsorted(mine[order], keys)
    place[place == len(mine)] = 0
    is_in = mine[order][place] == keys
    counts = np.zeros(len(cells), np.int64)
    counts[order] = np.bincount(place[is_in], minlength=len(cells))
    return counts
