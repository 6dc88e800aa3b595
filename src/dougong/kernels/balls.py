"""Sums over balls by the moments of whole tree nodes, exact in integers.

Points stand on an integer lattice (as float64, so distances are exact). Moments of a node are int64
sums about the origin; they may wrap round 2**64, but the moments of a ball about its centre are
small, and arithmetic modulo 2**64 gives them exactly. A ball adds whole nodes and looks at points
only on its rim, so on a surface the cost grows with the square root of the neighbours.

Most of the time goes into the points of the rim. They are copied so that the points of one leaf,
which all look at the same ones, do so in plain loops over columns, without a branch.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel, summing_kernel
from dougong.kernels.ball_walk import (
    CHUNK,
    GROUP,
    SHARE,
    OpenLeaves,
    gather_band,
    load,
    look,
    make_open_leaves,
    make_walk,
    set_bands,
    sort_out,
)
from dougong.kernels.boxtree import LEAF
from dougong.kernels.moments import add_products, eigen3, least_share

_WIDTH = 32
"""Columns are filled up to multiples of this, so that vectorised loops over them have no rest."""
_FAR = 2.0**60
"""Where a point stands that no ball holds."""


@kernel
def add_point(points: Floats, i: int, out: Ints) -> None:
    """Add x, y, z, xx, yy, zz, xy, xz, yz of point i, whole numbers, to out (9,)."""
    add_products(np.int64(points[i, 0]), np.int64(points[i, 1]), np.int64(points[i, 2]), out)


@kernel
def node_moments(points: Floats, out: Ints) -> None:
    """Fill out (2 leaves, 10) with counts and sums of x, y, z, xx, yy, zz, xy, xz, yz of all nodes.

    points (n, 3): whole numbers, in the order of a box tree with `leaves` leaves.
    """
    n = points.shape[0]
    leaves = out.shape[0] // 2
    out[:] = 0
    for leaf in range(leaves):
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            out[leaves + leaf, 0] += 1
            add_point(points, i, out[leaves + leaf, 1:])
    add_up_nodes(out)


@kernel
def node_sums(values: Ints, out: Ints) -> None:
    """Fill out (2 leaves, 3) with count, sum and sum of squares of every node's values >= 0.

    values (n,) in sorted order; negative ones do not count.
    """
    n = values.shape[0]
    leaves = out.shape[0] // 2
    out[:] = 0
    for leaf in range(leaves):
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            value = values[i]
            if value >= 0:
                out[leaves + leaf, 0] += 1
                out[leaves + leaf, 1] += value
                out[leaves + leaf, 2] += value * value
    add_up_nodes(out)


@kernel
def add_rows(rows: Ints, which: Ints, count: int, sums: Ints, row: int) -> None:
    """Add those of rows (.., w) that which[:count] lists to a row of sums (.., w)."""
    for r in range(np.uint64(count)):
        for c in range(sums.shape[1]):
            sums[row, c] += rows[which[r], c]


@kernel
def add_up_nodes(sums: Ints) -> None:
    """Fill sums (2 leaves, w) of the inner nodes from those of the leaves."""
    for node in range(sums.shape[0] // 2 - 1, 0, -1):
        for c in range(sums.shape[1]):
            sums[node, c] = sums[2 * node, c] + sums[2 * node + 1, c]


@kernel
def _fill_up(points: Floats, held: int) -> int:
    """Add points that lie in no ball until they fill whole vectors; return how many there are."""
    stop = -(-held // _WIDTH) * _WIDTH
    for i in range(held, stop):
        points[0, i] = _FAR
    return stop


@kernel
def _gather_near(points: Floats, values: Ints, chunk: OpenLeaves, n_rim: int, near: Floats) -> int:
    """Fill `near` with the points of the leaves that chunk.rim[:n_rim] lists; return how many.

    near (3 or 4, ..): x, y, z and, where values are summed, the value.
    """
    # Taken out of the tuple once: inside a loop each access counts a reference.
    listed, starts, stops = chunk.rim, chunk.starts, chunk.stops
    held = np.uint64(0)
    for r in range(np.uint64(n_rim)):
        k = listed[r]
        for i in range(np.uint64(starts[k]), np.uint64(stops[k])):
            for axis in range(3):
                near[axis, held] = points[i, axis]
            if near.shape[0] > 3:
                near[3, held] = values[i]
                if values[i] < 0:
                    near[0, held] = _FAR
            held += np.uint64(1)
    return _fill_up(near, int(held))


@summing_kernel
def _add_moments(
    near: Floats, held: int, x: float, y: float, z: float, radius2: float, sums: Ints, row: int
) -> None:
    """Add count and moments about (x, y, z) of `held` points, those in the ball, to a row of sums.

    Whole numbers that add up to less than 2**53: exact in any order, so the sums are vectorised.
    """
    m = 0
    sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
    for i in range(np.uint64(held)):
        dx = near[0, i] - x
        dy = near[1, i] - y
        dz = near[2, i] - z
        # A far point of the leaf may be so far that its products are not exact: it becomes 0.
        is_in = dx * dx + dy * dy + dz * dz <= radius2
        dx = dx if is_in else 0.0
        dy = dy if is_in else 0.0
        dz = dz if is_in else 0.0
        m += 1 if is_in else 0
        sx += dx
        sy += dy
        sz += dz
        xx += dx * dx
        yy += dy * dy
        zz += dz * dz
        xy += dx * dy
        xz += dx * dz
        yz += dy * dz
    sums[row, 0] += m
    sums[row, 1] += np.int64(sx)
    sums[row, 2] += np.int64(sy)
    sums[row, 3] += np.int64(sz)
    sums[row, 4] += np.int64(xx)
    sums[row, 5] += np.int64(yy)
    sums[row, 6] += np.int64(zz)
    sums[row, 7] += np.int64(xy)
    sums[row, 8] += np.int64(xz)
    sums[row, 9] += np.int64(yz)


@summing_kernel
def _add_totals(
    near: Floats, held: int, x: float, y: float, z: float, radius2: float, sums: Ints, row: int
) -> None:
    """Add count, sum and sum of squares of the values near[3] in the ball to a row of sums.

    Whole numbers that add up to less than 2**53: exact in any order.
    """
    count = 0
    total = squares = 0.0
    for i in range(np.uint64(held)):
        dx = near[0, i] - x
        dy = near[1, i] - y
        dz = near[2, i] - z
        is_in = dx * dx + dy * dy + dz * dz <= radius2
        value = near[3, i] if is_in else 0.0
        count += 1 if is_in else 0
        total += value
        squares += value * value
    sums[row, 0] += count
    sums[row, 1] += np.int64(total)
    sums[row, 2] += np.int64(squares)


@kernel
def _add_rim(
    queries: Floats,
    first: int,
    last: int,
    near: Floats,
    held: int,
    radius2: float,
    sums: Ints,
    row: int,
) -> None:
    """Add what is asked for of `held` points in the balls round queries first .. last - 1.

    To sums (.., w), from `row` on. The loop stands here because whoever calls counts references.
    """
    for q in range(first, last):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        if near.shape[0] > 3:
            _add_totals(near, held, x, y, z, radius2, sums, row + q - first)
        else:
            _add_moments(near, held, x, y, z, radius2, sums, row + q - first)


@kernel
def add_moved(about: Ints, a: int, b: int, c: int, sums: Ints) -> None:
    """Add count and moments about (a, b, c), given those `about` (0, 0, 0) (10,), to sums (10,).

    Modulo 2**64.
    """
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
def _add_common(
    common: Ints, inner: Ints, centre: Floats, points: Floats, first: int, last: int, out: Ints
) -> None:
    """Add to out (last - first, w) what the balls round points first .. last - 1 have in common.

    common (w,): sums of nodes, moments about (0, 0, 0). inner (w,): sums of points, moments about
    `centre`; it is changed.
    """
    if common.shape[0] == 3:
        out += common + inner
        return
    a, b, c = int(centre[0]), int(centre[1]), int(centre[2])
    add_moved(common, a, b, c, inner)
    for q in range(first, last):
        x, y, z = int(points[q, 0]), int(points[q, 1]), int(points[q, 2])
        add_moved(inner, x - a, y - b, z - c, out[q - first])


@kernel
def ball_sums(
    points: Floats,
    values: Ints,
    boxes: Floats,
    nodes: Ints,
    radius2: float,
    first_leaf: int,
    last_leaf: int,
    out: Ints,
) -> None:
    """Fill out (.., w) with the sums over the balls of the points of leaves first .. last_leaf - 1.

    nodes (2 leaves, w): those of the nodes. With w = 10 count and moments, each about the point
    itself (see `node_moments`); with w = 3 those of the values >= 0 (see `node_sums`). values is
    (n,) or, for moments, (0,).
    """
    n, leaves, width = points.shape[0], boxes.shape[0] // 2, nodes.shape[1]
    group, share = min(GROUP, leaves), min(SHARE, leaves)
    radius = np.sqrt(radius2)
    walk, chunk = make_walk(leaves), make_open_leaves()
    columns, room = 4 if width == 3 else 3, CHUNK * LEAF + _WIDTH
    near, band = np.empty((columns, room), np.float64), np.empty((columns, room), np.float64)
    flags, who = np.empty(room, np.int64), np.empty(room, np.int64)
    common = np.empty((group // share, width), np.int64)
    inner = np.empty((group, width), np.int64)
    centres, bands = np.empty((group, 3), np.float64), np.empty((group, 2), np.float64)
    offset = first_leaf * n // leaves
    held = 0
    for asked in range(first_leaf, last_leaf, group):
        n_whole, n_open = look(boxes, (leaves + asked) // group, radius2, walk)
        common[:] = 0
        add_rows(nodes, walk.whole, n_whole, common, 0)
        common[1:] = common[0]
        inner[:] = 0
        out[asked * n // leaves - offset : (asked + group) * n // leaves - offset] = 0
        set_bands(points, boxes, asked, radius, centres, bands)
        for start in range(0, n_open, CHUNK):
            opened = walk.open[start : min(start + CHUNK, n_open)]
            load(boxes, n, opened, chunk)
            for k in range(group):
                if k % share == 0:
                    asking = (leaves + asked + k) // share
                    n_whole, n_rim = sort_out(chunk, opened, boxes, asking, radius2)
                    add_rows(nodes, chunk.whole, n_whole, common, k // share)
                    held = _gather_near(points, values, chunk, n_rim, near)
                _add_rim(centres, k, k + 1, near, held, bands[k, 0], inner, k)
                kept = _fill_up(band, gather_band(near, held, centres, bands, k, flags, who, band))
                first, last = (asked + k) * n // leaves, (asked + k + 1) * n // leaves
                _add_rim(points, first, last, band, kept, radius2, out, first - offset)
        for k in range(group):
            first, last = (asked + k) * n // leaves, (asked + k + 1) * n // leaves
            own = out[first - offset : last - offset]
            _add_common(common[k // share], inner[k], centres[k], points, first, last, own)


@kernel
def variations(sums: Ints, out: Floats) -> None:
    """Fill out (k,) with the surface variation of balls by their count and moments (k, 10)."""
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    for q in range(sums.shape[0]):
        out[q] = variation_of(sums[q], a, v)


@kernel
def variation_of(sums: Ints, a: Floats, v: Floats) -> float:
    """Return l3 / (l1 + l2 + l3) of the covariance of sums (10,); a and v (3, 3) are work space.

    0 where all of the ball lies in one place.
    """
    m = np.float64(sums[0])
    mx, my, mz = sums[1] / m, sums[2] / m, sums[3] / m
    a[0, 0] = max(sums[4] / m - mx * mx, 0.0)
    a[1, 1] = max(sums[5] / m - my * my, 0.0)
    a[2, 2] = max(sums[6] / m - mz * mz, 0.0)
    a[0, 1] = a[1, 0] = sums[7] / m - mx * my
    a[0, 2] = a[2, 0] = sums[8] / m - mx * mz
    a[1, 2] = a[2, 1] = sums[9] / m - my * mz
    total = a[0, 0] + a[1, 1] + a[2, 2]
    if not total > 0.0:
        return 0.0
    share = least_share(a, total)
    if share < 0.0:
        small, middle, large = eigen3(a, v)
        least = max(a[small, small], 0.0)
        share = least / (least + max(a[middle, middle], 0.0) + max(a[large, large], 0.0))
    return share
