"""Fine fit and evidence for objects of any size and attitude: no ground, no up, no metres known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dougong.filters import neighbourhood
from dougong.registration.icp_solve import moved_by, normal_equations, robust_weights, solve
from dougong.registration.pose_search import View
from dougong.typing import Index, Mask, Points, Transform, Values

_LEAST_PAIRS = 12
_MOST_OF_IT = 0.8


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Testimony:
    """What every point of both clouds says about one pose."""

    T: Transform
    loss: Values
    """(n + m,) 0 explained .. 1 not."""
    is_near: Mask
    """(n + m,) the other cloud shows something within three gaps: a point can be judged there."""
    explained_source: float
    """Share of source points with a like surface of the target within the tolerance."""
    explained_target: float

    @property
    def total(self) -> float:
        """Return the mean loss."""
        return float(self.loss.mean())


def noise_of(source: Body, target: Body, T: Transform, reach_m: float) -> float:
    """Return the robust sigma of the plane distances at a pose, metres."""
    pairs = _pairs(source, target, T, reach_m, 0.8)
    if not len(pairs.residuals):
        return reach_m
    return 1.4826 * float(np.median(np.abs(pairs.residuals)))


def hear(source: Body, target: Body, T: Transform, tolerance_m: float, gap_m: float) -> Testimony:
    """Return what both clouds say about `T` (between views).

    A point's error is the smaller of its distances along both normals, or its distance to the
    nearest point beyond `gap_m` if that is more: between samples nothing is known. The loss rises
    from 0 at no error to 1 at four tolerances, or where the normals differ by more than 45 deg.
    """
    one, two = (
        np.clip(errors / (4.0 * tolerance_m), 0.0, 1.0)
        for errors in _errors_both_ways(source, target, T, 4.0 * tolerance_m, gap_m)
    )
    reach = 3.0 * gap_m
    there = neighbourhood.nearest(target.index, source.view.points @ T[:3, :3].T + T[:3, 3], reach)
    here = neighbourhood.nearest(source.index, (target.view.points - T[:3, 3]) @ T[:3, :3], reach)
    return Testimony(
        T=T,
        loss=np.concatenate([one, two]),
        is_near=np.concatenate([there[0] >= 0, here[0] >= 0]),
        explained_source=float((one < 0.75).mean()),
        explained_target=float((two < 0.75).mean()),
    )


def blind_loss(source: Body, target: Body, T: Transform, reach_m: float, gap_m: float) -> float:
    """Return the mean loss of a pose without knowing the noise: the logarithm of the errors.

    0 at a hundredth of `reach_m` or less, 1 at `reach_m`. A bound as wide as the spacing would
    prefer poses that cover much to poses that fit well.
    """
    errors = np.concatenate(_errors_both_ways(source, target, T, reach_m, gap_m))
    return float(
        np.clip(1.0 + np.log(np.maximum(errors / reach_m, 1e-2)) / np.log(100), 0, 1).mean()
    )


def _errors_both_ways(
    source: Body, target: Body, T: Transform, reach_m: float, gap_m: float
) -> tuple[Values, Values]:
    """Return the errors of source points and of target points, inf where nothing is alike."""
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return (
        _errors(source, target, T, reach_m, gap_m),
        _errors(target, source, back, reach_m, gap_m),
    )


def _errors(one: Body, other: Body, T: Transform, reach_m: float, gap_m: float) -> Values:
    moved = one.view.points @ T[:3, :3].T + T[:3, 3]
    turned = one.view.normals @ T[:3, :3].T
    place, distance = neighbourhood.nearest(other.index, moved, gap_m + reach_m)
    is_near = place >= 0
    at = np.where(is_near, place, 0)
    normals, offset = other.view.normals[at], moved - other.view.points[at]
    across = np.abs((normals * offset).sum(axis=1))
    along = np.abs((turned * offset).sum(axis=1))
    error = np.maximum(np.minimum(across, along), np.where(is_near, distance, np.inf) - gap_m)
    is_alike = np.abs((normals * turned).sum(axis=1)) > np.sqrt(0.5)
    result: Values = np.where(is_near & is_alike, error, np.inf)
    return result


def blocks_of(source: View, target: View, per_side: int) -> tuple[Index, int]:
    """Return the block (n + m,) of every point, in either cloud's own cube grid, and their number.

    Errors of neighbouring points go together; blocks are what counts as independent.
    """
    parts, start = [], 0
    for view in (source, target):
        edge = float(np.ptp(view.points, axis=0).max()) / per_side
        cell = np.floor(view.points / max(edge, 1e-300)).astype(np.int64)
        _, block = np.unique(cell, axis=0, return_inverse=True)
        parts.append(block.ravel() + start)
        start += int(block.max()) + 1
    return np.concatenate(parts), start


def is_worse(better: Testimony, other: Testimony, block: Index, blocks: int, sigmas: float) -> bool:
    """Say whether the blocks tell `other` apart from `better`: paired differences, METHOD 2.3.

    Over all points, and again over the common domain, where both poses bring the clouds near each
    other: a pose is not refuted by showing less of the overlap, if it shows nearly as much.
    """
    if not _differ(better.loss, other.loss, block, blocks, sigmas):
        return False
    if 1.0 - other.total < _MOST_OF_IT * (1.0 - better.total):
        return True
    common = better.is_near & other.is_near
    return _differ(better.loss[common], other.loss[common], block[common], blocks, sigmas)


def _differ(better: Values, other: Values, block: Index, blocks: int, sigmas: float) -> bool:
    sums = np.bincount(block, weights=other - better, minlength=blocks)
    error = float(np.sqrt((sums**2).sum()))
    return bool(sums.sum() > sigmas * max(error, 1e-300))


def sharpness(
    source: Body, target: Body, best: Testimony, tolerance_m: float, gap_m: float
) -> float:
    """Return how many times more a pose explains than six poses a fifth of the radius beside it.

    Their mean counts: a plate slides along itself in two directions, and still has its place.
    """
    away = 0.2 * target.view.radius_m
    around = 0.0
    for axis in range(3):
        for sign in (1.0, -1.0):
            T = best.T.copy()
            T[axis, 3] += sign * away
            heard = hear(source, target, T, tolerance_m, gap_m)
            around += (1.0 - heard.total) / 6.0
    return (1.0 - best.total) / max(around, 0.02)


def near(a: Transform, b: Transform, angle_deg: float, shift_m: float) -> bool:
    """Say whether two poses between views are one."""
    cosine = 0.5 * (float(np.trace(a[:3, :3].T @ b[:3, :3])) - 1.0)
    is_turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) > angle_deg
    return bool(not is_turned and np.linalg.norm(a[:3, 3] - b[:3, 3]) < shift_m)
