"""Points joined into clusters at distances of their own, and the shape of one: the kernels.

Points come in the order of a box tree. Which points are joined depends on distances alone, so no
order, offset or tile changes it.
"""

import math

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.boxtree import (
    box_distance2,
    box_far_distance2,
    comes_first,
    points_under,
)
from dougong.kernels.disjoint import join, root_of

_DEPTH = 64


@kernel
def node_ends(n: int, ends: Ints) -> None:
    """Fill ends (2 leaves,): one past the last of n points under each node."""
    for node in range(1, ends.shape[0]):
        _, ends[node] = points_under(node, n)


@kernel
def _refresh(parent: Ints, ends: Ints, label: Ints) -> None:
    """Fill label (2 leaves,): a point of each node whose points are all joined; -1 where not."""
    leaves = label.shape[0] // 2
    n = parent.shape[0]
    for node in range(2 * leaves - 1, 0, -1):
        if node < leaves:
            a, b = label[2 * node], label[2 * node + 1]
            is_one = a >= 0 and b >= 0 and root_of(parent, a) == root_of(parent, b)
            label[node] = root_of(parent, a) if is_one else -1
            continue
        first = (node - leaves) * n // leaves
        root = root_of(parent, first)
        for i in range(first + 1, ends[node]):
            if root_of(parent, i) != root:
                root = -1
                break
        label[node] = root


@kernel
def _join_small_nodes(boxes: Floats, least2: float, parent: Ints) -> None:
    """Join all points of nodes whose box has a squared diagonal of at most `least2`."""
    n = parent.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(_DEPTH, np.int64)
    stack[0] = 1
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        diagonal2 = 0.0
        for axis in range(3):
            diagonal2 += (boxes[node, 3 + axis] - boxes[node, axis]) ** 2
        if diagonal2 <= least2:
            first, last = points_under(node, n)
            for i in range(first + 1, last):
                join(parent, first, i)
        elif node < leaves:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2


