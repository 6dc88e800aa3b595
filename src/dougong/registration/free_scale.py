"""The scale of a cloud that has none: found, fitted with the pose, and judged (METHOD.md 2.2, 3).

Photogrammetry without control is a shape without a unit. So its unit is searched first: over a grid
of scales the plan search asks where the walls of both clouds meet, and the best few are fitted with
the scale as a seventh unknown. Everything is measured in the cloud whose unit is known, on its own
points: a cloud that shrinks to nothing explains none of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dougong.cloud import Cloud
from dougong.registration.cleaning import extent, far_points
from dougong.registration.covariance import blocks_of
from dougong.registration.evidence import Court, hear, summon
from dougong.registration.heights import height_candidates, levels
from dougong.registration.hypotheses import rank
from dougong.registration.icp import Icp
from dougong.registration.plan_search import PlanSearch, plan_search, pose_transform, search
from dougong.registration.prepare import Prepare, Prepared, prepare
from dougong.registration.rasters import plan_view
from dougong.registration.result import Hypothesis
from dougong.registration.similarity_fit import SimilarityFit, fit_similarity
from dougong.typing import Kind, Points, Transform, Values

Side = Literal["source", "target"]
LEAST, MOST = 0.01, 100.0
"""Metres per unit of the file between which a scale is searched."""
_STEP = 0.04
_REACH = 2.5
_PREPARED_EVERY = 3.0
_COARSE = PlanSearch(cell_m=1.0, fine_cell_m=1.0, max_cells=96, yaw_step_deg=5.0, peaks=4)
_FINE = PlanSearch(max_cells=192, yaw_step_deg=4.0, peaks=12, max_hypotheses=2)
_THIN = Prepare(min_spacing_m=0.15, max_points=100_000)
_KEPT = 3
_RIVAL = 0.6
_SEPARATE = 0.03
_BLOCK_M = 5.0
_DECISIVE = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleCandidate:
    """A scale, the pose that goes with it, and what it explains."""

    metres_per_unit: float
    """Metres per unit of the free cloud's local frame."""
    T_target_source: Transform
    """Rigid, between the local frames with the free cloud in metres."""
    loss: float
    """Mean loss of the metric cloud's structure, 0 explained .. 1 contradicted."""
    losses: Values
    """(m,) the same per point."""
    fit: SimilarityFit


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSearch:
    """What the search over scales found."""

    side: Side
    """Which cloud has no unit."""
    candidates: tuple[ScaleCandidate, ...]
    """Best first, at least 3 % apart."""
    undecided: tuple[ScaleCandidate, ...]
    """Other scales that explain the metric cloud as well."""
    control_points: int = 0
    """Control points that the best scale was adjusted with."""
    contradiction: str | None = None
    """What the control points and the clouds hold against each other; None: nothing."""


def free_side(source: Cloud, source_kind: Kind, target: Cloud, target_kind: Kind) -> Side:
    """Return which cloud's scale is freed: the one that names no system, else photogrammetry."""
    known = source.frame.crs is not None, target.frame.crs is not None
    if known[0] != known[1]:
        return "target" if known[0] else "source"
    return "target" if target_kind == "photogrammetry" and source_kind == "lidar" else "source"


def with_unit(cloud: Cloud, metres_per_unit: float) -> Cloud:
    """Return `cloud` with its local unit taken for so many metres; its file stays as it is."""
    x, y, z = cloud.frame.unit_m
    frame = replace(
        cloud.frame,
        origin=cloud.frame.origin * metres_per_unit,
        unit_m=(x * metres_per_unit, y * metres_per_unit, z * metres_per_unit),
        crs=None,
    )
    return cloud.stretched(metres_per_unit, frame)


def without_unit(cloud: Cloud) -> Cloud:
    """Return `cloud` with its numbers as they stand: no reference system, no unit."""
    (unit, *_) = cloud.frame.unit_m
    return with_unit(cloud, 1.0 / unit)


def scaled(cloud: Prepared, factor: float) -> Prepared:
    """Return a prepared cloud with every length multiplied."""
    return replace(
        cloud,
        xyz=cloud.xyz * factor,
        seen_from=None if cloud.seen_from is None else cloud.seen_from * factor,
        height_above_ground=cloud.height_above_ground * factor,
        weights_area=cloud.weights_area * factor**2,
        spacing_m=cloud.spacing_m * factor,
        sigma_m=cloud.sigma_m * factor,
    )


