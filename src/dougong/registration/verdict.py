"""The proof: which refined poses the data can tell apart, and whether the best one holds.

Hypotheses are compared pair by pair on the same points, summed over blocks of about 5 m, so that
errors which neighbouring points share count once (METHOD.md 2.3). A raster score or an RMSE is
not evidence: a round building turned by 180 degrees fits almost as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dougong.params import Parameters
from dougong.registration.covariance import blocks_of
from dougong.registration.evidence import (
    Court,
    Testimony,
    hear,
    sharpness,
    structure_weights,
    support,
    violation,
)
from dougong.registration.icp import Icp, Level, refined_pose
from dougong.registration.overlap import apply, inverse
from dougong.registration.randomisation import sign_flip, student
from dougong.registration.rivals import (
    is_near,
    is_same,
    middle_of,
    propose_neighbours,
    propose_rivals,
)
from dougong.threads import each
from dougong.typing import Mask, Transform, Values

_LEADERS = 2
"""Of so many headings the best rival is looked at as closely as the winner."""
_TWIN_M = 0.1
"""Fits that end farther apart than this (95 % of the structure) rest in different places: twice
what is correct, and more than an unfinished fit lacks."""
_SHARED = 0.5
"""A pose that shares this much of a cloud's structure is no laying of one wall on another."""


class Verdict(Parameters):
    """How sure the proof has to be."""

    block_m: Annotated[float, Field(gt=0)] = 5.0
    """Edge of the blocks that count as one observation each."""
    p_value: Annotated[float, Field(gt=0, lt=0.5)] = 1e-3
    """A rival is beaten when the blocks' evidence for it is rarer than this by chance."""
    gain: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """A rival is beaten only when the winner also contradicts this much less of the surface."""
    least_overlap: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Less shared surface than this proves nothing."""
    least_explained: Annotated[float, Field(ge=0, le=1)] = 0.25
    """Share of the structure near the other cloud that the pose must explain."""
    least_sharpness: Annotated[float, Field(ge=1)] = 3.0
    """So many times more of the structure that faces the way must be explained at the pose than
    half a metre beside it."""
    most_violation: Annotated[float, Field(ge=0, le=1)] = 0.08
    """Share of the structure that may stand where the other cloud saw free space."""
    most_spread_m: Annotated[float, Field(gt=0)] = 0.05
    """By how much the blocks may disagree about the pose, as 95 % displacement of the shared
    surface: 50 mm is what METHOD.md 5 calls correct. Thin or rough clouds find the place, but not
    that closely, and are told so."""
    poses: Annotated[int, Field(ge=1)] = 8
    """So many coarse hypotheses are refined."""
    neighbours: Annotated[int, Field(ge=0)] = 4
    """So many poses within a metre of the winner, where a fit may come to rest, are refined too."""
    twin_gain: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """For such neighbours so little is enough, if it is as rare as `p_value`; `gain` always is."""
    rivals: Annotated[int, Field(ge=0)] = 6
    """So many poses made by turning the winner, and half as many by shifting, are refined too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One rival against the winner."""

    T: Transform
    gain: float
    """Weighted mean loss of the rival minus the winner's, over all points: > 0 for the winner."""
    p_value: float
    """Chance of so much evidence for the winner if blocks did not prefer either."""
    blocks: int
    p_shared: float | None = None
    """`p_value` over what both poses share, of a rival that loses only by sharing less; see
    `shared_chance`. None: it does not explain what it shares as well as the winner does."""

    @property
    def chance(self) -> float:
        """Return the p-value that counts: over all, or over what is shared if that is larger."""
        return self.p_value if self.p_shared is None else max(self.p_value, self.p_shared)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ruling:
    """What the court says about a pair."""

    winner: Testimony
    middle: NDArray[np.float64]
    """(3,) of the source's points, in its own frame."""
    undecided: tuple[Comparison, ...]
    """Rivals that the data cannot tell from the winner, closest first."""
    beaten: tuple[Comparison, ...]
    explained: float
    """Share of the structure that both clouds show near each other, see `support`."""
    sharpness: float
    violation: float
    overruled: Comparison | None = None
    """How the winner compares with a pose that is not allowed (by a hint, by control points) and
    that the clouds prefer beyond doubt; None: there is none."""
    contradicted: str = ""
    """What was given that leaves the pose of `overruled` out, in words."""
    told: str = ""
    """What told the winner from poses that fit as well; see `told_apart`."""


