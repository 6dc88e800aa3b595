"""Sums over balls by the moments of whole tree nodes, exact in integers.

Points stand on an integer lattice (as float64, so distances are exact). Moments of a node are int64
sums about the origin; they may wrap round 2**64, but the moments of a ball about its centre are
small, and arithmetic modulo 2**64 gives them exactly. A ball adds whole nodes and looks at points
only on its rim, so on a surface the cost grows with the square root of the neighbours.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel, summing_kernel
from dougong.kernels.ball_walk import SHARE, look, make_walk, size_of
from dougong.kernels.boxtree import LEAF
from dougong.kernels.moments import add_products, eigen3
from dougong.kernels.neighbours import DEPTH, next_leaf

_CHUNK = 64
"""Leaves on the rim that are looked at together: their points fit the fast cache."""


@kernel
def add_point(points: Floats, i: int, out: Ints) -> None:
    """Add x, y, z, xx, yy, zz, xy, xz, yz of point i, whole numbers, to out (9,)."""
    add_products(np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2]), out)


@kernel
def node_moments(points: Floats, out: Ints) -> None:
    """Fill out (2 leaves, 9) with sums of x, y, z, xx, yy, zz, xy, xz, yz of every node's points.

    points (n, 3): whole numbers, in the order of a box tree with `leaves` leaves.
    """
    n = points.shape[0]
    leaves = out.shape[0] // 2
    for leaf in range(leaves):
        node = leaves + leaf
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            add_point(points, i, out[node])
    for node in range(leaves - 1, 0, -1):
        for c in range(9):
            out[node, c] = out[2 * node, c] + out[2 * node + 1, c]


@kernel
def node_sums(values: Ints, out: Ints) -> None:
    """Fill out (2 leaves, 3) with count, sum and sum of squares of every node's values >= 0.

    values (n,) in sorted order; negative ones do not count.
    """
    n = values.shape[0]
    leaves = out.shape[0] // 2
    for leaf in range(leaves):
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            value = values[i]
            if value >= 0:
                out[leaves + leaf, 0] += 1
                out[leaves + leaf, 1] += value
                out[leaves + leaf, 2] += value * value
    for node in range(leaves - 1, 0, -1):
        for c in range(3):
            out[node, c] = out[2 * node, c] + out[2 * node + 1, c]


@kernel
def _gather(points: Floats, leaves: int, rim: Ints, start: int, stop: int, near: Floats) -> int:
    """Fill near (3, ..) with the points of leaf nodes rim[start:stop]; return how many."""
    n = points.shape[0]
    held = 0
    for r in range(start, stop):
        leaf = rim[r] - leaves
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            near[0, held], near[1, held], near[2, held] = points[i, 0], points[i, 1], points[i, 2]
            held += 1
    return held


@kernel
def _gather_values(
    values: Ints, leaves: int, rim: Ints, start: int, stop: int, given: Floats
) -> None:
    """Fill `given` with the values of the points that `_gather` finds."""
    n = values.shape[0]
    held = 0
    for r in range(start, stop):
        leaf = rim[r] - leaves
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            given[held] = values[i]
            held += 1


@summing_kernel
def _rim_moments(
    near: Floats, held: int, x: float, y: float, z: float, radius2: float, sums: Floats
) -> None:
    """Add moments about (x, y, z) of the first `held` points inside the ball to sums (10,).

    Whole numbers below 2**53: exact in any order, so the sums may be vectorised. One long loop over
    all leaves that the balls of these queries touch is faster than to sort them out for each.
    """
    m = sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
    for i in range(np.uint64(held)):
        dx = near[0, i] - x
        dy = near[1, i] - y
        dz = near[2, i] - z
        # A far point of the leaf may be so far that its products are not exact: it has weight 0.
        is_in = 1.0 if dx * dx + dy * dy + dz * dz <= radius2 else 0.0
        dx *= is_in
        dy *= is_in
        dz *= is_in
        m += is_in
        sx += dx
        sy += dy
        sz += dz
        xx += dx * dx
        yy += dy * dy
        zz += dz * dz
        xy += dx * dy
        xz += dx * dz
        yz += dy * dz
    sums[0] += m
    sums[1] += sx
    sums[2] += sy
    sums[3] += sz
    sums[4] += xx
    sums[5] += yy
    sums[6] += zz
    sums[7] += xy
    sums[8] += xz
    sums[9] += yz


@kernel
def _add_node(moments: Ints, node: int, n: int, about: Ints) -> None:
    """Add count and moments of `node` to about (10,)."""
    about[0] += size_of(node, n)
    for c in range(9):
        about[1 + c] += moments[node, c]


@kernel
def add_moved(about: Ints, centre: Floats, sums: Floats) -> None:
    """Add moments about (0, 0, 0), modulo 2**64, to sums (10,) about the centre (3,), exactly."""
    a, b, c = np.int64(centre[0]), np.int64(centre[1]), np.int64(centre[2])
    m, sx, sy, sz = about[0], about[1], about[2], about[3]
    sums[0] += m
    sums[1] += sx - m * a
    sums[2] += sy - m * b
    sums[3] += sz - m * c
    sums[4] += about[4] - 2 * a * sx + m * a * a
    sums[5] += about[5] - 2 * b * sy + m * b * b
    sums[6] += about[6] - 2 * c * sz + m * c * c
    sums[7] += about[7] - a * sy - b * sx + m * a * b
    sums[8] += about[8] - a * sz - c * sx + m * a * c
    sums[9] += about[9] - b * sz - c * sy + m * b * c


@kernel
def variation_of(sums: Floats, a: Floats, v: Floats) -> float:
    """Return l3 / (l1 + l2 + l3) of the covariance of sums (10,); a and v (3, 3) are work space."""
    m = sums[0]
    for row in range(3):
        mean = sums[1 + row] / m
        a[row, row] = max(sums[4 + row] / m - mean * mean, 0.0)
    a[0, 1] = a[1, 0] = sums[7] / m - sums[1] / m * (sums[2] / m)
    a[0, 2] = a[2, 0] = sums[8] / m - sums[1] / m * (sums[3] / m)
    a[1, 2] = a[2, 1] = sums[9] / m - sums[2] / m * (sums[3] / m)
    small, middle, large = eigen3(a, v)
    least = max(a[small, small], 0.0)
    total = least + max(a[middle, middle], 0.0) + max(a[large, large], 0.0)
    return float(least / total) if total > 0.0 else 0.0


@kernel
def ball_variation(
    points: Floats,
    boxes: Floats,
    moments: Ints,
    radius2: float,
    first_leaf: int,
    last_leaf: int,
    variation: Floats,
) -> None:
    """Fill variation (n,) at the sorted points of leaves first_leaf .. last_leaf - 1.

    Surface variation l3 / (l1 + l2 + l3) of the covariance about the mean of each point's ball,
    the point itself included; 0 where all of the ball lies in one place.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    walk, share = make_walk(leaves), min(SHARE, leaves)
    about = np.empty(10, np.int64)
    sums = np.empty((SHARE * LEAF, 10), np.float64)
    near = np.empty((3, _CHUNK * LEAF), np.float64)
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    for asked in range(first_leaf, last_leaf, share):
        n_whole, n_rim = look(boxes, asked, radius2, walk)
        about[:] = 0
        for w in range(n_whole):
            _add_node(moments, walk.whole[w], n, about)
        begin, end = asked * n // leaves, (asked + share) * n // leaves
        sums[:] = 0.0
        for start in range(0, n_rim, _CHUNK):
            stop = min(start + _CHUNK, n_rim)
            held = _gather(points, leaves, walk.rim, start, stop, near)
            for q in range(begin, end):
                x, y, z = points[q, 0], points[q, 1], points[q, 2]
                _rim_moments(near, held, x, y, z, radius2, sums[q - begin])
        for q in range(begin, end):
            add_moved(about, points[q], sums[q - begin])
            variation[q] = variation_of(sums[q - begin], a, v)