def search_scale(
    source: Cloud,
    target: Cloud,
    *,
    source_kind: Kind,
    target_kind: Kind,
    icp: Icp,
    dof: int,
    side: Side | None = None,
) -> ScaleSearch:
    """Search the scale of the cloud that has no unit, over 0.01 to 100 metres per unit.

    Parameters
    ----------
    source, target : Cloud
    source_kind, target_kind : {"lidar", "photogrammetry"}
    icp : Icp
        Settings of the fit.
    dof : int
        5 (levelled) or 7.
    side : {"source", "target"}, optional
        Which cloud has no unit; by default see `free_side`.

    Returns
    -------
    ScaleSearch
        Empty candidates: at no scale do the clouds have anything in common.

    Notes
    -----
    Cost: about as many small plan searches as steps of 4 % fit between the sizes' bounds (a
    hundred at most), then six fits. Deterministic.
    """
    side = side or free_side(source, source_kind, target, target_kind)
    free, fixed, kinds = _by_side(source, target, (source_kind, target_kind), side)
    metric = prepare(fixed, kinds[1], _THIN)
    grid = _grid(free.xyz, fixed.xyz)
    parts = max(1, int(np.ceil(np.log(grid[-1] / grid[0]) / np.log(_PREPARED_EVERY))))
    scores: list[tuple[float, float, Prepared]] = []
    for some in np.array_split(grid, parts):
        middle = float(np.sqrt(some[0] * some[-1]))
        ready = scaled(prepare(with_unit(free, middle), kinds[0], _THIN), 1.0 / middle)
        for k in some:
            scores.append((_coarse_score(scaled(ready, k), metric, side), float(k), ready))
    found = []
    for _, k, ready in _peaks(scores):
        candidate = _refined(ready, k, metric, side, icp, dof)
        if candidate is not None:
            found.append(candidate)
    kept = _distinct(found)
    undecided = tuple(c for c in kept[1:] if not _is_better(kept[0], c, metric))
    return ScaleSearch(side=side, candidates=tuple(kept), undecided=undecided)


def scale_near(
    source: Cloud,
    target: Cloud,
    metres_per_unit: float,
    T: Transform,
    *,
    source_kind: Kind,
    target_kind: Kind,
    icp: Icp,
    dof: int,
    side: Side,
) -> ScaleSearch:
    """Fit the scale of one cloud, and the pose, near what is known of them.

    Parameters
    ----------
    metres_per_unit : float
        Of the free cloud, to a few per cent.
    T : ndarray, shape (4, 4)
        Rigid, source local -> target local with both in metres.

    Returns
    -------
    ScaleSearch
        At most one candidate; none: the clouds have too little in common there.
    """
    free, fixed, kinds = _by_side(source, target, (source_kind, target_kind), side)
    k, metric = metres_per_unit, prepare(fixed, kinds[1], _THIN)
    ready = prepare(with_unit(free, k), kinds[0], _THIN)
    fit = fit_similarity(*_ordered(ready, metric, side), T, side, icp, dof)
    found = () if fit is None else (_candidate(scaled(ready, 1.0 / k), k, metric, side, fit),)
    return ScaleSearch(side=side, candidates=found, undecided=())


def _by_side(
    source: Cloud, target: Cloud, kinds: tuple[Kind, Kind], side: Side
) -> tuple[Cloud, Cloud, tuple[Kind, Kind]]:
    """Return the cloud without a unit, the other one, and their kinds in that order."""
    if side == "source":
        return source, target, kinds
    return target, source, (kinds[1], kinds[0])


def _grid(free: Points, fixed: Points) -> Values:
    """Return the scales to try, metres per unit, geometric, from what the sizes allow."""
    ratios = []
    for axes in ((0, 1), (2,)):
        one = _spread(free)[list(axes)].max()
        other = _spread(fixed)[list(axes)].max()
        if min(one, other) > 0.0:
            ratios.append(other / one)
    low, high = (min(ratios) / _REACH, max(ratios) * _REACH) if ratios else (LEAST, MOST)
    low, high = max(low, LEAST / 1.05), min(high, MOST * 1.05)
    count = max(1, int(np.ceil(np.log(high / low) / _STEP))) if high > low else 0
    grid: Values = np.geomspace(low, high, count + 1) if count else np.array([low])
    return grid


def _spread(points: Points) -> Values:
    low, high = extent(points[~far_points(points)])
    sizes: Values = high - low
    return sizes


def _ordered(free: Prepared, metric: Prepared, side: Side) -> tuple[Prepared, Prepared]:
    return (free, metric) if side == "source" else (metric, free)


