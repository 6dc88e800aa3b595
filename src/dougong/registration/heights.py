"""The height of a pose: votes of level surfaces over the plan cells that both clouds share."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dougong.kernels.plan import vote_heights
from dougong.registration.cleaning import extent
from dougong.registration.plan_refine import PlanPose
from dougong.registration.rasters import PlanView
from dougong.typing import Points, Values

_CELL_M = 0.5
_BIN_M = 0.05
_BLUR_M = 0.1
_SEPARATE_M = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levels:
    """The level surfaces of a cloud: one entry per plan cell, 0.1 m of height and kind."""

    xyz: Points
    """(m, 3) levelled."""
    weight: Values
    """(m,) ground weighs three times as much: both sensors see its upper side."""
    low: NDArray[np.float64]
    """(3,) corner of the grid."""
    high: NDArray[np.float64]
    pivot: NDArray[np.float64]


def height_candidates(
    pose: PlanPose, source: Levels, target: Levels, count: int = 3, share: float = 0.4
) -> list[float]:
    """Return offsets to add to the source's z, metres, most votes first.

    In every shared cell each pair of levels (one per cloud) votes for its difference, so the
    right offset collects one vote per level, wrong ones the chance pairs: a terrace or a storey
    can still be the stronger one, so every peak with `share` of the best one's votes is kept,
    up to `count`, 0.5 m apart.
    """
    source_xyz, target_xyz = source.xyz, target.xyz
    cosine, sine = np.cos(pose.yaw), np.sin(pose.yaw)
    x, y = (source_xyz[:, :2] - source.pivot).T
    turned = np.column_stack([cosine * x - sine * y + pose.x, sine * x + cosine * y + pose.y])
    columns, rows = np.ceil((target.high - target.low)[:2] / _CELL_M).astype(int) + 1
    cell = np.floor((turned - target.low[:2]) / _CELL_M).astype(np.int64)
    is_inside = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1)
    flat = np.where(is_inside, cell[:, 1] * columns + cell[:, 0], -1)
    target_cell = np.floor((target_xyz[:, :2] - target.low[:2]) / _CELL_M).astype(np.int64)
    target_flat = target_cell[:, 1] * columns + target_cell[:, 0]
    order = np.argsort(target_flat, kind="stable")
    starts = np.searchsorted(target_flat[order], np.arange(rows * columns + 1))
    low = float(target_xyz[:, 2].min() - source_xyz[:, 2].max()) - 1.0
    high = float(target_xyz[:, 2].max() - source_xyz[:, 2].min()) + 1.0
    votes = np.zeros(int(np.ceil((high - low) / _BIN_M)) + 1)
    vote_heights(
        flat,
        np.ascontiguousarray(source_xyz[:, 2]),
        source.weight,
        starts.astype(np.int64),
        np.ascontiguousarray(target_xyz[order, 2]),
        target.weight[order],
        low,
        _BIN_M,
        votes,
    )
    return _peaks(gaussian_filter1d(votes, _BLUR_M / _BIN_M), low, count, share)


def levels(view: PlanView) -> Levels:
    """Return the level surfaces of `view`: what is not wall (ground, floors, roofs)."""
    chosen = np.flatnonzero(view.wall == 0.0)
    if len(chosen) == 0:
        chosen = np.arange(len(view.xyz))
    xyz = view.xyz[chosen]
    low, high = extent(xyz)
    key = np.floor((xyz - low) / [_CELL_M, _CELL_M, 0.1]).astype(np.int64)
    size = np.floor((high - low) / [_CELL_M, _CELL_M, 0.1]).astype(np.int64) + 1
    flat = ((key[:, 1] * size[0] + key[:, 0]) * size[2] + key[:, 2]) * 2
    flat += view.is_ground[chosen]
    keys, place = np.unique(flat, return_inverse=True)
    counts = np.bincount(place)
    mean = np.column_stack([np.bincount(place, xyz[:, axis]) / counts for axis in range(3)])
    return Levels(
        xyz=mean,
        weight=np.where(keys % 2 == 1, 3.0, 1.0),
        low=low,
        high=high,
        pivot=view.pivot,
    )


def _peaks(votes: Values, low: float, count: int, share: float) -> list[float]:
    """Return the offsets of the highest maxima; none when no cell is shared."""
    found: list[float] = []
    left = votes.copy()
    gap = int(_SEPARATE_M / _BIN_M)
    while len(found) < count:
        top = int(left.argmax())
        if left[top] <= 0.0 or left[top] < share * votes.max():
            break
        if 0 < top < len(votes) - 1 and votes[top] >= max(votes[top - 1], votes[top + 1]):
            before, here, after = votes[top - 1 : top + 2]
            bend = before - 2.0 * here + after
            shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
            found.append(low + (top + float(shift)) * _BIN_M)
        left[max(0, top - gap) : top + gap + 1] = 0.0
    return found
