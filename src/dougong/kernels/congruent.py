"""Pairs of points at a given distance: what congruent sets are made of."""

import math

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel


@kernel
def pairs_at_distance(
    points: Floats,
    normals: Floats,
    length: float,
    tolerance: float,
    cosine: float,
    cosine_tolerance: float,
    first: int,
    last: int,
    out: Ints,
) -> int:
    """Write the ordered pairs (i, j), first <= i < last, that are `length` apart; return how many.

    points, normals (n, 3). A pair counts when its distance is within `tolerance` of `length` and
    |n_i . n_j| within `cosine_tolerance` of `cosine`. out (p, 2) int64; what does not fit is
    counted but not written.
    """
    count = 0
    low = max(length - tolerance, 0.0)
    low2, high2 = low * low, (length + tolerance) * (length + tolerance)
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(points.shape[0]):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            d2 = dx * dx + dy * dy + dz * dz
            if d2 < low2 or d2 > high2 or i == j:
                continue
            c = (
                normals[i, 0] * normals[j, 0]
                + normals[i, 1] * normals[j, 1]
                + normals[i, 2] * normals[j, 2]
            )
            if math.fabs(math.fabs(c) - cosine) > cosine_tolerance:
                continue
            if count < out.shape[0]:
                out[count, 0] = i
                out[count, 1] = j
            count += 1
    return count
