"""From two clouds to one pose with a verdict: search, then proof (METHOD.md 2 and 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from dougong.cloud import Cloud, Frame
from dougong.registration.checks import checks_document
from dougong.registration.control import Control, local_control
from dougong.registration.control_solve import ControlPoints
from dougong.registration.decision import Found, decide, refused
from dougong.registration.file_coordinates import in_file_coordinates, unit_of
from dougong.registration.free_scale import ScaleSearch, Side, scale_near
from dougong.registration.free_scale_control import find_scale, with_control
from dougong.registration.free_scale_result import (
    in_metres,
    is_off_metres,
    metre_note,
    refusal,
    scale_document,
    with_scale,
)
from dougong.registration.handedness import LEFT_SENTENCE
from dougong.registration.laps import Laps
from dougong.registration.picked_pairs import (
    PairFit,
    PickedPairs,
    fit_pairs,
    from_levelled,
    levelled_source,
    weigh,
    with_pairs,
)
from dougong.registration.prepare import Prepared, Thinned, describe, thin
from dougong.registration.result import Hypothesis, Registration
from dougong.registration.sanity import is_mirrored, propose_scale
from dougong.registration.settings import Register
from dougong.registration.starting_poses import coarse_poses, heard, picked_poses, with_delivered
from dougong.threads import each
from dougong.typing import Kind


def register(
    source: Cloud,
    target: Cloud,
    params: Register | None = None,
    *,
    source_kind: Kind = "lidar",
    target_kind: Kind = "photogrammetry",
    pairs: PickedPairs | None = None,
    control: ControlPoints | None = None,
    unscaled: Side | None = None,
    scale: ScaleSearch | None = None,
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
    unscaled : {"source", "target"}, optional
        The cloud whose unit nothing declares. With ``dof`` auto it is taken for metres where that
        holds, else its scale is freed.
    scale : ScaleSearch, optional
        What `find_scale` found before; both clouds have been brought to metres by it, unless it
        found none.

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
    kinds = (source_kind, target_kind)
    if scale is not None:
        why = refusal(scale)
        if why is not None:
            return _without_scale(why, scale, source, target, params, Laps())
        return _at_scale(source, target, scale, params, kinds, pairs, control)
    if params.dof in (5, 7):
        return _with_free_scale(source, target, params, kinds, pairs, control, unscaled)
    if params.dof == "auto" and unscaled is not None:
        return _taken_for_metres(source, target, params, kinds, pairs, control, unscaled)
    if pairs is None:
        return _registered(source, target, params, kinds, None, control)
    fit = fit_pairs(pairs, source, target)
    level = levelled_source(source, fit)
    if level is None:
        return _registered(source, target, params, kinds, fit, control)
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
    return from_levelled(straight, fit, matrix, source, cloud)


def _registered(
    source: Cloud,
    target: Cloud,
    params: Register,
    kinds: tuple[Kind, Kind],
    fit: PairFit | None,
    control: ControlPoints | None,
) -> Registration:
    """Register two levelled clouds in known units."""
    clock = Laps()
    surveyed = None if control is None else local_control(control, source, target)
    scale = unit_of(source) / unit_of(target)
    proposal = propose_scale(source, target)
    if proposal is not None:
        none = refused(proposal.sentence)
        return in_file_coordinates(none, source, target, scale, params, clock, [])
    settings = params.prepare.model_copy(update={"is_filtered": params.filtered})

    def tried(thinned: Sequence[Thinned]) -> _Tried:
        described = zip(thinned, kinds, strict=True)
        one, two = each(lambda cloud: describe(*cloud, settings), described)
        clock.lap("prepare")
        starts = _starts(one, two, (source.frame, target.frame), params, fit, surveyed)
        clock.lap("coarse")
        return _Tried(one, two, starts, decide(one, two, starts, params, clock, surveyed))

    # One after the other: together they would hold twice what one needs beyond its points.
    thinned = [thin(cloud, settings) for cloud in (source, target)]
    best = tried(thinned)
    if best.is_refused:
        # Among many strays a true pose explains little: it is asked again without them.
        without = [cloud.without_strays() for cloud in thinned]
        again = tried(without) if without != thinned else best
        best = best if again.is_refused else again
    one, two, starts, found = best
    notes = [f"{c.name}: {n}" for c, p in ((source, one), (target, two)) for n in p.notes]
    is_judged = found.status == "ok" or found.reason == LEFT_SENTENCE
    if not is_judged and params.coarse in ("auto", "plan") and params.yaw_hint_deg is None:
        # Nothing was found to reflect: the mirror image is searched for from the start, at every
        # heading. Where a hint left only some for the pose, it would win by that alone.
        mirror = is_mirrored(one, two, starts, params.plan)
        found = refused(mirror.sentence) if mirror.is_mirrored else found
        clock.lap("mirror check")
    if found.status == "failed" and params.yaw_hint_deg is not None:
        found = replace(found, reason=f"{found.reason} {_only_near_hint(params)}")
    if fit is not None:
        status, reason = weigh(found.status, found.reason, found.T, fit, found.ruling)
        found = replace(found, status=status, reason=reason)
    result = in_file_coordinates(found, source, target, scale, params, clock, notes)
    if surveyed is not None:
        result = replace(result, checks=checks_document(surveyed, found.adjusted, found.T))
    return result if fit is None else with_pairs(result, fit)


def _only_near_hint(params: Register) -> str:
    return (
        f"Only turns within {params.plan.yaw_hint_range_deg:g} deg of the yaw hint, "
        f"{params.yaw_hint_deg:g}, were searched: check it, or register without it."
    )


class _Tried(NamedTuple):
    """Two prepared clouds, the poses they were heard with, and what came of it."""

    one: Prepared
    two: Prepared
    starts: list[Hypothesis]
    found: Found

    @property
    def is_refused(self) -> bool:
        """True: no pose holds, for another reason than a left-handed file."""
        return self.found.status == "failed" and self.found.reason != LEFT_SENTENCE


def _starts(
    source: Prepared,
    target: Prepared,
    frames: tuple[Frame, Frame],
    params: Register,
    fit: PairFit | None,
    control: Control | None,
) -> list[Hypothesis]:
    """Return every pose to be heard: of picked pairs, of control points, of the search."""
    picked = [] if fit is None else picked_poses(fit, source, target)
    is_searched = fit is None or params.coarse != "none"
    found = coarse_poses(source, target, *frames, params) if is_searched else []
    if params.coarse != "none":
        found = with_delivered(found, source, target, *frames)
    if control is not None and control.T_target_source is not None:
        found = [heard(control.T_target_source, "control", source, target), *found]
    return [*picked, *found]


def _with_free_scale(
    source: Cloud,
    target: Cloud,
    params: Register,
    kinds: tuple[Kind, Kind],
    pairs: PickedPairs | None,
    control: ControlPoints | None,
    side: Side | None,
) -> Registration:
    """Search the scale, then register the clouds in metres."""
    clock = Laps()
    found = find_scale(
        source,
        target,
        params,
        source_kind=kinds[0],
        target_kind=kinds[1],
        control=control,
        side=side,
    )
    clock.lap("scale")
    why = refusal(found)
    if why is not None:
        return _without_scale(why, found, source, target, params, clock)
    result = _at_scale(*in_metres(found, source, target), found, params, kinds, pairs, control)
    return replace(result, seconds={**clock.seconds, **result.seconds})


def _without_scale(
    why: str,
    found: ScaleSearch,
    source: Cloud,
    target: Cloud,
    params: Register,
    clock: Laps,
) -> Registration:
    """Return the answer where no scale could be found."""
    none = in_file_coordinates(refused(why), source, target, 1.0, params, clock, [])
    dof = 5 if params.dof in (4, 5) else 7
    return replace(none, dof=dof, scale_search=scale_document(found, source, target))


def _at_scale(
    source: Cloud,
    target: Cloud,
    found: ScaleSearch,
    params: Register,
    kinds: tuple[Kind, Kind],
    pairs: PickedPairs | None,
    control: ControlPoints | None,
) -> Registration:
    """Register two clouds that `found` has brought to metres; the result has its scale."""
    dof: Literal[4, 6] = 4 if params.dof in (4, 5) else 6
    result = register(
        source,
        target,
        params.model_copy(update={"dof": dof}),
        source_kind=kinds[0],
        target_kind=kinds[1],
        pairs=pairs,
        control=control,
    )
    return with_scale(result, found, (source, target), dof + 1, params.verdict.most_spread_m)


def _taken_for_metres(
    source: Cloud,
    target: Cloud,
    params: Register,
    kinds: tuple[Kind, Kind],
    pairs: PickedPairs | None,
    control: ControlPoints | None,
    side: Side,
) -> Registration:
    """Register a cloud whose unit nothing declares: in metres if that holds, else with its scale.

    A file without a coordinate system is mostly in metres; photogrammetry that is not, or whose
    metres are off by more than chance, is found out by the other cloud.
    """
    plain = params.model_copy(update={"dof": 6})
    result = register(
        source,
        target,
        plain,
        source_kind=kinds[0],
        target_kind=kinds[1],
        pairs=pairs,
        control=control,
    )
    free = params.model_copy(update={"dof": 7})
    if result.status == "failed" or result.fine is None:
        if params.coarse not in ("auto", "plan"):
            return result
        scaled = _with_free_scale(source, target, free, kinds, pairs, control, side)
        if scaled.status == "failed":
            said = "Taken for metres, and with its scale free: no pose was found either way."
            return replace(result, reason=f"{result.reason} {said}")
        return scaled
    found = scale_near(
        source,
        target,
        1.0,
        result.fine.T_target_source,
        source_kind=kinds[0],
        target_kind=kinds[1],
        icp=params.icp,
        dof=7,
        side=side,
    )
    if control is not None and found.candidates:
        found = with_control(found, source, target, control, 7)
    if is_off_metres(found):
        return _at_scale(*in_metres(found, source, target), found, free, kinds, pairs, control)
    return replace(result, notes=(*result.notes, metre_note(found, source, target)))
