"""Is a pose's covariance honest? Pairs with spatially correlated errors and a known pose.

Real errors of neighbouring points go together (calibration, a block that bends, registration of
stations). Each cloud of a pair here has white noise and, along its surface, a smooth random field:
a covariance that counts every point as an observation of its own promises far too much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from dougong.registration.icp import Icp, refine
from dougong.registration.prepare import Prepared
from dougong.registration.similarity_fit import fit_similarity
from dougong.typing import Points, Transform, Values

_LEVEL = 0.95
_WAVES = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How often the 95 % ellipsoid held the truth."""

    runs: int
    covered: int
    chi2_per_dof: Values
    """(runs,) squared error in units of the covariance, over the unknowns; 1 on average where
    honest."""

    @property
    def share(self) -> float:
        """Return the share of runs in which the ellipsoid held the true pose."""
        return self.covered / self.runs


def coverage(
    seeds: Sequence[int],
    *,
    white_m: float = 0.004,
    field_m: float = 0.006,
    length_m: float = 1.5,
    points: int = 9000,
    dof: Literal[6, 7] = 6,
    icp: Icp | None = None,
) -> Coverage:
    """Fit pairs of one hall whose true pose is the identity, and count.

    Parameters
    ----------
    seeds : sequence of int
        One pair each.
    white_m, field_m : float
        Standard deviations along the normals: of each point by itself, and of the smooth field.
    length_m : float
        Correlation length of the field: at this distance exp(-1/2) is left.
    points : int
        Of each cloud.
    dof : {6, 7}
        Unknowns of the fit; 7: with the source's scale.
    icp : Icp, optional
    """
    icp = icp or Icp(points_per_level=4000, levels=2)
    squares = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        # Anywhere: a wall along the sides of the blocks would flatter or spoil them.
        at = Rotation.from_euler("z", rng.uniform(0, 360), degrees=True), rng.uniform(-20, 20, 3)
        one, two = (_cloud(rng, points, white_m, field_m, length_m, at) for _ in range(2))
        if dof == 7:
            fit = fit_similarity(one, two, np.eye(4), "source", icp, 7)
            assert fit is not None
            T, covariance, centre = fit.T_target_source.copy(), fit.covariance, fit.centre
            T[:3, :3] *= fit.factor
        else:
            fine = refine(one, two, np.eye(4), icp)
            T, covariance, centre = fine.T_target_source, fine.covariance, fine.covariance_about
        assert covariance is not None
        squares.append(_square(T, covariance, centre))
    values = np.array(squares)
    bound = float(stats.chi2.ppf(_LEVEL, dof))
    return Coverage(
        runs=len(values), covered=int((values <= bound).sum()), chi2_per_dof=values / dof
    )


def _square(T: Transform, covariance: NDArray[np.float64], centre: NDArray[np.float64]) -> float:
    """Return the squared error of a pose, whose truth is the identity, by its own covariance."""
    growth = float(np.cbrt(np.linalg.det(T[:3, :3])))
    turn = Rotation.from_matrix(T[:3, :3] / growth).as_rotvec()
    shift = T[:3, :3] @ centre + T[:3, 3] - centre
    error = np.concatenate([turn, shift, [np.log(growth)]])[: len(covariance)]
    return float(error @ np.linalg.solve(covariance, error))


def _cloud(
    rng: np.random.Generator,
    count: int,
    white_m: float,
    field_m: float,
    length_m: float,
    at: tuple[Rotation, NDArray[np.float64]],
) -> Prepared:
    xyz, normals = _hall(rng, count)
    xyz, normals = at[0].apply(xyz) + at[1], at[0].apply(normals)
    off = field_m * _field(rng, xyz, length_m) + rng.normal(0.0, white_m, count)
    moved = xyz + off[:, None] * normals
    area = _area() / count
    return Prepared(
        xyz=moved,
        normals=normals,
        normal_is_oriented=False,
        planarity=np.ones(count),
        is_ground=np.zeros(count, dtype=bool),
        height_above_ground=moved[:, 2],
        weights_area=np.full(count, area),
        spacing_m=0.5 * float(np.sqrt(area)),
        sigma_m=white_m,
        kind="lidar",
    )


_FACES: tuple[tuple[Points, Points, Points], ...] = tuple(
    (np.array(corner, float), np.array(u, float), np.array(v, float))
    for corner, u, v in (
        ((-15, -10, 0), (30, 0, 0), (0, 0, 9)),
        ((-15, 10, 0), (30, 0, 0), (0, 0, 9)),
        ((-15, -10, 0), (0, 20, 0), (0, 0, 9)),
        ((15, -10, 0), (0, 20, 0), (0, 0, 9)),
        ((-15, -10, 0), (30, 0, 0), (0, 20, 0)),
        ((-15, -10, 9), (30, 0, 0), (0, 10, 5)),
        ((-15, 10, 9), (30, 0, 0), (0, -10, 5)),
        ((-4, -10, 0), (0, 20, 0), (0, 0, 9)),
    )
)
"""A hall with a gable roof and one partition: corner and two sides of each rectangle, metres."""


def _area() -> float:
    return float(sum(np.linalg.norm(np.cross(u, v)) for _, u, v in _FACES))


def _hall(rng: np.random.Generator, count: int) -> tuple[Points, Points]:
    """Return random points (n, 3) on the hall, and the normals of their faces."""
    areas = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in _FACES])
    face = rng.choice(len(_FACES), count, p=areas / areas.sum())
    corner, u, v = (np.array([row[k] for row in _FACES])[face] for k in range(3))
    points: Points = corner + rng.random((count, 1)) * u + rng.random((count, 1)) * v
    normals = np.cross(u, v)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _field(rng: np.random.Generator, points: Points, length_m: float) -> Values:
    """Return a smooth random field of unit variance with a Gaussian correlation (n,)."""
    waves: NDArray[np.float64] = rng.normal(0.0, 1.0 / length_m, (3, _WAVES))
    phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    field: Values = np.sqrt(2.0 / _WAVES) * np.cos(points @ waves + phase).sum(axis=1)
    return field
