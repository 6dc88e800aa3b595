"""Loops of the fine registration: normal equations of plane distances, summed per block."""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel


@kernel
def block_normal_equations(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    residuals: NDArray[np.float64],
    weights: NDArray[np.float64],
    block: NDArray[np.int64],
    H: NDArray[np.float64],
    g: NDArray[np.float64],
) -> None:
    """Add each correspondence's part to the normal equations of its block.

    points (n, 3) about the centre of rotation; normals (n, 3) unit; residuals (n,) metres along
    the normal; weights (n,); block (n,) in 0..b-1; H (b, 6, 6) and g (b, 6), zeroed by the caller.
    Row of the Jacobian: (point x normal, normal), for the motion p + omega x p + v
    (Chen and Medioni 1992).
    """
    row = np.empty(6)
    for i in range(points.shape[0]):
        weight = weights[i]
        if weight == 0.0:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        row[0] = py * nz - pz * ny
        row[1] = pz * nx - px * nz
        row[2] = px * ny - py * nx
        row[3] = nx
        row[4] = ny
        row[5] = nz
        b = block[i]
        for j in range(6):
            scaled = weight * row[j]
            g[b, j] += scaled * residuals[i]
            for k in range(j, 6):
                H[b, j, k] += scaled * row[k]
    for b in range(H.shape[0]):
        for j in range(6):
            for k in range(j):
                H[b, j, k] = H[b, k, j]
