"""How far a found pose is from the true one, by the definitions of METHOD.md section 5."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._checks import as_transform
from dougong.errors import InputError
from dougong.typing import Points, Transform, Values

CORRECT_TRE95_M = 0.050
ACCURATE_TRE95_M = 0.020
ACCURATE_ROTATION_DEG = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What the generator knows about a pair of clouds."""

    T_target_source: Transform
    """The true motion, lidar file coordinates to map file coordinates, without bending: rigid, or
    of the map's scale in plan where the drone cloud is in a projection that has one."""
    T_best: Transform
    """The motion of that scale nearest to the bent surface: argmin of the area integral over the
    surface both sensors saw of |T x - (T_target_source x + d(x))|^2."""
    surface_points: Points
    """(m, 3) lidar file coordinates; uniform by area over the surface both sensors saw."""
    surface_bent: Points
    """(m, 3) map file coordinates: where the drone cloud has them, without noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """The distance of one pose from the truth. 95 = 95th percentile over the shared surface."""

    tre95_m: float
    """A: between the pose and T_best."""
    bending_floor95_m: float
    """B: what T_best itself leaves, by the bending alone."""
    total95_m: float
    """C: between the pose and the bent surface, noise-free."""
    rotation_error_deg: float
    """Angle between the pose and T_best."""
    scale_error_ppm: float
    """(scale of the pose / that of T_best - 1) x 1e6; zero for a rigid one on a rigid map."""
    translation_at_centroid_m: NDArray[np.float64]
    """(3,) pose minus T_best at the centroid of the shared surface, map axes."""
    is_correct: bool
    """tre95_m <= 0.050."""
    is_accurate: bool
    """tre95_m <= 0.020 and rotation_error_deg <= 0.02."""


def fit_rigid(source: Points, target: Points, scale: float = 1.0) -> Transform:
    """Return the motion of a known `scale` that brings `source` nearest to `target`.

    In the least squares. Both (n, 3), paired, n >= 3 and not on a line; coordinates may be as large
    as map coordinates.
    Kabsch (1976) by singular value decomposition, proper rotations only.
    """
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    left, _, right = np.linalg.svd((target - centre_target).T @ (source - centre_source))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * (left @ mirror @ right)
    matrix[:3, 3] = centre_target - matrix[:3, :3] @ centre_source
    return matrix


def best_scale(truth: Truth) -> float:
    """Return lengths in the bent map / lengths in the scan, of the similarity nearest to both.

    Umeyama (1991) over the surface that both sensors saw: a drone cloud's slow bending has a
    scale of its own, which is the true one for whoever fits a scale.
    """
    source = truth.surface_points - truth.surface_points.mean(axis=0)
    target = truth.surface_bent - truth.surface_bent.mean(axis=0)
    rotation = fit_rigid(source, target)[:3, :3]
    return float(np.einsum("ij,ij->", target, source @ rotation.T) / np.square(source).sum())


def rotation_angle_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the angle between two rotations (3, 3), exact for tiny angles too."""
    # The chord |R1 - R2| = 2 sqrt(2) sin(angle / 2) keeps digits that the arc cosine loses.
    chord = np.linalg.norm(first - second) / (2 * np.sqrt(2))
    return float(np.degrees(2 * np.arcsin(min(1.0, float(chord)))))


def displacements(first: Transform, second: Transform, points: Points) -> Points:
    """Return (first - second) applied to `points` (n, 3), without loss at map coordinates."""
    centre = points.mean(axis=0)
    difference = first - second
    at_centre = difference[:3, :3] @ centre + difference[:3, 3]
    moved: Points = (points - centre) @ difference[:3, :3].T + at_centre
    return moved


def pose_errors(matrix: ArrayLike, truth: Truth) -> PoseErrors:
    """Return the errors of a found pose.

    Parameters
    ----------
    matrix : array_like, shape (4, 4)
        Rigid or similarity motion, lidar file coordinates to map file coordinates.
    truth : Truth

    Raises
    ------
    InputError
        Not a proper transform, or a truth without shared surface.
    """
    pose = as_transform(matrix)
    points = truth.surface_points
    if not len(points):
        msg = "the truth has no surface that both sensors saw (0 points). Use another seed."
        raise InputError(msg)
    from_best = displacements(pose, truth.T_best, points)
    bend = _left_by(truth.T_best, truth)
    scale = float(np.cbrt(np.linalg.det(pose[:3, :3])))
    scale_best = float(np.cbrt(np.linalg.det(truth.T_best[:3, :3])))
    tre95 = percentile95(np.linalg.norm(from_best, axis=1))
    angle = rotation_angle_deg(pose[:3, :3] / scale, truth.T_best[:3, :3] / scale_best)
    return PoseErrors(
        tre95_m=tre95,
        bending_floor95_m=percentile95(np.linalg.norm(bend, axis=1)),
        total95_m=percentile95(np.linalg.norm(from_best + bend, axis=1)),
        rotation_error_deg=angle,
        scale_error_ppm=(scale / scale_best - 1) * 1e6,
        translation_at_centroid_m=from_best.mean(axis=0),
        is_correct=tre95 <= CORRECT_TRE95_M,
        is_accurate=tre95 <= ACCURATE_TRE95_M and angle <= ACCURATE_ROTATION_DEG,
    )


def percentile95(values: Values) -> float:
    """Return the 95th percentile of `values` (n,), linear between ranks."""
    return float(np.percentile(values, 95))


def _left_by(pose: Transform, truth: Truth) -> Points:
    """Return pose(x) - bent(x), (m, 3), about the centres so that no digit is lost."""
    centre, centre_bent = truth.surface_points.mean(axis=0), truth.surface_bent.mean(axis=0)
    offset = pose[:3, :3] @ centre + pose[:3, 3] - centre_bent
    turned = (truth.surface_points - centre) @ pose[:3, :3].T
    left: Points = turned + offset - (truth.surface_bent - centre_bent)
    return left
