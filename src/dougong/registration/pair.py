"""From two clouds to one pose with a verdict: search, then proof (METHOD.md 2 and 3)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from dougong._checks import as_transform
from dougong.cloud import Cloud, Frame
from dougong.errors import FrameError
from dougong.params import Parameters
from dougong.registration import hypotheses as ranking
from dougong.registration.checks import checks_document
from dougong.registration.congruent_sets import CongruentSets, four_pcs
from dougong.registration.control import (
    Adjusted,
    Control,
    ControlPoints,
    adjust,
    local_control,
    weigh_control,
)
from dougong.registration.covariance import displacement95
from dougong.registration.evidence import Court, hear, summon
from dougong.registration.free_scale import search_scale
from dougong.registration.free_scale_result import in_metres, refusal, scale_document, with_scale
from dougong.registration.handedness import LEFT_SENTENCE, handedness
from dougong.registration.icp import Icp, build_levels, refine
from dougong.registration.overlap import apply
from dougong.registration.picked_pairs import (
    PairFit,
    PickedPairs,
    fit_pairs,
    from_levelled,
    levelled_source,
    starts_of,
    weigh,
    with_pairs,
)
from dougong.registration.plan_search import PlanSearch, plan_search
from dougong.registration.prepare import Prepare, Prepared, prepare
from dougong.registration.principal_axes import improved_pca, traditional_pca
from dougong.registration.result import FineResult, Hypothesis, Registration
from dougong.registration.rivals import is_same, middle_of
from dougong.registration.sample_consensus import SacIa, sac_ia
from dougong.registration.sanity import is_mirrored, propose_scale
from dougong.registration.verdict import Ruling, Verdict, rule, status_of
from dougong.typing import Kind, Transform

Coarse = Literal["auto", "plan", "improved-pca", "pca", "sac-ia", "4pcs", "none"]
_LISTED = 12
_FACTORS = (0.9, 1.1)
"""Combined factors of survey projections, with room to spare."""


class Register(Parameters):
    """How one cloud is registered to another."""

    coarse: Coarse = "auto"
    """Where starting poses come from; auto: the plan search. none: the files' own coordinates."""
    fine: Literal["point-to-plane", "point-to-point", "none"] = "point-to-plane"
    """How the best pose is refined."""
    dof: Literal["auto", 4, 5, 6, 7] = "auto"
    """Degrees of freedom: 4 levelled, 5 levelled with scale, 6 rigid, 7 rigid with scale; auto: 6
    with a gravity prior."""
    filtered: bool = False
    """The inputs are clean already: nothing is dropped before the search."""
    yaw_hint_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Known turn from source to target about the vertical, within 15 degrees."""
    grid_scale: Literal["auto", "off"] | float = "auto"
    """Combined factor (grid / ground) of clouds in a map projection; auto: from their system and
    height; off: they are true to scale, as site-calibrated ground systems are."""
    accept_best: bool = False
    """The caller takes the best pose of an ambiguous result; the status stays ambiguous."""
    prepare: Prepare = Prepare()
    plan: PlanSearch = PlanSearch()
    sac_ia: SacIa = SacIa()
    congruent_sets: CongruentSets = CongruentSets()
    icp: Icp = Icp()
    verdict: Verdict = Verdict()

    @field_validator("grid_scale", mode="before")
    @classmethod
    def _is_a_factor_or_a_word(cls, value: object) -> object:
        if value in ("auto", "off"):
            return value
        try:
            factor = float(str(value))
        except ValueError:
            factor = float("nan")
        if not _FACTORS[0] <= factor <= _FACTORS[1]:
            msg = (
                f"{value!r} is neither auto, off nor a factor between {_FACTORS[0]:g} and "
                f"{_FACTORS[1]:g} (grid / ground, such as 0.9996)"
            )
            raise ValueError(msg)
        return factor

    @field_validator("dof", mode="before")
    @classmethod
    def _read_a_number(cls, value: object) -> object:
        return int(value) if isinstance(value, str) and value.isdigit() else value


@dataclass(slots=True)
class _Clock:
    """Seconds per step."""

    seconds: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now


def register(
    source: Cloud,
    target: Cloud,
    params: Register | None = None,
    *,
    source_kind: Kind = "lidar",
    target_kind: Kind = "photogrammetry",
    pairs: PickedPairs | None = None,
    control: ControlPoints | None = None,
) -> Registration:
    """Find the motion from `source`'s file coordinates to `target`'s, and say how sure it is.

    Parameters
    ----------
    source, target : Cloud
        Raw or filtered; thinned and cleaned here for the search, never changed.
    params : Register, optional
    source_kind, target_kind : {"lidar", "photogrammetry"}
        What a sensor can and cannot see decides what counts as a contradiction.
    pairs : PickedPairs, optional
        Places that a person picked in both: their pose is heard beside those of the search.
    control : ControlPoints, optional
        Places surveyed in both frames: adjusted together with the clouds, or held out as checks.

    Returns
    -------
    Registration
        Status ``ok``, ``ambiguous`` or ``failed`` with a reason in words.

    Raises
    ------
    FrameError
        Heights and plan of a file have different units.
    InputError
        The pairs fix no pose, or they or the control points do not belong to these clouds.
    RegistrationError
        A cloud has too few points, or is not levelled.

    Notes
    -----
    Deterministic; independent of thread count, point order and coordinate offset.
    """
    params = params or Register()
    if params.dof in (5, 7):
        return _with_free_scale(source, target, params, (source_kind, target_kind), pairs, control)
    clock = _Clock()
    fit = None if pairs is None else fit_pairs(pairs, source, target)
    level = None if fit is None else levelled_source(source, fit)
    if fit is not None and level is not None:
        cloud, own, matrix = level
        straight = register(
            cloud,
            target,
            params,
            source_kind=source_kind,
            target_kind=target_kind,
            pairs=own,
            control=None if control is None else control.moved(matrix),
        )
        return from_levelled(straight, fit, matrix, source.name)
    surveyed = None if control is None else local_control(control, source, target)
    scale = _unit_of(source) / _unit_of(target)
    proposal = propose_scale(source, target)
    if proposal is not None:
        refused = _refused(proposal.sentence)
        return _in_file_coordinates(refused, source, target, scale, params, clock, [])
    settings = params.prepare.model_copy(update={"is_filtered": params.filtered})
    one, two = prepare(source, source_kind, settings), prepare(target, target_kind, settings)
    notes = [
        *(f"{source.name}: {n}" for n in one.notes),
        *(f"{target.name}: {n}" for n in two.notes),
    ]
    clock.lap("prepare")
    picked = [] if fit is None else _picked(fit, one, two)
    is_searched = fit is None or params.coarse != "none"
    starts = coarse_poses(one, two, source.frame, target.frame, params) if is_searched else []
    if surveyed is not None and surveyed.T_target_source is not None:
        starts = [_heard(surveyed.T_target_source, "control", one, two), *starts]
    starts = [*picked, *starts]
    clock.lap("coarse")
    found = decide(one, two, starts, params, clock, surveyed)
    is_judged = found.status == "ok" or found.reason == LEFT_SENTENCE
    if not is_judged and params.coarse in ("auto", "plan"):
        # Nothing was found to reflect: the mirror image is searched for from the start.
        mirror = is_mirrored(one, two, starts, params.plan)
        found = _refused(mirror.sentence) if mirror.is_mirrored else found
        clock.lap("mirror check")
    if fit is not None:
        status, reason = weigh(found.status, found.reason, found.T, fit, found.ruling)
        found = replace(found, status=status, reason=reason)
    result = _in_file_coordinates(found, source, target, scale, params, clock, notes)
    if surveyed is not None:
        result = replace(result, checks=checks_document(surveyed, found.adjusted, found.T))
    return result if fit is None else with_pairs(result, fit)


def _with_free_scale(
    source: Cloud,
    target: Cloud,
    params: Register,
    kinds: tuple[Kind, Kind],
    pairs: PickedPairs | None,
    control: ControlPoints | None,
) -> Registration:
    """Search the scale, then register the clouds in metres."""
    clock = _Clock()
    dof: Literal[4, 6] = 4 if params.dof == 5 else 6
    found = search_scale(
        source, target, source_kind=kinds[0], target_kind=kinds[1], icp=params.icp, dof=dof + 1
    )
    clock.lap("scale")
    why = refusal(found)
    if why is not None:
        none = _in_file_coordinates(_refused(why), source, target, 1.0, params, clock, [])
        return replace(none, dof=dof + 1, scale_search=scale_document(found, source, target))
    one, two = in_metres(found, source, target)
    result = register(
        one,
        two,
        params.model_copy(update={"dof": dof}),
        source_kind=kinds[0],
        target_kind=kinds[1],
        pairs=pairs,
        control=control,
    )
    result = replace(result, seconds={**clock.seconds, **result.seconds})
    return with_scale(result, found, (source, target), dof + 1, params.verdict.most_spread_m)


def _picked(fit: PairFit, source: Prepared, target: Prepared) -> list[Hypothesis]:
    return [_heard(T, "pairs", source, target) for T in starts_of(fit)]


def _heard(T: Transform, method: str, source: Prepared, target: Prepared) -> Hypothesis:
    """Return a pose that no search found, scored as theirs are."""
    return Hypothesis(T_target_source=T, score=ranking.score(T, source, target), method=method)


def coarse_poses(
    source: Prepared, target: Prepared, source_frame: Frame, target_frame: Frame, params: Register
) -> list[Hypothesis]:
    """Return the starting poses of the chosen method, best first, in local frames."""
    if params.coarse == "none":
        T = np.eye(4)
        T[:3, 3] = source_frame.origin - target_frame.origin
        return [_heard(T, "none", source, target)]
    if params.coarse == "improved-pca":
        return list(improved_pca(source, target))
    if params.coarse == "pca":
        return list(traditional_pca(source, target))
    if params.coarse == "sac-ia":
        return sac_ia(source, target, params.sac_ia)
    if params.coarse == "4pcs":
        return four_pcs(source, target, params.congruent_sets)
    plan = params.plan.model_copy(update={"yaw_hint_deg": params.yaw_hint_deg})
    return plan_search(source, target, plan)


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
    adjusted: Adjusted | None = None
    """With the control points; None: there are none, or they changed nothing."""


def decide(
    source: Prepared,
    target: Prepared,
    starts: Sequence[Hypothesis],
    params: Register,
    clock: _Clock | None = None,
    control: Control | None = None,
) -> Found:
    """Refine, compare and judge the starting poses; local frames."""
    clock = clock or _Clock()
    if not starts:
        return _refused(
            "the coarse search found no pose at which the two clouds have anything in common."
        )
    dof = 4 if params.dof == 4 else 6
    icp = params.icp.model_copy(
        update={"dof": dof, **({} if params.fine == "none" else {"method": params.fine})}
    )
    court = summon(source, target)
    quick = _quick(icp, source, target)
    levels = build_levels(source, target, quick)
    hint, reach = params.yaw_hint_deg, params.plan.yaw_hint_range_deg
    ruling = rule(
        court,
        levels,
        [h.T_target_source for h in starts],
        quick,
        params.verdict,
        lambda T: (
            (hint is None or _is_near_yaw(T, hint, reach))
            and (control is None or control.allows(T))
        ),
    )
    clock.lap("proof")
    fine, T = None, ruling.winner.T
    # What the proof has refused needs no exact pose.
    if params.fine != "none" and status_of(ruling, None, params.verdict)[0] != "failed":
        fine = refine(source, target, ruling.winner.T, icp)
        T = fine.T_target_source
    clock.lap("fine")
    adjusted = None
    if control is not None and fine is not None:
        adjusted = adjust(fine, control, dof)
    if adjusted is not None:
        fine, T = adjusted.fine, adjusted.fine.T_target_source
    status, reason = _judged(court, ruling, fine, params)
    if status == "ok":
        hand = handedness(court, levels, ruling.winner, quick, params.verdict)
        if hand == "left":
            return _refused(LEFT_SENTENCE)
        reason += " Its mirror image fits as well." if hand == "unknown" else ""
        clock.lap("mirror check")
    status, reason = weigh_control(status, reason, adjusted)
    listed = _listed(ruling, T, starts, source, target)
    return Found(
        status=status,
        reason=reason,
        T=None if status == "failed" else T,
        fine=fine,
        probability=0.0 if status == "failed" else ruling.probability,
        hypotheses=listed,
        margin=_margin(listed),
        ruling=ruling,
        adjusted=adjusted,
    )


def _refused(reason: str) -> Found:
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
) -> tuple[Literal["ok", "ambiguous", "failed"], str]:
    status, reason = status_of(ruling, fine, params.verdict)
    if fine is None or status == "failed":
        return status, reason
    final = hear(court, fine.T_target_source)
    if not is_same(final.T, ruling.winner.T, middle_of(court.source.points)):
        return "ambiguous", (
            "the fine fit left the pose that was judged best: the surface near it holds it "
            "too weakly. Control points or more overlap would decide."
        )
    if status == "ok" and fine.covariance is not None:
        explained = final.is_explained[: len(court.source.points)]
        shared = apply(final.T, court.source.points[explained])
        spread = displacement95(
            fine.covariance, fine.covariance_about, shared, fine.covariance_blocks
        )
        limit = params.verdict.most_spread_m
        if spread > limit:
            return "ambiguous", (
                f"the parts of the shared surface disagree about the pose by {spread:.2g} m "
                f"(95 %; at most {limit:.2g} m expected): it is held too weakly, or one cloud is "
                "bent. Control points or more overlap would decide."
            )
        reason += (
            f" The parts of the shared surface agree about it to {1e3 * spread:.0f} mm (95 %)."
        )
    return status, reason


def _is_near_yaw(T: Transform, hint_deg: float, reach_deg: float) -> bool:
    yaw = np.degrees(np.arctan2(T[1, 0], T[0, 0]))
    return bool(abs((yaw - hint_deg + 180.0) % 360.0 - 180.0) <= reach_deg)


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


def _unit_of(cloud: Cloud) -> float:
    unit = cloud.frame.unit_m
    if max(unit) - min(unit) > 1e-12:
        msg = (
            f"{cloud.name} has heights in units of {unit[2]:.6g} m and plan coordinates in units "
            f"of {unit[0]:.6g} m; one unit is needed. Convert the heights first."
        )
        raise FrameError(msg)
    return float(unit[0])


def to_file_transform(T_local: Transform, source: Frame, target: Frame) -> Transform:
    """Return the motion between *file* coordinates of a motion between local frames.

    T_file = F_target T_local F_source^-1, with F the affine map local -> file.
    """
    unit_s, unit_t = float(source.unit_m[0]), float(target.unit_m[0])
    result = np.eye(4)
    result[:3, :3] = T_local[:3, :3] * (unit_s / unit_t)
    result[:3, 3] = (T_local[:3, 3] + target.origin - T_local[:3, :3] @ source.origin) / unit_t
    return as_transform(result)


def _in_file_coordinates(
    found: Found,
    source: Cloud,
    target: Cloud,
    scale: float,
    params: Register,
    clock: _Clock,
    notes: list[str],
) -> Registration:
    def to_file(T: Transform) -> Transform:
        return to_file_transform(T, source.frame, target.frame)

    listed = tuple(
        Hypothesis(T_target_source=to_file(h.T_target_source), score=h.score, method=h.method)
        for h in found.hypotheses
    )
    if scale != 1.0:
        notes.append(f"units differ: the matrix scales by {scale:.9g}")
    return Registration(
        status=found.status,
        matrix=None if found.T is None else to_file(found.T),
        reason=found.reason,
        probability=found.probability,
        scale=scale,
        scale_source="none" if scale == 1.0 else "units",
        dof=6 if params.dof == "auto" else params.dof,
        coarse_method="plan" if params.coarse == "auto" else params.coarse,
        hypotheses=listed,
        margin=found.margin,
        fine=found.fine,
        notes=tuple(notes),
        seconds=dict(clock.seconds),
        parameters=params.model_dump(mode="json"),
    )
