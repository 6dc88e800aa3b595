"""The ladder of object registration: precision and recall from copies to half-seen, noisy parts.

Levels (METHOD.md 5), each on top of the one before where it says so, 1024 points before cropping:

- ``L0``: the same sampled points, moved.
- ``L1``: source and target sampled independently.
- ``L2``: as L1; each cropped to 0.7 by a random half-space of its own; jitter 0.01 on every
  coordinate, cut at 0.05.
- ``L3``: as L2, cropped to 0.5.
- ``L4``: as L1; the density of each falls to a tenth across it, along a random direction.

Motions: ``45`` three Euler angles drawn from 0..45 degrees, ``any`` uniform over SO(3), ``yaw``
any turn about z; translation up to 0.5 along each axis. Shapes lie in the unit sphere. No method
is told which motion was drawn.

Symmetry is judged on the dense shape: a motion is a symmetry when half of the dense points, moved
by it, come as near to the other half as without it (mean nearest distance at most 1.3 times).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Limits

from dougong.evaluation.metrics import rotation_angle_deg
from dougong.evaluation.object_methods import METHODS
from dougong.filters import neighbourhood
from dougong.params import Parameters
from dougong.registration import object_fit as fitting
from dougong.registration.free_rotation import (
    FreeRotation,
    ObjectRegistration,
    judge_poses,
    object_pair,
)
from dougong.registration.pose_search import (
    build_field,
    distinct,
    poses_of,
    rotation_grid,
    rotations_of,
    score_poses,
    settle_poses,
    view_of,
)
from dougong.registration.surface import surface
from dougong.typing import Points, Transform

Level = Literal["L0", "L1", "L2", "L3", "L4"]
Motion = Literal["45", "any", "yaw"]
LEVELS: tuple[Level, ...] = ("L0", "L1", "L2", "L3", "L4")
MOTIONS: tuple[Motion, ...] = ("45", "any", "yaw")
CORRECT_DEG = 5.0
CORRECT_RADII = 0.05
SYMMETRY_RATIO = 1.3


class Ladder(Parameters):
    """What is tried."""

    levels: tuple[Level, ...] = LEVELS
    motions: tuple[Motion, ...] = MOTIONS
    methods: tuple[str, ...] = ("ours", "improved-pca", "pca", "sac-ia", "4pcs")
    poses: Annotated[int, Limits(ge=1)] = 5
    """Random motions per shape."""
    points: Annotated[int, Limits(ge=100)] = 1024
    seed: int = 0
    settings: FreeRotation = FreeRotation()
    """Of our method; thinning, fit and verdict of all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One method on one pair."""

    shape: str
    level: str
    motion: str
    method: str
    status: str
    has_symmetry: bool
    rre_deg: float
    """Angle between found and true rotation; NaN without a pose. The best pose when ambiguous."""
    rte: float
    is_correct: bool
    """The best pose is within 5 degrees and 0.05 of the true one."""
    is_correct_symmetric: bool
    """... or of one that a symmetry of the shape makes equal to it."""
    is_listed: bool
    """Some listed pose is right in the symmetry-aware sense."""
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """A dense shape and its symmetries."""

    name: str
    points: Points
    """(n, 3) in the unit sphere."""
    halves: tuple[fitting.Body, fitting.Body]
    floor: float
    """Mean distance from the points of one half to the other: what sampling alone leaves."""
    symmetries: NDArray[np.float64]
    """(k, 4, 4) proper motions other than the identity that keep the shape; many where it is
    round (then a sample of them)."""


def describe_shape(name: str, points: Points, rotations: int = 2000) -> Shape:
    """Return a shape with the symmetries that an even grid of rotations, improved, leads to."""
    points = np.asarray(points, np.float64)
    order = np.random.default_rng(0).permutation(len(points))
    normals = surface(points, 16).normals
    split = len(points) // 2
    # One common origin, so that motions of the halves are motions of the shape.
    views = [
        view_of(points[part], normals[part], surface(points[part], 16).spacing_m)
        for part in (order[:split], order[split:])
    ]
    bodies = [fitting.body_of(view) for view in views]
    halves = (bodies[0], bodies[1])
    shift = views[0].centre - views[1].centre
    identity = np.eye(4)
    identity[:3, 3] = shift
    floor = _mean_distance(halves, identity)
    shape = Shape(
        name=name, points=points, halves=halves, floor=floor, symmetries=np.empty((0, 4, 4))
    )
    found = _symmetries(shape, rotations)
    return Shape(name=name, points=points, halves=halves, floor=floor, symmetries=found)


def _symmetries(shape: Shape, rotations: int) -> NDArray[np.float64]:
    """Return the symmetries (k, 4, 4) that turn by more than 5 degrees, apart by 5 degrees."""
    one, two = shape.halves
    field = build_field(two.view, 0.3)
    step = max(1, len(one.view.points) // 300)
    few, few_normals = one.view.points[::step].copy(), one.view.normals[::step].copy()
    turns = rotation_grid(rotations)
    poses = settle_poses(poses_of(turns, np.zeros((len(turns), 3))), few, field, 0.2, 15)
    poses = settle_poses(poses, few, field, 0.1, 10)
    scores = score_poses(poses, few, few_normals, field, 0.1)
    # A motion that does not even nearly score like the identity need not be looked at.
    start = np.concatenate([np.eye(3).ravel(), one.view.centre - two.view.centre])
    own = score_poses(start[None], few, few_normals, field, 0.1)[0]
    order = distinct(poses, scores, 80, 5.0, 0.1)
    found = []
    for pose in poses[order[scores[order] > 0.8 * own]]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
        local = _in_shape(T, shape)
        if rotation_angle_deg(local[:3, :3], np.eye(3)) > CORRECT_DEG and is_symmetry(local, shape):
            found.append(local)
    return np.array(found).reshape(-1, 4, 4)


def _in_shape(T: Transform, shape: Shape) -> Transform:
    """Return a motion between the halves' own origins as one of the shape."""
    one, two = shape.halves
    result = T.copy()
    result[:3, 3] = T[:3, 3] + two.view.centre - T[:3, :3] @ one.view.centre
    return result


