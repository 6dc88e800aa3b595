"""Registration of objects whose attitude is unknown: every rotation, any size, features, ICP.

Where gravity is known use `register`: it is safer. Here starting poses come from three sides,
which fail on different shapes: the principal axes in all 24 proper pairings, sample consensus on
features, and an even grid over all rotations, each shifted to where it fits. They are scored
alike, improved together, refined, and compared pairwise by blocks (METHOD.md 2.3).
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Limits

from dougong._checks import as_points
from dougong._sorting import by_coordinates
from dougong.errors import RegistrationError
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid
from dougong.params import Parameters
from dougong.registration import object_evidence as evidence
from dougong.registration import object_fit as fitting
from dougong.registration.pose_search import (
    Field,
    Poses,
    View,
    build_field,
    distinct,
    from_transform,
    inverted,
    poses_of,
    rotation_grid,
    score_both_ways,
    settle_poses,
    shift_poses,
    spread,
    to_transform,
    view_of,
)
from dougong.registration.result import Hypothesis
from dougong.registration.sample_consensus import SacIa, consensus_poses
from dougong.registration.surface import surface
from dougong.threads import each
from dougong.typing import Index, Points, Transform, Values

MIN_POINTS = 50
GRACE_DEG = 5.0
"""A pose may turn by so much more than the largest angle that is known: people round."""
SAME_DEG = 8.0
SAME_RADII = 0.08
"""Starting poses nearer than this, in degrees and RMS radii, are one."""
ONE_DEG = 4.0
"""... and refined ones nearer than this angle. A thin thing may fit alike at any tilt in between:
poses that are farther apart, and not told apart, say that the pose is not well known."""


class FreeRotation(Parameters):
    """How an object is registered to another view of it."""

    search_points: Annotated[int, Limits(ge=100)] = 2000
    """Points of each cloud that are searched with."""
    fit_points: Annotated[int, Limits(ge=100)] = 20_000
    """Points of each cloud in the final fit."""
    normal_neighbours: Annotated[int, Limits(ge=4)] = 12
    """Points per local plane."""
    rotations: Annotated[int, Limits(ge=0)] = 3000
    """Rotations of the even grid; 0: axes and features only."""
    max_angle_deg: Annotated[float, Limits(gt=0, le=180)] = 180.0
    """The source is known to be turned by no more than this, give or take 5 degrees."""
    features: SacIa | None = SacIa(trials=100_000, returned=100)
    """Sample consensus on features; None: axes and grid only."""
    refined: Annotated[int, Limits(ge=1)] = 24
    """Distinct poses that are refined and compared."""
    min_overlap: Annotated[float, Limits(ge=0, le=1)] = 0.2
    """A pose that explains less of both clouds is no answer."""
    min_sharpness: Annotated[float, Limits(ge=1)] = 1.3
    """A pose must explain so many times more than the poses beside it. A weak test: unlike
    objects, laid on each other as well as they go, were seen to reach 1.15 to 1.7."""
    sigmas: Annotated[float, Limits(gt=0)] = 3.0
    """Poses nearer than this in standard errors of the paired blocks are not told apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectRegistration:
    """The verdict on two clouds of one object."""

    status: Literal["ok", "ambiguous", "failed"]
    T_target_source: Transform | None
    """None when failed; the best pose when ambiguous."""
    reason: str
    hypotheses: tuple[Hypothesis, ...]
    """Best first; when ambiguous the poses that the data do not tell apart."""
    explained_source: float
    """Share of source points that the pose lays on a like surface of the target."""
    explained_target: float
    sigma_m: float
    """Robust spread of the plane distances where the clouds fit best."""
    seconds: dict[str, float] = field(default_factory=dict)


def register_object(
    source: Points, target: Points, params: FreeRotation | None = None
) -> ObjectRegistration:
    """Find the rigid motion from `source` to `target`, whatever the rotation.

    Parameters
    ----------
    source, target : ndarray, shape (n, 3) and (m, 3)
        Surfaces of one object, in any unit, each in its own frame; they may share only a part.
    params : FreeRotation, optional

    Returns
    -------
    ObjectRegistration
        ``ambiguous`` lists the poses that fit equally well: a symmetric object has several.

    Raises
    ------
    InputError
        Not (n, 3), or not finite.
    RegistrationError
        A cloud has fewer than 50 points, each place counted once, or all at one place.

    Notes
    -----
    Deterministic; independent of thread count and point order.
    """
    params = params or FreeRotation()
    start = time.perf_counter()
    pair = object_pair(source, target, params)
    poses, _ = starting_poses(*pair.views, params)
    middle = time.perf_counter()
    result = _held_to_limit(pair, judge_poses(pair, poses, params), params)
    end = time.perf_counter()
    result.seconds.update({"search": middle - start, "fit": end - middle})
    return result


