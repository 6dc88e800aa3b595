"""Whether a pose that fits best lays one part of a place on another that is like it.

Surface alone cannot tell: where each cloud shows another corner of a house, another gallery of a
cloister, a twin, or where scaffolding has moved to the other side of a building that repeats, the
wrong pose explains more than the true one. What stands about can (`standing_things`), and the
relief of the ground (`ground_relief`): they are asked of every pose that would be ``ok``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dougong.registration.evidence import Court, Testimony, hear, sharpness, support, violation
from dougong.registration.ground_relief import level_ground, relief
from dougong.registration.prepare import Prepared
from dougong.registration.rivals import is_near
from dougong.registration.standing_things import things_of
from dougong.registration.symmetry import in_short, move_between
from dougong.registration.verdict import Ruling, Verdict
from dougong.typing import Transform

_DECIDES = "Control points, a yaw hint, or a cloud that shows more of the site would decide."
_SECTORS = 12
_SECTOR_DEG = 180.0 / _SECTORS
_MAIN = 0.1
"""Share of the walls from which on a heading is asked about, ..."""
_ROW_M = 2.5
"""... and within how much the middle eight tenths of its walls lie in one row."""
_UPRIGHT = 0.5
"""The rise of a normal up to which it is a wall's."""
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
    relief vouch for the winner, and two scans leave room for a copy that they do not show.
    """
    spacing = max(witness.everything.spacing_m for witness in (court.source, court.target))
    things = things_of(
        (source, court.source.everything),
        (target, court.target.everything),
        court.tolerance_m + spacing,
    )
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
    telling = things.telling(winner, rivals)
    if telling.is_refuted:
        return (
            f"what stands about speaks against the best pose: {telling.gone} things are gone where "
            f"the other cloud shows their place, and {telling.found} are found there, no more than "
            "chance finds. Either nearly all of it was moved, or the clouds show two parts of the "
            f"place that are alike. {_DECIDES}"
        )
    ground = relief(
        level_ground(source, court.source.everything),
        level_ground(target, court.target.everything),
        winner,
    )
    if ground.is_refuted:
        return (
            "the ground speaks against the best pose: both clouds show its relief, and it is not "
            f"the same (correlation {ground.alike:.2f}). Either it was dug up, or the clouds show "
            f"two parts of the place that are alike. {_DECIDES}"
        )
    if telling.is_vouched or ground.is_vouched:
        return None
    return _unseen_copy(court, source, target, ruling, rivals)


def _unseen_copy(
    court: Court, source: Prepared, target: Prepared, ruling: Ruling, rivals: Sequence[Transform]
) -> str | None:
    """Return where two scans that nothing else ties to one place leave room for a copy of it."""
    if source.kind != "lidar" or target.kind != "lidar":
        # A flight shows a building from all sides.
        return None
    if court.source.free is not None and court.target.free is not None:
        for rival in rivals:
            if _is_possible(court, hear(court, rival), ruling):
                return (
                    f"the place repeats ({_moved(rival, ruling)}), each scan shows a part of it, "
                    "and nothing that stands about tells which: the pose that explains most may "
                    f"lay one part on another. {_DECIDES}"
                )
    is_one_side = _is_one_side(court, ruling.winner)
    if is_one_side and source.has_ground and target.has_ground:
        return (
            "both scans show one side of what stands there, and neither the ground nor anything "
            "about it tells that it is the same side: an opposite side that is alike would fit as "
            f"well. {_DECIDES}"
        )
    return None


def _is_one_side(court: Court, pose: Testimony) -> bool:
    """Say whether the explained walls of each heading lie in one row, in either cloud.

    So they do at a corner of a house, along a straight front, and round half a tower; of a house
    seen all round, of a room and of a street each heading has walls well before one another.
    """
    split = len(court.source.points)
    for cloud, part in ((court.source, slice(0, split)), (court.target, slice(split, None))):
        is_wall = cloud.is_structure & (np.abs(cloud.normals[:, 2]) < _UPRIGHT)
        is_wall &= pose.is_explained[part]
        normals, places = cloud.normals[is_wall, :2], cloud.points[is_wall, :2]
        heading = np.degrees(np.arctan2(normals[:, 1], normals[:, 0])) % 180.0
        sector = np.round(heading / _SECTOR_DEG).astype(np.int64) % _SECTORS
        held = np.bincount(sector, minlength=_SECTORS)
        for k in np.flatnonzero(held > _MAIN * len(sector)):
            turn = np.radians(k * _SECTOR_DEG)
            off = places[sector == k] @ np.array([np.cos(turn), np.sin(turn)])
            if np.ptp(np.quantile(off, [0.1, 0.9])) > _ROW_M:
                return False
    return True


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
