"""From starting poses to one pose with a verdict: refine, compare, judge (METHOD.md 2.3 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dougong.registration import hypotheses as ranking
from dougong.registration.control import Adjusted, Control, adjust, weigh_control
from dougong.registration.covariance import displacement95
from dougong.registration.evidence import Court, hear, summon
from dougong.registration.handedness import LEFT_SENTENCE, OPEN_SENTENCE, handedness
from dougong.registration.icp import Icp, Level, build_levels, refine
from dougong.registration.laps import Laps
from dougong.registration.look_alikes import look_alike_doubt
from dougong.registration.overlap import apply
from dougong.registration.prepare import Prepared
from dougong.registration.probability import BELIEF, Evidence
from dougong.registration.result import FineResult, Hypothesis, Status
from dougong.registration.rivals import is_near, is_same, middle_of
from dougong.registration.roof_sides import (
    LEFT_OUT,
    UNHELD,
    are_roofs_unsure,
    ground_says,
    without_unsure_roofs,
)
from dougong.registration.scale_check import size_doubt
from dougong.registration.settings import Register
from dougong.registration.told_by_ground import told_by_ground
from dougong.registration.verdict import Ruling, rule, status_of
from dougong.typing import Transform

_LISTED = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The verdict on a pair, in local frames."""

    status: Literal["ok", "ambiguous", "failed"]
    reason: str
    T: Transform | None
    fine: FineResult | None
    probability: float
    hypotheses: tuple[Hypothesis, ...]
    margin: float
    ruling: Ruling | None
    evidence: Evidence | None = None
    """What `probability` was worked out from; None: no pose was judged."""
    adjusted: Adjusted | None = None
    """With the control points; None: there are none, or they changed nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Heard:
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

    @property
    def T(self) -> Transform:
        """Return the pose (source -> target), as exact as it is known."""
        return self.ruling.winner.T if self.fine is None else self.fine.T_target_source


def decide(
    source: Prepared,
    target: Prepared,
    starts: Sequence[Hypothesis],
    params: Register,
    clock: Laps | None = None,
    control: Control | None = None,
) -> Found:
    """Refine, compare and judge the starting poses; local frames."""
    clock = clock or Laps()
    if not starts:
        return refused(
            "the coarse search found no pose at which the two clouds have anything in common."
        )
    poses = [h.T_target_source for h in starts]
    whole = _hear((source, target), poses, params, control, clock)
    heard = _without_roofs_in_doubt(whole, poses, params, control, clock)
    answer = _doubted(heard, whole, params, clock)
    if answer is None:
        return refused(LEFT_SENTENCE)
    status, reason, evidence = answer
    adjusted, ruling = heard.adjusted, heard.ruling
    status, reason = weigh_control(status, reason, adjusted)
    listed = _listed(ruling, heard.T, starts, source, target)
    return Found(
        status=status,
        reason=reason,
        T=None if status == "failed" else heard.T,
        fine=heard.fine,
        probability=_probability(status, ruling, evidence),
        hypotheses=listed,
        margin=_margin(listed),
        ruling=ruling,
        evidence=evidence,
        adjusted=adjusted,
    )


def _hear(
    clouds: tuple[Prepared, Prepared],
    poses: Sequence[Transform],
    params: Register,
    control: Control | None,
    clock: Laps,
) -> _Heard:
    """Return the best of what the poses lead to, fitted exactly, and whether it is proven."""
    court, quick = summon(*clouds), _quick(_icp(params), *clouds)
    levels = build_levels(*clouds, quick)
    ruling = rule(
        court,
        levels,
        poses,
        quick,
        params.verdict,
        lambda T: _is_near_hint(T, params) and (control is None or control.allows(T)),
    )
    ruling = told_by_ground(court, clouds, levels, ruling, quick, params.verdict)
    clock.lap("proof")
    fine, adjusted = _refined(*clouds, ruling, params, control)
    clock.lap("fine")
    status, reason, spread = _judged(court, ruling, fine, params)
    return _Heard(
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


def _without_roofs_in_doubt(
    heard: _Heard,
    poses: Sequence[Transform],
    params: Register,
    control: Control | None,
    clock: Laps,
) -> _Heard:
    """Return what a pair says without roofs of unknown side, if they may hold its height wrongly.

    What was heard with them stays where the ground or control points hold the height, where turns
    are undecided (less of the building does not tell them apart), and where all else holds the same
    pose: with the roofs it is the more exact one.
    """
    if heard.adjusted is not None or not are_roofs_unsure(heard.source, heard.target):
        return heard
    at, winner = heard.ruling.middle, heard.ruling.winner.T
    is_turned = any(not is_near(c.T, winner, at) for c in heard.ruling.undecided)
    if is_turned or _ground_says(heard, heard.T) == "agrees":
        return heard
    rest = _rest(heard, poses, params, control, clock)
    if rest is None or _ground_says(heard, rest.T) == "differs":
        return replace(heard, status="ambiguous", reason=UNHELD) if heard.status == "ok" else heard
    apart = np.linalg.norm(apply(rest.T, at[None]) - apply(heard.T, at[None]))
    if heard.status == "ok" and apart <= params.verdict.most_spread_m:
        return heard
    return replace(rest, reason=rest.reason + LEFT_OUT)


def _rest(
    heard: _Heard,
    poses: Sequence[Transform],
    params: Register,
    control: Control | None,
    clock: Laps,
) -> _Heard | None:
    """Return what is proven without roofs of unknown side; None: nothing is."""
    T, rest = heard.T, None
    # What lies near a roof under a pose that is a roof's thickness off is asked once more.
    for _ in range(2):
        without = without_unsure_roofs(heard.source, heard.target, T)
        rest = None if without is None else _hear(without, [T, *poses], params, control, clock)
        if rest is None or rest.status != "ok":
            return None
        T = rest.T
    return rest


def _ground_says(heard: _Heard, T: Transform) -> Literal["agrees", "differs", "nothing"]:
    return ground_says(heard.court, heard.source, heard.target, T)


def _doubted(
    heard: _Heard, whole: _Heard, params: Register, clock: Laps
) -> tuple[Status, str, Evidence] | None:
    """Return status, reason and evidence after every doubt was heard; None: it is left-handed.

    `whole` is what both clouds said with all their points: marks of the place are among them.
    """
    status, reason, evidence = heard.status, heard.reason, _evidence(heard.ruling, heard.spread_m)
    if reason == UNHELD:
        # The other side of the roof is one more pose that fits as well.
        evidence = _with_one_more(evidence)
    source, target, court, ruling, fine = (
        heard.source, heard.target, heard.court, heard.ruling, heard.fine,
    )  # fmt: skip
    if status == "ok" and fine is not None and params.fine == "point-to-point":
        pulled = _weigh_points(source, target, ruling, fine, params)
        if pulled is not None:
            (status, reason), evidence = pulled, replace(evidence, spread_m=np.inf)
    if status == "ok":
        clouds = whole.court, whole.source, whole.target
        alike = look_alike_doubt(*clouds, ruling, params.verdict)
        if alike is not None:
            status, reason, evidence = "ambiguous", alike, _with_one_more(evidence)
    if status == "ok" and fine is not None:
        doubt = size_doubt(source, target, heard.T, _icp(params), params.verdict.most_spread_m)
        if doubt is not None:
            (reason, moved), status = doubt, "ambiguous"
            evidence = replace(evidence, spread_m=moved)
    if status == "ok":
        hand = handedness(court, heard.levels, ruling.winner, heard.quick, params.verdict)
        if hand == "left":
            return None
        if hand == "open":
            status, reason, evidence = "ambiguous", OPEN_SENTENCE, _with_one_more(evidence)
        reason += " Its mirror image fits as well." if hand == "unknown" else ""
        clock.lap("mirror check")
    if status == "ok" and not _is_near_hint(heard.T, params):
        status, reason = "ambiguous", _off_hint(heard.T, params)
    return status, reason, evidence


def _evidence(ruling: Ruling, spread_m: float) -> Evidence:
    return Evidence(
        sharpness=ruling.sharpness,
        explained=ruling.explained,
        violation=ruling.violation,
        spread_m=spread_m,
        rivals=tuple(c.chance for c in (*ruling.undecided, *ruling.beaten)),
        is_undecided=bool(ruling.undecided),
    )


def _with_one_more(evidence: Evidence) -> Evidence:
    """Return the evidence with one more rival that fits as well as the winner."""
    return replace(evidence, rivals=(*evidence.rivals, 1.0), is_undecided=True)


def _probability(status: str, ruling: Ruling, evidence: Evidence) -> float:
    """Return the probability of the pose; 0 where it is refused or what is known contradicts it."""
    if status == "failed" or ruling.overruled is not None:
        return 0.0
    return BELIEF.probability(evidence)


def _icp(params: Register) -> Icp:
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
    icp = _icp(params)
    fine = refine(source, target, ruling.winner.T, icp)
    adjusted = None if control is None else adjust(fine, control, icp.dof)
    return (fine if adjusted is None else adjusted.fine), adjusted


def _weigh_points(
    source: Prepared, target: Prepared, ruling: Ruling, fine: FineResult, params: Register
) -> tuple[Literal["ambiguous"], str] | None:
    """Return why a point-to-point pose is not ok: it is not where the surfaces meet.

    Points that lie farther apart than the clouds are rough pull their pose towards themselves: two
    samplings of one surface then meet decimetres off, each block agreeing. None: they do meet.
    """
    icp = _icp(params).model_copy(update={"method": "point-to-plane"})
    plane = refine(source, target, ruling.winner.T, icp).T_target_source
    off = apply(plane, source.xyz) - apply(fine.T_target_source, source.xyz)
    apart = float(np.quantile(np.linalg.norm(off, axis=1), 0.95))
    # The other half is for what the plane fit itself may be off.
    limit = params.verdict.most_spread_m / 2.0
    if apart <= limit:
        return None
    return "ambiguous", (
        f"point-to-point and point-to-plane fits end {apart:.2g} m apart (95 %; at most "
        f"{limit:.2g} m expected): the points are too far apart for the first. Use --fine "
        "point-to-plane."
    )


def refused(reason: str) -> Found:
    """Return the answer when no pose is even listed."""
    return Found(
        status="failed",
        reason=reason,
        T=None,
        fine=None,
        probability=0.0,
        hypotheses=(),
        margin=0.0,
        ruling=None,
    )


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
) -> tuple[Literal["ok", "ambiguous", "failed"], str, float]:
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


def _is_near_hint(T: Transform, params: Register) -> bool:
    """Say whether a pose is turned as the yaw hint says; any is where there is none."""
    hint, reach = params.yaw_hint_deg, params.plan.yaw_hint_range_deg
    return hint is None or abs((_yaw_deg(T) - hint + 180.0) % 360.0 - 180.0) <= reach


def _off_hint(T: Transform, params: Register) -> str:
    """Return what is to be said where no pose near the hint was left to be heard."""
    return (
        f"the clouds fit at a yaw of {_yaw_deg(T):.0f} deg, and the hint says "
        f"{params.yaw_hint_deg:g}, within {params.plan.yaw_hint_range_deg:g}: nothing fits there. "
        "Check the hint, or register without it."
    )


def _yaw_deg(T: Transform) -> float:
    return float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))


def _listed(
    ruling: Ruling,
    T: Transform,
    starts: Sequence[Hypothesis],
    source: Prepared,
    target: Prepared,
) -> tuple[Hypothesis, ...]:
    """Return the winner, then the other refined poses and coarse ones, by score."""
    method = starts[0].method
    best = Hypothesis(T_target_source=T, score=ranking.score(T, source, target), method=method)
    refined = [
        Hypothesis(
            T_target_source=c.T, score=ranking.score(c.T, source, target), method=f"{method}, rival"
        )
        for c in (*ruling.undecided, *ruling.beaten)
    ]
    others = ranking.dedupe([*refined, *starts], source)
    middle = middle_of(source.xyz)
    others = [h for h in others if not is_same(h.T_target_source, T, middle)]
    return (best, *others[: _LISTED - 1])


def _margin(listed: Sequence[Hypothesis]) -> float:
    """Return 1 - s2 / s1, at least 0; 1 when there is one pose."""
    if len(listed) < 2:
        return 1.0
    best = max(listed[0].score, 1e-12)
    return max(0.0, 1.0 - max(h.score for h in listed[1:]) / best)
