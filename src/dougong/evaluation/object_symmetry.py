"""Symmetries of a dense shape, and how far a pose is from the nearest one that they make equal.

A motion is a symmetry when half of the dense points, moved by it, come as near to the other half
as without it (mean nearest distance at most 1.3 times).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.metrics import rotation_angle_deg
from dougong.filters import neighbourhood
from dougong.registration import object_fit as fitting
from dougong.registration.pose_search import (
    build_field,
    distinct,
    poses_of,
    rotation_grid,
    score_poses,
    settle_poses,
    view_of,
)
from dougong.registration.surface import surface
from dougong.typing import Points, Transform

CORRECT_DEG = 5.0
CORRECT_RADII = 0.05
SYMMETRY_RATIO = 1.3
_REACHES = (0.15, 0.05)


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
    found: list[Transform] = []
    for pose in poses[order[scores[order] > 0.7 * own]]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
        # A few hundred points leave it degrees off: what all of them make of it counts.
        fitted = fitting.fit(*shape.halves, T, _REACHES, iterations=10)
        local = _in_shape(fitted, shape)
        known = [np.eye(4), *found]
        if any(rotation_angle_deg(local[:3, :3], S[:3, :3]) < CORRECT_DEG for S in known):
            continue
        if _mean_distance(shape.halves, fitted) <= SYMMETRY_RATIO * shape.floor:
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
    fitted = _fitted_symmetry(T, shape)
    return fitted is not None and is_near(fitted, T)


def _fitted_symmetry(T: Transform, shape: Shape) -> Transform | None:
    """Return the symmetry that a fit of the dense halves leads to from `T`; None if it is none."""
    fitted = fitting.fit(*shape.halves, _between_halves(T, shape), _REACHES, iterations=10)
    if _mean_distance(shape.halves, fitted) > SYMMETRY_RATIO * shape.floor:
        return None
    return _in_shape(fitted, shape)


def is_near(a: Transform, b: Transform) -> bool:
    """Say whether two poses of a shape are within 5 degrees and 0.05 of each other."""
    angle, shift = pose_error(a, b)
    return angle < CORRECT_DEG and shift < CORRECT_RADII


def pose_error(a: Transform, b: Transform) -> tuple[float, float]:
    """Return the angle (deg) and the shift between two poses of a shape."""
    angle = rotation_angle_deg(a[:3, :3], b[:3, :3])
    return float(angle), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def is_equal(T: Transform, truth: Transform, shape: Shape) -> bool:
    """Say whether a pose is within 5 degrees and 0.05 of one that the shape makes true."""
    motion = np.linalg.inv(truth) @ T
    known = (np.eye(4), *shape.symmetries)
    # The dense fit costs more than all else: it is asked where nothing known is near.
    return any(is_near(S, motion) for S in known) or is_symmetry(motion, shape)


def symmetric_error(T: Transform, truth: Transform, shape: Shape) -> tuple[float, float]:
    """Return angle (deg) and shift of `T` from the nearest pose that the shape makes true.

    These are the truth, and the truth after any symmetry: those found before, and the one that a
    fit of the dense shape leads to from here (of a round shape only some are listed).
    """
    motion = np.linalg.inv(truth) @ T
    fitted = _fitted_symmetry(motion, shape)
    equal = [np.eye(4), *shape.symmetries, *([] if fitted is None else [fitted])]
    return min(pose_error(S, motion) for S in equal)