def _between_halves(T: Transform, shape: Shape) -> Transform:
    one, two = shape.halves
    result = T.copy()
    result[:3, 3] = T[:3, 3] - two.view.centre + T[:3, :3] @ one.view.centre
    return result


def _mean_distance(halves: tuple[fitting.Body, fitting.Body], T: Transform) -> float:
    """Return the mean nearest distance, both ways, of the halves at a pose between their views."""
    one, two = halves
    moved = one.view.points @ T[:3, :3].T + T[:3, 3]
    back = (two.view.points - T[:3, 3]) @ T[:3, :3]
    there, here = (
        neighbourhood.nearest(two.index, moved)[1],
        neighbourhood.nearest(one.index, back)[1],
    )
    return float(max(there.mean(), here.mean()))


def is_symmetry(T: Transform, shape: Shape) -> bool:
    """Say whether a motion (4, 4), within 5 degrees and 0.05 of itself, keeps the dense shape."""
    start = _between_halves(T, shape)
    fitted = fitting.fit(*shape.halves, start, (0.15, 0.05), iterations=10)
    if not _is_near(_in_shape(fitted, shape), T):
        return False
    return _mean_distance(shape.halves, fitted) <= SYMMETRY_RATIO * shape.floor


def _is_near(a: Transform, b: Transform) -> bool:
    angle = rotation_angle_deg(a[:3, :3], b[:3, :3])
    return bool(angle < CORRECT_DEG and np.linalg.norm(a[:3, 3] - b[:3, 3]) < CORRECT_RADII)


