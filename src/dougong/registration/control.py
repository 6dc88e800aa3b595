"""Control and check points: places surveyed in both frames, used by their sigmas or held out.

Control points propose a pose, decide between poses that the clouds cannot tell apart, and are
adjusted together with the fit of the clouds. One that the others contradict is found, named and
left out. Check points touch nothing: they say how right the result is (METHOD.md 3 and 5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.registration.icp_solve import FREE, moved_by
from dougong.registration.overlap import apply
from dougong.registration.picked_pairs import fit_rigid
from dougong.registration.result import FineResult, Status
from dougong.typing import Mask, Points, Transform, Values

FEWEST_FOR_POSE = 3
_THIN = 0.03
_NEAR_M = 0.5
"""A pose of the search may lie so far from the control points and still be theirs: it is not fine
yet."""
_SIGMAS = 4.0
_REJECT = 3.29
"""Normalised residual of a bad point: 1 in 1000 by chance (Baarda 1968)."""
_DISAGREE_P = 1e-3
_DISAGREE_M = 0.05
"""What METHOD.md 5 calls correct: two answers that differ by less may both be."""


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
class Control:
    """The control points of a pair in local metres, and what they say before any cloud is heard."""

    points: ControlPoints
    """All of them, check points too, in the local frames of source and target, metres."""
    used: Mask
    """(n,) control points that the others do not contradict."""
    T_target_source: Transform | None
    """The pose of the control points alone, by their sigmas; None: fewer than three, or on one
    line."""

    def allows(self, T: Transform) -> bool:
        """Say whether pose `T` brings the used control points about to their places."""
        if not self.used.any():
            return True
        off = _miss(T, self.points, self.used)
        reach = _NEAR_M + _SIGMAS * self.points.sigma_m[self.used]
        return bool(np.mean(np.square(off / reach)) <= 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Adjusted:
    """The clouds' fit and the control points adjusted together."""

    fine: FineResult
    used: Mask
    """(n,) control points that were left in."""
    disagreement_m: float
    """Root mean square miss of the used points at the pose of the clouds alone."""
    p_value: float
    """Chance of such a miss if the clouds' covariance and the sigmas were true."""


def local_control(control: ControlPoints, source: Cloud, target: Cloud) -> Control:
    """Bring the points into local metres, and find a bad one among the control points.

    Raises
    ------
    InputError
        The points lie far outside their clouds: they belong to another frame.
    """
    points = replace(
        control,
        source=source.frame.to_local(control.source),
        target=target.frame.to_local(control.target),
    )
    for side, cloud in (("source", source), ("target", target)):
        _refuse_far(getattr(points, side), cloud, side, control)
    used = ~points.is_check
    T, used = _own_pose(points, used)
    return Control(points=points, used=used, T_target_source=T)


def _refuse_far(points: Points, cloud: Cloud, side: str, control: ControlPoints) -> None:
    """Refuse points farther from the cloud's box than its longest side."""
    low, high = np.quantile(cloud.xyz, [0.001, 0.999], axis=0)
    size = float((high - low).max())
    off = np.maximum(low - points, points - high).max(axis=1)
    worst = int(off.argmax()) if len(off) else 0
    if len(off) and off[worst] > max(size, 10.0):
        msg = (
            f"{control.where}: the {side} point of {control.names[worst]} lies {off[worst]:,.0f} m "
            f"outside {cloud.name}. Give the coordinates of the file itself, in its units; "
            f"{side}_x is the file's x, not its northing."
        )
        raise InputError(msg)


def _own_pose(points: ControlPoints, used: Mask) -> tuple[Transform | None, Mask]:
    """Return the pose of the control points, and which are left when bad ones are taken out."""
    used = used.copy()
    while True:
        T = _weighted_pose(points, used)
        if T is None or int(used.sum()) <= FEWEST_FOR_POSE:
            return T, used
        centre = points.target[used].mean(axis=0)
        _, bad = _worst(T, points, used, np.zeros((6, 6)), centre)
        if bad is None:
            return T, used
        used[bad] = False


