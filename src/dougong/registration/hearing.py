"""The best pose of a pair, fitted exactly, and what the proof says of it (METHOD.md 2.3 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dougong.registration.control import Adjusted, Control, adjust
from dougong.registration.covariance import displacement95
from dougong.registration.evidence import Court, hear, summon
from dougong.registration.icp import Icp, Level, build_levels, refine
from dougong.registration.laps import Laps
from dougong.registration.overlap import apply
from dougong.registration.prepare import Prepared
from dougong.registration.result import FineResult, Status
from dougong.registration.rivals import is_same, middle_of
from dougong.registration.settings import Register
from dougong.registration.status import status_of
from dougong.registration.told_apart import told_apart, told_by_control, without_refuted
from dougong.registration.verdict import Ruling, rule
from dougong.typing import Transform


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """The best pose of a pair and what the proof says of it, before it is doubted."""

    source: Prepared
    target: Prepared
    court: Court
    levels: tuple[Level, ...]
    quick: Icp
    ruling: Ruling
    fine: FineResult | None
    adjusted: Adjusted | None
    status: Status
    reason: str
    spread_m: float
    """How closely the blocks hold the pose, metres; inf: unknown."""
    is_height_open: bool = False
    """Only roofs of unknown side hold the height, see `roof_sides`."""

    @property
    def T(self) -> Transform:
        """Return the pose (source -> target), as exact as it is known."""
        return self.ruling.winner.T if self.fine is None else self.fine.T_target_source


def hear_pair(
    clouds: tuple[Prepared, Prepared],
    poses: Sequence[Transform],
    params: Register,
    control: Control | None,
    clock: Laps,
    seen_through: Court | None = None,
) -> Heard:
    """Return the best of what the poses lead to, fitted exactly, and whether it is proven.

    Parameters
    ----------
    seen_through : Court, optional
        Of the whole clouds, where `clouds` are parts of them: parts do not tell what their scanners
        saw through, nor whether they are single scans.
    """
    court, quick = summon(*clouds), _quick(icp_of(params), *clouds)
    if seen_through is not None:
        court = replace(
            court,
            source=replace(court.source, free=seen_through.source.free),
            target=replace(court.target, free=seen_through.target.free),
        )
    levels = build_levels(*clouds, quick)
    ruling = rule(
        court,
        levels,
        poses,
        quick,
        params.verdict,
        lambda T: is_near_hint(T, params) and (control is None or control.allows(T)),
    )
    ruling = told_by_control(court, levels, ruling, control, quick, params.verdict)
    ruling = _with_contradicted(ruling, params, control)
    ruling = told_apart(court, clouds, levels, ruling, quick, params.verdict)
    clock.lap("proof")
    fine, adjusted = _refined(*clouds, ruling, params, control)
    if control is not None and adjusted is not None:
        ruling = without_refuted(ruling, control)
    clock.lap("fine")
    status, reason, spread = _judged(court, ruling, fine, params)
    return Heard(
        source=clouds[0],
        target=clouds[1],
        court=court,
        levels=levels,
        quick=quick,
        ruling=ruling,
        fine=fine,
        adjusted=adjusted,
        status=status,
        reason=reason,
        spread_m=spread,
    )


def icp_of(params: Register) -> Icp:
    """Return the settings of the exact fit."""
    method = {} if params.fine == "none" else {"method": params.fine}
    return params.icp.model_copy(update={"dof": 4 if params.dof == 4 else 6, **method})


def _refined(
    source: Prepared, target: Prepared, ruling: Ruling, params: Register, control: Control | None
) -> tuple[FineResult | None, Adjusted | None]:
    """Return the exact fit at the winning pose, adjusted with the control points if there are any.

    None, None: what the proof has refused needs no exact pose.
    """
    if params.fine == "none" or status_of(ruling, None, params.verdict)[0] == "failed":
        return None, None
    icp = icp_of(params)
    fine = refine(source, target, ruling.winner.T, icp)
    adjusted = None if control is None else adjust(fine, control, icp.dof)
    return (fine if adjusted is None else adjusted.fine), adjusted


def _quick(icp: Icp, source: Prepared, target: Prepared) -> Icp:
    """Return settings for bringing every hypothesis to its place: wide bounds, few points."""
    spacing = max(source.spacing_m, target.spacing_m)
    return icp.model_copy(
        update={
            "method": "point-to-plane",
            "levels": 3,
            "first_distance_m": max(1.5, 12.0 * spacing),
            "last_distance_m": max(0.25, 3.0 * spacing),
            "points_per_level": min(4000, icp.points_per_level),
            "tolerance_m": 5e-4,
            "max_iterations": 20,
        }
    )


def _judged(
    court: Court, ruling: Ruling, fine: FineResult | None, params: Register
) -> tuple[Status, str, float]:
    """Return status, reason, and how closely the blocks hold the pose, metres (inf: unknown)."""
    status, reason = status_of(ruling, fine, params.verdict)
    if fine is None or status == "failed":
        return status, reason, np.inf
    final = hear(court, fine.T_target_source)
    if not is_same(final.T, ruling.winner.T, middle_of(court.source.points)):
        why = (
            "the fine fit left the pose that was judged best: the surface near it holds it "
            "too weakly. Control points or more overlap would decide."
        )
        return "ambiguous", why, np.inf
    if fine.covariance is None:
        return status, reason, np.inf
    explained = final.is_explained[: len(court.source.points)]
    spread = displacement95(
        fine.covariance,
        fine.covariance_about,
        apply(final.T, court.source.points[explained]),
        fine.covariance_blocks,
        fine.covariance_widening,
        fine.covariance_of_control,
    )
    if status != "ok":
        return status, reason, spread
    limit = params.verdict.most_spread_m
    if spread > limit:
        why = (
            f"the parts of the shared surface disagree about the pose by {spread:.2g} m "
            f"(95 %; at most {limit:.2g} m expected): it is held too weakly, or one cloud is "
            "bent. Control points or more overlap would decide."
        )
        return "ambiguous", why, spread
    agree = f"The parts of the shared surface agree about it to {1e3 * spread:.0f} mm (95 %)."
    return status, f"{reason} {agree}", spread


def _with_contradicted(ruling: Ruling, params: Register, control: Control | None) -> Ruling:
    """Return the ruling with what was given, and the clouds contradict, in words."""
    if ruling.overruled is None:
        return ruling
    T, names = ruling.overruled.T, []
    if not is_near_hint(T, params):
        names.append("the yaw hint")
    if control is not None and (control.refutes(T) or not control.allows(T)):
        names.append("the control points")
    return replace(ruling, contradicted=" and ".join(names))


def is_near_hint(T: Transform, params: Register) -> bool:
    """Say whether a pose is turned as the yaw hint says; any is where there is none."""
    hint, reach = params.yaw_hint_deg, params.plan.yaw_hint_range_deg
    return hint is None or abs((yaw_deg(T) - hint + 180.0) % 360.0 - 180.0) <= reach


def yaw_deg(T: Transform) -> float:
    """Return the turn about the vertical of a pose."""
    return float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