@summing_kernel
def _rim_totals(
    near: Floats,
    given: Floats,
    held: int,
    x: float,
    y: float,
    z: float,
    radius2: float,
    sums: Floats,
) -> None:
    """Add count, sum and sum of squares of `given` >= 0 inside the ball to sums (3,).

    Whole numbers that add up to less than 2**53: exact in any order.
    """
    count = total = squares = 0.0
    for i in range(np.uint64(held)):
        dx = near[0, i] - x
        dy = near[1, i] - y
        dz = near[2, i] - z
        value = given[i]
        is_in = 1.0 if dx * dx + dy * dy + dz * dz <= radius2 and value >= 0.0 else 0.0
        count += is_in
        total += is_in * value
        squares += is_in * value * value
    sums[0] += count
    sums[1] += total
    sums[2] += squares


@kernel
def ball_totals(
    points: Floats,
    boxes: Floats,
    values: Ints,
    sums: Ints,
    radius2: float,
    first_leaf: int,
    last_leaf: int,
    out: Ints,
) -> None:
    """Fill out (n, 3) at the sorted points of leaves first_leaf .. last_leaf - 1 from their balls.

    Count, sum and sum of squares of the values >= 0 in each point's ball; sums (2 leaves, 3) are
    those of the nodes (see `node_sums`).
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    walk, share = make_walk(leaves), min(SHARE, leaves)
    about = np.empty(3, np.int64)
    found = np.empty((SHARE * LEAF, 3), np.float64)
    near, given = np.empty((3, _CHUNK * LEAF), np.float64), np.empty(_CHUNK * LEAF, np.float64)
    for asked in range(first_leaf, last_leaf, share):
        n_whole, n_rim = look(boxes, asked, radius2, walk)
        about[:] = 0
        for w in range(n_whole):
            about += sums[walk.whole[w]]
        begin, end = asked * n // leaves, (asked + share) * n // leaves
        found[:] = 0.0
        for start in range(0, n_rim, _CHUNK):
            stop = min(start + _CHUNK, n_rim)
            held = _gather(points, leaves, walk.rim, start, stop, near)
            _gather_values(values, leaves, walk.rim, start, stop, given)
            for q in range(begin, end):
                x, y, z = points[q, 0], points[q, 1], points[q, 2]
                _rim_totals(near, given, held, x, y, z, radius2, found[q - begin])
        for q in range(begin, end):
            for c in range(3):
                out[q, c] = about[c] + np.int64(found[q - begin, c])


@kernel
def least_weighted(
    points: Floats,
    boxes: Floats,
    weights: Floats,
    radii: Floats,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Fill out (n,): least weights[j] x distance over j != i within radii[i] of sorted point i.

    weights (n,), at least 1, so that distance bounds the product from below; radii (n,) inclusive.
    Inf where no other point is in reach. Duplicates of a point are others.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(DEPTH, np.int64)
    bound = np.empty(DEPTH, np.float64)
    for q in range(start, stop):
        x, y, z = points[q, 0], points[q, 1], points[q, 2]
        radius2 = radii[q] * radii[q]
        best2 = np.inf
        stack[0] = 1
        bound[0] = 0.0
        height = 1
        while True:
            limit2 = min(best2, radius2)
            leaf, height = next_leaf(boxes, x, y, z, limit2, stack, bound, height)
            if leaf < 0:
                break
            for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
                dx = points[i, 0] - x
                dy = points[i, 1] - y
                dz = points[i, 2] - z
                d2 = dx * dx + dy * dy + dz * dz
                if d2 <= radius2 and i != q:
                    best2 = min(best2, d2 * weights[i] * weights[i])
        out[q] = np.sqrt(best2)
