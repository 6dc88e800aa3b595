"""Whether a pose that fits best lays one part of a place on another that is like it.

Surface alone cannot tell: where each cloud shows another corner of a house, another gallery of a
cloister, a twin, or where scaffolding has moved to the other side of a building that repeats, the
wrong pose explains more than the true one. What stands about can (`standing_things`), and the
relief of the ground (`ground_relief`): they are asked of every pose that would be ``ok``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dougong.registration.deciding_part import deciding_part
from dougong.registration.evidence import (
    Court,
    Testimony,
    Witness,
    hear,
    sharpness,
    support,
    violation,
)
from dougong.registration.ground_relief import level_ground, relief
from dougong.registration.prepare import Prepared
from dougong.registration.rivals import is_near
from dougong.registration.shown_sides import (
    are_beside,
    are_walls,
    has_ground_on_one_side,
    lacks_opposite_sides,
)
from dougong.registration.standing_things import Things, things_of
from dougong.registration.symmetry import in_short, move_between
from dougong.registration.verdict import Ruling, Verdict
from dougong.typing import Kind, Mask, Points, Transform

_DECIDES = "Control points, a yaw hint, or a cloud that shows more of the site would decide."
_SUPPORT, _SHARPNESS, _VIOLATION = 0.5, 0.4, 0.01
"""A beaten pose is possible where it explains this share of what lies near under it, this share as
sharply as the winner, and violates this much more free space at most. Of ten cloisters the false
winner's rivals have 0.51 to 0.69, 0.4 to 0.7 and none; turned into a corner where they do not
belong, 0.15 to 0.3 stand in free space."""


def look_alike_doubt(
    court: Court, source: Prepared, target: Prepared, ruling: Ruling, params: Verdict
) -> str | None:
    """Return why the winner may be a copy of the true pose; None: nothing says so.

    Things that are gone under the winner are found under a rival; more than a few are gone and
    none found that chance would not find; the ground has another relief; or neither things nor
    relief vouch for the winner, and two scans leave room for a copy that they do not show, or one
    part of the place alone speaks against a rival.
    """
    things = things_of(court, source, target)
    winner = ruling.winner.T
    rivals = [c.T for c in ruling.beaten if not is_near(c.T, winner, ruling.middle)]
    for rival in rivals:
        found = things.speak_for(rival, winner)
        if found and _holds(court, hear(court, rival), params):
            return (
                f"the best pose explains most, but {found} things that stand about are gone under "
                f"it and found under another one ({_moved(rival, ruling)}): one of the two rests "
                "on what was moved between the surveys. A yaw hint or control points would decide."
            )
    telling = things.telling(winner, things.found_by(rivals))
    if telling.is_refuted:
        return (
            f"what stands about speaks against the best pose: {telling.gone} things are gone where "
            f"the other cloud shows their place, and {telling.found} are found there, no more than "
            "chance finds. Either nearly all of it was moved, or the clouds show two parts of the "
            f"place that are alike. {_DECIDES}"
        )
    grounds = (
        level_ground(source, court.source.everything),
        level_ground(target, court.target.everything),
    )
    ground = relief(*grounds, winner)
    if ground.is_refuted:
        return (
            "the ground speaks against the best pose: both clouds show its relief, and it is not "
            f"the same (correlation {ground.alike:.2f}). Either it was dug up, or the clouds show "
            f"two parts of the place that are alike. {_DECIDES}"
        )
    if ground.is_vouched:
        return None
    # The ruling may be of parts of both clouds.
    best = hear(court, winner)
    if not telling.is_vouched:
        kinds = source.kind, target.kind
        unseen = _unseen_copy(court, grounds, kinds, ruling, best, rivals)
        if unseen is not None:
            return unseen
    return _rests_on_one_part(court, ruling, best, rivals, things, params)


def _rests_on_one_part(
    court: Court,
    ruling: Ruling,
    winner: Testimony,
    rivals: Sequence[Transform],
    things: Things,
    params: Verdict,
) -> str | None:
    """Return where one part of the place alone tells the winner from a rival, and may have moved.

    Things on that part may have moved with it; others may vouch.
    """
    for rival in rivals:
        part = deciding_part(court, winner, hear(court, rival), params)
        if part is None:
            continue
        unasked = things.found_by(rivals) | things.standing_on(part.holds, winner.T)
        if things.telling(winner.T, unasked).is_vouched:
            continue
        long, short = part.size_m
        return (
            f"the place repeats ({_moved(rival, ruling)}), and one part of it, {long:.0f} x "
            f"{short:.0f} m, alone tells which way round: if that is something that was moved "
            f"between the surveys, as scaffolding is, the pose is wrong. {_DECIDES}"
        )
    return None


def _unseen_copy(
    court: Court,
    grounds: tuple[Points, Points],
    kinds: tuple[Kind, Kind],
    ruling: Ruling,
    winner: Testimony,
    rivals: Sequence[Transform],
) -> str | None:
    """Return where clouds that nothing else ties to one place leave room for a copy of it."""
    if court.source.free is not None and court.target.free is not None:
        for rival in rivals:
            if _is_possible(court, hear(court, rival), ruling):
                return (
                    f"the place repeats ({_moved(rival, ruling)}), each scan shows a part of it, "
                    "and nothing that stands about tells which: the pose that explains most may "
                    f"lay one part on another. {_DECIDES}"
                )
    is_explained = np.split(winner.is_explained, [len(court.source.points)])
    if all(
        _shows_one_side(*shown)
        for shown in zip(grounds, kinds, (court.source, court.target), is_explained, strict=True)
    ):
        return (
            "both clouds show one side of what stands there, and neither the ground nor anything "
            "about it tells that it is the same side: an opposite side that is alike would fit as "
            f"well. {_DECIDES}"
        )
    return None


def _shows_one_side(ground: Points, kind: Kind, witness: Witness, is_explained: Mask) -> bool:
    """Say whether a cloud shows one of two opposite sides only of the explained walls."""
    is_wall = are_walls(witness)
    if not (is_wall & is_explained).any():
        return False
    explained = witness.points[is_wall & is_explained]
    if kind == "lidar":
        return has_ground_on_one_side(ground, explained)
    # A flight may show sides that the other cloud does not: then it is tied to the place by them.
    is_wall &= are_beside(witness.points, explained)
    return lacks_opposite_sides(
        ground, witness.points[is_wall], witness.normals[is_wall], witness.weights[is_wall]
    )


def _moved(rival: Transform, ruling: Ruling) -> str:
    return in_short(move_between(ruling.winner.T, rival, ruling.middle))


def _holds(court: Court, pose: Testimony, params: Verdict) -> bool:
    """Say whether a pose stands by itself: explained, sharp, and through nothing seen through."""
    return (
        support(court, pose) >= params.least_explained
        and sharpness(court, pose) >= params.least_sharpness
        and violation(court, pose) <= params.most_violation
    )


def _is_possible(court: Court, pose: Testimony, ruling: Ruling) -> bool:
    """Say whether two scans from known places leave a beaten pose possible."""
    return (
        support(court, pose) >= _SUPPORT
        and violation(court, pose) <= ruling.violation + _VIOLATION
        and sharpness(court, pose) >= _SHARPNESS * ruling.sharpness
    )
