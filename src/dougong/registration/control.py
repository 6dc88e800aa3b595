"""Control and check points: places surveyed in both frames, used by their sigmas or held out.

Control points propose a pose, decide between poses that the clouds cannot tell apart, and are
adjusted together with the fit of the clouds. One that the others contradict is found, named and
left out. Check points touch nothing: they say how right the result is (METHOD.md 3 and 5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.registration.control_solve import (
    RIGID,
    ControlPoints,
    information_of,
    joint,
    miss,
    own_pose,
)
from dougong.registration.icp_solve import FREE
from dougong.registration.result import FineResult, Status
from dougong.typing import Mask, Points, Transform

_NEAR_M = 0.5
"""A pose of the search may lie so far from the control points and still be theirs: it is not fine
yet."""
_SIGMAS = 4.0
DISAGREE_P = 1e-3
DISAGREE_M = 0.05
"""What METHOD.md 5 calls correct: two answers that differ by less may both be."""


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
        off = miss(T, self.points, self.used)
        reach = _NEAR_M + _SIGMAS * self.points.sigma_m[self.used]
        return bool(np.mean(np.square(off / reach)) <= 1.0)

    def refutes(self, T: Transform) -> bool:
        """Say whether a fitted pose misses the used control points by more than may be.

        By more than their sigmas allow, and by more than two right poses may differ.
        """
        off = miss(T, self.points, self.used)
        if not len(off) or np.sqrt(np.mean(np.square(off))) <= DISAGREE_M:
            return False
        square = float(np.square(off / self.points.sigma_m[self.used]).sum())
        return float(stats.chi2.sf(square, 3 * len(off))) < DISAGREE_P


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


def local_control(
    control: ControlPoints, source: Cloud, target: Cloud, free: Sequence[int] = RIGID
) -> Control:
    """Bring the points into local metres, and find a bad one among the control points.

    `free` says which of (omega, v, ln s) their own pose may have.

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
    T, used = own_pose(points, used, free)
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
    if not control.used.any() or fine.covariance is None:
        return None
    free, centre = FREE[dof], fine.covariance_about
    information = information_of(fine.covariance, free, fine.unobservable)
    found = joint(fine.T_target_source, information, centre, control.points, control.used, free)
    covariance = found.covariance[:6, :6]
    loose = tuple(item for item in fine.unobservable if not _is_held(item, covariance))
    return Adjusted(
        fine=replace(
            fine,
            T_target_source=found.T,
            covariance=covariance,
            covariance_of_control=found.of_control[:6, :6],
            unobservable=loose,
        ),
        used=found.used,
        disagreement_m=found.disagreement_m,
        p_value=found.p_value,
    )


def _is_held(item: Mapping[str, Any], covariance: NDArray[np.float64]) -> bool:
    """Say whether a motion that the clouds leave free is now known to a few centimetres.

    The vector is that of one metre of motion.
    """
    vector = np.asarray(item["vector"], dtype=np.float64)
    length = float(vector @ vector)
    return bool(np.sqrt(vector @ covariance @ vector) / length < DISAGREE_M)


def weigh_control(status: Status, reason: str, adjusted: Adjusted | None) -> tuple[Status, str]:
    """Return status and reason of the proof, with what the control points say about it."""
    if adjusted is None or status == "failed":
        return status, reason
    count = int(adjusted.used.sum())
    told = f"{count} control point{'s' if count != 1 else ''}"
    if adjusted.p_value < DISAGREE_P and adjusted.disagreement_m > DISAGREE_M:
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
