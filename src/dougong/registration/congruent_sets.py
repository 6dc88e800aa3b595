"""Coarse registration by 4-point congruent sets: 4PCS (Aiger 2008), with what Super4PCS adds.

A base of four coplanar points of the source is looked for in the target: the two ratios in which
its diagonals cut each other, the lengths of the diagonals and the angle between them survive
every rigid motion. Crossing points of candidate diagonals are matched through a spatial index
(Mellado 2014) instead of pair by pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Limits

from dougong.filters import neighbourhood
from dougong.kernels.congruent import pairs_at_distance
from dougong.params import Parameters
from dougong.registration.hypotheses import rank
from dougong.registration.pose_search import (
    Field,
    Poses,
    View,
    build_field,
    distinct,
    fit_rigid_many,
    score_poses,
    spread,
    to_transform,
)
from dougong.registration.prepare import Prepared
from dougong.registration.result import Hypothesis
from dougong.registration.sample_consensus import view_of_prepared
from dougong.threads import for_blocks
from dougong.typing import Index, Points, Values

_BLOCK = 32
_MOST_PAIRS = 60_000
_PER_CROSSING = 12
_DRAWS = 200


class CongruentSets(Parameters):
    """How 4PCS draws its bases and finds them again."""

    overlap: Annotated[float, Limits(gt=0, le=1)] = 0.6
    """Share of the source that the target shows too: wide bases need much of it."""
    sampled: Annotated[int, Limits(ge=50)] = 500
    """Evenly spread points of each cloud that bases are made of."""
    bases: Annotated[int, Limits(ge=1)] = 60
    """Bases drawn."""
    tolerance_spacings: Annotated[float, Limits(gt=0)] = 0.5
    """Congruent means: equal to so many spacings of the sampled points."""
    normal_tolerance: Annotated[float, Limits(gt=0)] = 0.25
    """Largest difference in the cosine between the normals of a diagonal's ends."""
    angle_tolerance_deg: Annotated[float, Limits(gt=0)] = 8.0
    """Largest difference in the angle between the diagonals."""
    most_sets: Annotated[int, Limits(ge=10)] = 4000
    """Congruent sets tried per base."""
    returned: Annotated[int, Limits(ge=1)] = 8
    """Distinct poses handed over."""
    seed: int = 0
    """Of the bases."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """Four nearly coplanar points a, b, c, d; the diagonals ab and cd cross."""

    places: Index
    """(4,)"""
    ratios: tuple[float, float]
    """Where the crossing lies on ab and on cd, 0..1."""
    lengths: tuple[float, float]
    angle_cosine: float
    """|cosine| between the diagonals."""


def four_pcs(
    source: Prepared, target: Prepared, params: CongruentSets | None = None
) -> list[Hypothesis]:
    """Return the best distinct poses of 4-point congruent sets, best score first.

    Notes
    -----
    Deterministic by `seed`; independent of thread count and point order.
    """
    params = params or CongruentSets()
    one, two = view_of_prepared(source, 4000), view_of_prepared(target, 4000)
    field = build_field(two, max(0.1 * two.radius_m, 4.0 * two.spacing_m), 96)
    poses, scores = congruent_poses(one, two, field, params)
    found = [
        Hypothesis(T_target_source=to_transform(pose, one, two), score=float(score), method="4pcs")
        for pose, score in zip(poses, scores, strict=True)
    ]
    return rank(found, source, target)


def congruent_poses(
    source: View, target: View, field: Field, params: CongruentSets
) -> tuple[Poses, Values]:
    """Return up to `returned` distinct poses (k, 12) between views and their scores."""
    sampled = np.sort(spread(source, params.sampled)), np.sort(spread(target, params.sampled))
    points = [view.points[s] for view, s in zip((source, target), sampled, strict=True)]
    normals = [view.normals[s] for view, s in zip((source, target), sampled, strict=True)]
    gap = float(np.median(neighbourhood.knn(neighbourhood.build_index(points[1]), None, 1)[1]))
    tolerance = params.tolerance_spacings * gap
    rng = np.random.default_rng(params.seed)
    judged = spread(source, 256)
    reach = max(4.0 * source.spacing_m, 0.05 * target.radius_m)
    kept, scores = np.empty((0, 12)), np.empty(0)
    for _ in range(params.bases):
        base = draw_base(points[0], params.overlap, tolerance, rng)
        if base is None:
            continue
        sets = congruent(base, points[0], normals[0], points[1], normals[1], tolerance, params)
        if not len(sets):
            continue
        poses = fit_rigid_many(
            np.broadcast_to(points[0][base.places], (len(sets), 4, 3)), points[1][sets]
        )
        found = score_poses(poses, source.points[judged], source.normals[judged], field, reach)
        best = np.argsort(-found, kind="stable")[:50]
        kept, scores = np.concatenate([kept, poses[best]]), np.concatenate([scores, found[best]])
    order = distinct(kept, scores, params.returned, 5.0, 0.1 * target.radius_m)
    return kept[order], scores[order]


def draw_base(
    points: Points, overlap: float, tolerance: float, rng: np.random.Generator
) -> Base | None:
    """Return a wide base of four nearly coplanar points, None when chance gives none.

    Three points as far apart as the overlap allows (the widest of some draws), then the point
    nearest to their plane whose diagonals cross inside (Aiger 2008, sec. 3).
    """
    widest = overlap * float(np.ptp(points, axis=0).max())
    draws = rng.integers(0, len(points), (_DRAWS, 3))
    corners = points[draws]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    area[(sides > widest).any(axis=1)] = 0.0
    # The widest of few draws: always the same triangle would waste the next base.
    three = draws[int(np.argmax(area[: int(rng.integers(20, _DRAWS))]))]
    normal = np.cross(points[three[1]] - points[three[0]], points[three[2]] - points[three[0]])
    size = float(np.linalg.norm(normal))
    if size <= 1e-12:
        return None
    height = np.abs((points - points[three[0]]) @ (normal / size))
    distance = np.linalg.norm(points[:, None] - points[three], axis=2)
    height[(distance.max(axis=1) > widest) | (distance.min(axis=1) < 0.2 * widest)] = np.inf
    for fourth in np.argsort(height, kind="stable")[:40]:
        if height[fourth] > 2.0 * tolerance:
            return None
        base = _crossing(points, np.array([*three, fourth], np.int64))
        if base is not None:
            return base
    return None


def _crossing(points: Points, four: Index) -> Base | None:
    """Return the base of `four` places in the pairing whose diagonals cross inside, or None."""
    for order in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2)):
        places = four[list(order)]
        a, b, c, d = points[places]
        along, across = b - a, d - c
        matrix = np.column_stack([along, -across])
        (first, second), *_ = np.linalg.lstsq(matrix, c - a, rcond=None)
        lengths = float(np.linalg.norm(along)), float(np.linalg.norm(across))
        cosine = abs(float(along @ across)) / max(lengths[0] * lengths[1], 1e-300)
        if 0.05 < first < 0.95 and 0.05 < second < 0.95 and cosine < 0.95:
            return Base(
                places=places,
                ratios=(float(first), float(second)),
                lengths=lengths,
                angle_cosine=cosine,
            )
    return None


def congruent(
    base: Base,
    points: Points,
    normals: Points,
    target: Points,
    target_normals: Points,
    tolerance: float,
    params: CongruentSets,
) -> Index:
    """Return the sets (k, 4) of target places that are congruent to `base`."""
    a, b, c, d = base.places
    pairs, crossings = [], []
    for ends, length, ratio in zip(((a, b), (c, d)), base.lengths, base.ratios, strict=True):
        cosine = abs(float(normals[ends[0]] @ normals[ends[1]]))
        found = pairs_of(target, target_normals, length, tolerance, cosine, params.normal_tolerance)
        pairs.append(found)
        crossings.append(target[found[:, 0]] + ratio * (target[found[:, 1]] - target[found[:, 0]]))
    if not len(pairs[0]) or not len(pairs[1]):
        return np.empty((0, 4), np.int64)
    places, _ = neighbourhood.knn(
        neighbourhood.build_index(crossings[0]), crossings[1], _PER_CROSSING, tolerance
    )
    second, slot = np.nonzero(places >= 0)
    first = places[second, slot]
    one, two = (
        _directions(target, p[rows]) for p, rows in zip(pairs, (first, second), strict=True)
    )
    angle = np.degrees(np.arccos(np.clip(np.abs((one * two).sum(axis=1)), 0.0, 1.0)))
    wanted = np.degrees(np.arccos(min(base.angle_cosine, 1.0)))
    good = np.abs(angle - wanted) < params.angle_tolerance_deg
    sets = np.column_stack([pairs[0][first[good]], pairs[1][second[good]]])
    return _congruent_sides(base, points, target, sets, tolerance)[: params.most_sets]


def _congruent_sides(
    base: Base, points: Points, target: Points, sets: Index, tolerance: float
) -> Index:
    """Return those of `sets` (k, 4) whose other four sides agree, best agreement first."""
    four = points[base.places]
    worst = np.zeros(len(sets))
    for i, j in ((0, 2), (0, 3), (1, 2), (1, 3)):
        wanted = np.linalg.norm(four[i] - four[j])
        there = np.linalg.norm(target[sets[:, i]] - target[sets[:, j]], axis=1)
        worst = np.maximum(worst, np.abs(there - wanted))
    order = np.argsort(worst, kind="stable")
    return sets[order[worst[order] < 2.0 * tolerance]]


def _directions(points: Points, pairs: Index) -> Points:
    """Return unit vectors (k, 3) from the first to the second place of pairs (k, 2)."""
    offsets = points[pairs[:, 1]] - points[pairs[:, 0]]
    unit: Points = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-300)
    return unit


def pairs_of(
    points: Points,
    normals: Points,
    length: float,
    tolerance: float,
    cosine: float,
    cosine_tolerance: float,
) -> NDArray[np.int64]:
    """Return the ordered pairs (k, 2) of points (n, 3) that are `length` apart; at most 60,000.

    |cosine| between their normals is within `cosine_tolerance` of `cosine`. Of too many pairs an
    even share is kept.
    """
    n = len(points)
    parts: list[NDArray[np.int64]] = [np.empty((0, 2), np.int64)] * (-(-n // _BLOCK))

    def task(start: int, stop: int) -> None:
        out = np.empty(((stop - start) * n, 2), np.int64)
        count = pairs_at_distance(
            points, normals, length, tolerance, cosine, cosine_tolerance, start, stop, out
        )
        parts[start // _BLOCK] = out[:count].copy()

    for_blocks(n, _BLOCK, task)
    found = np.concatenate(parts)
    if len(found) > _MOST_PAIRS:
        found = found[np.linspace(0, len(found) - 1, _MOST_PAIRS).astype(np.int64)]
    return found
