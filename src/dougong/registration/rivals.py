"""Poses that a nearly symmetric or repetitive building could take for the found one.

A coarse search may not list them, so they are made here: turns about the middle of what fits,
and shifts along it. Most fit badly and are dropped at once; those that fit are refined and heard
like every other pose (METHOD.md 2.3).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from dougong.kernels import partners
from dougong.registration.evidence import Court, Testimony
from dougong.registration.icp_solve import rotation_of
from dougong.registration.overlap import apply
from dougong.threads import for_blocks
from dougong.typing import Mask, Points, Transform, Values

SAME_YAW_DEG = 5.0
SAME_SHIFT_M = 0.5
_SAMPLE = 1500
_TURN_STEP_DEG = 5.0
_SHIFT_STEP_M = 0.25
_REACH_M = 1.0
_LIKE_COSINE = 0.7
_MOVES = 4
"""Poses per task of the quick score."""
# Of what the winner itself reaches in the quick score, a pose worth refining reaches so much.
_WORTH = 0.4
_NEAR_REACH_M = 0.3
_NEAR_STEP_M = 0.05
_NEAR_UP_M = 1.0
_NEAR_ASIDE_M = 0.6
_NEAR_TURN_DEG = 6.0
_NEAR_WORTH = 0.5


def is_same(
    a: Transform,
    b: Transform,
    at: NDArray[np.float64],
    angle_deg: float = SAME_YAW_DEG,
    shift_m: float = SAME_SHIFT_M,
) -> bool:
    """Say whether two poses (source -> target) are one: within 5 degrees and 0.5 m.

    `at` (3,) is the middle of the source's structure: a turn about a far origin is no shift.
    """
    turn = a[:3, :3] @ b[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    shift = np.linalg.norm(apply(a, at[None]) - apply(b, at[None]))
    return bool(angle < angle_deg and shift < shift_m)


def is_near(a: Transform, b: Transform, at: NDArray[np.float64]) -> bool:
    """Say whether two poses lie as close as `propose_neighbours` looks, and rests a little off."""
    return is_same(a, b, at, _NEAR_TURN_DEG + 0.5, _NEAR_UP_M + 0.25)


def middle_of(points: Points) -> NDArray[np.float64]:
    """Return the middle (3,) of the smallest rectangle in plan round `points`, median height."""
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    origin = inside.mean(axis=0)
    rectangle = cv2.minAreaRect((inside[:, :2] - origin[:2]).astype(np.float32))
    return np.array([*(np.array(rectangle[0]) + origin[:2]), np.median(inside[:, 2])])


def propose_rivals(court: Court, winner: Testimony, most: int) -> list[Transform]:
    """Return starting poses that could rival the winner's: `most` turns, half as many shifts.

    They are the peaks, away from the winner, of a quick score over turns (every 5 degrees) about
    the middle of the explained structure, of all the source's and of all the target's structure,
    and over shifts along the structure's two axes (every 0.25 m, up to half its length).
    """
    split = len(court.source.points)
    explained = court.source.is_structure & winner.is_explained[:split]
    if int(explained.sum()) < 50 or int(court.target.is_structure.sum()) < 50:
        return []
    structure = apply(winner.T, court.source.points[court.source.is_structure])
    normals = court.source.normals[court.source.is_structure] @ winner.T[:3, :3].T
    middles = _middles(court, winner, explained)
    shifts = _shifts(structure)
    step = max(1, len(structure) // _SAMPLE)
    structure, normals = structure[::step], normals[::step]
    worth = _WORTH * float(_quick_scores(court, [np.eye(4)], structure, normals)[0])
    turns = [move for middle in middles for move in _turns(middle)]
    rivals: list[Transform] = []
    for families, count in (([turns], most), (shifts, most // 2)):
        found: list[tuple[float, Transform]] = []
        for family in families:
            scores = _quick_scores(court, family, structure, normals)
            found += [(scores[k], family[k]) for k in _peaks(scores) if scores[k] > worth]
        found.sort(key=lambda item: -item[0])
        kept: list[Transform] = []
        for _, move in found:
            if not any(is_same(move, other, middles[0]) for other in kept):
                kept.append(move)
        rivals += [_settled(court, move, structure, normals) for move in kept[:count]]
    return [move @ winner.T for move in rivals]


def propose_neighbours(court: Court, winner: Testimony, most: int) -> list[Transform]:
    """Return starting poses close to the winner's where a fit may have come to rest as well.

    A roof's underside on its top, the next step of a stair, the next bar of a lattice: peaks of
    the quick score, with a short reach, over shifts of up to 1 m in height and 0.6 m along both
    axes of the structure, and turns of up to 6 degrees.
    """
    if int(court.source.is_structure.sum()) < 50 or int(court.target.is_structure.sum()) < 50:
        return []
    structure = apply(winner.T, court.source.points[court.source.is_structure])
    normals = court.source.normals[court.source.is_structure] @ winner.T[:3, :3].T
    middle, axes = middle_of(structure), _plan_axes(structure)
    step = max(1, len(structure) // _SAMPLE)
    structure, normals = structure[::step], normals[::step]
    own = _quick_scores(court, [np.eye(4)], structure, normals, _NEAR_REACH_M)
    worth = _NEAR_WORTH * float(own[0])
    found: list[tuple[float, Transform]] = []
    for family in _near_families(middle, axes):
        scores = _quick_scores(court, family, structure, normals, _NEAR_REACH_M)
        found += [(scores[k], family[k]) for k in _peaks(scores) if scores[k] > worth]
    found.sort(key=lambda item: -item[0])
    return [move @ winner.T for _, move in found[:most]]


def _near_families(middle: NDArray[np.float64], axes: NDArray[np.float64]) -> list[list[Transform]]:
    """Return small shifts up, down and both ways along `axes` (2, 2), and turns both ways."""
    ways = [(np.array([0.0, 0.0, 1.0]), _NEAR_UP_M)]
    ways += [(np.array([*axis, 0.0]), _NEAR_ASIDE_M) for axis in axes]
    families = []
    for sign in (1.0, -1.0):
        for way, reach in ways:
            steps = sign * np.arange(_NEAR_STEP_M, reach + 0.5 * _NEAR_STEP_M, _NEAR_STEP_M)
            families.append([_motion(0.0, step * way, middle) for step in steps])
        turns = sign * np.radians(np.arange(0.5, _NEAR_TURN_DEG + 0.25, 0.5))
        families.append([_motion(turn, np.zeros(3), middle) for turn in turns])
    return families


def _motion(turn: float, shift: NDArray[np.float64], middle: NDArray[np.float64]) -> Transform:
    """Return the turn (rad) about the vertical through `middle`, then the shift (3,)."""
    move = np.eye(4)
    move[:3, :3] = rotation_of(np.array([0.0, 0.0, turn]))
    move[:3, 3] = middle - move[:3, :3] @ middle + shift
    return move


def propose_mirrored(court: Court, winner: Testimony, most: int) -> list[Transform]:
    """Return poses (improper, source -> target) that lay the source's mirror image on the target.

    Reflections of the winner in upright planes through the middles of the structure, every 2.5
    degrees: what a left-handed file of a building that nearly equals its own mirror image needs.
    """
    split = len(court.source.points)
    explained = court.source.is_structure & winner.is_explained[:split]
    if int(explained.sum()) < 50 or int(court.target.is_structure.sum()) < 50:
        return []
    structure = apply(winner.T, court.source.points[court.source.is_structure])
    normals = court.source.normals[court.source.is_structure] @ winner.T[:3, :3].T
    step = max(1, len(structure) // (_SAMPLE // 2))
    structure, normals = structure[::step], normals[::step]
    found: list[tuple[float, Transform]] = []
    middles = _middles(court, winner, explained)
    for middle in middles[:2]:
        family = _reflections(middle)
        scores = _quick_scores(court, family, structure, normals)
        # The family closes on itself: no end leans on anything.
        is_peak = (scores >= np.roll(scores, 1)) & (scores > np.roll(scores, -1))
        found += [(scores[k], family[k]) for k in np.flatnonzero(is_peak)]
    found.sort(key=lambda item: -item[0])
    kept: list[Transform] = []
    for _, move in found:
        if not any(is_same(move, other, middles[0]) for other in kept):
            kept.append(move)
    return [_settled(court, move, structure, normals) @ winner.T for move in kept[:most]]


def _middles(court: Court, winner: Testimony, explained: Mask) -> list[NDArray[np.float64]]:
    """Return the middles (3,) of the explained, all the source's, all the target's structure."""
    return [
        middle_of(apply(winner.T, court.source.points[explained])),
        middle_of(apply(winner.T, court.source.points[court.source.is_structure])),
        middle_of(court.target.points[court.target.is_structure]),
    ]


def _reflections(middle: NDArray[np.float64]) -> list[Transform]:
    """Return the reflections in upright planes through `middle`, every half turn step."""
    moves = []
    for angle in np.radians(np.arange(0.0, 360.0, _TURN_STEP_DEG)):
        move = np.eye(4)
        move[:3, :3] = rotation_of(np.array([0.0, 0.0, angle])) @ np.diag([-1.0, 1.0, 1.0])
        move[:3, 3] = middle - move[:3, :3] @ middle
        moves.append(move)
    return moves


def _turns(middle: NDArray[np.float64]) -> list[Transform]:
    """Return the turns about the vertical through `middle`, 10 to 350 degrees."""
    angles = np.arange(2 * _TURN_STEP_DEG, 360.0 - _TURN_STEP_DEG, _TURN_STEP_DEG)
    return [_motion(float(np.radians(angle)), np.zeros(3), middle) for angle in angles]


def _plan_axes(points: Points) -> NDArray[np.float64]:
    """Return the two axes (2, 2), by rows, along which the plan of `points` spreads."""
    centred = points[:, :2] - points[:, :2].mean(axis=0)
    axes: NDArray[np.float64] = np.linalg.eigh(centred.T @ centred)[1].T
    return axes


def _shifts(points: Points) -> list[list[Transform]]:
    """Return the shifts both ways along both axes of the structure's plan."""
    centred = points[:, :2] - points[:, :2].mean(axis=0)
    families = []
    for axis in _plan_axes(points):
        along = centred @ axis
        half = 0.5 * float(np.quantile(along, 0.99) - np.quantile(along, 0.01))
        steps = np.arange(2 * _SHIFT_STEP_M, max(min(half, 20.0), 1.0), _SHIFT_STEP_M)
        for sign in (1.0, -1.0):
            family = []
            for step in steps:
                move = np.eye(4)
                move[:2, 3] = sign * step * axis
                family.append(move)
            families.append(family)
    return families


