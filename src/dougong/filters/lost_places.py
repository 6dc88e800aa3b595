"""Whether a noise filter took whole places, in words: something may have stood there.

Noise is thin. Where a cell held many points and most of them went, a filter took a thing: a flock,
a passer-by, or the stele that it should have left. Totals do not show that, so it is said, with
the place to look at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import are_within
from dougong.filters.octree_voxel_grid import runs_of_cells, summed_cells
from dougong.typing import Index, Points

EDGE_M = 0.5
"""Edge of the cells that are looked at."""
LEAST_HELD = 20
"""A cell with fewer points was no place of anything."""
SHARE = 0.6
"""A place is lost where more than this share of its points went."""
LEAST_POINTS = 200
"""Fewer points in all are not spoken of."""


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
    cells, gone = lost_cells(taken, asked)
    points = int(gone.sum())
    if points < LEAST_POINTS:
        return None
    most = (cells[np.argmax(gone)] + 0.5) * EDGE_M + origin
    x, y, z = (f"{value:,.1f}" for value in most.tolist())
    places = f"{len(gone):,} places" if len(gone) > 1 else "one place"
    return (
        f"took most of the points in {places} of {EDGE_M} m, {points:,} in all, most at x {x}, "
        f"y {y}, z {z}: noise is seldom so dense. Look there with --mark, whether something stood "
        "in it."
    )


def lost_cells(taken: Taken, asked: Taken, edge_m: float = EDGE_M) -> tuple[Points, Index]:
    """Return the cells (m, 3), in edges, that lost most of their points, and how many each lost."""
    nothing = np.zeros((0, 3)), np.zeros(0, np.int64)
    parts = [_counted(points, edge_m) for points in taken() if len(points)]
    if not parts:
        return nothing
    cells, gone = summed_cells(*map(np.concatenate, zip(*parts, strict=True)))
    is_crowded = gone > SHARE * LEAST_HELD
    cells, gone = cells[is_crowded], gone[is_crowded]
    if not len(gone):
        return nothing
    held = sum((_held(points, cells, edge_m) for points in asked()), np.zeros(1, np.int64))
    is_lost = (held >= LEAST_HELD) & (gone > SHARE * held)
    return cells[is_lost], gone[is_lost]


def _counted(points: Points, edge_m: float) -> tuple[Points, Index]:
    """Return the cells of points (n, 3), n >= 1, each once, and how many points each has."""
    return summed_cells(np.floor(points / edge_m), np.ones(len(points), np.int64))


def _held(points: Points, cells: Points, edge_m: float) -> Index:
    """Return how many of `points` (n, 3) each of the cells (m, 3), m >= 1, each once, holds."""
    at = np.floor(points / edge_m)
    near = at[are_within(at, cells.min(axis=0), cells.max(axis=0))]
    both = np.concatenate([cells, near])
    places, starts = runs_of_cells(both, both.min(axis=0), 1.0)
    counts = np.diff(starts)
    held = np.empty(len(both), np.int64)
    held[places] = np.repeat(counts, counts)
    # Each cell counts itself once.
    return held[: len(cells)] - 1
