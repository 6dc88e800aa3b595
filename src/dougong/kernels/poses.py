"""Score and improve many rigid poses at once against a field of closest points.

The field is a regular grid over the target; each cell holds the point nearest to its centre, so a
look-up costs the same however many points there are. The point found is the exact nearest one up
to the diagonal of a cell. Poses are rows of 12 numbers: rotation by rows, then translation.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._arrays import Floats
from dougong.kernels._jit import kernel

Cells: TypeAlias = NDArray[np.int32]
_STEADY = 0.1
"""Weight of point distances beside plane distances: holds what planes alone let slide."""


@kernel
def _closest(x: float, y: float, z: float, field: Cells, low: Floats, cell: float) -> int:
    """Return the place that field (a, b, c) holds at x, y, z; -1 outside or out of reach."""
    i = math.floor((x - low[0]) / cell)
    j = math.floor((y - low[1]) / cell)
    k = math.floor((z - low[2]) / cell)
    if i < 0 or j < 0 or k < 0 or i >= field.shape[0] or j >= field.shape[1] or k >= field.shape[2]:
        return -1
    return int(field[int(i), int(j), int(k)])


@kernel
def score_poses(
    poses: Floats,
    points: Floats,
    normals: Floats,
    target: Floats,
    target_normals: Floats,
    field: Cells,
    low: Floats,
    cell: float,
    reach: float,
    out: Floats,
) -> None:
    """Fill out (k,) with the mean over points (m, 3) of (1 - d^2 / reach^2) cos^2, d < reach.

    poses (k, 12); d is the distance to the closest target point (n, 3) that the field knows, cos
    the cosine between the normals, whose signs mean nothing. 0 is nowhere near, 1 a perfect fit.
    """
    reach2 = reach * reach
    for k in range(poses.shape[0]):
        p = poses[k]
        total = 0.0
        for i in range(points.shape[0]):
            a, b, c = points[i, 0], points[i, 1], points[i, 2]
            x = p[0] * a + p[1] * b + p[2] * c + p[9]
            y = p[3] * a + p[4] * b + p[5] * c + p[10]
            z = p[6] * a + p[7] * b + p[8] * c + p[11]
            j = _closest(x, y, z, field, low, cell)
            if j < 0:
                continue
            dx, dy, dz = target[j, 0] - x, target[j, 1] - y, target[j, 2] - z
            d2 = dx * dx + dy * dy + dz * dz
            if d2 >= reach2:
                continue
            a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
            cosine = (
                (p[0] * a + p[1] * b + p[2] * c) * target_normals[j, 0]
                + (p[3] * a + p[4] * b + p[5] * c) * target_normals[j, 1]
                + (p[6] * a + p[7] * b + p[8] * c) * target_normals[j, 2]
            )
            total += (1.0 - d2 / reach2) * cosine * cosine
        out[k] = total / max(points.shape[0], 1)


@kernel
def shift_poses(
    poses: Floats,
    points: Floats,
    target: Floats,
    field: Cells,
    low: Floats,
    cell: float,
    reach: float,
    steps: int,
) -> None:
    """Move poses (k, 12) in place, without turning them, to where the points meet the target.

    Mean shift with the kernel (1 - d^2 / reach^2): `steps` times by the weighted mean offset.
    """
    reach2 = reach * reach
    for k in range(poses.shape[0]):
        p = poses[k]
        for _ in range(steps):
            weight = sx = sy = sz = 0.0
            for i in range(points.shape[0]):
                a, b, c = points[i, 0], points[i, 1], points[i, 2]
                x = p[0] * a + p[1] * b + p[2] * c + p[9]
                y = p[3] * a + p[4] * b + p[5] * c + p[10]
                z = p[6] * a + p[7] * b + p[8] * c + p[11]
                j = _closest(x, y, z, field, low, cell)
                if j < 0:
                    continue
                dx, dy, dz = target[j, 0] - x, target[j, 1] - y, target[j, 2] - z
                share = 1.0 - (dx * dx + dy * dy + dz * dz) / reach2
                if share > 0.0:
                    weight += share
                    sx += share * dx
                    sy += share * dy
                    sz += share * dz
            if weight == 0.0:
                break
            p[9] += sx / weight
            p[10] += sy / weight
            p[11] += sz / weight


@kernel
def _add_row(
    H: Floats, g: Floats, row: Floats, arm: Floats, axis: Floats, residual: float, weight: float
) -> None:
    """Add one residual along axis (3,) at arm (3,) to H (6, 6), upper half, and g (6,)."""
    row[0] = arm[1] * axis[2] - arm[2] * axis[1]
    row[1] = arm[2] * axis[0] - arm[0] * axis[2]
    row[2] = arm[0] * axis[1] - arm[1] * axis[0]
    row[3], row[4], row[5] = axis[0], axis[1], axis[2]
    for u in range(6):
        g[u] += weight * residual * row[u]
        for v in range(u, 6):
            H[u, v] += weight * row[u] * row[v]


@kernel
def solve6(H: Floats, g: Floats) -> bool:
    """Solve H x = g in place of g by Cholesky; H (6, 6) upper half given. False: not positive."""
    for i in range(6):
        for j in range(i, 6):
            total = H[i, j]
            for k in range(i):
                total -= H[k, i] * H[k, j]
            if i == j:
                if not total > 0.0:
                    return False
                H[i, i] = math.sqrt(total)
            else:
                H[i, j] = total / H[i, i]
    for i in range(6):
        for k in range(i):
            g[i] -= H[k, i] * g[k]
        g[i] /= H[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            g[i] -= H[i, k] * g[k]
        g[i] /= H[i, i]
    return True


@kernel
def _turn(p: Floats, step: Floats) -> None:
    """Apply x' = Exp(omega) x + v, step = (omega, v), to pose p (12,) in place (Rodrigues)."""
    wx, wy, wz = step[0], step[1], step[2]
    angle = math.sqrt(wx * wx + wy * wy + wz * wz)
    if angle > 0.0:
        wx, wy, wz = wx / angle, wy / angle, wz / angle
        c, s = math.cos(angle), math.sin(angle)
        q = 1.0 - c
        for column in range(4):
            a = p[column] if column < 3 else p[9]
            b = p[3 + column] if column < 3 else p[10]
            d = p[6 + column] if column < 3 else p[11]
            dot = q * (wx * a + wy * b + wz * d)
            x = c * a + s * (wy * d - wz * b) + dot * wx
            y = c * b + s * (wz * a - wx * d) + dot * wy
            z = c * d + s * (wx * b - wy * a) + dot * wz
            if column < 3:
                p[column], p[3 + column], p[6 + column] = x, y, z
            else:
                p[9], p[10], p[11] = x, y, z
    p[9] += step[3]
    p[10] += step[4]
    p[11] += step[5]