def _held_to_limit(
    pair: ObjectPair, found: ObjectRegistration, params: FreeRotation
) -> ObjectRegistration:
    """Return the verdict, not ``ok`` where a pose beyond the largest turn fits better.

    Who was told wrongly finds some pose within the limit, and nothing to compare it with.
    """
    if found.status != "ok" or found.T_target_source is None or params.max_angle_deg >= 180.0:
        return found
    free = params.model_copy(update={"max_angle_deg": 180.0, "rotations": 0})
    beyond, _ = starting_poses(*pair.views, free)
    own = from_transform(found.T_target_source, *pair.views)
    freed = judge_poses(pair, np.concatenate([own[None], beyond]), free)
    best = freed.hypotheses[0].T_target_source
    # As good a fit, by a symmetry, is what the limit is told for.
    if freed.status != "ok" or len(_allowed(_flat(best)[None], params.max_angle_deg)):
        return found
    reason = (
        "a pose that turns by more fits better than any within the largest turn that is said to "
        f"be known, {params.max_angle_deg:g} deg (max_angle_deg): search without it"
    )
    return replace(found, status="ambiguous", reason=reason)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectPair:
    """Two clouds and what the search sees of them."""

    clouds: tuple[Points, Points]
    views: tuple[View, View]


def object_pair(source: Points, target: Points, params: FreeRotation) -> ObjectPair:
    """Check, thin and describe two clouds for `starting_poses` and `judge_poses`."""
    clouds = (
        _each_once(as_points(source, "source"), "source"),
        _each_once(as_points(target, "target"), "target"),
    )
    views = (
        _view(clouds[0], params.search_points, params, "source"),
        _view(clouds[1], params.search_points, params, "target"),
    )
    return ObjectPair(clouds=clouds, views=views)


def _each_once(points: Points, name: str) -> Points:
    """Return every point (n, 3) once, by its coordinates: triangles repeat their corners."""
    ordered = points[by_coordinates(points)]
    is_new = np.ones(len(ordered), np.bool_)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    if len(points) > 1 and is_new.sum() == 1:
        msg = f"{name} has all {len(points)} points at one place. Check the file's columns."
        raise RegistrationError(msg)
    return ordered[is_new]


def judge_poses(pair: ObjectPair, poses: Poses, params: FreeRotation) -> ObjectRegistration:
    """Refine poses (k, 12) between the views, compare them, and give the verdict on the best.

    The same for every method that proposes poses.
    """
    judged = _judge(pair.views, poses, params) if len(poses) else None
    if judged is None:
        turned = (
            ""
            if params.max_angle_deg >= 180.0
            else (f" that turns by no more than {params.max_angle_deg:g} deg (max_angle_deg)")
        )
        return ObjectRegistration(
            status="failed",
            T_target_source=None,
            reason=f"the coarse search found no pose{turned}",
            hypotheses=(),
            explained_source=0.0,
            explained_target=0.0,
            sigma_m=float("nan"),
        )
    return _answer(pair, judged, params)


def _view(points: Points, most: int, params: FreeRotation, name: str) -> View:
    """Return at most about `most` evenly thinned points with their normals."""
    if len(points) < MIN_POINTS:
        msg = f"{name} has {len(points)} points, at least {MIN_POINTS} are needed. Thin it less."
        raise RegistrationError(msg)
    centre = points.mean(axis=0)
    # Normals come from all points, before any is left out.
    plane = surface(points - centre, params.normal_neighbours)
    chosen = np.arange(len(points))
    voxel = float(np.ptp(points, axis=0).max()) / 400.0
    while len(chosen) > most:
        kept = octree_voxel_grid(points - centre, OctreeVoxelGrid(voxel_m=voxel)).is_kept
        chosen = np.flatnonzero(kept)
        voxel *= max(1.03, np.sqrt(len(chosen) / most))
    thinned = points[chosen]
    spacing = plane.spacing_m
    if len(chosen) < len(points):
        spacing = surface(thinned - centre, params.normal_neighbours).spacing_m
    return view_of(thinned, plane.normals[chosen], spacing)