def _coarse_score(free: Prepared, metric: Prepared, side: Side) -> float:
    """Return how well the best plan pose explains both clouds at one scale, 0..1."""
    source, target = _ordered(free, metric, side)
    edges = np.asarray(_COARSE.band_edges_m)
    views = plan_view(source, edges), plan_view(target, edges)
    if min(np.ptp(view.xyz[:, :2], axis=0).max() for view in views) < 4.0:
        return 0.0
    poses = search(*views, _COARSE)[:3]
    heights = levels(views[0]), levels(views[1])
    starts = [
        Hypothesis(T_target_source=pose_transform(pose, z, *views), score=0.0, method="plan")
        for pose in poses
        for z in height_candidates(pose, *heights)[:2]
    ]
    ranked = rank(starts, source, target)
    return ranked[0].score if ranked else 0.0


def _peaks(scores: list[tuple[float, float, Prepared]]) -> list[tuple[float, float, Prepared]]:
    """Return the highest local maxima over the scales, each between its neighbours (parabola)."""
    values = np.array([0.0, *(row[0] for row in scores), 0.0])
    peaks = []
    for place, (value, k, ready) in enumerate(scores, 1):
        before, after = values[place - 1], values[place + 1]
        if value >= max(before, after) and value >= _RIVAL * values.max() > 0.0:
            bend = 2.0 * value - before - after
            shift = 0.5 * (after - before) / bend if bend > 0.0 else 0.0
            peaks.append((value, k * float(np.exp(_STEP * shift)), ready))
    return sorted(peaks, key=lambda row: -row[0])[:_KEPT]


def _refined(
    ready: Prepared, k: float, metric: Prepared, side: Side, icp: Icp, dof: int
) -> ScaleCandidate | None:
    """Fit scale and pose near scale `k`; None: nothing in common there."""
    source, target = _ordered(scaled(ready, k), metric, side)
    best: ScaleCandidate | None = None
    for hypothesis in plan_search(source, target, _FINE)[:2]:
        fit = fit_similarity(source, target, hypothesis.T_target_source, side, icp, dof)
        if fit is None:
            continue
        candidate = _candidate(ready, k, metric, side, fit)
        if best is None or candidate.loss < best.loss:
            best = candidate
    return best


def _candidate(
    ready: Prepared, k: float, metric: Prepared, side: Side, fit: SimilarityFit
) -> ScaleCandidate:
    """Return what a fit that began at scale `k` explains of the metric cloud."""
    size = k * fit.factor
    court = summon(*_ordered(scaled(ready, size), metric, side))
    losses, weights = _losses(court, fit.T_target_source, side), _weights(court, side)
    return ScaleCandidate(
        metres_per_unit=size,
        T_target_source=fit.T_target_source,
        loss=float(weights @ losses / max(float(weights.sum()), 1e-300)),
        losses=losses,
        fit=fit,
    )


def _losses(court: Court, T: Transform, side: Side) -> Values:
    """Return the losses of the metric cloud's points."""
    split = len(court.source.points)
    loss = hear(court, T).loss
    part: Values = loss[split:] if side == "source" else loss[:split]
    return part


def _weights(court: Court, side: Side) -> Values:
    witness = court.target if side == "source" else court.source
    weights: Values = witness.weights * witness.is_structure
    return weights


def _distinct(found: list[ScaleCandidate]) -> list[ScaleCandidate]:
    """Return the candidates best first, one of each scale."""
    kept: list[ScaleCandidate] = []
    for candidate in sorted(found, key=lambda c: c.loss):
        if all(
            abs(np.log(candidate.metres_per_unit / other.metres_per_unit)) > _SEPARATE
            for other in kept
        ):
            kept.append(candidate)
    return kept


def _is_better(one: ScaleCandidate, other: ScaleCandidate, metric: Prepared) -> bool:
    """Say whether blocks of the metric cloud tell two scales apart, by their paired losses."""
    court = summon(metric, metric).source
    weights = court.weights * court.is_structure
    block, count = blocks_of(court.points, _BLOCK_M)
    sums: Values = np.bincount(block, weights, count).astype(np.float64)
    gain = weights * (other.losses - one.losses)
    gain = np.bincount(block, gain, count).astype(np.float64)
    has = sums > 0.01 * float(sums.mean())
    if int(has.sum()) < 4:
        return False
    # Each block is one observation, by what it weighs.
    mean = float(gain[has].sum())
    spread = float(
        np.sqrt(np.square(gain[has] - gain[has].mean()).sum() * has.sum() / (has.sum() - 1))
    )
    return mean > _DECISIVE * spread
