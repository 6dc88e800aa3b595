"""Is one cloud left-handed? The mirror image of the source, heard on the very same points.

Most heritage buildings equal their own mirror image, so a left-handed export of one can be laid
on the target well; what is beside the building then stands wrong. Hence the winner's reflections
are refined and heard like any other rival (METHOD.md 2.3 and 7).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from dougong.filters.neighbourhood import build_index
from dougong.registration.evidence import Court, Testimony, Witness, hear
from dougong.registration.icp import Icp, Level, refined_pose
from dougong.registration.overlap import Rung
from dougong.registration.rivals import propose_mirrored
from dougong.registration.verdict import Comparison, Verdict, compare, is_beaten
from dougong.threads import each

Handedness = Literal["right", "left", "open", "unknown"]

_FLIP = np.array([-1.0, 1.0, 1.0])
_TRIED = 3
_SUSPICION = 0.05
"""Chance below which blocks that prefer the mirror image are believed."""
LEFT_SENTENCE = (
    "the mirror image of the source fits clearly better than the source: one file is "
    "left-handed. Export it again with x and y in the right order and sign (negate x, or swap "
    "x and y)."
)
OPEN_SENTENCE = (
    "the mirror image of the source lays more of it on the target, and what both images share "
    "does not tell them apart beyond doubt: the clouds may show two parts of a building that "
    "mirror each other, or one file is left-handed (inscriptions then read backwards). Control "
    "points or more overlap would decide."
)


def handedness(
    court: Court, levels: tuple[Level, ...], winner: Testimony, icp: Icp, params: Verdict
) -> Handedness:
    """Say whether the source's mirror image fits clearly worse ("right") or better ("left").

    "open": it fits better, but only by sharing more or in a few blocks, and unseen is not empty:
    one wing of a compound can be laid, mirrored, on the other. "unknown": the blocks cannot tell,
    as when all that both clouds show equals its mirror image.
    """
    poses = propose_mirrored(court, winner, _TRIED)
    if not poses:
        return "right"
    other = replace(court, source=_mirrored_witness(court.source))
    mirrored = tuple(
        replace(level, source=_mirrored_rung(level.source), up_source=level.up_source * _FLIP)
        for level in levels
    )
    flip = np.diag([*_FLIP, 1.0])
    heard = each(lambda T: hear(other, refined_pose(mirrored, T @ flip, icp)), poses)
    best = min(heard, key=lambda testimony: testimony.total)
    if is_beaten(compare(court, winner, best, params.block_m), params):
        return "right"
    if not _leads(compare(other, best, winner, params.block_m), params):
        return "unknown"
    shared = compare(other, best, winner, params.block_m, best.is_within & winner.is_within)
    return "left" if _leads(shared, params) and is_beaten(shared, params) else "open"


def _leads(mirror: Comparison, params: Verdict) -> bool:
    """Say whether the mirror image is believed to fit better.

    Suspicion is enough: a pose taken for right is the worse mistake.
    """
    return mirror.gain >= params.gain and mirror.p_value <= _SUSPICION


def _mirrored_witness(witness: Witness) -> Witness:
    """Return `witness` with x negated, its points in the same order."""
    plan = witness.plan
    high = plan.low[0] + plan.cell_m * plan.covered.shape[0]
    return replace(
        witness,
        points=witness.points * _FLIP,
        normals=witness.normals * _FLIP,
        everything=_mirrored_rung(witness.everything),
        free=None if witness.free is None else witness.free.mirrored(),
        plan=replace(
            plan,
            low=np.array([-high, plan.low[1]]),
            covered=plan.covered[::-1],
            within=plan.within[::-1],
            top=plan.top[::-1],
        ),
    )


def _mirrored_rung(rung: Rung) -> Rung:
    xyz = rung.xyz * _FLIP
    neighbours = build_index(xyz)
    return replace(rung, xyz=xyz, normals=rung.normals * _FLIP, neighbours=neighbours)
