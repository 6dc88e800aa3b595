"""Least squares of surveyed places: one pose by their sigmas, with or without the clouds.

Everything is written for the seven unknowns (omega, v, ln s) of a similarity; which of them are
free is an argument, and a rigid motion is one whose ln s is not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dougong.registration.icp_solve import grown_by
from dougong.registration.overlap import apply
from dougong.registration.picked_pairs import fit_rigid
from dougong.typing import Mask, Points, Transform, Values

FEWEST_FOR_POSE = 3
RIGID, SIMILAR = (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4, 5, 6)
_THIN = 0.03
BLUNDER_M = 0.1
"""More than a third of the points may be bad, if each misses its place by more than this."""
_ZERO = np.zeros((7, 7))
_REJECT = float(np.sqrt(stats.chi2.isf(1e-3, 3) / 3.0))
"""Normalised residual, of three coordinates together, of a bad point: 1 in 1000 is as large by
chance (after Baarda 1968)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlPoints:
    """The same places in two frames, in *file* coordinates and units."""

    names: tuple[str, ...]
    source: Points
    """(n, 3)"""
    target: Points
    """(n, 3)"""
    sigma_m: Values
    """(n,) metres per axis, of the difference between both surveys of the place."""
    is_check: Mask
    """(n,) True: held out."""
    where: str = "the control file"
    """What to call them in messages: the file's name."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """What the result says of where they came from (path, SHA-256)."""

    def __len__(self) -> int:
        return len(self.names)

    def moved(self, matrix: Transform) -> ControlPoints:
        """Return the points with their source side moved by a matrix of the source's file."""
        return replace(self, source=apply(matrix, self.source))


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """Clouds and control points adjusted together."""

    T: Transform
    """(4, 4), a similarity where the scale is free."""
    covariance: NDArray[np.float64]
    """(7, 7) of (omega, v, ln s), zero where not free."""
    of_control: NDArray[np.float64]
    """(7, 7), the part of it that the control points' sigmas bring: known, not estimated."""
    used: Mask
    """(n,) control points that were left in."""
    disagreement_m: float
    """Root mean square miss of the used points at the pose of the clouds alone."""
    p_value: float
    """Chance of such a miss if the clouds' covariance and the sigmas were true."""


