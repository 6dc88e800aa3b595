"""Which way a surface faces: normals turned to the open side.

Normals of a point cloud have no sign, but "in front of" and "behind" need one. A wall's open side
is the one over which the site is lower: inside stands the building under its roof, outside the
ground. Several metres are looked at, since eaves hang over the foot of a wall.
"""

from __future__ import annotations

import numpy as np

from dougong._boxes import cells_in_plan
from dougong.typing import Mask, Points, Values

_CELL_M = 0.5
_MOST_CELLS = 4_000_000
_LOOKED_AT_M = np.arange(0.75, 8.1, 0.5)
_UPRIGHT = 0.5
"""|nz| from which a surface is seen from above rather than from a side."""
_LEAST_STEP_M = 0.5
"""Sides whose mean heights differ by less do not tell which of them is open."""


def outward(core: Points, normals: Points, site: Points) -> tuple[Points, Mask]:
    """Turn the normals of core points to the open side.

    Parameters
    ----------
    core, normals : ndarray, shape (k, 3)
    site : ndarray, shape (n, 3)
        All that is known of the place, both clouds, metres, in the frame of `core`.

    Returns
    -------
    normals : ndarray, shape (k, 3)
        Upward where the surface can be seen from above, else to the lower side of the site.
    is_known : ndarray, shape (k,)
        False where both sides are alike; the normal then points to +x, else +y.
    """
    top, low, cell = _tops(site)
    level = np.hypot(normals[:, 0], normals[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        aside = normals[:, :2] / level[:, None]
        is_wall = np.abs(normals[:, 2]) < _UPRIGHT
    ground = float(np.quantile(site[:, 2], 0.02))
    heights = [np.zeros(len(core)), np.zeros(len(core))]
    for side, direction in enumerate((1.0, -1.0)):
        for distance in _LOOKED_AT_M:
            place = core[:, :2] + direction * distance * np.where(is_wall[:, None], aside, 0.0)
            heights[side] += _at(top, low, cell, place, ground) / len(_LOOKED_AT_M)
    step = heights[1] - heights[0]
    is_known = np.where(is_wall, np.abs(step) >= _LEAST_STEP_M, np.isfinite(normals[:, 2]))
    x, y = normals[:, 0], normals[:, 1]
    is_forward = (x > 1e-9) | ((np.abs(x) <= 1e-9) & (y > 0.0))
    keeps = np.where(is_wall, np.where(is_known, step > 0.0, is_forward), normals[:, 2] > 0.0)
    return np.where(keeps[:, None], normals, -normals), is_known


def _tops(site: Points) -> tuple[Values, Values, float]:
    """Return the highest point over each plan cell (-inf: none), the low corner, the cell."""
    low, high = np.quantile(site[:, :2], [0.001, 0.999], axis=0)
    low, high = low - 1.0, high + 1.0
    cell = max(_CELL_M, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    size = np.ceil((high - low) / cell).astype(np.int64) + 1
    place = np.floor((site[:, :2] - low) / cell).astype(np.int64)
    is_in = np.all((place >= 0) & (place < size), axis=1)
    top = np.full(tuple(size), -np.inf)
    np.maximum.at(top, (place[is_in, 0], place[is_in, 1]), site[is_in, 2])
    return top, low, cell


def _at(top: Values, low: Values, cell: float, place: Points, ground: float) -> Values:
    """Return the top over each place (k, 2); the ground where nothing was seen."""
    is_in, i, j = cells_in_plan(np.nan_to_num(place), low, cell, top.shape)
    found = np.where(is_in, top[i, j], -np.inf)
    return np.where(np.isfinite(found), found, ground)
