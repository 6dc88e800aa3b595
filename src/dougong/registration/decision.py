"""From starting poses to one pose with a verdict: refine, compare, judge (METHOD.md 2.3 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import chi2

from dougong.registration import hypotheses as ranking
from dougong.registration.control import Adjusted, Control, weigh_control
from dougong.registration.handedness import LEFT_SENTENCE, OPEN_SENTENCE, handedness
from dougong.registration.hearing import Heard, hear_pair, icp_of, is_near_hint, yaw_deg
from dougong.registration.icp import refine
from dougong.registration.laps import Laps
from dougong.registration.look_alikes import look_alike_doubt
from dougong.registration.overlap import apply
from dougong.registration.prepare import Prepared
from dougong.registration.probability import BELIEF, Evidence
from dougong.registration.result import FineResult, Hypothesis, Status
from dougong.registration.rivals import is_near, is_same, middle_of
from dougong.registration.roof_sides import (
    LEFT_OUT,
    are_roofs_unsure,
    ground_says,
    height_left_open,
    unheld,
    without_unsure_roofs,
)
from dougong.registration.scale_check import size_doubt
from dougong.registration.settings import Register
from dougong.registration.verdict import Ruling
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
    whole = hear_pair((source, target), poses, params, control, clock)
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


def _without_roofs_in_doubt(
    heard: Heard,
    poses: Sequence[Transform],
    params: Register,
    control: Control | None,
    clock: Laps,
) -> Heard:
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
    if rest is not None:
        apart = np.linalg.norm(apply(rest.T, at[None]) - apply(heard.T, at[None]))
        if heard.status == "ok" and apart <= params.verdict.most_spread_m:
            return heard
        if _ground_says(heard, rest.T) != "differs":
            return replace(rest, reason=rest.reason + LEFT_OUT)
    if heard.status != "ok":
        return heard
    left_open = height_left_open(heard.court, heard.source, heard.target, heard.T)
    if left_open is None:
        return heard
    return replace(heard, status="ambiguous", reason=unheld(left_open), is_height_open=True)


def _rest(
    heard: Heard,
    poses: Sequence[Transform],
    params: Register,
    control: Control | None,
    clock: Laps,
) -> Heard | None:
    """Return what is proven without roofs of unknown side; None: nothing is."""
    T, rest = heard.T, None
    # What lies near a roof under a pose that is a roof's thickness off is asked once more.
    for _ in range(2):
        without = without_unsure_roofs(heard.source, heard.target, T)
        if without is None:
            return None
        rest = hear_pair(without, [T, *poses], params, control, clock, seen_through=heard.court)
        if rest.status != "ok":
            return None
        T = rest.T
    return rest


def _ground_says(heard: Heard, T: Transform) -> Literal["agrees", "differs", "nothing"]:
    return ground_says(heard.court, heard.source, heard.target, T)


def _doubted(
    heard: Heard, whole: Heard, params: Register, clock: Laps
) -> tuple[Status, str, Evidence] | None:
    """Return status, reason and evidence after every doubt was heard; None: it is left-handed.

    `whole` is what both clouds said with all their points: marks of the place are among them.
    """
    status, reason, evidence = heard.status, heard.reason, _evidence(heard.ruling, heard.spread_m)
    if heard.is_height_open:
        # The other side of the roof is one more pose that fits as well.
        evidence = _with_one_more(evidence)
    source, target, court, ruling, fine = (
        heard.source, heard.target, heard.court, heard.ruling, heard.fine,
    )  # fmt: skip
    if status == "ok" and fine is not None and params.fine == "point-to-point":
        pulled = _weigh_points(source, target, ruling, fine, params)
        if pulled is not None:
            (status, reason), evidence = pulled, replace(evidence, spread_m=np.inf)
    if status == "ok" and fine is not None and params.dof == 4:
        leaning = _lean(source, target, ruling, fine, params)
        if leaning is not None:
            status, reason, evidence = "ambiguous", leaning, replace(evidence, spread_m=np.inf)
    if status == "ok":
        clouds = whole.court, whole.source, whole.target
        alike = look_alike_doubt(*clouds, ruling, params.verdict)
        if alike is not None:
            status, reason, evidence = "ambiguous", alike, _with_one_more(evidence)
    if status == "ok" and fine is not None:
        doubt = size_doubt(source, target, heard.T, icp_of(params), params.verdict.most_spread_m)
        if doubt is not None:
            (reason, moved), status = doubt, "ambiguous"
            evidence = replace(evidence, spread_m=moved)
    if status == "ok":
        hand = handedness(court, heard.levels, ruling.winner, heard.quick, params.verdict)
        if hand == "left":
            return None
        if hand == "open":
            status, reason, evidence = "ambiguous", OPEN_SENTENCE, _with_one_more(evidence)
        if hand == "unknown":
            reason += " Its mirror image fits as well: what both clouds show is symmetric."
        clock.lap("mirror check")
    if status != "failed" and not is_near_hint(heard.T, params):
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


def _weigh_points(
    source: Prepared, target: Prepared, ruling: Ruling, fine: FineResult, params: Register
) -> tuple[Literal["ambiguous"], str] | None:
    """Return why a point-to-point pose is not ok: it is not where the surfaces meet.

    Points that lie farther apart than the clouds are rough pull their pose towards themselves: two
    samplings of one surface then meet decimetres off, each block agreeing. None: they do meet.
    """
    icp = icp_of(params).model_copy(update={"method": "point-to-plane"})
    plane = refine(source, target, ruling.winner.T, icp)
    apart = _apart_m(source, plane.T_target_source, fine.T_target_source)
    # The other half is for what the plane fit itself may be off.
    limit = params.verdict.most_spread_m / 2.0
    if apart <= limit:
        return None
    return "ambiguous", (
        f"point-to-point and point-to-plane fits end {apart:.2g} m apart (95 %; at most "
        f"{limit:.2g} m expected): the points are too far apart for the first. Use --fine "
        "point-to-plane."
    )


def _lean(
    source: Prepared, target: Prepared, ruling: Ruling, fine: FineResult, params: Register
) -> str | None:
    """Return why a levelled pose is not ok: the clouds lean against each other.

    The fit that may tilt leaves the levelled one by more than its own covariance allows and by
    more than half of what is correct. None: it does not.
    """
    icp = icp_of(params).model_copy(update={"dof": 6})
    free = refine(source, target, ruling.winner.T, icp)
    if free.covariance is None:
        return None
    turn = free.T_target_source[:3, :3] @ fine.T_target_source[:3, :3].T
    tilt = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0]]) / 2.0
    square = float(tilt @ np.linalg.solve(free.covariance[:2, :2], tilt))
    apart = _apart_m(source, free.T_target_source, fine.T_target_source)
    limit = params.verdict.most_spread_m / 2.0
    if apart <= limit or chi2.sf(square, 2) >= params.verdict.p_value:
        return None
    return (
        f"the clouds lean {np.degrees(np.linalg.norm(tilt)):.2f} deg against each other, which 4 "
        f"degrees of freedom leave as it is: the two fits end {apart:.2g} m apart (95 %; at most "
        f"{limit:.2g} m expected). Use --dof 6, or level the cloud that is not."
    )


def _apart_m(source: Prepared, one: Transform, other: Transform) -> float:
    """Return how far apart two poses put 95 % of the source's points at most, metres."""
    off = apply(one, source.xyz) - apply(other, source.xyz)
    return float(np.quantile(np.linalg.norm(off, axis=1), 0.95))


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


def _off_hint(T: Transform, params: Register) -> str:
    """Return what is to be said where no pose near the hint was left to be heard."""
    return (
        f"the clouds fit at a yaw of {yaw_deg(T):.0f} deg, and the hint says "
        f"{params.yaw_hint_deg:g}, within {params.plan.yaw_hint_range_deg:g}: nothing fits there. "
        "Check the hint, or register without it."
    )


def _listed(
    ruling: Ruling,
    T: Transform,
    starts: Sequence[Hypothesis],
    source: Prepared,
    target: Prepared,
) -> tuple[Hypothesis, ...]:
    """Return the winner, then the other refined poses and coarse ones, by score."""
    method = starts[0].method
    poses = [T, *(c.T for c in (*ruling.undecided, *ruling.beaten))]
    best, *refined = (
        Hypothesis(T_target_source=pose, score=score, method=f"{method}, rival" if k else method)
        for k, (pose, score) in enumerate(
            zip(poses, ranking.scores(poses, source, target), strict=True)
        )
    )
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
