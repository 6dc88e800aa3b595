"""One score for every pose, whichever method proposed it; ranking and margin.

The score is for choosing which poses are worth refining, and for the margin that is reported.
It is not the proof that a pose is right (METHOD.md 2.3): that is `verdict`'s.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from dougong._boxes import cells_in_plan
from dougong.filters import neighbourhood
from dougong.registration.cleaning import extent
from dougong.registration.levelling import rotation_to_vertical
from dougong.registration.prepare import Prepared
from dougong.registration.result import Hypothesis
from dougong.threads import each
from dougong.typing import Mask, Points, Transform, Values

SEPARATE_DEG = 5.0
SEPARATE_M = 0.5
"""Poses farther apart than this in angle or place count as different ones."""

_SAMPLE = 4000
_TRIM = 0.75
"""The best matching share that counts: one sensor sees surfaces that the other cannot."""
_MIN_SUPPORT = 0.3
"""Share of either cloud that must lie where the other one saw anything, for a full score."""
_SEEN_CELL_M = 1.0
_CLEARANCE_M = 0.7
"""A point this far inside free space violates it: more than noise, blur and tilt explain."""
_CLASS_SHARES = (0.2, 0.5, 0.3)
"""Weights of ground, walls and other surfaces: ground fits nearly everywhere, walls do not."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Side:
    """What the score needs to know about one cloud; worked out once."""

    index: neighbourhood.Neighbourhood
    normals: Points
    sample: Points
    sample_normals: Points
    weights: Values
    """(m,) of the sample, sum 1."""
    rotation: NDArray[np.float64]
    low: NDArray[np.float64]
    is_seen: NDArray[np.bool_]
    """(rows, columns) cells of `_SEEN_CELL_M`, widened by one."""
    extent_m: float
    """Longer side of the plan box."""
    spacing_m: float
    free_low: NDArray[np.float64]
    """(rows, columns) levelled z between which the sensor saw nothing but air (NaN: unknown)."""
    free_high: NDArray[np.float64]


_sides: WeakKeyDictionary[Prepared, _Side] = WeakKeyDictionary()


def score(T_target_source: Transform, source: Prepared, target: Prepared) -> float:
    """Return how well a pose explains both clouds, 0..1.

    For each direction: the sampled points of one cloud that fall where the other one saw
    anything at all are matched to their nearest point there; a match is worth
    exp(-d^2 / 2 s^2), averaged over three scales s (a factor of two apart) and multiplied by the
    squared cosine between the normals; the best three quarters by weight are averaged. Ground,
    walls and the rest weigh 0.2 : 0.5 : 0.3 whatever their areas. The score is the geometric
    mean of both directions, times the shares of points that do *not* stand in space which the
    other sensor saw to be free, times min(1, support / 0.3), where support is the larger share
    of a cloud inside the region that the other one saw.
    """
    one, other = _side(source), _side(target)
    inverse: Transform = np.linalg.inv(T_target_source).astype(np.float64)
    finest = _finest_scale_m(one, other)
    forward = _one_way(T_target_source, one, other, finest)
    backward = _one_way(inverse, other, one, finest)
    support = max(forward.support, backward.support)
    quality = float(np.sqrt(forward.match * backward.match))
    free = (1.0 - forward.violation) * (1.0 - backward.violation)
    return float(quality * free * min(1.0, support / _MIN_SUPPORT))


def scores(poses: Sequence[Transform], source: Prepared, target: Prepared) -> list[float]:
    """Return `score` of every pose (source -> target)."""
    each(_side, (source, target))  # once, before many poses ask for them at the same time
    return each(lambda T: score(T, source, target), poses)


def rank(hypotheses: Sequence[Hypothesis], source: Prepared, target: Prepared) -> list[Hypothesis]:
    """Score every hypothesis, drop near copies of better ones, best first."""
    poses = [hypothesis.T_target_source for hypothesis in hypotheses]
    scored = [
        replace(hypothesis, score=found)
        for hypothesis, found in zip(hypotheses, scores(poses, source, target), strict=True)
    ]
    return dedupe(scored, source)


