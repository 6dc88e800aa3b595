"""Coarse registration by sample consensus on features: SAC-IA (Rusu 2009)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field as Limits

from dougong.params import Parameters
from dougong.registration.features import Fpfh, fpfh, nearest_features
from dougong.registration.hypotheses import rank
from dougong.registration.overlap import rung
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
    view_of,
)
from dougong.registration.prepare import Prepared
from dougong.registration.result import Hypothesis
from dougong.typing import Index, Points, Values

_BATCH = 20_000
_SCORED = 4000


class SacIa(Parameters):
    """How sample consensus initial alignment draws and keeps its poses."""

    feature: Fpfh = Fpfh()
    max_points: Annotated[int, Limits(ge=100)] = 4000
    """Points of each cloud, thinned evenly, that carry features."""
    trials: Annotated[int, Limits(ge=1)] = 200_000
    """Samples drawn."""
    alike: Annotated[int, Limits(ge=1)] = 5
    """A sampled point is paired with one of so many points of the most alike features."""
    min_distance_share: Annotated[float, Limits(gt=0, lt=1)] = 0.15
    """Sampled points are farther apart than this share of the longest side."""
    edge_tolerance: Annotated[float, Limits(gt=0)] = 0.1
    """Sides of the sampled triangles may differ by this share, or by two spacings if more."""
    returned: Annotated[int, Limits(ge=1)] = 8
    """Distinct poses handed over."""
    seed: int = 0
    """Of the samples."""


def sac_ia(source: Prepared, target: Prepared, params: SacIa | None = None) -> list[Hypothesis]:
    """Return the best distinct poses of sample consensus on FPFH, best score first.

    Samples of three source points, far from each other, are paired at random with points of
    alike features; the rigid motion of each is judged by all points with a truncated error
    (Rusu 2009, sec. IV). Triangles whose sides do not agree are not tried: they cannot be right.

    Notes
    -----
    Deterministic by `seed`; independent of thread count and point order.
    """
    params = params or SacIa()
    one, two = (
        view_of_prepared(source, params.max_points),
        view_of_prepared(target, params.max_points),
    )
    field = build_field(two, max(0.1 * two.radius_m, 4.0 * two.spacing_m), 96)
    poses, scores = consensus_poses(one, two, field, params)
    found = [
        Hypothesis(
            T_target_source=to_transform(pose, one, two), score=float(score), method="sac-ia"
        )
        for pose, score in zip(poses, scores, strict=True)
    ]
    return rank(found, source, target)


def view_of_prepared(cloud: Prepared, most: int) -> View:
    """Return at most `most` evenly thinned points of a prepared cloud, without plain ground.

    Ground is alike everywhere: it is left out where enough else remains.
    """
    thinned = rung(cloud, cloud.spacing_m, most, most)
    is_object = ~cloud.is_ground[thinned.index]
    if is_object.sum() < max(200, 0.1 * len(is_object)):
        is_object = np.ones(len(is_object), bool)
    return view_of(thinned.xyz[is_object], thinned.normals[is_object], thinned.spacing_m)


def consensus_poses(
    source: View, target: View, field: Field, params: SacIa
) -> tuple[Poses, Values]:
    """Return up to `returned` distinct poses (k, 12) between views and their scores."""
    spacing = max(source.spacing_m, target.spacing_m)
    radius = params.feature.radius_spacings * spacing
    features = [
        fpfh(v.points, v.normals, radius, max_neighbours=params.feature.max_neighbours)
        for v in (source, target)
    ]
    alike, _ = nearest_features(features[0], features[1], params.alike)
    longest = float(np.ptp(source.points, axis=0).max())
    rng = np.random.default_rng(params.seed)
    chosen = spread(source, 256)
    points, normals = source.points[chosen], source.normals[chosen]
    reach = max(4.0 * spacing, 0.05 * target.radius_m)
    kept, scores = np.empty((0, 12)), np.empty(0)
    for start in range(0, params.trials, _BATCH):
        count = min(_BATCH, params.trials - start)
        poses = _trial_poses(source, target, alike, longest, spacing, count, rng, params)
        kept = np.concatenate([kept, poses])
        scores = np.concatenate([scores, score_poses(poses, points, normals, field, reach)])
        best = np.argsort(-scores, kind="stable")[:_SCORED]
        kept, scores = kept[best], scores[best]
    order = distinct(kept, scores, params.returned, 5.0, 0.1 * target.radius_m)
    return kept[order], scores[order]


def _trial_poses(
    source: View,
    target: View,
    alike: Index,
    longest: float,
    spacing: float,
    count: int,
    rng: np.random.Generator,
    params: SacIa,
) -> Poses:
    """Return the motions of those of `count` random samples whose triangles agree."""
    triples = rng.integers(0, len(source.points), (count, 3))
    picks = rng.integers(0, min(params.alike, len(target.points)), (count, 3))
    partners = alike[triples, picks]
    here, there = source.points[triples], target.points[partners]
    sides = np.array([_sides(here), _sides(there)])
    is_wide = (sides[0] > params.min_distance_share * longest).all(axis=1)
    bound = np.maximum(params.edge_tolerance * sides[0], 2.0 * spacing)
    is_alike = (np.abs(sides[0] - sides[1]) < bound).all(axis=1)
    good = is_wide & is_alike & (partners >= 0).all(axis=1)
    return fit_rigid_many(here[good], there[good])


def _sides(triangles: Points) -> Points:
    """Return the lengths (k, 3) of the sides of triangles (k, 3, 3)."""
    lengths: Points = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
    return lengths
