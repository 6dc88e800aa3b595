"""The relief of the ground as a mark of the place: hollows and rises are nowhere twice.

A plane is taken out of the heights that both clouds show in the same cells; what is left is
compared. Paving that is flat to the noise says nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dougong.registration.overlap import Rung, apply
from dougong.registration.prepare import Prepared
from dougong.typing import Index, Points, Transform, Values

_CELL_M = 1.0
_WIDTH = 1 << 24
"""Cells along a row of the numbering: local frames are nowhere wider."""
_MOST_POINTS = 60_000
_LEAST_POINTS = 3
"""In each cell, of each cloud."""
_LEAST_CELLS = 40
_RELIEF_M = 0.012
"""Less relief (one standard deviation) is that of any paving."""
_UNBENT_M = 0.03
"""Level paving may show so much in a flight that is bent."""
_ALIKE, _UNLIKE = 0.9, 0.3
"""Generated sites under true poses: 0.93 and more. The feet of equal walls: up to 0.86."""
_TURNS = 7
_LEVEL = 0.95
"""The rise of a normal from which on it is the ground's."""


class Relief(NamedTuple):
    """How alike the ground of two clouds is under a pose."""

    alike: float
    """Correlation of what a plane leaves of both, -1 .. 1; NaN where one shows no relief."""
    by_chance: float
    """The most of it when one cloud's ground is turned about its middle."""
    spread_m: float
    """The smaller relief of the two, one standard deviation."""

    @property
    def is_vouched(self) -> bool:
        """Say whether the ground is as alike as it is under no turn of itself."""
        return self.alike >= _ALIKE and self.alike - self.by_chance > 0.5 * (1.0 - self.by_chance)

    @property
    def is_refuted(self) -> bool:
        """Say whether both show more relief than a flight bends, and not the same."""
        return self.alike < _UNLIKE and self.spread_m >= _UNBENT_M


def level_ground(cloud: Prepared, everything: Rung) -> Points:
    """Return ground (n, 3) of a rung without the feet of walls that hang on it: walls repeat."""
    rise = np.abs(cloud.normals[everything.index] @ cloud.up)
    level = everything.xyz[cloud.is_ground[everything.index] & (rise > _LEVEL)]
    few: Points = level[:: -(-len(level) // _MOST_POINTS) or 1]
    return few


def likeness(source: Points, target: Points, T: Transform) -> float:
    """Return the correlation of the relief of two clouds' ground (n, 3) under a pose, or NaN."""
    return _alike(apply(T, source), _heights(target))[0]


def relief(source: Points, target: Points, T: Transform) -> Relief:
    """Compare the ground (n, 3) of two clouds under a pose (source -> target)."""
    moved, heights = apply(T, source), _heights(target)
    alike, spread = _alike(moved, heights)
    if np.isnan(alike):
        return Relief(alike, np.nan, spread)
    middle = (moved.min(axis=0) + moved.max(axis=0)) / 2.0
    turned = [_alike(_turned(moved, middle, k), heights)[0] for k in range(1, _TURNS + 1)]
    known = [value for value in turned if np.isfinite(value)]
    return Relief(alike, max(known, default=0.0), spread)


def _turned(points: Points, middle: Values, eighth: int) -> Points:
    c, s = np.cos(eighth * np.pi / 4.0), np.sin(eighth * np.pi / 4.0)
    turned: Points = (points - middle) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + middle
    return turned


def _alike(one: Points, two: tuple[Index, Values]) -> tuple[float, float]:
    """Return how the relief of ground (n, 3) and of known cells correlate, and the smaller one.

    NaN, where too few cells are shared or one shows no relief.
    """
    (cells, heights), (others, other_heights) = _heights(one), two
    shared, first, second = np.intersect1d(cells, others, assume_unique=True, return_indices=True)
    if len(shared) < _LEAST_CELLS:
        return np.nan, 0.0
    place = np.column_stack([shared // _WIDTH, shared % _WIDTH]).astype(np.float64)
    plan = np.column_stack([place - place.mean(axis=0), np.ones(len(shared))])
    left = [_without_plane(plan, h) for h in (heights[first], other_heights[second])]
    spread = [float(np.std(values)) for values in left]
    if min(spread) < _RELIEF_M:
        return np.nan, min(spread)
    return float(np.mean(left[0] * left[1]) / (spread[0] * spread[1])), min(spread)


def _heights(points: Points) -> tuple[Index, Values]:
    """Return the cells, ascending, with enough points, and the lower quartile of their heights.

    What is taken for ground ends a hand's breadth up the walls, and walls repeat.
    """
    i, j = np.floor(points[:, :2] / _CELL_M).astype(np.int64).T
    cell = (i + _WIDTH // 2) * _WIDTH + j + _WIDTH // 2
    order = np.lexsort((points[:, 2], cell))
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    height = points[order[first + count // 4], 2]
    return cells[count >= _LEAST_POINTS], height[count >= _LEAST_POINTS]


def _without_plane(plan: Values, heights: Values) -> Values:
    """Return heights (n,) less their plane, without the far ends of their spread."""
    left = heights - plan @ np.linalg.lstsq(plan, heights, rcond=None)[0]
    low, high = np.quantile(left, [0.02, 0.98])
    clipped: Values = np.clip(left, low, high)
    level: Values = clipped - clipped.mean()
    return level