def starting_poses(source: View, target: View, params: FreeRotation) -> tuple[Poses, Values]:
    """Return the best distinct poses (k, 12) between the views and their scores, best first.

    All proposals are improved before any is dropped, and they are chosen at narrow reaches: a
    wide one prefers poses that cover much of the other cloud, and the true one may share little.
    The smaller cloud is the one that is moved about, whichever is the source.
    """
    if source.radius_m > target.radius_m:
        poses, scores = starting_poses(target, source, params)
        return inverted(poses), scores
    radius = max(source.radius_m, target.radius_m)
    fields = (_field(source, radius), _field(target, radius))
    few = (spread(source, 96), spread(target, 96))
    more = (spread(source, 256), spread(target, 256))
    parts = [_axes_poses(source, target)]
    if params.rotations:
        parts.append(_grid_poses(fields, few, radius, params))
    if params.features is not None:
        parts.append(consensus_poses(source, target, fields[1], params.features)[0])
    poses = _allowed(np.concatenate(parts), params.max_angle_deg)
    spacing = max(source.spacing_m, target.spacing_m)
    for reach, steps in ((0.25, 6), (0.12, 6)):
        bound = max(reach * radius, 3.0 * spacing)
        poses = settle_poses(poses, source.points[more[0]], fields[1], bound, steps)
    narrow = max(0.08 * radius, 2.0 * spacing)
    scores = score_both_ways(poses, *fields, more, narrow)
    order = distinct(poses, scores, 100, 4.0, 0.05 * radius)
    poses = settle_poses(
        poses[order], source.points[more[0]], fields[1], max(narrow, 3.0 * spacing), 8
    )
    poses = _allowed(poses, params.max_angle_deg)
    scores = score_both_ways(poses, *fields, more, max(0.05 * radius, 2.0 * spacing))
    order = distinct(poses, scores, params.refined, SAME_DEG, SAME_RADII * radius)
    return poses[order], scores[order]


def _field(view: View, radius: float) -> Field:
    """Return the closest points of `view`, as fine as its spacing where that is affordable."""
    extent = float(np.ptp(view.points, axis=0).max()) + 0.8 * radius
    return build_field(view, 0.4 * radius, int(np.clip(extent / view.spacing_m, 40, 72)))


def _allowed(poses: Poses, max_angle_deg: float) -> Poses:
    """Return the poses that turn by no more than the limit and `GRACE_DEG`; there may be none."""
    if max_angle_deg >= 180.0:
        return poses
    trace = poses[:, 0] + poses[:, 4] + poses[:, 8]
    least = 1.0 + 2.0 * np.cos(np.radians(min(max_angle_deg + GRACE_DEG, 180.0)))
    allowed: Poses = poses[trace >= least]
    return allowed


def _axes_poses(source: View, target: View) -> Poses:
    """Return the 24 proper pairings of the principal axes about the centroids."""
    axes = [np.linalg.eigh(v.points.T @ v.points)[1][:, ::-1] for v in (source, target)]
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            pairing = np.zeros((3, 3))
            pairing[range(3), order] = signs
            turn = axes[1] @ pairing @ axes[0].T
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    return poses_of(np.array(turns), np.zeros((len(turns), 3)))


def _grid_poses(
    fields: tuple[Field, Field], few: tuple[Index, Index], radius: float, params: FreeRotation
) -> Poses:
    """Return the grid's rotations, each shifted from several starts to where it fits best."""
    source, target = fields
    turns = rotation_grid(params.rotations)
    turns = _allowed(poses_of(turns, np.zeros((len(turns), 3))), params.max_angle_deg)
    offsets = np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]) * 0.4 * radius
    best, best_score = turns, np.full(len(turns), -1.0)
    for offset in offsets:
        poses = turns.copy()
        poses[:, 9:] = offset
        poses = shift_poses(poses, source.view.points[few[0]], target, 0.4 * radius, 6)
        scores = score_both_ways(poses, source, target, few, 0.25 * radius)
        is_better = scores > best_score
        best = np.where(is_better[:, None], poses, best)
        best_score = np.maximum(best_score, scores)
    order = np.argsort(-best_score, kind="stable")[:600]
    return best[order]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judged:
    best: evidence.Testimony
    rivals: tuple[evidence.Testimony, ...]
    """Not told apart from the best."""
    others: tuple[evidence.Testimony, ...]
    sigma_m: float
    sharpness: float