def own_pose(
    points: ControlPoints, used: Mask, free: Sequence[int] = RIGID
) -> tuple[Transform | None, Mask]:
    """Return the pose of the control points alone, and which are left when bad ones are out.

    None: fewer than three, or on one line.
    """

    def worst(left: Mask) -> int | None:
        T = _weighted_pose(points, left, free)
        if T is None:
            return None
        return _worst(T, points, left, _ZERO, points.target[left].mean(axis=0), free)

    count = int(used.sum())
    left = _without_bad(worst, used, FEWEST_FOR_POSE, (count - 1) // 2)
    T, out = _weighted_pose(points, left, free), used & ~left
    # Too small a sigma makes sound points bad, but not by decimetres.
    is_many = int(out.sum()) > max(1, count // 3)
    if is_many and (T is None or miss(T, points, out).min() <= BLUNDER_M):
        return _weighted_pose(points, used, free), used
    return T, left


def joint(
    clouds: Transform,
    information: NDArray[np.float64],
    centre: NDArray[np.float64],
    points: ControlPoints,
    used: Mask,
    free: Sequence[int],
) -> Joint:
    """Adjust the pose of the clouds and the control points together.

    Parameters
    ----------
    clouds : ndarray, shape (4, 4)
        The pose that the clouds have by themselves.
    information : ndarray, shape (7, 7)
        What they know of (omega, v, ln s) about `centre` (3,), see `information_of`.
    points : ControlPoints
        In local metres.
    used : ndarray of bool, shape (n,)
        Which of them are control. Those whose normalised residual against the clouds and all
        others is beyond chance are left out one by one, worst first (data snooping).
    free : sequence of int
        Which unknowns move.
    """
    used = _without_bad(
        lambda left: _worst(clouds, points, left, information, centre, free),
        used,
        fewest=1,
        most=max(1, int(used.sum()) // 3),
    )
    T, at, covariance = clouds, np.zeros(7), _ZERO
    for _ in range(10):
        step, covariance = _solved(T, centre, points, used, information, free, at)
        T = grown_by(T, step, centre)
        at = at - step
        if float(np.abs(step).max()) < 1e-12:
            break
    J = jacobian(apply(T, points.source[used]), centre)
    seen = np.einsum("nij,n,nik->jk", J, 1.0 / np.square(points.sigma_m[used]), J)
    return Joint(
        T=T,
        covariance=covariance,
        of_control=covariance @ seen @ covariance,
        used=used,
        disagreement_m=float(np.sqrt(np.mean(np.square(miss(clouds, points, used))))),
        p_value=_p_value(clouds, centre, information, points, used, free),
    )


def information_of(
    covariance: NDArray[np.float64],
    free: Sequence[int],
    unobservable: Sequence[Mapping[str, Any]] = (),
) -> NDArray[np.float64]:
    """Return what clouds know of (omega, v, ln s), (7, 7): nothing along what they do not hold.

    Parameters
    ----------
    covariance : ndarray, shape (6, 6) or (7, 7)
    free : sequence of int
    unobservable : sequence of mapping
        ``vector`` of each motion (6,) that the clouds leave free.
    """
    known = [place for place in free if place < len(covariance)]
    information = np.zeros((7, 7))
    information[np.ix_(known, known)] = np.linalg.pinv(
        covariance[np.ix_(known, known)], hermitian=True
    )
    for item in unobservable:
        vector = np.zeros(7)
        vector[:6] = item["vector"]
        along = information @ vector
        strength = float(along @ vector)
        if strength > 0.0:
            information = information - np.outer(along, along) / strength
    return information


def _weighted_pose(points: ControlPoints, used: Mask, free: Sequence[int]) -> Transform | None:
    source, target = points.source[used], points.target[used]
    if len(source) < FEWEST_FOR_POSE:
        return None
    lengths = []
    for side in (source, target):
        spread = np.linalg.svd(side - side.mean(axis=0), compute_uv=False)
        if spread[0] <= 0.0 or spread[1] <= _THIN * spread[0]:
            return None
        lengths.append(float(np.linalg.norm(spread)))
    scale = lengths[1] / lengths[0] if 6 in free else 1.0
    T = fit_rigid(source * scale, target)
    T[:3, :3] *= scale
    centre = target.mean(axis=0)
    for _ in range(10):
        step, _ = _solved(T, centre, points, used, _ZERO, free)
        T = grown_by(T, step, centre)
        if float(np.abs(step).max()) < 1e-12:
            break
    return T


def miss(T: Transform, points: ControlPoints, chosen: Mask) -> Values:
    """Return how far (k,) the chosen points lie from their places under `T`, metres."""
    off: Values = np.linalg.norm(apply(T, points.source[chosen]) - points.target[chosen], axis=1)
    return off


def jacobian(moved: Points, centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return d(point) / d(omega, v, ln s), (n, 3, 7): x' = c + s Exp(omega)(x - c) + v."""
    arms = moved - centre
    J = np.zeros((len(arms), 3, 7))
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        J[:, axis, first] = arms[:, second]
        J[:, axis, second] = -arms[:, first]
        J[:, axis, 3 + axis] = 1.0
    J[:, :, 6] = arms
    return J


def _solved(
    T: Transform,
    centre: NDArray[np.float64],
    points: ControlPoints,
    used: Mask,
    information: NDArray[np.float64],
    free: Sequence[int],
    at: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the step (7,) from `T`, and the covariance (7, 7), of one weighted adjustment.

    `at` (7,) is where, seen from `T`, the clouds' own pose lies.
    """
    moved = apply(T, points.source[used])
    J = jacobian(moved, centre)
    weight = 1.0 / np.square(points.sigma_m[used])
    off = points.target[used] - moved
    H = np.einsum("nij,n,nik->jk", J, weight, J) + information
    g = np.einsum("nij,n,ni->j", J, weight, off)
    if at is not None:
        g = g + information @ at
    chosen = np.ix_(free, free)
    step, covariance = np.zeros(7), np.zeros((7, 7))
    covariance[chosen] = np.linalg.pinv(H[chosen], hermitian=True)
    step[list(free)] = covariance[chosen] @ g[list(free)]
    return step, covariance


def _worst(
    T: Transform,
    points: ControlPoints,
    used: Mask,
    information: NDArray[np.float64],
    centre: NDArray[np.float64],
    free: Sequence[int],
) -> int | None:
    """Return the point of the largest normalised residual, where that is beyond chance.

    Each used point is held against the pose that all others (and the clouds' `information`) have
    without it, so a bad one cannot hide by pulling the pose towards itself.
    """
    largest, bad = _REJECT, None
    for place in np.flatnonzero(used):
        rest = used.copy()
        rest[place] = False
        if not information.any() and _weighted_pose(points, rest, free) is None:
            continue
        step, covariance = _solved(T, centre, points, rest, information, free, np.zeros(7))
        pose = grown_by(T, step, centre)
        moved = apply(pose, points.source[place][None])
        J = jacobian(moved, centre)[0]
        expected = J @ covariance @ J.T + np.eye(3) * points.sigma_m[place] ** 2
        off = points.target[place] - moved[0]
        size = float(np.sqrt(off @ np.linalg.solve(expected, off) / 3.0))
        if size > largest:
            largest, bad = size, int(place)
    return bad


def _without_bad(worst: Callable[[Mask], int | None], used: Mask, fewest: int, most: int) -> Mask:
    """Return `used` without the points that all others contradict, the `worst` of those left first.

    At most `most` can be bad: if more are, it is the clouds that differ or the sigmas that are too
    small, and all are left in to say so. No fewer than `fewest` are left.
    """
    left = used.copy()
    while int(left.sum()) > fewest:
        bad = worst(left)
        if bad is None:
            return left
        if int(used.sum()) - int(left.sum()) == most:
            return used
        left[bad] = False
    return left


def _p_value(
    T: Transform,
    centre: NDArray[np.float64],
    information: NDArray[np.float64],
    points: ControlPoints,
    used: Mask,
    free: Sequence[int],
) -> float:
    """Return the chance of the control points' joint miss at the pose of the clouds alone.

    Chi-square of what the joint adjustment leaves, in the clouds and in the points.
    """
    step, covariance = _solved(T, centre, points, used, information, free, np.zeros(7))
    moved = apply(T, points.source[used])
    rows = jacobian(moved, centre)
    left = points.target[used] - moved - rows @ step
    square = float((np.square(left) / np.square(points.sigma_m[used])[:, None]).sum())
    square += float(step @ information @ step)
    # Every coordinate is an observation, and so is each motion that the clouds hold; the free
    # unknowns are spent.
    known = int(np.linalg.matrix_rank(information, hermitian=True))
    redundancy = 3 * int(used.sum()) + known - int(np.linalg.matrix_rank(covariance))
    return float(stats.chi2.sf(square, max(redundancy, 1)))
