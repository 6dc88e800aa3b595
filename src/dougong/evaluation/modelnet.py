"""The ladder of object registration: precision and recall from copies to half-seen, noisy parts.

Levels (METHOD.md 5), each on top of the one before where it says so, 1024 points before cropping:

- ``L0``: the same sampled points, moved.
- ``L1``: source and target sampled independently.
- ``L2``: as L1; each cropped to 0.7 by a random half-space of its own; jitter 0.01 on every
  coordinate, cut at 0.05.
- ``L3``: as L2, cropped to 0.5.
- ``L4``: as L1; the density of each falls to a tenth across it, along a random direction.

Motions: ``45`` three Euler angles drawn from 0..45 degrees, ``any`` uniform over SO(3), ``yaw``
any turn about z; translation up to 0.5 along each axis. Shapes lie in the unit sphere.

The method ``ours-told`` is ours told the largest rotation of the motion (86 degrees of ``45``), as
learned methods are by what they are trained on. Symmetry: `dougong.evaluation.object_symmetry`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Limits

from dougong.evaluation.object_methods import METHODS, TOLD
from dougong.evaluation.object_symmetry import (
    CORRECT_DEG,
    CORRECT_RADII,
    Shape,
    describe_shape,
    is_equal,
    pose_error,
    symmetric_error,
)
from dougong.params import Parameters
from dougong.registration.free_rotation import (
    FreeRotation,
    ObjectRegistration,
    judge_poses,
    object_pair,
)
from dougong.registration.pose_search import rotations_of
from dougong.typing import Points, Transform

Level = Literal["L0", "L1", "L2", "L3", "L4"]
Motion = Literal["45", "any", "yaw"]
LEVELS: tuple[Level, ...] = ("L0", "L1", "L2", "L3", "L4")
MOTIONS: tuple[Motion, ...] = ("45", "any", "yaw")
MOST_DEG: Mapping[Motion, float] = {"45": 86.0, "any": 180.0, "yaw": 180.0}
"""The largest rotation of each motion: three turns of 45 degrees make one of 85.8."""


_ERRORS = ("rre_deg", "rre_symmetric_deg", "rte", "rte_symmetric")


class Ladder(Parameters):
    """What is tried."""

    levels: tuple[Level, ...] = LEVELS
    motions: tuple[Motion, ...] = MOTIONS
    methods: tuple[str, ...] = ("ours", TOLD, "improved-pca", "pca", "sac-ia", "4pcs")
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
    rre_symmetric_deg: float
    """Angle and shift from the nearest pose that the symmetries of the shape make equal to it."""
    rte_symmetric: float
    is_correct: bool
    """The best pose is within 5 degrees and 0.05 of the true one."""
    is_correct_symmetric: bool
    """... or of one that is equal to it."""
    is_listed: bool
    """Some listed pose is right in the symmetry-aware sense."""
    seconds: float


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
    for name, points in shapes.items():
        for trial in climb(describe_shape(name, points), ladder):
            trials.append(trial)
            if tell is not None:
                tell(trial)
    return trials


def climb(shape: Shape, ladder: Ladder) -> Iterator[Trial]:
    """Yield the trials of one shape; ours is told nothing twice where nothing can be told."""
    for level, motion in itertools.product(ladder.levels, ladder.motions):
        methods = [m for m in ladder.methods if m != TOLD or MOST_DEG[motion] < 180.0]
        for number in range(ladder.poses):
            pair = draw_pair(shape, level, motion, number, ladder)
            for method in methods:
                yield _trial(shape, level, motion, method, pair, ladder)


def draw_pair(
    shape: Shape, level: Level, motion: Motion, number: int, ladder: Ladder
) -> tuple[Points, Points, Transform]:
    """Return source, target and true motion of a shape's pair by its number."""
    which = (LEVELS.index(level), MOTIONS.index(motion), number)
    rng = np.random.default_rng((ladder.seed, *which, *shape.name.encode()))
    return make_pair(shape.points, level, motion, ladder.points, rng)


def _trial(
    shape: Shape,
    level: Level,
    motion: Motion,
    method: str,
    pair: tuple[Points, Points, Transform],
    ladder: Ladder,
) -> Trial:
    source, target, truth = pair
    settings = ladder.settings
    if method == TOLD:
        settings = settings.model_copy(update={"max_angle_deg": MOST_DEG[motion]})
    start = time.perf_counter()
    prepared = object_pair(source, target, settings)
    found = judge_poses(prepared, METHODS[method](prepared, settings), settings)
    seconds = time.perf_counter() - start
    best = found.hypotheses[0].T_target_source if found.hypotheses else None
    error = like = (float("nan"), float("nan"))
    if best is not None:
        error = pose_error(best, truth)
        like = error if _is_right(error) else symmetric_error(best, truth, shape)
    return Trial(
        shape=shape.name,
        level=level,
        motion=motion,
        method=method,
        status=found.status,
        has_symmetry=len(shape.symmetries) > 0,
        rre_deg=error[0],
        rte=error[1],
        rre_symmetric_deg=like[0],
        rte_symmetric=like[1],
        is_correct=_is_right(error),
        is_correct_symmetric=_is_right(like),
        is_listed=_is_right(like) or _is_listed(found, truth, shape),
        seconds=seconds,
    )


def _is_right(error: tuple[float, float]) -> bool:
    return error[0] < CORRECT_DEG and error[1] < CORRECT_RADII


def _is_listed(found: ObjectRegistration, truth: Transform, shape: Shape) -> bool:
    if found.status != "ambiguous":
        return False
    poses = [h.T_target_source for h in found.hypotheses[1:]]
    return any(is_equal(T, truth, shape) for T in poses)


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
    errors = {key: np.array([getattr(t, key) for t in chosen]) for key in _ERRORS}
    rre_ok = np.array([t.rre_deg for t in ok])
    return {
        "pairs": len(chosen),
        "ok": len(ok),
        "wrong": sum(not t.is_correct for t in ok),
        "wrong_symmetric": sum(not t.is_correct_symmetric for t in ok),
        "ambiguous": len(answered) - len(ok),
        "precision": right / len(ok) if ok else float("nan"),
        "recall": right / len(chosen),
        "precision_symmetric": like / len(answered) if answered else float("nan"),
        "recall_symmetric": like / len(chosen),
        "best_correct": sum(t.is_correct for t in chosen) / len(chosen),
        "best_correct_symmetric": sum(t.is_correct_symmetric for t in chosen) / len(chosen),
        **{f"{key}_mean": _over(np.mean, values) for key, values in errors.items()},
        **{f"{key}_median": _over(np.median, values) for key, values in errors.items()},
        "rre_ok_mean_deg": _over(np.mean, rre_ok),
        "rre_ok_median_deg": _over(np.median, rre_ok),
        "seconds_median": float(np.median([t.seconds for t in chosen])),
    }


def _over(statistic: Callable[..., Any], values: NDArray[np.float64]) -> float:
    """Return a statistic of the finite values; NaN of none."""
    finite = values[np.isfinite(values)]
    return float(statistic(finite)) if len(finite) else float("nan")