def dedupe(hypotheses: Sequence[Hypothesis], source: Prepared) -> list[Hypothesis]:
    """Return `hypotheses` best first, without those within 5 degrees and 0.5 m of a better one."""
    centre = source.xyz.mean(axis=0)
    kept: list[Hypothesis] = []
    order = sorted(range(len(hypotheses)), key=lambda i: (-hypotheses[i].score, i))
    for index in order:
        candidate = hypotheses[index]
        if all(_are_separate(candidate, other, centre) for other in kept):
            kept.append(candidate)
    return kept


def _are_separate(one: Hypothesis, other: Hypothesis, centre: Values) -> bool:
    a, b = one.T_target_source, other.T_target_source
    cosine = 0.5 * (np.trace(a[:3, :3].T @ b[:3, :3]) / _scale(a) / _scale(b) - 1.0)
    if np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) > SEPARATE_DEG:
        return True
    apart = (a[:3, :3] - b[:3, :3]) @ centre + a[:3, 3] - b[:3, 3]
    return bool(np.linalg.norm(apart) > SEPARATE_M)


def _scale(matrix: Transform) -> float:
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def _finest_scale_m(source: _Side, target: _Side) -> float:
    """Return the finest scale of a match: 0.5 % of the smaller extent, within sound bounds.

    Half a percent of a 40 m hall is what a coarse pose can reach (0.2 m); never finer than the
    spacing of the thinner cloud allows, and never so coarse that anything matches.
    """
    smaller = min(source.extent_m, target.extent_m)
    spacing = max(source.spacing_m, target.spacing_m)
    return max(min(0.005 * smaller, 0.25), 2.0 * spacing)


@dataclass(frozen=True, slots=True)
class _OneWay:
    match: float
    support: float
    violation: float


def _one_way(T_to_from: Transform, one: _Side, other: _Side, finest_m: float) -> _OneWay:
    """Match the sample of `one` to `other`."""
    moved = one.sample @ T_to_from[:3, :3].T + T_to_from[:3, 3]
    is_seen, violates = _seen(moved, other)
    seen_weight = float(one.weights[is_seen].sum())
    if seen_weight <= 0.0:
        return _OneWay(0.0, 0.0, 0.0)
    weights = one.weights[is_seen] / seen_weight
    place, distance = neighbourhood.nearest(other.index, moved[is_seen], 8.0 * finest_m)
    turned = one.sample_normals[is_seen] @ T_to_from[:3, :3].T / _scale(T_to_from)
    cosine = np.where(place >= 0, (turned * other.normals[place]).sum(axis=1), 0.0)
    worth = np.zeros(len(place))
    for factor in (1.0, 2.0, 4.0):
        worth += np.exp(-0.5 * (np.minimum(distance, 1e9) / (factor * finest_m)) ** 2) / 3.0
    worth *= cosine**2
    order = np.argsort(-worth, kind="stable")
    share = np.cumsum(weights[order])
    counted = np.clip(_TRIM - (share - weights[order]), 0.0, weights[order])
    violation = float(one.weights[violates].sum()) / seen_weight
    return _OneWay(float(worth[order] @ counted) / _TRIM, seen_weight, violation)


def _seen(points: Points, other: _Side) -> tuple[Mask, Mask]:
    """Return which `points` lie where `other` saw anything, and which stand in its free space."""
    level = points @ other.rotation.T
    rows, columns = other.is_seen.shape
    is_inside, column, row = cells_in_plan(level, other.low, _SEEN_CELL_M, (columns, rows))
    is_seen: Mask = is_inside & other.is_seen[row, column]
    height = level[:, 2]
    with np.errstate(invalid="ignore"):
        violates = height > other.free_low[row, column] + _CLEARANCE_M
        violates &= height < other.free_high[row, column] - _CLEARANCE_M
    return is_seen, is_seen & violates