def compare(
    court: Court,
    winner: Testimony,
    rival: Testimony,
    block_m: float,
    domain: Mask | None = None,
) -> Comparison:
    """Return the paired block comparison of two poses.

    Blocks lie in the source's frame; target points are put there by the winner's pose, so that
    what both clouds say about one place counts once. If the blocks preferred neither pose, each
    block's difference could as well have had the other sign (Fisher's randomisation test), or
    their mean were 0 (Student's t). The first tells many unequal blocks, the second a few alike;
    the smaller chance counts, doubled because two were looked at. `domain` (m,): only these points
    are heard.
    """
    back = apply(inverse(winner.T), court.target.points)
    places = np.concatenate([court.source.points, back])
    extent = np.ptp(places, axis=0).max()
    block, count = blocks_of(places, min(block_m, max(float(extent) / 8.0, 1e-6)))
    weights = court.weights if domain is None else court.weights * domain
    difference = weights * (rival.loss - winner.loss)
    sums: Values = np.bincount(block, difference, count).astype(np.float64)
    mass = np.bincount(block, weights, count)
    gain = float(sums.sum() / max(float(mass.sum()), 1e-300))
    sums = sums[mass > 0.0]
    chance = min(sign_flip(_telling(sums, 0.9)), student(_telling(sums, 0.99)))
    p_value = min(1.0, 2.0 * chance)
    return Comparison(T=rival.T, gain=gain, p_value=p_value, blocks=len(_telling(sums, 0.9)))


def _telling(sums: Values, share: float) -> Values:
    """Return the largest block sums, which carry `share` of the difference.

    Whichever pose they prefer. The many that hardly differ would all follow one small common
    error, such as a bent cloud's, and outvote the few walls that do tell.
    """
    order = np.argsort(-np.abs(sums), kind="stable")
    carried = np.cumsum(np.abs(sums[order]))
    if not len(carried) or carried[-1] <= 0.0:
        return sums[:0]
    telling: Values = sums[order[: int(np.searchsorted(carried, share * carried[-1])) + 1]]
    return telling


def separate(poses: Sequence[Testimony], at: NDArray[np.float64]) -> list[Testimony]:
    """Return `poses`, best first, without those that are the same as a better one."""
    kept: list[Testimony] = []
    for pose in sorted(poses, key=lambda item: item.total):
        if not any(is_same(pose.T, other.T, at) for other in kept):
            kept.append(pose)
    return kept


def rule(
    court: Court,
    levels: tuple[Level, ...],
    starts: Sequence[Transform],
    icp: Icp,
    params: Verdict,
    is_allowed: Callable[[Transform], bool] = lambda _: True,
) -> Ruling:
    """Refine every start, add rivals of the best, and compare all with the best.

    Parameters
    ----------
    levels : tuple of Level
        Coarse levels: every pose is refined on them.
    starts : sequence of (4, 4)
        Coarse poses, at least one.
    is_allowed : callable
        What a yaw hint leaves; other poses are rivals only while nothing else is left.
    """
    at = middle_of(court.source.points)
    poses = separate(_all_refined(court, levels, starts[: params.poses], icp), at)
    rivals = propose_rivals(court, poses[0], params.rivals)
    poses = separate([*poses, *_all_refined(court, levels, rivals, icp)], at)
    best = poses[0]
    poses = [pose for pose in poses if is_allowed(pose.T)] or poses
    beside = propose_neighbours(court, poses[0], params.neighbours)
    near = _all_refined(court, levels, beside, icp)
    near = [pose for pose in near if is_allowed(pose.T) or not is_allowed(poses[0].T)]
    winner, twins = _told_apart(court, [poses[0], *near])
    overruled = None
    if best is not poses[0]:
        overruled = compare(court, best, winner, params.block_m)
        overruled = overruled if is_beaten(overruled, params) else None
    others = [pose for pose in poses[1:] if not is_same(pose.T, winner.T, at)]
    others = _looked_at_closely(court, levels, others, icp)
    undecided, beaten = _compared(court, winner, others, twins, params)
    return Ruling(
        winner=winner,
        middle=at,
        undecided=undecided,
        beaten=beaten,
        explained=support(court, winner),
        sharpness=sharpness(court, winner),
        violation=violation(court, winner),
        overruled=overruled,
    )


def _compared(
    court: Court,
    winner: Testimony,
    others: Sequence[Testimony],
    twins: Sequence[Testimony],
    params: Verdict,
) -> tuple[tuple[Comparison, ...], tuple[Comparison, ...]]:
    """Return the poses that cannot be told from the winner and those that it beats, closest first.

    Of `others` it is asked what both clouds share, not of `twins`, which rest beside the winner.
    """

    def against(rival: Testimony) -> Comparison:
        shared = shared_chance(court, winner, rival, params)
        return replace(compare(court, winner, rival, params.block_m), p_shared=shared)

    results = each(against, others)
    results += [compare(court, winner, twin, params.block_m) for twin in twins]
    results.sort(key=lambda comparison: comparison.gain)
    at = middle_of(court.source.points)
    is_told = [
        c.p_shared is None and is_beaten(c, params, is_near(c.T, winner.T, at)) for c in results
    ]
    undecided = tuple(c for c, told in zip(results, is_told, strict=True) if not told)
    return undecided, tuple(c for c, told in zip(results, is_told, strict=True) if told)


