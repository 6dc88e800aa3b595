"""One Gauss-Newton step of the fine registration: weights, normal equations, prior, motion."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dougong.kernels.icp import block_normal_equations
from dougong.typing import Index, Points, Transform, Values

Robust = Literal["tukey", "geman-mcclure", "none"]

FREE = {4: (2, 3, 4, 5), 6: (0, 1, 2, 3, 4, 5)}
"""Which of (omega_x, omega_y, omega_z, v_x, v_y, v_z) move, by degrees of freedom."""
# Directions whose information is below this share of the strongest are left where they are:
# below it only the scatter of normals speaks.
_STIFFNESS_FLOOR = 1e-5
_BLOCK_ERROR_FLOOR_M = 0.005


def rotation_of(omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) rotation Exp(omega), omega (3,) in radians (Rodrigues)."""
    angle = float(np.linalg.norm(omega))
    x, y, z = omega
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return orthonormal(np.eye(3) + skew)
    first, second = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    rotation: NDArray[np.float64] = np.eye(3) + first * skew + second * (skew @ skew)
    return rotation


def orthonormal(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the proper rotation nearest to `matrix` (3, 3)."""
    u, _, vt = np.linalg.svd(matrix)
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    nearest: NDArray[np.float64] = u @ vt
    return nearest


def moved_by(T: Transform, step: NDArray[np.float64], centre: NDArray[np.float64]) -> Transform:
    """Return `T` followed by x' = c + Exp(omega)(x - c) + v, step = (omega, v), (6,)."""
    turn = rotation_of(step[:3])
    result = np.eye(4)
    result[:3, :3] = orthonormal(turn @ T[:3, :3])
    result[:3, 3] = turn @ (T[:3, 3] - centre) + centre + step[3:]
    return result


def grown_by(T: Transform, step: NDArray[np.float64], centre: NDArray[np.float64]) -> Transform:
    """Return the similarity `T` followed by x' = c + s Exp(omega)(x - c) + v.

    step = (omega, v, ln s), (7,).
    """
    growth, turn = float(np.exp(step[6])), rotation_of(step[:3])
    scale = growth * float(np.cbrt(np.linalg.det(T[:3, :3])))
    result = np.eye(4)
    result[:3, :3] = scale * orthonormal(turn @ T[:3, :3])
    result[:3, 3] = growth * (turn @ (T[:3, 3] - centre)) + centre + step[3:6]
    return result


def plane_rows(arms: Points, normals: Points, *, with_scale: bool = False) -> NDArray[np.float64]:
    """Return d(residual along the normal) / d(omega, v[, ln s]), (n, 6) or (n, 7).

    n . (omega x arm + v) = (arm x n) . omega + n . v, and growing by ln s moves a point by its
    arm; `arms` (n, 3) are the points about the centre of `moved_by`'s motion.
    """
    parts = [np.cross(arms, normals), normals]
    if with_scale:
        parts.append(np.einsum("ij,ij->i", arms, normals)[:, None])
    rows: NDArray[np.float64] = np.concatenate(parts, axis=1)
    return rows


def levelled(T: Transform, centre: NDArray[np.float64]) -> Transform:
    """Return `T` with its rotation replaced by its turn about the vertical.

    The image of the source point that `T` brings to `centre` (3,) stays where it is.
    """
    yaw = np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
    result = np.eye(4)
    result[:3, :3] = rotation_of(np.array([0.0, 0.0, yaw]))
    source = T[:3, :3].T @ (centre - T[:3, 3])
    result[:3, 3] = centre - result[:3, :3] @ source
    return result


def weighted_median(values: Values, weights: Values) -> float:
    """Return the value below which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


def robust_weights(residuals: Values, scale_m: float, kind: Robust) -> Values:
    """Return weights (n,) in 0..1 of an M-estimator; `scale_m` is the inliers' sigma.

    Constants give 95 % efficiency for normal errors (Huber and Ronchetti 2009).
    """
    ratio = residuals / scale_m
    if kind == "tukey":
        weights: Values = np.square(np.clip(1.0 - np.square(ratio / 4.685), 0.0, None))
    elif kind == "geman-mcclure":
        weights = 1.0 / np.square(1.0 + np.square(ratio / 3.0))
    else:
        weights = np.ones(len(residuals))
    return weights


def robust_widening(residuals: Values, areas: Values, scale_m: float, kind: Robust) -> float:
    """Return the factor (>= 1) by which robust weights understate a covariance.

    Weights are not constants: a residual that grows loses weight, so the estimate follows its
    data more than H with the weights says. The sandwich of an M-estimator has the derivative of
    the influence in place of the weight (Huber and Ronchetti 2009); `areas` (n,) weigh both.
    """
    square = np.square(residuals / scale_m)
    if kind == "tukey":
        inner = np.clip(1.0 - square / 4.685**2, 0.0, None)
        slope = np.where(inner > 0.0, inner * (1.0 - 5.0 * square / 4.685**2), 0.0)
    elif kind == "geman-mcclure":
        slope = (1.0 - square / 3.0) / (1.0 + square / 9.0) ** 3
    else:
        return 1.0
    weights = robust_weights(residuals, scale_m, kind)
    share = float(areas @ slope) / max(float(areas @ weights), 1e-300)
    # Below a third the residuals are no longer a bell: the factor is bounded.
    return 1.0 / float(np.clip(share, 1.0 / 3.0, 1.0)) ** 2


def normal_equations(
    points: Points, normals: Points, residuals: Values, weights: Values, block: Index, blocks: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return H (blocks, 6, 6) and g (blocks, 6) of plane distances; `points` about the centre."""
    H, g = np.zeros((blocks, 6, 6)), np.zeros((blocks, 6))
    block_normal_equations(
        np.ascontiguousarray(points),
        np.ascontiguousarray(normals),
        np.ascontiguousarray(residuals),
        np.ascontiguousarray(weights),
        np.ascontiguousarray(block),
        H,
        g,
    )
    return H, g


def gravity_prior(
    up: NDArray[np.float64], up_target: NDArray[np.float64], sigma_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return H (6, 6), g (6,) of "the source's vertical is the target's, within sigma_rad".

    up (3,): the source's vertical as the pose turns it; up_target (3,); both unit.
    """
    across = np.linalg.svd(up_target[None])[2][1:]
    x, y, z = up
    J = np.zeros((2, 6))
    # d(omega x up) / d omega, seen across the target's vertical.
    J[:, :3] = across @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    return J.T @ J / sigma_rad**2, J.T @ (across @ up) / sigma_rad**2


def solve(
    H: NDArray[np.float64], g: NDArray[np.float64], dof: int, length_m: float
) -> NDArray[np.float64]:
    """Return the step (6,) = (omega, v) that solves H step = -g over the free directions.

    `length_m` turns radians into metres of motion, so that all six share a unit. Directions
    without information are not moved.
    """
    free = list(FREE[dof])
    scale = np.array([length_m] * 3 + [1.0] * 3)[free]
    values, vectors = np.linalg.eigh(H[np.ix_(free, free)] / np.outer(scale, scale))
    is_stiff = values > _STIFFNESS_FLOOR * max(values[-1], 1e-300)
    inverse = np.where(is_stiff, 1.0 / np.where(is_stiff, values, 1.0), 0.0)
    step = np.zeros(6)
    step[free] = -(vectors @ (inverse * (vectors.T @ (g[free] / scale)))) / scale
    return step


def with_prior(
    H: NDArray[np.float64],
    g: NDArray[np.float64],
    prior: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    weight_sum: float,
    scale_m: float,
    blocks: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return H, g with the gravity prior in, each block counted as one independent look.

    Residuals of neighbouring points err together, so a million of them must not outvote the
    prior a million times: the data weigh as much as `blocks` measurements of sigma `scale_m`.
    """
    share = weight_sum * max(scale_m, _BLOCK_ERROR_FLOOR_M) ** 2 / max(blocks, 1)
    return H + share * prior[0], g + share * prior[1]