def make_pair(
    points: Points, level: Level, motion: Motion, count: int, rng: np.random.Generator
) -> tuple[Points, Points, Transform]:
    """Return source, target and the true motion of one pair of the ladder."""
    order = rng.permutation(len(points))
    if level == "L4":
        source, target = (_thinned(points, count, rng) for _ in range(2))
    else:
        source = points[order[:count]]
        target = source if level == "L0" else points[order[-count:]]
    if level in ("L2", "L3"):
        share = 0.7 if level == "L2" else 0.5
        source, target = (_jittered(_cropped(p, share, rng), rng) for p in (source, target))
    T = random_motion(motion, rng)
    target = (target @ T[:3, :3].T + T[:3, 3])[rng.permutation(len(target))]
    return np.ascontiguousarray(source), np.ascontiguousarray(target), T


def _cropped(points: Points, share: float, rng: np.random.Generator) -> Points:
    direction = rng.normal(size=3)
    height = points @ (direction / np.linalg.norm(direction))
    return points[height >= np.quantile(height, 1.0 - share)]


def _jittered(points: Points, rng: np.random.Generator) -> Points:
    return points + np.clip(rng.normal(0.0, 0.01, points.shape), -0.05, 0.05)


def _thinned(points: Points, count: int, rng: np.random.Generator) -> Points:
    """Return `count` points whose density falls to a tenth along a random direction."""
    direction = rng.normal(size=3)
    height = points @ direction
    share = (height - height.min()) / max(float(np.ptp(height)), 1e-12)
    weights = 10.0**-share
    return points[rng.choice(len(points), count, replace=False, p=weights / weights.sum())]


