"""Which way is up: the instrument's z axis, checked against the walls (METHOD.md 2.2)."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dougong.typing import Points, Values

_WALL_MAX_NZ = 0.17
"""A normal within 10 degrees of horizontal may belong to a wall."""
_LEVEL_MIN_NZ = 0.97
"""A normal within 14 degrees of vertical may belong to ground or floor."""
_FACE_M = 4.0
"""Wall normals are averaged per face of this size, so that one large wall is not many votes."""
_TUKEY_DEG = 1.5
"""Faces leaning more than this against the common vertical (battered walls) lose their vote."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levelling:
    """How far the walls say that z is from the vertical."""

    up: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """(3,) unit vector, the vertical by the walls, local frame; z where walls cannot tell."""
    tilt_deg: float = 0.0
    """Angle between `up` and z."""
    sigma_deg: float = float("inf")
    """Standard deviation of the tilt in its weakest direction; inf: the walls cannot tell."""
    faces: int = 0
    """Wall faces that voted."""
    support: float = 0.0
    """Share of the wall area that is upright by `up`, from the weights of the robust fit, 0..1."""
    battered: float = 0.0
    """Share of it that leans by one angle to both sides of z, as the walls of a battered building
    or a rampart do all round, 0..1."""
    ground_agrees: bool = True
    """The level surfaces, too, are squarer to `up` than to z. False: leaning (battered) walls on
    level ground, which say nothing about the instrument."""

    def is_tilted(self, tolerance_deg: float) -> bool:
        """Say whether the walls prove a tilt of more than `tolerance_deg` (4 sigma)."""
        is_explained_by_batter = self.battered >= self.support
        return (
            self.ground_agrees
            and not is_explained_by_batter
            and self.tilt_deg - 4.0 * self.sigma_deg > tolerance_deg
        )


def levelling(points: Points, normals: Points, weights: Values) -> Levelling:
    """Estimate the vertical from wall normals, which are horizontal on upright walls.

    Minimises the robust sum of (normal . up)^2 over wall faces (Tukey weights). Faces are
    averages over `_FACE_M` columns and 30 degree classes of direction. The standard deviation
    comes from the scatter of the faces, so leaning walls widen it instead of faking a tilt.

    Parameters
    ----------
    points, normals : ndarray, shape (n, 3)
        Metres, local frame; unit normals, any sign.
    weights : ndarray, shape (n,)
        Area of planar surface that each point stands for; 0 for points that are not planar.

    Notes
    -----
    Tilts beyond 10 degrees are outside its reach: such walls are not recognised as walls.
    """
    is_wall = (np.abs(normals[:, 2]) < _WALL_MAX_NZ) & (weights > 0)
    if is_wall.sum() < 50:
        return Levelling()
    faces, areas = _faces(points[is_wall], normals[is_wall], weights[is_wall])
    if len(faces) < 6:
        return Levelling(faces=len(faces))
    # up = (-a, -b, 1): a face with horizontal normal (u, v) and rest w satisfies u a + v b = w.
    slope = np.zeros(2)
    limit = np.tan(np.radians(_TUKEY_DEG))
    scale = 8.0 * limit
    for _ in range(30):
        residual = faces[:, 2] - faces[:, :2] @ slope
        share = np.clip(1.0 - (residual / scale) ** 2, 0.0, None) ** 2 * areas
        information = (faces[:, :2] * share[:, None]).T @ faces[:, :2]
        if np.linalg.cond(information) > 1e4:
            return Levelling(faces=len(faces))
        slope = np.linalg.solve(information, (faces[:, :2] * share[:, None]).T @ faces[:, 2])
        scale = max(limit, scale * 0.7)
    level = _level_normal(normals, weights)
    return _summary(slope, faces, areas, share, information, level)