def _side(cloud: Prepared) -> _Side:
    side = _sides.get(cloud)
    if side is None:
        side = _sides[cloud] = _build_side(cloud)
    return side


def _build_side(cloud: Prepared) -> _Side:
    rotation = rotation_to_vertical(cloud.up)
    level = cloud.xyz @ rotation.T
    chosen, weights = _sample(cloud)
    low, high = extent(level)
    low, high = low[:2] - 2.0 * _SEEN_CELL_M, high[:2] + 2.0 * _SEEN_CELL_M
    columns, rows = np.ceil((high - low) / _SEEN_CELL_M).astype(int) + 1
    cell = np.floor((level[:, :2] - low) / _SEEN_CELL_M).astype(np.int64)
    flat = cell[:, 1] * columns + cell[:, 0]
    has_points = np.bincount(flat, minlength=rows * columns).reshape(rows, columns) > 0
    free_low, free_high = _free_space(cloud, level, flat, has_points)
    return _Side(
        index=neighbourhood.build_index(cloud.xyz),
        normals=cloud.normals,
        sample=np.ascontiguousarray(cloud.xyz[chosen]),
        sample_normals=cloud.normals[chosen],
        weights=weights,
        rotation=rotation,
        low=low,
        is_seen=maximum_filter(has_points, 3),
        extent_m=float((high - low - 4.0 * _SEEN_CELL_M).max()),
        spacing_m=cloud.spacing_m,
        free_low=free_low,
        free_high=free_high,
    )


def _sample(cloud: Prepared) -> tuple[NDArray[np.int64], Values]:
    """Return points spread evenly by area within each class, and their weights (sum 1).

    Points are ordered by content before every so-many-th is taken: independent of input order.
    """
    up = cloud.normals @ cloud.up
    is_wall = ~cloud.is_ground & (np.abs(up) < 0.6)
    classes = (cloud.is_ground, is_wall, ~cloud.is_ground & ~is_wall)
    chosen, weights = [], []
    for members, share in zip(classes, _CLASS_SHARES, strict=True):
        index = np.flatnonzero(members)
        count = round(share * _SAMPLE)
        if len(index) < 20:
            continue
        index = index[np.lexsort(np.round(cloud.xyz[index].T, 6))]
        area = np.cumsum(cloud.weights_area[index])
        wanted = (np.arange(count) + 0.5) / count * area[-1]
        chosen.append(index[np.minimum(np.searchsorted(area, wanted), len(index) - 1)])
        weights.append(np.full(count, share / count))
    total = np.concatenate(weights)
    return np.concatenate(chosen), total / total.sum()


def _free_space(
    cloud: Prepared, level: Points, flat: NDArray[np.int64], has_points: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the levelled z range of air above each cell (NaN where unknown).

    A drone: from the highest point of the cell and its neighbours to the sky. A scanner on the
    ground: from the ground to the first surface above, where it saw the ground and nothing else
    in the cell and its neighbours, up to 3 m (what is higher may be hidden from below).
    """
    shape = has_points.shape
    size = has_points.size
    top = np.full(size, -np.inf)
    np.maximum.at(top, flat, level[:, 2])
    top = maximum_filter(top.reshape(shape), 3)
    known = has_points & (maximum_filter(~has_points, 3) == 0)
    if cloud.kind == "photogrammetry":
        return np.where(known, top, np.nan), np.full(shape, np.inf)
    is_object = np.zeros(size, dtype=bool)
    is_object[flat[~cloud.is_ground & (cloud.height_above_ground > 0.3)]] = True
    has_ground = np.zeros(size, dtype=bool)
    has_ground[flat[cloud.is_ground]] = True
    open_ground = has_ground.reshape(shape) & ~maximum_filter(is_object.reshape(shape), 3)
    is_free = open_ground & known & cloud.has_ground
    return np.where(is_free, top, np.nan), np.where(is_free, top + 3.0, np.nan)