def _judge(views: tuple[View, View], poses: Poses, params: FreeRotation) -> _Judged | None:
    """Refine the starting poses and compare them pair by pair.

    None: none of them ends within the largest turn.
    """
    source, target = (fitting.body_of(view) for view in views)
    radius, spacing = target.view.radius_m, max(v.spacing_m for v in views)
    reaches = (max(0.1 * radius, 3.0 * spacing), 2.5 * spacing)
    refined = each(
        lambda pose: fitting.fit(source, target, _matrix(pose), reaches, iterations=12), poses
    )
    refined = [T for T in refined if len(_allowed(_flat(T)[None], params.max_angle_deg))]
    if not refined:
        return None
    sigma = evidence.noise_of(source, target, refined, 2.0 * spacing)
    court = evidence.court_of(source, target, max(sigma, 0.02 * spacing), 1.5 * spacing)
    heard = sorted(each(lambda T: evidence.hear(court, T), refined), key=lambda h: h.total)
    kept: list[evidence.Testimony] = []
    for one in heard:
        if not any(fitting.near(one.T, k.T, ONE_DEG, SAME_RADII * radius) for k in kept):
            kept.append(one)
    block, blocks = evidence.blocks_of(*views)
    is_beaten = [evidence.is_worse(kept[0], k, block, blocks, params.sigmas) for k in kept[1:]]
    return _Judged(
        best=kept[0],
        rivals=tuple(k for k, beaten in zip(kept[1:], is_beaten, strict=True) if not beaten),
        others=tuple(k for k, beaten in zip(kept[1:], is_beaten, strict=True) if beaten),
        sigma_m=sigma,
        sharpness=evidence.sharpness(court, kept[0]),
    )


def _matrix(pose: NDArray[np.float64]) -> Transform:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
    return T


def _answer(pair: ObjectPair, judged: _Judged, params: FreeRotation) -> ObjectRegistration:
    """Fit the best pose with all points and put the verdict into words."""
    views, best = pair.views, judged.best
    T = to_transform(_flat(best.T), views[0], views[1])
    if max(len(c) for c in pair.clouds) > params.search_points:
        T = _refit(pair.clouds, T, params)
    listed = tuple(
        Hypothesis(
            T_target_source=T if k == 0 else to_transform(_flat(h.T), views[0], views[1]),
            score=h.explained,
            method="free-rotation",
        )
        for k, h in enumerate((best, *judged.rivals, *judged.others))
    )
    share = max(best.explained_source, best.explained_target)
    status: Literal["ok", "ambiguous", "failed"] = "ok"
    reason = f"the pose explains {100 * share:.0f} % of a cloud; no other pose does as well"
    if share < params.min_overlap:
        status = "failed"
        reason = (
            f"the best pose explains only {100 * share:.0f} % of either cloud: too little is shared"
        )
    elif judged.sharpness < params.min_sharpness:
        status, reason = "failed", "the best pose fits hardly better than the poses beside it"
    elif judged.rivals:
        count = len(judged.rivals) + 1
        status, listed = "ambiguous", listed[:count]
        reason = f"{count} poses fit equally well: the object repeats, or too little is shared"
    return ObjectRegistration(
        status=status,
        T_target_source=None if status == "failed" else T,
        reason=reason,
        hypotheses=listed,
        explained_source=best.explained_source,
        explained_target=best.explained_target,
        sigma_m=judged.sigma_m,
    )


def _flat(T: Transform) -> NDArray[np.float64]:
    return np.concatenate([T[:3, :3].ravel(), T[:3, 3]])


def _refit(clouds: tuple[Points, Points], T: Transform, params: FreeRotation) -> Transform:
    """Return `T` fitted with more points than the search used."""
    views = [
        _view(c, params.fit_points, params, n)
        for c, n in zip(clouds, ("source", "target"), strict=True)
    ]
    source, target = (fitting.body_of(view) for view in views)
    spacing = max(view.spacing_m for view in views)
    local = _matrix(from_transform(T, views[0], views[1]))
    refined = fitting.fit(source, target, local, (6.0 * spacing, 2.5 * spacing), iterations=30)
    return to_transform(_flat(refined), views[0], views[1])