def _looked_at_closely(
    court: Court, levels: tuple[Level, ...], rivals: Sequence[Testimony], icp: Icp
) -> list[Testimony]:
    """Return the rivals, the best of each heading moved to where a fit close to it rests better.

    The winner is looked for as closely: a true pose heard half a metre off would lose to a turn of
    itself.
    """
    at = middle_of(court.source.points)
    found: list[Testimony] = []
    leaders: list[Testimony] = []
    for pose in sorted(rivals, key=lambda item: item.total):
        if len(leaders) < _LEADERS and not any(
            is_same(pose.T, other.T, at, shift_m=np.inf) for other in leaders
        ):
            leaders.append(pose)
            near = _all_refined(court, levels, propose_neighbours(court, pose, 2), icp)
            same = [item for item in near if is_same(item.T, pose.T, at)]
            pose = min([pose, *same], key=lambda item: item.total)
        found.append(pose)
    return found


def _told_apart(court: Court, poses: Sequence[Testimony]) -> tuple[Testimony, list[Testimony]]:
    """Return the best of `poses`, close to one another, and those that rest somewhere else."""
    points = court.source.points[court.source.is_structure]
    points = points[:: max(1, len(points) // 1000)]
    best, *others = sorted(poses, key=lambda item: item.total)
    apart: list[Testimony] = []
    for pose in others:
        moved = apply(pose.T, points)
        offs = [np.linalg.norm(moved - apply(o.T, points), axis=1) for o in (best, *apart)]
        if len(points) and all(np.quantile(off, 0.95) > _TWIN_M for off in offs):
            apart.append(pose)
    return best, apart


def is_beaten(comparison: Comparison, params: Verdict, is_close: bool = False) -> bool:
    """Say whether the data tell a rival from the winner.

    The larger the difference, the less rare it has to be, up to ten times at three times the gain
    asked for: small sites have few blocks, and a handful of walls cannot be rarer. Within about a
    metre (`is_close`) what is bent or unseen is alike for both: a small gain is a true one, and a
    large one needs no count of blocks.
    """
    if is_close:
        is_rare = comparison.gain >= params.twin_gain and comparison.p_value <= params.p_value
        return is_rare or comparison.gain >= params.gain
    surplus = min(max((comparison.gain / params.gain - 1.0) / 2.0, 0.0), 1.0)
    limit = params.p_value * 10.0**surplus
    return comparison.gain >= params.gain and comparison.p_value <= limit


def shared_chance(
    court: Court, winner: Testimony, rival: Testimony, params: Verdict
) -> float | None:
    """Return the chance that a rival is as good as the winner where both clouds show something.

    None for a rival that is contradicted more than the winner there.

    What lies outside the other cloud's plan counts against a pose in `compare`, else one could
    win by moving the clouds apart. But unseen is not empty: where each cloud shows another end
    of a building whose ends are alike, a pose that lays one end on the other shares more than
    the true one and is wrong. So a rival that would pass for a pose of its own, and explains
    what lies well within both clouds as well as the winner does, is not beaten by sharing less.
    """
    weights, split = structure_weights(court), len(court.source.points)
    shared = [weights * pose.is_within for pose in (winner, rival)]
    share = max(
        float(shared[1][side].sum()) / max(float(weights[side].sum()), 1e-300)
        for side in (slice(0, split), slice(split, None))
    )
    if share < params.least_overlap:
        return None
    loss = [
        float(part @ pose.loss) / max(float(part.sum()), 1e-300)
        for part, pose in zip(shared, (winner, rival), strict=True)
    ]
    if loss[1] > loss[0] + params.gain:
        return None
    common = compare(court, winner, rival, params.block_m, winner.is_within & rival.is_within)
    if is_beaten(common, params, is_close=True):
        return None
    if support(court, rival) < params.least_explained:
        return None
    # Any wall can be laid on any other with the rest of the cloud outside: of a pose that shares
    # little, as much is asked as of the winner.
    is_held = share >= _SHARED or sharpness(court, rival) >= params.least_sharpness
    is_free = violation(court, rival) <= params.most_violation
    return common.p_value if is_held and is_free else None


def _all_refined(
    court: Court, levels: tuple[Level, ...], starts: Iterable[Transform], icp: Icp
) -> list[Testimony]:
    """Return what is said about the poses that fits lead to from every start."""
    return each(lambda T: hear(court, refined_pose(levels, T, icp)), starts)
