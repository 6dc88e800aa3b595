"""The least weighted distance from each point to another one, leaf by leaf.

How far the best of a leaf's own points is bounds the search; what lies within the largest of these
bounds is looked at for all points of the leaf, in plain loops over columns.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel, least_kernel
from dougong.kernels.neighbours import DEPTH, next_leaf
from dougong.kernels.self_neighbours import gather_near

_MOST = 1024
"""More candidates than this are not worth it: each point is then searched for in the tree."""


@kernel
def _best_of(
    points: Floats, weights: Floats, first: int, last: int, q: int, radius2: float
) -> float:
    """Return the least squared weighted distance from point q to points first .. last - 1."""
    x, y, z = points[q, 0], points[q, 1], points[q, 2]
    best2 = np.inf
    for i in range(first, last):
        dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 <= radius2 and i != q:
            best2 = min(best2, d2 * weights[i] * weights[i])
    return best2


@kernel
def _search(
    points: Floats,
    boxes: Floats,
    weights: Floats,
    q: int,
    radius2: float,
    best2: float,
    stack: Ints,
    bound: Floats,
) -> float:
    """Return the least squared weighted distance from point q, found in the tree, or `best2`."""
    n, leaves = points.shape[0], boxes.shape[0] // 2
    stack[0] = 1
    bound[0] = 0.0
    height = 1
    while True:
        limit2 = min(best2, radius2)
        leaf, height = next_leaf(
            boxes, points[q, 0], points[q, 1], points[q, 2], limit2, stack, bound, height
        )
        if leaf < 0:
            return best2
        first, last = leaf * n // leaves, (leaf + 1) * n // leaves
        best2 = min(best2, _best_of(points, weights, first, last, q, radius2))


@least_kernel
def _least(
    near: Floats, given: Floats, first: int, last: int, x: float, y: float, z: float, radius2: float
) -> float:
    """Return the least squared weighted distance from (x, y, z) to columns first .. last - 1."""
    best2 = np.inf
    for i in range(np.uint64(first), np.uint64(last)):
        dx, dy, dz = near[0, i] - x, near[1, i] - y, near[2, i] - z
        d2 = dx * dx + dy * dy + dz * dz
        weighted2 = d2 * given[i] * given[i] if d2 <= radius2 else np.inf
        best2 = min(best2, weighted2)
    return best2


@kernel
def least_weighted(
    points: Floats,
    boxes: Floats,
    weights: Floats,
    radii: Floats,
    first_leaf: int,
    last_leaf: int,
    out: Floats,
) -> None:
    """Fill out (m,) at the sorted points of leaves first_leaf .. last_leaf - 1.

    With the least weights[j] x distance over j != i within the radius of point i. weights (n,), at
    least 1, so that distance bounds the product from below; radii (m,) inclusive, those of the
    points asked about. Inf where no other point is in reach. Duplicates of a point are others.
    """
    n, leaves = points.shape[0], boxes.shape[0] // 2
    stack, bound = np.empty(DEPTH, np.int64), np.empty(DEPTH, np.float64)
    near, given = np.empty((3, _MOST), np.float64), np.empty(_MOST, np.float64)
    who = np.empty(_MOST, np.int64)
    offset = first_leaf * n // leaves
    for leaf in range(first_leaf, last_leaf):
        begin, end = leaf * n // leaves, (leaf + 1) * n // leaves
        reach2 = 0.0
        for q in range(begin, end):
            row = q - offset
            radius2 = radii[row] * radii[row]
            out[row] = _best_of(points, weights, begin, end, q, radius2)
            reach2 = max(reach2, min(out[row], radius2))
        held = gather_near(points, boxes, leaves + leaf, reach2, stack, near, who)
        for i in range(held):
            given[i] = weights[who[i]]
        for q in range(begin, end):
            row = q - offset
            radius2, best2 = radii[row] * radii[row], out[row]
            if held < 0:
                best2 = _search(points, boxes, weights, q, radius2, best2, stack, bound)
            else:
                # The leaf's own points come first, and have been looked at.
                x, y, z = points[q, 0], points[q, 1], points[q, 2]
                best2 = min(best2, _least(near, given, end - begin, held, x, y, z, radius2))
            out[row] = np.sqrt(best2)
