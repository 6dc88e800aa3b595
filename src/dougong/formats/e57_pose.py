"""Where a scan stands: the pose of E57, a turn and a shift, and how a registration changes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong._checks import as_transform
from dougong.typing import Transform

SAME_SCALE = 1e-9
"""Scales this near to 1 count as 1: 0.1 micrometre on 100 m."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid pose: file coordinates = rotation @ own coordinates + translation."""

    rotation: NDArray[np.float64]
    """(3, 3)."""
    translation: NDArray[np.float64]
    """(3,), metres."""

    @property
    def is_still(self) -> bool:
        """Whether it moves nothing."""
        return bool((self.rotation == np.eye(3)).all() and not self.translation.any())

    @property
    def quaternion(self) -> NDArray[np.float64]:
        """(w, x, y, z) of length one, w never negative."""
        return quaternion_of(self.rotation)


def still() -> Pose:
    """Return the pose of a scan that says none: its own coordinates are the file's."""
    return Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Motion:
    """A similarity taken apart: target = scale x rotation @ source + translation."""

    rotation: NDArray[np.float64]
    scale: float
    """Exactly 1 where it is 1 within `SAME_SCALE`."""
    translation: NDArray[np.float64]
    residual_m: float
    """How far the matrix moves points a metre from `about` otherwise: its axes' error."""

    def applied(self, pose: Pose) -> Pose:
        """Return the pose of a scan after the motion; its own points are to be scaled besides."""
        return Pose(
            rotation=_nearest_rotation(self.rotation @ pose.rotation),
            translation=self.scale * (self.rotation @ pose.translation) + self.translation,
        )


def motion_of(matrix: Transform, about: NDArray[np.float64]) -> Motion:
    """Take a (4, 4) rigid or similarity `matrix` between metres apart.

    Parameters
    ----------
    matrix : ndarray, shape (4, 4)
        Its axes may be a rounding error off a rotation (six decimals in a text file, say).
    about : ndarray, shape (3,)
        Source coordinates that the motion maps exactly as the matrix does: a point amid the
        scan, so that a small error of the axes is not multiplied by map coordinates.
    """
    matrix = as_transform(matrix)
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if abs(scale - 1.0) <= SAME_SCALE:
        scale = 1.0
    rotation = _nearest_rotation(linear / scale)
    translation = linear @ about + matrix[:3, 3] - scale * (rotation @ about)
    residual = float(np.linalg.norm(linear - scale * rotation, 2))
    return Motion(rotation, scale, translation, residual)


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) nearest to `matrix` (polar decomposition)."""
    u, _, vt = np.linalg.svd(matrix)
    nearest: NDArray[np.float64] = u @ vt
    return nearest


def matrix_of(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation of a quaternion (w, x, y, z), which need not have length one."""
    length = float(np.linalg.norm(quaternion))
    if length == 0:
        return np.eye(3)
    w, x, y, z = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternion (w, x, y, z) of a rotation (3, 3): length one, w not negative.

    Computed from its largest part, so no digit is lost near half turns (Shepperd 1978).
    """
    r = rotation
    trace = float(np.trace(r))
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        parts = [1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        parts = [r[k, j] - r[j, k], 0.0, 0.0, 0.0]
        parts[1 + i] = 1 + r[i, i] - r[j, j] - r[k, k]
        parts[1 + j] = r[j, i] + r[i, j]
        parts[1 + k] = r[k, i] + r[i, k]
    quaternion = np.array(parts)
    quaternion /= np.linalg.norm(quaternion)
    return -quaternion if quaternion[0] < 0 else quaternion