def _faces(points: Points, normals: Points, weights: Values) -> tuple[Points, Values]:
    """Return mean wall normals (m, 3), horizontal part of unit length, and their areas (m,)."""
    angle = np.mod(np.arctan2(normals[:, 1], normals[:, 0]), np.pi)
    sign = np.where(np.arctan2(normals[:, 1], normals[:, 0]) % (2 * np.pi) >= np.pi, -1.0, 1.0)
    column = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _FACE_M).astype(np.int64)
    key = (column[:, 0] * (column[:, 1].max() + 1) + column[:, 1]) * 6
    key += np.minimum((angle / (np.pi / 6)).astype(np.int64), 5)
    _, place = np.unique(key, return_inverse=True)
    area = np.bincount(place, weights)
    mean = np.column_stack(
        [np.bincount(place, weights * sign * normals[:, axis]) for axis in range(3)]
    )
    length = np.linalg.norm(mean[:, :2], axis=1)
    # Opposite signs inside a class cancel; a face whose normals disagree is no face.
    is_good = (area > 0.5) & (length > 0.8 * area)
    return mean[is_good] / length[is_good, None], np.minimum(area[is_good], _FACE_M**2)


def _summary(
    slope: NDArray[np.float64],
    faces: Points,
    areas: Values,
    share: Values,
    information: NDArray[np.float64],
    level: NDArray[np.float64],
) -> Levelling:
    """Turn the fitted slope into up, tilt and an honest standard deviation."""
    residual = faces[:, 2] - faces[:, :2] @ slope
    if (share > 0.1 * areas).sum() < 6:
        return Levelling(faces=len(faces))
    scatter = faces[:, :2] * (share * residual)[:, None]
    inverse = np.linalg.inv(information)
    # Sandwich estimate: each face is one independent observation, however heavy it is.
    covariance = inverse @ (scatter.T @ scatter) @ inverse
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    # Faces the robust fit threw away could as well have been the upright ones.
    rejected = 1.0 - float(share.sum() / areas.sum())
    sigma = sigma / max(1.0 - rejected, 0.1)
    up = np.array([-slope[0], -slope[1], 1.0])
    up /= np.linalg.norm(up)
    return Levelling(
        up=up,
        tilt_deg=float(np.degrees(np.arctan(np.hypot(*slope)))),
        sigma_deg=float(np.degrees(sigma)),
        faces=len(faces),
        support=1.0 - rejected,
        battered=_battered_share(faces, areas),
        ground_agrees=bool(up @ level >= level[2]),
    )


def _battered_share(faces: Points, areas: Values) -> float:
    """Return the share of wall area that leans by one angle to both sides of z, 0..1.

    Normals of opposite walls count as one direction here: a tilted instrument leans them to the
    same side of it, a battered building to both. So an angle's share counts, per direction, twice
    the smaller of both sides. Otherwise a fit that stands a quarter of a round building's walls
    upright would pass for a tilt of the instrument.
    """
    lean = np.degrees(np.arctan(faces[:, 2]))
    angle = np.mod(np.arctan2(faces[:, 1], faces[:, 0]), np.pi)
    direction = np.minimum((angle / (np.pi / 6)).astype(np.int64), 5)
    best = 0.0
    for batter in np.arange(0.5 * _TUKEY_DEG, 10.0, 0.25 * _TUKEY_DEG):
        near = [
            np.bincount(
                direction,
                areas * np.clip(1.0 - ((side * lean - batter) / _TUKEY_DEG) ** 2, 0.0, None) ** 2,
                6,
            )
            for side in (1.0, -1.0)
        ]
        best = max(best, float(2.0 * np.minimum(*near).sum()))
    return best / float(areas.sum())


def _level_normal(normals: Points, weights: Values) -> NDArray[np.float64]:
    """Return the median direction (3,) of ground, floors and terraces by area; z without any."""
    is_level = (np.abs(normals[:, 2]) > _LEVEL_MIN_NZ) & (weights > 0)
    if is_level.sum() < 50:
        return np.array([0.0, 0.0, 1.0])
    slopes = normals[is_level, :2] / normals[is_level, 2:]
    area = weights[is_level]
    middle = []
    for axis in range(2):
        order = np.argsort(slopes[:, axis], kind="stable")
        place = np.searchsorted(np.cumsum(area[order]), 0.5 * area.sum())
        middle.append(slopes[order[place], axis])
    normal = np.array([*middle, 1.0])
    unit: NDArray[np.float64] = normal / np.linalg.norm(normal)
    return unit


def rotation_to_vertical(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) that turns `up` onto z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    cosine = float(up[2])
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation: NDArray[np.float64] = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return rotation