def _weighted_pose(points: ControlPoints, used: Mask) -> Transform | None:
    source, target = points.source[used], points.target[used]
    if len(source) < FEWEST_FOR_POSE:
        return None
    for side in (source, target):
        spread = np.linalg.svd(side - side.mean(axis=0), compute_uv=False)
        if spread[0] <= 0.0 or spread[1] <= _THIN * spread[0]:
            return None
    T = fit_rigid(source, target)
    centre = target.mean(axis=0)
    for _ in range(10):
        step, _ = _solved(T, centre, points, used, np.zeros((6, 6)), 6)
        T = moved_by(T, step, centre)
        if float(np.abs(step).max()) < 1e-12:
            break
    return T


def _miss(T: Transform, points: ControlPoints, chosen: Mask) -> Values:
    """Return how far (k,) the chosen points lie from their places under `T`, metres."""
    off: Values = np.linalg.norm(apply(T, points.source[chosen]) - points.target[chosen], axis=1)
    return off


def _jacobian(moved: Points, centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return d(point) / d(omega, v), (n, 3, 6), for x' = c + Exp(omega)(x - c) + v."""
    arms = moved - centre
    J = np.zeros((len(arms), 3, 6))
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        J[:, axis, first] = arms[:, second]
        J[:, axis, second] = -arms[:, first]
        J[:, axis, 3 + axis] = 1.0
    return J


def _solved(
    T: Transform,
    centre: NDArray[np.float64],
    points: ControlPoints,
    used: Mask,
    information: NDArray[np.float64],
    dof: int,
    at: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the step (6,) from `T`, and the covariance (6, 6), of one weighted adjustment.

    `information` (6, 6) is what the clouds know about (omega, v), and `at` (6,) where, seen from
    `T`, their own pose lies.
    """
    moved = apply(T, points.source[used])
    J = _jacobian(moved, centre)
    weight = 1.0 / np.square(points.sigma_m[used])
    off = points.target[used] - moved
    H = np.einsum("nij,n,nik->jk", J, weight, J) + information
    g = np.einsum("nij,n,ni->j", J, weight, off)
    if at is not None:
        g = g + information @ at
    free = list(FREE[dof])
    step, covariance = np.zeros(6), np.zeros((6, 6))
    inverse = np.linalg.pinv(H[np.ix_(free, free)], hermitian=True)
    step[free] = inverse @ g[free]
    covariance[np.ix_(free, free)] = inverse
    return step, covariance


def _worst(
    T: Transform,
    points: ControlPoints,
    used: Mask,
    information: NDArray[np.float64],
    centre: NDArray[np.float64],
) -> tuple[float, int | None]:
    """Return the largest normalised residual, and its point where that is beyond chance.

    Each used point is held against the pose that all others (and the clouds' `information`) have
    without it, so a bad one cannot hide by pulling the pose towards itself.
    """
    places = np.flatnonzero(used)
    largest, bad = 0.0, None
    for place in places:
        rest = used.copy()
        rest[place] = False
        if not information.any() and _weighted_pose(points, rest) is None:
            continue
        step, covariance = _solved(T, centre, points, rest, information, 6, np.zeros(6))
        pose = moved_by(T, step, centre)
        alone = np.zeros_like(used)
        alone[place] = True
        moved = apply(pose, points.source[alone])
        J = _jacobian(moved, centre)[0]
        expected = J @ covariance @ J.T + np.eye(3) * points.sigma_m[place] ** 2
        off = points.target[place] - moved[0]
        size = float(np.sqrt(off @ np.linalg.solve(expected, off) / 3.0))
        if size > largest:
            largest, bad = size, int(place)
    return largest, bad if largest > _REJECT else None


def adjust(fine: FineResult, control: Control, dof: int) -> Adjusted | None:
    """Adjust the fit of the clouds and the control points together by their covariances.

    Least squares over (omega, v) about ``fine.covariance_about``: the clouds count by the inverse
    of their covariance, each control point by its sigma. Points whose normalised residual against
    all others is beyond chance are left out one by one, worst first (data snooping).

    Returns
    -------
    Adjusted or None
        None without control points, or where the clouds' covariance is unknown.
    """
    points, used = control.points, control.used.copy()
    if not used.any() or fine.covariance is None:
        return None
    centre, free = fine.covariance_about, list(FREE[dof])
    information = _information(fine, free)
    clouds = fine.T_target_source
    used = _without_bad(clouds, points, used, information, centre)
    T, at = clouds, np.zeros(6)
    for _ in range(10):
        step, covariance = _solved(T, centre, points, used, information, dof, at)
        T = moved_by(T, step, centre)
        at = at - step
        if float(np.abs(step).max()) < 1e-12:
            break
    off = _miss(clouds, points, used)
    loose = tuple(item for item in fine.unobservable if not _is_held(item, covariance))
    return Adjusted(
        fine=replace(fine, T_target_source=T, covariance=covariance, unobservable=loose),
        used=used,
        disagreement_m=float(np.sqrt(np.mean(np.square(off)))),
        p_value=_p_value(clouds, centre, information, points, used),
    )


def _information(fine: FineResult, free: Sequence[int]) -> NDArray[np.float64]:
    """Return what the clouds know of (omega, v), (6, 6): nothing along what they do not hold."""
    assert fine.covariance is not None
    information = np.zeros((6, 6))
    information[np.ix_(free, free)] = np.linalg.pinv(
        fine.covariance[np.ix_(free, free)], hermitian=True
    )
    for item in fine.unobservable:
        along = information @ np.asarray(item["vector"], dtype=np.float64)
        strength = float(along @ np.asarray(item["vector"]))
        if strength > 0.0:
            information = information - np.outer(along, along) / strength
    return information


def _is_held(item: Mapping[str, Any], covariance: NDArray[np.float64]) -> bool:
    """Say whether a motion that the clouds leave free is now known to a few centimetres.

    The vector is that of one metre of motion.
    """
    vector = np.asarray(item["vector"], dtype=np.float64)
    length = float(vector @ vector)
    return bool(np.sqrt(vector @ covariance @ vector) / length < _DISAGREE_M)


def _without_bad(
    clouds: Transform,
    points: ControlPoints,
    used: Mask,
    information: NDArray[np.float64],
    centre: NDArray[np.float64],
) -> Mask:
    """Return `used` without the points that the clouds and the other points contradict.

    At most a third of them (but one of two) can be bad: if more are, it is the clouds that differ,
    and all are left in to say so.
    """
    left = used.copy()
    most = max(1, int(used.sum()) // 3)
    while int(left.sum()) > 1:
        _, bad = _worst(clouds, points, left, information, centre)
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
) -> float:
    """Return the chance of the control points' joint miss at the pose of the clouds alone.

    Chi-square of what the joint adjustment leaves, in the clouds and in the points.
    """
    step, covariance = _solved(T, centre, points, used, information, 6, np.zeros(6))
    moved = apply(T, points.source[used])
    rows = _jacobian(moved, centre)
    left = points.target[used] - moved - rows @ step
    square = float((np.square(left) / np.square(points.sigma_m[used])[:, None]).sum())
    square += float(step @ information @ step)
    # Every coordinate is an observation, and so is each motion that the clouds hold; six are spent.
    known = int(np.linalg.matrix_rank(information, hermitian=True))
    redundancy = 3 * int(used.sum()) + known - int(np.linalg.matrix_rank(covariance))
    return float(stats.chi2.sf(square, max(redundancy, 1)))


def weigh_control(status: Status, reason: str, adjusted: Adjusted | None) -> tuple[Status, str]:
    """Return status and reason of the proof, with what the control points say about it."""
    if adjusted is None or status == "failed":
        return status, reason
    count = int(adjusted.used.sum())
    told = f"{count} control point{'s' if count != 1 else ''}"
    if adjusted.p_value < _DISAGREE_P and adjusted.disagreement_m > _DISAGREE_M:
        return "ambiguous", (
            f"the clouds and the {told} disagree by {adjusted.disagreement_m:.2g} m (root mean "
            f"square), more than both declare (p = {max(adjusted.p_value, 1e-9):.1g}): a point is "
            "misnamed or mistaken, a sigma is too small, or one cloud is bent. "
            f"Of the clouds alone: {reason}"
        )
    return status, (
        f"{reason} The {told} lie {1e3 * adjusted.disagreement_m:.0f} mm (root mean square) from "
        "the pose of the clouds alone and were adjusted with it."
    )
