"""Poses that the built surface cannot tell apart, told apart by marks: the ground, and things.

Or by control points, where there are any.

An octagon fits itself at eight turns, and ground counts a tenth of what walls do in the proof: flat
ground agrees with any pose. But where it rises and falls, it does so once. So do lanterns, crates
and trees, small beside the walls: each stands in one place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dougong.registration.control import Control
from dougong.registration.evidence import Court
from dougong.registration.ground_relief import level_ground, likeness, relief
from dougong.registration.icp import Icp, Level
from dougong.registration.prepare import Prepared
from dougong.registration.rivals import is_near
from dougong.registration.standing_things import things_of
from dougong.registration.verdict import Comparison, Ruling, Verdict, rule
from dougong.typing import Mask, Transform

_OTHERS = 0.8
"""Under every other pose the ground is less alike than this; under the told one `is_vouched`."""
_SHARPER = 1.5
"""Marks tell the place, not the pose: walls that leave two places open must hold the pose more
sharply than those that do not. Right ones had 5.5 and more, one of 3.3 was 84 mm off."""
_CHANCE = 1e-3
"""What is declared for a pose that marks refute."""


class _Told(NamedTuple):
    """The only one of some poses that a mark vouches for."""

    pose: int
    said: str
    """What tells it from the others, in words."""


def told_apart(
    court: Court,
    clouds: tuple[Prepared, Prepared],
    levels: tuple[Level, ...],
    ruling: Ruling,
    icp: Icp,
    params: Verdict,
) -> Ruling:
    """Return the ruling with the undecided poses that marks refute among the beaten ones.

    The pose that they vouch for wins, whichever it is. The ruling itself where no pose, or more
    than one, has the ground's relief or its things, where the clouds share too little of either, or
    where the walls hold the pose weakly.
    """
    at, winner = ruling.middle, ruling.winner.T
    others = [c for c in ruling.undecided if not is_near(c.T, winner, at)]
    if not others:
        return ruling
    poses = [winner, *(c.T for c in others)]
    told = _by_ground(court, clouds, poses, ruling) or _by_things(court, clouds, poses, ruling)
    if told is None:
        return ruling
    refuted = _refuted(poses[k] for k in np.flatnonzero(_elsewhere(poses, told.pose, ruling)))
    alone = _about(court, levels, poses[told.pose], ruling, icp, params)
    if alone.sharpness < _SHARPER * params.least_sharpness:
        return ruling
    said = f"{len(refuted)} other poses fit the walls as well, and {told.said}"
    return replace(
        alone,
        beaten=(*alone.beaten, *refuted),
        told=said,
        overruled=ruling.overruled,
        contradicted=ruling.contradicted,
    )


def told_by_control(
    court: Court,
    levels: tuple[Level, ...],
    ruling: Ruling,
    control: Control | None,
    icp: Icp,
    params: Verdict,
) -> Ruling:
    """Return the ruling on the undecided poses that control points do not refute, if there are any.

    The ruling itself where they do not refute the winner: see `without_refuted`.
    """
    if control is None or not control.refutes(ruling.winner.T):
        return ruling
    left = [c.T for c in ruling.undecided if not control.refutes(c.T)]
    if not left:
        return ruling
    again = rule(court, levels, left, icp, params, lambda T: not control.refutes(T))
    if control.refutes(again.winner.T):
        return ruling
    return replace(again, overruled=again.overruled or ruling.overruled)


def without_refuted(ruling: Ruling, control: Control) -> Ruling:
    """Return the ruling with the undecided poses that control points refute among the beaten ones.

    For where a pose holds that was adjusted with them.
    """
    is_refuted = [control.refutes(c.T) for c in ruling.undecided]
    if not any(is_refuted):
        return ruling
    refuted = _refuted(c.T for c, out in zip(ruling.undecided, is_refuted, strict=True) if out)
    return replace(
        ruling,
        undecided=tuple(c for c, out in zip(ruling.undecided, is_refuted, strict=True) if not out),
        beaten=(*ruling.beaten, *refuted),
        told=f"{len(refuted)} of the poses that fit as well miss the control points",
    )


def _refuted(poses: Iterable[Transform]) -> list[Comparison]:
    """Return what is declared for poses that something else than the surface refutes."""
    return [Comparison(T=T, gain=0.0, p_value=_CHANCE, blocks=0) for T in poses]


def _by_ground(
    court: Court, clouds: tuple[Prepared, Prepared], poses: Sequence[Transform], ruling: Ruling
) -> _Told | None:
    """Return the pose under which alone the relief of the ground is the same."""
    ground = (
        level_ground(clouds[0], court.source.everything),
        level_ground(clouds[1], court.target.everything),
    )
    alike = np.array([likeness(*ground, T) for T in poses])
    if np.isnan(alike).any():
        return None
    best = int(np.argmax(alike))
    most = float(alike[_elsewhere(poses, best, ruling)].max(initial=-1.0))
    if most >= _OTHERS or not relief(*ground, poses[best]).is_vouched:
        return None
    return _Told(
        best,
        f"the relief of the ground tells them apart (correlation {alike[best]:.2f}, under the "
        f"others at most {most:.2f})",
    )


def _by_things(
    court: Court, clouds: tuple[Prepared, Prepared], poses: Sequence[Transform], ruling: Ruling
) -> _Told | None:
    """Return the pose under which alone things that stand apart from each other are found.

    Under every other pose they are gone. Those close together count as one: posts of scaffolding
    that was moved are found together.
    """
    things = things_of(court, *clouds)
    vouched: list[_Told] = []
    for k, T in enumerate(poses):
        rivals = [poses[int(j)] for j in np.flatnonzero(_elsewhere(poses, k, ruling))]
        group, found = things.groups(T), things.found_by([T])
        telling = things.telling(T, things.found_by(rivals), group)
        if not telling.is_vouched:
            continue
        # What both poses find repeats as the walls do.
        tellings = [things.telling(R, found & things.found_by([R]), group) for R in rivals]
        if not all(other.is_refuted for other in tellings):
            return None
        said = (
            f"what stands about tells them apart: {telling.found} things that stand apart are "
            f"found in their places and {telling.gone} are gone, under the others no more are "
            "found than by chance"
        )
        vouched.append(_Told(k, said))
    if not vouched:
        return None
    is_elsewhere = _elsewhere(poses, vouched[0].pose, ruling)
    return None if is_elsewhere[[told.pose for told in vouched]].any() else vouched[0]


def _elsewhere(poses: Sequence[Transform], k: int, ruling: Ruling) -> Mask:
    """Say which poses are not near the `k`-th."""
    return np.array([not is_near(T, poses[k], ruling.middle) for T in poses])


def _about(
    court: Court,
    levels: tuple[Level, ...],
    T: Transform,
    ruling: Ruling,
    icp: Icp,
    params: Verdict,
) -> Ruling:
    """Return the ruling on the poses close to `T` alone."""
    at = ruling.middle
    if T is ruling.winner.T:
        return replace(ruling, undecided=tuple(c for c in ruling.undecided if is_near(c.T, T, at)))
    return rule(court, levels, [T], icp, params, lambda other: is_near(other, T, at))
