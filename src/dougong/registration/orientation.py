"""Which way normals point: to the side that was seen, where that is sure.

A fitted plane has no front. But a drone looks down, the ground and all below eye height is seen
from above, and a scanner that says where it stood has seen every surface from there. A roof's top
and its underside are parallel and centimetres apart: once both are sure of their side they never
pair (METHOD.md 3). Where the scanner's place is unknown, a roof that is open beneath may be the
underside of what the drone saw: such a pair says nothing about the height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.kernels.raster import cell_max, cell_min
from dougong.typing import Index, Kind, Mask, Points, Values

_FLAT = 0.7
"""Planarity from which a normal means something."""
_SURE_SIGHT = 0.17
"""A surface met at less than 10 degrees may be its neighbour's edge: its side is not sure."""
_UPWARD = 0.5
"""A drone's normal within 60 degrees of the vertical."""
_GROUND_UPWARD = 0.7
_BELOW_EYE_M = 1.2
"""No scanner stands under what is lower than this above the ground."""
_BENEATH_CELL_M = 0.5
_BENEATH_M = 1.0
"""A point in the same cells, lower by more than this, was seen through open space."""
_FREE_M = 0.3
"""No scanner stands closer than this to what it saw."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sides:
    """What is known of the side from which each surface was seen."""

    normals: Points
    """(n, 3) unit; to the seen side where `is_sure`, else of any sign."""
    is_sure: Mask
    """(n,)"""
    may_be_underside: Mask
    """(n,) a roof or floor overhead, its side not sure, open beneath (or nothing is known of what
    lies beneath)."""
    is_unknown: Mask
    """(n,) a roof or floor overhead, its side not sure, whatever lies beneath."""


def sides(
    normals: Points,
    xyz: Points,
    planarity: Values,
    height: Values,
    is_ground: Mask,
    up: NDArray[np.float64],
    kind: Kind,
    spacing_m: float,
    seen_from: Points | None,
) -> Sides:
    """Say which side of its surface each point shows.

    Parameters
    ----------
    height : ndarray, shape (n,)
        Above the ground; NaN where there is none.
    up : ndarray, shape (3,)
        The vertical, in the frame of `xyz` (n, 3).
    seen_from : ndarray, shape (n, 3), optional
        Where the sensor stood for each point (`sights`); NaN where unknown.
    """
    is_flat = planarity > _FLAT
    rise = normals @ up
    sign, is_sure = np.ones(len(normals)), np.zeros(len(normals), dtype=bool)
    is_low = is_ground | (height < _BELOW_EYE_M)
    is_up = is_low & (np.abs(rise) > _GROUND_UPWARD)
    if kind == "photogrammetry":
        is_up |= _is_on_top(xyz @ up, xyz, spacing_m) & (np.abs(rise) > _UPWARD)
    is_up &= is_flat
    sign[is_up], is_sure[is_up] = np.where(rise[is_up] < 0.0, -1.0, 1.0), True
    if seen_from is not None:
        sight = seen_from - xyz
        distance = np.linalg.norm(sight, axis=1)
        cosine = np.einsum("ij,ij->i", sight, normals) / np.maximum(distance, 1e-9)
        # What is known beats what is usual: a ceiling may have been taken for ground.
        is_known = np.isfinite(cosine)
        is_sure[is_known] = (is_flat & (np.abs(cosine) > _SURE_SIGHT))[is_known]
        sign[is_known] = np.where(cosine[is_known] < 0.0, -1.0, 1.0)
    is_unsure_roof = (np.abs(rise) > _UPWARD) & ~is_sure & ~is_low
    may_be = is_unsure_roof & (_is_open_beneath(xyz @ up, xyz) | np.isnan(height))
    return Sides(
        normals=normals * sign[:, None],
        is_sure=is_sure,
        may_be_underside=may_be,
        is_unknown=is_unsure_roof,
    )


def sights(cloud: Cloud, chosen: Index) -> Points | None:
    """Return where the scanner stood for each of the `chosen` points, (k, 3); None: unknown.

    Viewpoints that cannot be true are left out: off the plan that their points cover, or with a
    point closer than a scanner can stand (a file's global shift, not its scanner).
    """
    if cloud.viewpoints is None:
        return None
    number = cloud.attribute("station")
    xyz = cloud.xyz[chosen]
    row = np.zeros(len(xyz), np.int64) if number is None else number[chosen].astype(np.int64)
    places = cloud.viewpoints.copy()
    row[(row < 0) | (row >= len(places))] = 0 if len(places) == 1 else -1
    for k, place in enumerate(places):
        mine = xyz[row == k]
        if not len(mine) or not _could_stand(place, mine):
            places[k] = np.nan
    if not np.isfinite(places).any():
        return None
    places = np.vstack([places, np.full((1, 3), np.nan)])
    return places[row]


def _could_stand(place: NDArray[np.float64], points: Points) -> bool:
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    is_within = bool(((place[:2] >= low) & (place[:2] <= high)).all())
    return is_within and bool(np.linalg.norm(points - place, axis=1).min() > _FREE_M)


def _is_open_beneath(height: Values, xyz: Points) -> Mask:
    """Return over which points (n,) the cloud shows something well below, at the same place."""
    place, shape = _cells(xyz, _BENEATH_CELL_M)
    low = np.full(shape, np.nan)
    rows, columns = np.ascontiguousarray(place.T)
    cell_min(columns, rows, np.ascontiguousarray(height), shape, low)
    is_open: Mask = low[place[:, 0], place[:, 1]] < height - _BENEATH_M
    return is_open


def _cells(xyz: Points, cell: float) -> tuple[Index, tuple[int, int]]:
    place = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64)
    return place, (int(place[:, 0].max()) + 1, int(place[:, 1].max()) + 1)


def _is_on_top(height: Values, xyz: Points, spacing_m: float) -> Mask:
    """Return which points (n,) are the highest surface over their place in plan."""
    cell = max(0.2, 2.0 * spacing_m)
    place, shape = _cells(xyz, cell)
    top = np.full(shape, np.nan)
    rows, columns = np.ascontiguousarray(place.T)
    cell_max(columns, rows, np.ascontiguousarray(height), shape, top)
    # Within a cell a surface sloping 60 degrees rises by 1.7 cells; a roof stands higher yet.
    is_top: Mask = height >= top[place[:, 0], place[:, 1]] - 1.7 * cell
    return is_top
