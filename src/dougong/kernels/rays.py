"""Rays against triangles: a bounding volume hierarchy and its traversal.

The tree is built top down by the surface area heuristic (Goldsmith and Salmon 1987; binned as in
Wald 2007), triangles are met by Moeller and Trumbore (1997), from both sides. A ray's answer is
the nearest triangle, of equal distances the one with the smallest number, so it depends neither
on the shape of the tree nor on the order of the rays.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BINS = 16
_LEAF = 4
_DEPTH = 512


@kernel
def _bounds(low: Floats, high: Floats, order: Ints, start: int, stop: int, out: Floats) -> None:
    """Fill out (2, 6): the box of the triangles, and the box of their centres (doubled)."""
    out[:, :3] = np.inf
    out[:, 3:] = -np.inf
    for at in range(start, stop):
        i = order[at]
        for k in range(3):
            centre = low[i, k] + high[i, k]
            out[0, k] = min(out[0, k], low[i, k])
            out[0, 3 + k] = max(out[0, 3 + k], high[i, k])
            out[1, k] = min(out[1, k], centre)
            out[1, 3 + k] = max(out[1, 3 + k], centre)


@kernel
def _area(box: Floats) -> float:
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return float(x * y + y * z + z * x)


@kernel
def _best_bin(
    low: Floats,
    high: Floats,
    order: Ints,
    start: int,
    stop: int,
    axis: int,
    zero: float,
    per: float,
) -> int:
    """Return the last bin of the left side by the surface area heuristic."""
    boxes = np.empty((_BINS, 6))
    boxes[:, :3] = np.inf
    boxes[:, 3:] = -np.inf
    counts = np.zeros(_BINS, np.int64)
    for at in range(start, stop):
        i = order[at]
        b = min(_BINS - 1, int((low[i, axis] + high[i, axis] - zero) * per))
        counts[b] += 1
        for k in range(3):
            boxes[b, k] = min(boxes[b, k], low[i, k])
            boxes[b, 3 + k] = max(boxes[b, 3 + k], high[i, k])
    cost = np.zeros(_BINS)
    for side in range(2):
        box = np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf])
        total = 0
        for step in range(_BINS - 1):
            b = _BINS - 1 - step if side else step
            total += counts[b]
            for k in range(3):
                box[k] = min(box[k], boxes[b, k])
                box[3 + k] = max(box[3 + k], boxes[b, 3 + k])
            if total:
                cost[b - 1 if side else b] += total * _area(box)
    best = 0
    for b in range(_BINS - 1):
        if cost[b] < cost[best]:
            best = b
    return best


@kernel
def _partition(low: Floats, high: Floats, order: Ints, start: int, stop: int, boxes: Floats) -> int:
    """Reorder order[start:stop] into two sides and return where the right one starts."""
    axis = 0
    for k in range(1, 3):
        if boxes[1, 3 + k] - boxes[1, k] > boxes[1, 3 + axis] - boxes[1, axis]:
            axis = k
    zero, extent = boxes[1, axis], boxes[1, 3 + axis] - boxes[1, axis]
    if extent <= 0:
        return (start + stop) // 2
    per = _BINS * (1.0 - 1e-9) / extent
    last_left = _best_bin(low, high, order, start, stop, axis, zero, per)
    left = start
    for at in range(start, stop):
        i = order[at]
        if min(_BINS - 1, int((low[i, axis] + high[i, axis] - zero) * per)) <= last_left:
            order[at], order[left] = order[left], i
            left += 1
    return left if start < left < stop else (start + stop) // 2


@kernel
def build_tree(low: Floats, high: Floats, order: Ints, boxes: Floats, links: Ints) -> int:
    """Build the tree over triangle boxes; return its number of nodes.

    low, high (m, 3); order (m,), a permutation, rearranged; boxes (2 m, 6) and links (2 m, 2)
    are filled: an inner node links to its first child (the second follows it) and 0, a leaf to
    its first place in `order` and its count.
    """
    scratch = np.empty((2, 6))
    todo = np.empty((len(order) + 1, 3), np.int64)
    todo[0] = (0, 0, len(order))
    waiting, nodes = 1, 1
    while waiting:
        waiting -= 1
        node, start, stop = todo[waiting]
        _bounds(low, high, order, start, stop, scratch)
        boxes[node] = scratch[0]
        if stop - start <= _LEAF:
            links[node, 0] = start
            links[node, 1] = stop - start
            continue
        middle = _partition(low, high, order, start, stop, scratch)
        links[node, 0] = nodes
        links[node, 1] = 0
        todo[waiting] = (nodes, start, middle)
        todo[waiting + 1] = (nodes + 1, middle, stop)
        waiting += 2
        nodes += 2
    return nodes


@kernel
def _entry(boxes: Floats, node: int, ray: Floats, reach: float) -> float:
    """Return where a ray (origin, direction, 1/direction) enters a box; infinity: it misses."""
    near, far = 0.0, reach
    for k in range(3):
        a = (boxes[node, k] - ray[k]) * ray[6 + k]
        b = (boxes[node, 3 + k] - ray[k]) * ray[6 + k]
        if a > b:
            a, b = b, a
        near = max(near, a)
        far = min(far, b)
    # The box may round away from its own triangle by a few ulp.
    return near if near <= far * (1.0 + 1e-12) + 1e-12 else np.inf


@kernel
def _meet(corners: Floats, at: int, ray: Floats) -> float:
    """Return the distance to the triangle (corner, two edges) along a ray; infinity: none."""
    e = corners[at]
    px = ray[4] * e[8] - ray[5] * e[7]
    py = ray[5] * e[6] - ray[3] * e[8]
    pz = ray[3] * e[7] - ray[4] * e[6]
    det = e[3] * px + e[4] * py + e[5] * pz
    if det == 0.0:
        return np.inf
    tx, ty, tz = ray[0] - e[0], ray[1] - e[1], ray[2] - e[2]
    u = (tx * px + ty * py + tz * pz) / det
    if u < 0.0 or u > 1.0:
        return np.inf
    qx, qy, qz = ty * e[5] - tz * e[4], tz * e[3] - tx * e[5], tx * e[4] - ty * e[3]
    v = (ray[3] * qx + ray[4] * qy + ray[5] * qz) / det
    if v < 0.0 or u + v > 1.0:
        return np.inf
    t = (e[6] * qx + e[7] * qy + e[8] * qz) / det
    return t if t > 0.0 else np.inf


@kernel
def cast_rays(
    tree: Any, rays: Floats, reach: Floats, is_any: bool, distance: Floats, face: Ints
) -> None:
    """Fill the distance to, and the number of, the first triangle each ray meets.

    tree: (boxes, links, corners (m, 9) in tree order, numbers (m,)); rays (n, 6) origin and
    direction, distances counted in lengths of the direction; reach (n,) the farthest of
    interest. distance (n,) and face (n,): infinity and -1 where nothing is met. With `is_any`
    the first triangle found ends the ray (enough to know that something is in the way).
    """
    boxes, links, corners, numbers = tree
    stack = np.empty(_DEPTH, np.int64)
    entries = np.empty(_DEPTH)
    ray = np.empty(9)
    for i in range(len(rays)):
        ray[:6] = rays[i]
        for k in range(3):
            d = ray[3 + k]
            ray[6 + k] = 1.0 / d if abs(d) > 1e-300 else 1e300
        best, found = reach[i], -1
        stack[0] = 0
        entries[0] = _entry(boxes, 0, ray, best)
        waiting = 1
        while waiting:
            waiting -= 1
            node = stack[waiting]
            if entries[waiting] > best:
                continue
            first, count = links[node, 0], links[node, 1]
            if count:
                for at in range(first, first + count):
                    t = _meet(corners, at, ray)
                    if t < best or (t == best and numbers[at] < found):
                        best, found = t, numbers[at]
                if is_any and found >= 0:
                    break
                continue
            near = first
            a, b = _entry(boxes, first, ray, best), _entry(boxes, first + 1, ray, best)
            if b < a:
                a, b, near = b, a, first + 1
            # The farther child waits below the nearer one.
            if b <= best and b < np.inf:
                stack[waiting] = 2 * first + 1 - near
                entries[waiting] = b
                waiting += 1
            if a <= best and a < np.inf:
                stack[waiting] = near
                entries[waiting] = a
                waiting += 1
        distance[i] = best if found >= 0 else np.inf
        face[i] = found
