"""Poses that the built surface cannot tell apart, told apart by the relief of the ground.

An octagon fits itself at eight turns, and ground counts a tenth of what walls do in the proof: flat
ground agrees with any pose. But where it rises and falls, it does so once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dougong.registration.evidence import Court
from dougong.registration.ground_relief import level_ground, likeness, relief
from dougong.registration.icp import Icp, Level
from dougong.registration.prepare import Prepared
from dougong.registration.rivals import is_near
from dougong.registration.verdict import Comparison, Ruling, Verdict, rule
from dougong.typing import Transform

_OTHERS = 0.8
"""Under every other pose the ground is less alike than this; under the told one `is_vouched`."""
_SHARPER = 1.5
"""The ground tells the place, not the pose: walls that leave two places open must hold the pose
more sharply than those that do not. Right ones had 5.5 and more, one of 3.3 was 84 mm off."""
_CHANCE = 1e-3
"""What is declared for a pose that the ground refutes."""


def told_by_ground(
    court: Court,
    clouds: tuple[Prepared, Prepared],
    levels: tuple[Level, ...],
    ruling: Ruling,
    icp: Icp,
    params: Verdict,
) -> Ruling:
    """Return the ruling with the undecided poses that the ground refutes among the beaten ones.

    The pose that it vouches for wins, whichever it is. The ruling itself where no pose, or more
    than one, has the ground's relief, where the clouds share too little of it, or where the walls
    hold the pose weakly.
    """
    at, winner = ruling.middle, ruling.winner.T
    others = [c for c in ruling.undecided if not is_near(c.T, winner, at)]
    if not others:
        return ruling
    ground = (
        level_ground(clouds[0], court.source.everything),
        level_ground(clouds[1], court.target.everything),
    )
    poses = [winner, *(c.T for c in others)]
    alike = np.array([likeness(*ground, T) for T in poses])
    if np.isnan(alike).any():
        return ruling
    best = int(np.argmax(alike))
    elsewhere = np.array([not is_near(T, poses[best], at) for T in poses])
    most = float(alike[elsewhere].max(initial=-1.0))
    if most >= _OTHERS or not relief(*ground, poses[best]).is_vouched:
        return ruling
    refuted = [
        Comparison(T=poses[k], gain=0.0, p_value=_CHANCE, blocks=0)
        for k in np.flatnonzero(elsewhere)
    ]
    told = _about(court, levels, poses[best], ruling, icp, params)
    if told.sharpness < _SHARPER * params.least_sharpness:
        return ruling
    said = (
        f"{len(refuted)} other poses fit the walls as well, and the relief of the ground tells "
        f"them apart (correlation {alike[best]:.2f}, under the others at most "
        f"{most:.2f})"
    )
    return replace(told, beaten=(*told.beaten, *refuted), told=said)


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