@kernel
def settle_poses(
    poses: Floats,
    points: Floats,
    target: Floats,
    target_normals: Floats,
    field: Cells,
    low: Floats,
    cell: float,
    reach: float,
    steps: int,
) -> None:
    """Improve poses (k, 12) in place by `steps` of point-to-plane ICP on the field.

    Gauss-Newton about the target frame's origin (keep the target centred there); weights
    (1 - d^2 / reach^2)^2; a tenth of the weight on point distances. Poses without matches stay.
    """
    reach2 = reach * reach
    H, g, row = np.empty((6, 6)), np.empty(6), np.empty(6)
    arm, axis = np.empty(3), np.empty(3)
    for k in range(poses.shape[0]):
        p = poses[k]
        for _ in range(steps):
            H[:, :] = 0.0
            g[:] = 0.0
            for i in range(points.shape[0]):
                a, b, c = points[i, 0], points[i, 1], points[i, 2]
                arm[0] = p[0] * a + p[1] * b + p[2] * c + p[9]
                arm[1] = p[3] * a + p[4] * b + p[5] * c + p[10]
                arm[2] = p[6] * a + p[7] * b + p[8] * c + p[11]
                j = _closest(arm[0], arm[1], arm[2], field, low, cell)
                if j < 0:
                    continue
                dx, dy, dz = target[j, 0] - arm[0], target[j, 1] - arm[1], target[j, 2] - arm[2]
                share = 1.0 - (dx * dx + dy * dy + dz * dz) / reach2
                if share <= 0.0:
                    continue
                weight = share * share
                n = target_normals[j]
                _add_row(H, g, row, arm, n, n[0] * dx + n[1] * dy + n[2] * dz, weight)
                for u in range(3):
                    axis[:] = 0.0
                    axis[u] = 1.0
                    offset = dx if u == 0 else (dy if u == 1 else dz)
                    _add_row(H, g, row, arm, axis, offset, _STEADY * weight)
            trace = 0.0
            for u in range(6):
                trace += H[u, u]
            for u in range(6):
                H[u, u] += 1e-6 * trace
            if not solve6(H, g):
                break
            _turn(p, g)