def random_motion(motion: Motion, rng: np.random.Generator) -> Transform:
    """Return a random motion (4, 4) of the given kind."""
    T = np.eye(4)
    if motion == "any":
        q = rng.normal(size=4)
        T[:3, :3] = rotations_of((q / np.linalg.norm(q))[None])[0]
    else:
        angles = np.radians(rng.uniform(0.0, 45.0, 3))
        if motion == "yaw":
            angles = np.array([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)])
        T[:3, :3] = np.linalg.multi_dot(
            [_about(axis, float(angle)) for axis, angle in enumerate(angles)]
        )
    T[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return T


def _about(axis: int, angle: float) -> NDArray[np.float64]:
    """Return the turn (3, 3) about a coordinate axis, radians."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
    return turn


def run_ladder(
    shapes: Mapping[str, Points],
    ladder: Ladder | None = None,
    tell: Callable[[Trial], None] | None = None,
) -> list[Trial]:
    """Run every method on every level, motion and shape; the trials in that order of loops.

    shapes: name -> (n, 3), n at least twice the points of the ladder. `tell` hears every trial.
    """
    ladder = ladder or Ladder()
    trials = []
    for number, (name, points) in enumerate(shapes.items()):
        shape = describe_shape(name, points)
        for level, motion in itertools.product(ladder.levels, ladder.motions):
            for pose in range(ladder.poses):
                seed = (ladder.seed, number, LEVELS.index(level), MOTIONS.index(motion), pose)
                rng = np.random.default_rng(seed)
                source, target, truth = make_pair(shape.points, level, motion, ladder.points, rng)
                for method in ladder.methods:
                    trial = _trial(shape, level, motion, method, (source, target, truth), ladder)
                    trials.append(trial)
                    if tell is not None:
                        tell(trial)
    return trials


def _trial(
    shape: Shape,
    level: str,
    motion: str,
    method: str,
    pair: tuple[Points, Points, Transform],
    ladder: Ladder,
) -> Trial:
    source, target, truth = pair
    start = time.perf_counter()
    prepared = object_pair(source, target, ladder.settings)
    poses = METHODS[method](prepared, ladder.settings)
    found = judge_poses(prepared, poses, ladder.settings)
    seconds = time.perf_counter() - start
    best = found.hypotheses[0].T_target_source if found.hypotheses else None
    rre = rte = float("nan")
    if best is not None:
        rre = rotation_angle_deg(best[:3, :3], truth[:3, :3])
        rte = float(np.linalg.norm(best[:3, 3] - truth[:3, 3]))
    is_correct = bool(rre < CORRECT_DEG and rte < CORRECT_RADII)
    is_symmetric = is_correct or (best is not None and _is_equal(best, truth, shape))
    return Trial(
        shape=shape.name,
        level=level,
        motion=motion,
        method=method,
        status=found.status,
        has_symmetry=len(shape.symmetries) > 0,
        rre_deg=rre,
        rte=rte,
        is_correct=is_correct,
        is_correct_symmetric=is_symmetric,
        is_listed=is_symmetric or _is_listed(found, truth, shape),
        seconds=seconds,
    )


def _is_listed(found: ObjectRegistration, truth: Transform, shape: Shape) -> bool:
    if found.status != "ambiguous":
        return False
    return any(_is_equal(h.T_target_source, truth, shape) for h in found.hypotheses[1:])


def _is_equal(T: Transform, truth: Transform, shape: Shape) -> bool:
    """Say whether two poses of a shape differ by one of its symmetries only."""
    return _is_near(T, truth) or is_symmetry(np.linalg.inv(truth) @ T, shape)


def summarise(trials: Sequence[Trial]) -> list[dict[str, float | str | int]]:
    """Return one plain row per level, motion, method and group of shapes.

    ``precision`` correct / returned, ``recall`` correct / all; returned: status ok (strict), ok or
    ambiguous (symmetric; an ambiguous answer is right when it lists the truth or its like). Errors
    in degrees and radii: over all pairs with a pose, and over the returned (``ok``) ones.
    """
    rows = []
    keys = dict.fromkeys((t.level, t.motion, t.method) for t in trials)
    for (level, motion, method), group in itertools.product(keys, ("all", "no symmetry")):
        chosen = [
            t
            for t in trials
            if (t.level, t.motion, t.method) == (level, motion, method)
            and (group == "all" or not t.has_symmetry)
        ]
        if chosen:
            rows.append(
                {"level": level, "motion": motion, "method": method, "shapes": group} | _row(chosen)
            )
    return rows


def _row(chosen: Sequence[Trial]) -> dict[str, float | str | int]:
    ok = [t for t in chosen if t.status == "ok"]
    answered = [t for t in chosen if t.status != "failed"]
    right = sum(t.is_correct for t in ok)
    # An ok answer is one pose; an ambiguous one is its list.
    like = sum(t.is_correct_symmetric if t.status == "ok" else t.is_listed for t in answered)
    rre, rte = (np.array([getattr(t, k) for t in chosen]) for k in ("rre_deg", "rte"))
    rre_ok = np.array([t.rre_deg for t in ok])
    return {
        "pairs": len(chosen),
        "ok": len(ok),
        "ambiguous": len(answered) - len(ok),
        "precision": right / len(ok) if ok else float("nan"),
        "recall": right / len(chosen),
        "precision_symmetric": like / len(answered) if answered else float("nan"),
        "recall_symmetric": like / len(chosen),
        "best_correct": sum(t.is_correct for t in chosen) / len(chosen),
        "best_correct_symmetric": sum(t.is_correct_symmetric for t in chosen) / len(chosen),
        "rre_mean_deg": float(np.nanmean(rre)) if np.isfinite(rre).any() else float("nan"),
        "rre_median_deg": float(np.nanmedian(rre)) if np.isfinite(rre).any() else float("nan"),
        "rte_median": float(np.nanmedian(rte)) if np.isfinite(rte).any() else float("nan"),
        "rre_ok_mean_deg": float(rre_ok.mean()) if ok else float("nan"),
        "rre_ok_median_deg": float(np.median(rre_ok)) if ok else float("nan"),
        "seconds_median": float(np.median([t.seconds for t in chosen])),
    }