def _settled(court: Court, move: Transform, points: Points, normals: Points) -> Transform:
    """Return `move` shifted in plan, up to 3 m, to where it fits best, the reach shrinking.

    The middles are rough and columns repeat: from half a metre off, the fit may settle beside.
    """
    step = max(1, len(points) // 600)
    points, normals = points[::step], normals[::step]
    best = move
    for grid, reach in ((0.6, _REACH_M), (0.2, 0.4 * _REACH_M)):
        reached = 5 if grid > 0.5 else 3
        trials = []
        for i, j in itertools.product(range(-reached, reached + 1), repeat=2):
            trial = best.copy()
            trial[:2, 3] += (grid * i, grid * j)
            trials.append(trial)
        best = trials[int(np.argmax(_quick_scores(court, trials, points, normals, reach)))]
    return best


def _quick_scores(
    court: Court,
    moves: Sequence[Transform],
    points: Points,
    normals: Points,
    reach_m: float = _REACH_M,
) -> Values:
    """Return how near `points` (n, 3) come to like surfaces within `reach_m` after each move."""
    everything = court.target.everything
    scores = np.empty(len(moves))
    stacked = np.ascontiguousarray(moves, dtype=np.float64)

    def task(start: int, stop: int) -> None:
        partners.closeness(
            points, normals, stacked, everything.tree, everything.normals,
            reach_m, _LIKE_COSINE, start, stop, scores,
        )  # fmt: skip

    for_blocks(len(moves), _MOVES, task)
    return scores


def _peaks(scores: Values) -> list[int]:
    """Return the places of local maxima inside; the ends lean on the winner or on nothing."""
    if len(scores) < 3:
        return []
    padded = np.concatenate([[np.inf], scores, [np.inf]])
    is_peak = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:])
    return [int(k) for k in np.flatnonzero(is_peak)]
