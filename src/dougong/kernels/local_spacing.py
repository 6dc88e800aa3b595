"""Smoothed means over cells: the spacing usual round a point."""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.cells import steps_from, steps_per_edge


@kernel
def smooth_means(
    points: Floats,
    low: Floats,
    edge: float,
    cell: Ints,
    around: Ints,
    held: Ints,
    sums: Ints,
    start: int,
    stop: int,
    count: Floats,
    mean: Floats,
) -> None:
    """Fill count (n,) and mean (n,) of the values in the cells round points start .. stop - 1.

    low (3,): where cell (0, 0, 0) begins; cell (n,) of each point; around (cells, 27) the cells
    round each, x slowest, -1 where empty; held and sums (cells,). Weights are those of a quadratic
    B-spline, so nothing jumps from cell to cell; count is scaled so that the middle cell of an even
    cloud counts fully.
    """
    steps = steps_per_edge(edge)
    w = np.empty((3, 3), np.float64)
    for i in range(start, stop):
        for axis in range(3):
            t = steps_from(points[i, axis], low[axis], edge / steps) / steps
            t -= np.floor(t) + 0.5
            w[axis, 0] = 0.5 * (0.5 - t) * (0.5 - t)
            w[axis, 1] = 0.75 - t * t
            w[axis, 2] = 0.5 * (0.5 + t) * (0.5 + t)
        total = weight = 0.0
        for k in range(27):
            other = around[cell[i], k]
            if other >= 0:
                here = w[0, k // 9] * w[1, (k // 3) % 3] * w[2, k % 3]
                weight += here * held[other]
                total += here * sums[other]
        count[i] = 8.0 * weight
        mean[i] = total / weight
