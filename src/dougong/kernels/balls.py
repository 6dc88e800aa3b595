"""Sums over balls by the moments of whole tree nodes, exact in integers.

Points stand on an integer lattice (as float64, so distances are exact). Moments of a node are int64
sums about the origin; they may wrap round 2**64, but the moments of a ball about its centre are
small, and arithmetic modulo 2**64 gives them exactly. A ball adds whole nodes and looks at points
only on its rim, so on a surface the cost grows with the square root of the neighbours.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel, summing_kernel
from dougong.kernels.boxtree import box_distance2, box_far_distance2
from dougong.kernels.moments import eigen3

_DEPTH = 64


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
            x, y, z = np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2])
            out[node, 0] += x
            out[node, 1] += y
            out[node, 2] += z
            out[node, 3] += x * x
            out[node, 4] += y * y
            out[node, 5] += z * z
            out[node, 6] += x * y
            out[node, 7] += x * z
            out[node, 8] += y * z
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
def _size_of(node: int, n: int) -> int:
    """Return how many of n points lie under `node`."""
    level = 1
    while 2 * level <= node:
        level *= 2
    return (node - level + 1) * n // level - (node - level) * n // level


@kernel
def _reach2(boxes: Floats, a: int, b: int) -> tuple[float, float]:
    """Return the least and the largest squared distance between points of boxes a and b."""
    least = largest = 0.0
    for axis in range(3):
        ahead = boxes[b, axis] - boxes[a, 3 + axis]
        behind = boxes[a, axis] - boxes[b, 3 + axis]
        gap = max(ahead, behind, 0.0)
        span = max(boxes[b, 3 + axis] - boxes[a, axis], boxes[a, 3 + axis] - boxes[b, axis])
        least += gap * gap
        largest += span * span
    return least, largest


@kernel
def _parts(
    boxes: Floats, asked: int, radius2: float, stack: Ints, whole: Ints, rim: Ints
) -> tuple[int, int]:
    """Sort out the tree for the balls round all points of leaf node `asked`.

    Lists the nodes that lie in every ball (whole) and the leaf nodes that some ball may touch
    (rim); returns how many of each. The points of a leaf share this, so it is done once for them.
    """
    leaves = boxes.shape[0] // 2
    n_whole = n_rim = 0
    stack[0] = 1
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        least, largest = _reach2(boxes, asked, node)
        if least > radius2:
            continue
        if largest <= radius2:
            whole[n_whole] = node
            n_whole += 1
        elif node >= leaves:
            rim[n_rim] = node
            n_rim += 1
        else:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2
    return n_whole, n_rim


@summing_kernel
def _rim_moments(
    points: Floats,
    first: int,
    last: int,
    x: float,
    y: float,
    z: float,
    radius2: float,
    sums: Floats,
) -> None:
    """Add moments about (x, y, z) of points first .. last - 1 inside the ball to sums (10,).

    Whole numbers below 2**53: exact in any order, so the sums may be vectorised.
    """
    m = sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
    for i in range(np.uint64(first), np.uint64(last)):
        dx = points[i, 0] - x
        dy = points[i, 1] - y
        dz = points[i, 2] - z
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
    about[0] += _size_of(node, n)
    for c in range(9):
        about[1 + c] += moments[node, c]


@kernel
def _add_moved(about: Ints, x: float, y: float, z: float, sums: Floats) -> None:
    """Add moments about (0, 0, 0), modulo 2**64, to sums (10,) about (x, y, z), exactly."""
    a, b, c = np.int64(x), np.int64(y), np.int64(z)
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
def _variation(sums: Floats, a: Floats, v: Floats) -> float:
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
    stack = np.empty(_DEPTH, np.int64)
    whole, rim = np.empty(leaves, np.int64), np.empty(leaves, np.int64)
    shared, about, sums = np.empty(10, np.int64), np.empty(10, np.int64), np.empty(10, np.float64)
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    for asked in range(first_leaf, last_leaf):
        n_whole, n_rim = _parts(boxes, leaves + asked, radius2, stack, whole, rim)
        shared[:] = 0
        for w in range(n_whole):
            _add_node(moments, whole[w], n, shared)
        for q in range(asked * n // leaves, (asked + 1) * n // leaves):
            x, y, z = points[q, 0], points[q, 1], points[q, 2]
            sums[:] = 0.0
            about[:] = shared
            for r in range(n_rim):
                node = rim[r]
                if box_distance2(boxes, node, x, y, z) > radius2:
                    continue
                if box_far_distance2(boxes, node, x, y, z) <= radius2:
                    _add_node(moments, node, n, about)
                    continue
                first = (node - leaves) * n // leaves
                last = (node - leaves + 1) * n // leaves
                _rim_moments(points, first, last, x, y, z, radius2, sums)
            _add_moved(about, x, y, z, sums)
            variation[q] = _variation(sums, a, v)


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
    stack = np.empty(_DEPTH, np.int64)
    whole, rim = np.empty(leaves, np.int64), np.empty(leaves, np.int64)
    shared = np.empty(3, np.int64)
    for asked in range(first_leaf, last_leaf):
        n_whole, n_rim = _parts(boxes, leaves + asked, radius2, stack, whole, rim)
        shared[:] = 0
        for w in range(n_whole):
            for c in range(3):
                shared[c] += sums[whole[w], c]
        for q in range(asked * n // leaves, (asked + 1) * n // leaves):
            x, y, z = points[q, 0], points[q, 1], points[q, 2]
            out[q, :] = shared
            for r in range(n_rim):
                node = rim[r]
                if box_distance2(boxes, node, x, y, z) > radius2:
                    continue
                if box_far_distance2(boxes, node, x, y, z) <= radius2:
                    for c in range(3):
                        out[q, c] += sums[node, c]
                    continue
                for i in range((node - leaves) * n // leaves, (node - leaves + 1) * n // leaves):
                    dx = points[i, 0] - x
                    dy = points[i, 1] - y
                    dz = points[i, 2] - z
                    if dx * dx + dy * dy + dz * dz <= radius2 and values[i] >= 0:
                        out[q, 0] += 1
                        out[q, 1] += values[i]
                        out[q, 2] += values[i] * values[i]


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
    stack = np.empty(_DEPTH, np.int64)
    bound = np.empty(_DEPTH, np.float64)
    for q in range(start, stop):
        x, y, z = points[q, 0], points[q, 1], points[q, 2]
        radius2 = radii[q] * radii[q]
        best2 = np.inf
        stack[0] = 1
        bound[0] = 0.0
        height = 1
        while height > 0:
            height -= 1
            if bound[height] > min(best2, radius2):
                continue
            node = stack[height]
            while node < leaves:
                left = box_distance2(boxes, 2 * node, x, y, z)
                right = box_distance2(boxes, 2 * node + 1, x, y, z)
                near = 2 * node if left <= right else 2 * node + 1
                if max(left, right) <= min(best2, radius2):
                    stack[height] = 4 * node + 1 - near
                    bound[height] = max(left, right)
                    height += 1
                if min(left, right) > min(best2, radius2):
                    break
                node = near
            if node < leaves:
                continue
            leaf = node - leaves
            for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
                dx = points[i, 0] - x
                dy = points[i, 1] - y
                dz = points[i, 2] - z
                d2 = dx * dx + dy * dy + dz * dz
                if d2 <= radius2 and i != q:
                    best2 = min(best2, d2 * weights[i] * weights[i])
        out[q] = np.sqrt(best2)