@kernel
def link_within(points: Floats, boxes: Floats, gap: Floats, least: float, parent: Ints) -> None:
    """Join, in parent (n,), points no farther apart than the smaller of their gaps (n,).

    gap is at least `least` everywhere. parent comes as 0 .. n - 1 and leaves with every point's
    root. What is joined already is not looked at again, so dense surfaces cost little.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    ends = np.zeros(2 * leaves, np.int64)
    node_ends(n, ends)
    # A hair less than the rounding of a diagonal.
    _join_small_nodes(boxes, least * least * (1.0 - 1e-12), parent)
    label = np.full(2 * leaves, -1, np.int64)
    stack = np.empty(_DEPTH, np.int64)
    again = max(n // 16, 1024)
    for i in range(n):
        if i % again == 0:
            _refresh(parent, ends, label)
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        reach2 = gap[i] * gap[i]
        root = root_of(parent, i)
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            if ends[node] <= i or box_distance2(boxes, node, x, y, z) > reach2:
                continue
            if label[node] >= 0 and root_of(parent, label[node]) == root:
                continue
            if node < leaves:
                stack[height] = 2 * node
                stack[height + 1] = 2 * node + 1
                height += 2
                continue
            for j in range(max(i + 1, (node - leaves) * n // leaves), ends[node]):
                if root_of(parent, j) == root:
                    continue
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                if dx * dx + dy * dy + dz * dz <= min(reach2, gap[j] * gap[j]):
                    join(parent, i, j)
                    root = root_of(parent, i)
    for i in range(n):
        parent[i] = root_of(parent, i)


@kernel
def _farthest(points: Floats, boxes: Floats, ends: Ints, i: int, radius2: float) -> int:
    """Return the point within the ball round point i that is farthest from it; ties by content."""
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(_DEPTH, np.int64)
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    best, best2 = i, -1.0
    stack[0] = 1
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        if box_distance2(boxes, node, x, y, z) > radius2:
            continue
        # A hair more, for the rounding of the corner.
        if box_far_distance2(boxes, node, x, y, z) * (1.0 + 1e-12) < best2:
            continue
        if node < leaves:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2
            continue
        for j in range((node - leaves) * n // leaves, ends[node]):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            d2 = dx * dx + dy * dy + dz * dz
            if d2 > radius2 or d2 < best2:
                continue
            if d2 > best2 or comes_first(points, j, best):
                best, best2 = j, d2
    return best


@kernel
def _is_thin(
    points: Floats,
    boxes: Floats,
    ends: Ints,
    i: int,
    u: Floats,
    radius2: float,
    width2: float,
    most: int,
) -> bool:
    """Say whether at most `most` points of the ball round i lie off the line along u (3,)."""
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(_DEPTH, np.int64)
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    off = 0
    stack[0] = 1
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        if box_distance2(boxes, node, x, y, z) > radius2:
            continue
        if node < leaves:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2
            continue
        for j in range((node - leaves) * n // leaves, ends[node]):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            d2 = dx * dx + dy * dy + dz * dz
            along = dx * u[0] + dy * u[1] + dz * u[2]
            if d2 <= radius2 and d2 - along * along > width2:
                off += 1
                if off > most:
                    return False
    return True


@kernel
def thin_lines(
    points: Floats,
    boxes: Floats,
    asked: Ints,
    held: Ints,
    radius: float,
    width: float,
    least: float,
    steepest: float,
    share: float,
    line: Floats,
) -> None:
    """Fill line (m, 3): the direction of the thin line that an asked point (m,) lies on, else NaN.

    The line runs to the farthest point of the ball of `radius`, which must be `least` away and no
    steeper than `steepest` (sine). Of the held (m,) points in the ball at most `share` may lie more
    than `width` off it.
    """
    leaves = boxes.shape[0] // 2
    ends = np.zeros(2 * leaves, np.int64)
    node_ends(points.shape[0], ends)
    u = np.empty(3, np.float64)
    for q in range(asked.shape[0]):
        i = asked[q]
        line[q, :] = np.nan
        far = _farthest(points, boxes, ends, i, radius * radius)
        length2 = 0.0
        for axis in range(3):
            u[axis] = points[far, axis] - points[i, axis]
            length2 += u[axis] * u[axis]
        length = math.sqrt(length2)
        if length < least:
            continue
        u /= length
        if abs(u[2]) > steepest:
            continue
        most = int(share * held[q])
        if _is_thin(points, boxes, ends, i, u, radius * radius, width * width, most):
            line[q, :] = u


@kernel
def runs_along(
    points: Floats,
    boxes: Floats,
    line: Floats,
    radius: float,
    width: float,
    spread: float,
    step: float,
    start: int,
    stop: int,
    run: Floats,
) -> None:
    """Fill run (n,): how far others lie behind one another along each point's line (n, 3), metres.

    Along the better of both directions, counted while no `step` along it is empty. Others count
    within `radius`, off the line by at most `width` + `spread` per metre.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    ends = np.zeros(2 * leaves, np.int64)
    node_ends(n, ends)
    stack = np.empty(_DEPTH, np.int64)
    steps = int(radius / step)
    hit = np.zeros((2, steps + 1), np.bool_)
    for i in range(start, stop):
        hit[:, :] = False
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            if box_distance2(boxes, node, x, y, z) > radius * radius:
                continue
            if node < leaves:
                stack[height] = 2 * node
                stack[height + 1] = 2 * node + 1
                height += 2
                continue
            for j in range((node - leaves) * n // leaves, ends[node]):
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                along = dx * line[i, 0] + dy * line[i, 1] + dz * line[i, 2]
                far = abs(along)
                off = width + spread * far
                d2 = dx * dx + dy * dy + dz * dz
                if d2 <= radius * radius and d2 - far * far <= off * off:
                    hit[0 if along >= 0.0 else 1, min(int(far / step), steps)] = True
        longest = 0
        for side in range(2):
            reached = 1
            while reached <= steps and hit[side, reached]:
                reached += 1
            longest = max(longest, reached)
        run[i] = longest * step if longest > 1 else 0.0


@kernel
def _turns_left(hull: Ints, size: int, points: Floats, j: int) -> bool:
    a, b = hull[size - 2], hull[size - 1]
    left = (points[b, 0] - points[a, 0]) * (points[j, 1] - points[a, 1])
    right = (points[b, 1] - points[a, 1]) * (points[j, 0] - points[a, 0])
    return bool(left > right)


@kernel
def plan_hull(points: Floats, hull: Ints) -> int:
    """Fill hull with the corners in plan of points (n, 3) sorted by x, then y; return how many.

    Andrew's monotone chain; hull has room for 2 n.
    """
    n = points.shape[0]
    size = 0
    for i in range(n):
        while size >= 2 and not _turns_left(hull, size, points, i):
            size -= 1
        hull[size] = i
        size += 1
    lower = size + 1
    for i in range(n - 2, -1, -1):
        while size >= lower and not _turns_left(hull, size, points, i):
            size -= 1
        hull[size] = i
        size += 1
    return max(size - 1, 1)


@kernel
def least_rectangle(points: Floats, hull: Ints) -> tuple[float, float]:
    """Return the sides, longer first, of the least rectangle in plan round the corners `hull`."""
    size = hull.shape[0]
    best = np.inf
    length = width = 0.0
    for k in range(size):
        a, b = hull[k], hull[(k + 1) % size]
        ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        norm = math.sqrt(ux * ux + uy * uy)
        if norm == 0.0:
            continue
        ux, uy = ux / norm, uy / norm
        low = low_across = np.inf
        high = high_across = -np.inf
        for c in hull:
            dx, dy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
            along, across = dx * ux + dy * uy, dy * ux - dx * uy
            low, high = min(low, along), max(high, along)
            low_across, high_across = min(low_across, across), max(high_across, across)
        one, other = high - low, high_across - low_across
        if one * other < best:
            best = one * other
            length, width = max(one, other), min(one, other)
    return length, width
