"""Fine fit of objects of any size and attitude: no ground, no up, no metres known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dougong.filters import neighbourhood
from dougong.registration.icp_solve import moved_by, normal_equations, robust_weights, solve
from dougong.registration.pose_search import View
from dougong.typing import Points, Transform, Values

_LEAST_PAIRS = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """A view with its search index."""

    view: View
    index: neighbourhood.Neighbourhood


def body_of(view: View) -> Body:
    """Return `view` ready to be searched."""
    return Body(view=view, index=neighbourhood.build_index(view.points))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pairs:
    points: Points
    normals: Points
    residuals: Values
    distance: Values


def _pairs(source: Body, target: Body, T: Transform, reach_m: float, cosine: float) -> _Pairs:
    """Return the pairs within reach, both ways, in the target's frame, source moved there."""
    R, t = T[:3, :3], T[:3, 3]
    moved, turned = source.view.points @ R.T + t, source.view.normals @ R.T
    place, distance = neighbourhood.nearest(target.index, moved, reach_m)
    rows = np.flatnonzero(place >= 0)
    back, distance_back = neighbourhood.nearest(source.index, (target.view.points - t) @ R, reach_m)
    rows_back = np.flatnonzero(back >= 0)
    one = np.concatenate([rows, back[rows_back]])
    two = np.concatenate([place[rows], rows_back])
    alike = (turned[one] * target.view.normals[two]).sum(axis=1)
    # The sum of both normals, signs matched: a fit to either plane alone is first order only.
    both = target.view.normals[two] + np.where(alike < 0, -1.0, 1.0)[:, None] * turned[one]
    both /= np.linalg.norm(both, axis=1, keepdims=True)
    offsets = moved[one] - target.view.points[two]
    length = np.concatenate([distance[rows], distance_back[rows_back]])
    good = np.abs(alike) > cosine
    return _Pairs(
        points=moved[one][good],
        normals=both[good],
        residuals=(both * offsets).sum(axis=1)[good],
        distance=length[good],
    )


def fit(
    source: Body,
    target: Body,
    T: Transform,
    reaches_m: tuple[float, ...],
    *,
    iterations: int = 15,
    tolerance: float = 1e-5,
) -> Transform:
    """Return `T` (between views) improved by robust symmetric point-to-plane ICP.

    One run per reach, wide to narrow; pairs both ways; Tukey weights with the scale of the
    residuals; directions that nothing holds are not moved. Symmetric objective: Rusinkiewicz 2019.
    """
    length = target.view.radius_m
    for reach in reaches_m:
        for _ in range(iterations):
            pairs = _pairs(source, target, T, reach, 0.6)
            if len(pairs.residuals) < _LEAST_PAIRS:
                return T
            scale = 1.4826 * float(np.median(np.abs(pairs.residuals)))
            weights = robust_weights(pairs.residuals, max(scale, 1e-6 * length), "tukey")
            # Near pairs are the likelier ones: it lets the narrow reach be entered smoothly.
            weights = weights * np.square(np.clip(1.0 - (pairs.distance / reach) ** 2, 0.0, None))
            block = np.zeros(len(weights), np.int64)
            centre = np.zeros(3)
            H, g = normal_equations(pairs.points, pairs.normals, pairs.residuals, weights, block, 1)
            step = solve(H[0], g[0], 6, length)
            T = moved_by(T, step, centre)
            if np.linalg.norm(step[:3]) * length + np.linalg.norm(step[3:]) < tolerance * length:
                break
    return T


def near(a: Transform, b: Transform, angle_deg: float, shift_m: float) -> bool:
    """Say whether two poses between views are one."""
    cosine = 0.5 * (float(np.trace(a[:3, :3].T @ b[:3, :3])) - 1.0)
    is_turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) > angle_deg
    return bool(not is_turned and np.linalg.norm(a[:3, 3] - b[:3, 3]) < shift_m)
