"""A balanced kd-tree of tight boxes, stored without a pointer.

Node 1 is the root, the children of node i are 2i and 2i + 1, and nodes leaves .. 2 leaves - 1 are
the leaves, with leaves a power of two. Leaf number l holds the points
(l n) // leaves .. ((l + 1) n) // leaves of the order, so no leaf is empty and no pointer is stored.
boxes (2 leaves, 6) holds the low corner, then the high corner, of each node's points. Boxes are
tight, so any order gives right answers, and density or distant points do not matter.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel

LEAF = 16
"""At most this many points in a leaf (and at least half as many)."""


@kernel
def _swap(points: Floats, places: Ints, i: np.uint64, j: np.uint64) -> None:
    """Exchange points i and j, and their places."""
    for axis in range(3):
        points[i, axis], points[j, axis] = points[j, axis], points[i, axis]
    places[i], places[j] = places[j], places[i]


@kernel
def _shuffled(state: np.uint64) -> np.uint64:
    """Return the random number that follows `state` (xorshift, Marsaglia 2003)."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state


@kernel
def _select(points: Floats, places: Ints, first: int, last: int, middle: int, axis: int) -> None:
    """Reorder points first .. last - 1 so that none before `middle` is larger along `axis`.

    Quickselect (Hoare 1961); pivots are the median of three drawn places, so no pattern of a
    scanner makes it slow.
    """
    low, high = first, last - 1
    along = np.uint64(axis)
    state = np.uint64(88172645463325252)
    while low < high:
        lowest, span = np.uint64(low), np.uint64(high - low + 1)
        state = _shuffled(state)
        a = points[lowest + state % span, along]
        state = _shuffled(state)
        b = points[lowest + state % span, along]
        state = _shuffled(state)
        c = points[lowest + state % span, along]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            # Unsigned places: signed ones are asked each time whether they count from the end.
            while points[np.uint64(i), along] < pivot:
                i += 1
            while points[np.uint64(j), along] > pivot:
                j -= 1
            if i <= j:
                _swap(points, places, np.uint64(i), np.uint64(j))
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@kernel
def _fill_box(points: Floats, first: int, last: int, boxes: Floats, node: int) -> None:
    """Fill the box of `node` from points first .. last - 1."""
    low_x = low_y = low_z = np.inf
    high_x = high_y = high_z = -np.inf
    for i in range(np.uint64(first), np.uint64(last)):
        low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
        low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
        low_z, high_z = min(low_z, points[i, 2]), max(high_z, points[i, 2])
    boxes[node, 0], boxes[node, 1], boxes[node, 2] = low_x, low_y, low_z
    boxes[node, 3], boxes[node, 4], boxes[node, 5] = high_x, high_y, high_z


@kernel
def points_under(node: int, n: int) -> tuple[int, int]:
    """Return which of n points, first .. last - 1 of the order, lie under `node`."""
    level = 1
    while 2 * level <= node:
        level *= 2
    return (node - level) * n // level, (node - level + 1) * n // level


@kernel
def split(points: Floats, places: Ints, boxes: Floats, root: int, below: int) -> None:
    """Order points and places (n,) under node `root` by halving at medians along longest sides.

    Nodes numbered `below` and up are left for other calls: their boxes are not filled. With
    below = 2 leaves the whole subtree of `root` is done.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(64, np.int64)
    stack[0] = root
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        first, last = points_under(node, n)
        _fill_box(points, first, last, boxes, node)
        if node >= leaves:
            continue
        axis = 0
        for other in range(1, 3):
            if (
                boxes[node, 3 + other] - boxes[node, other]
                > boxes[node, 3 + axis] - boxes[node, axis]
            ):
                axis = other
        _, middle = points_under(2 * node, n)
        _select(points, places, first, last, middle, axis)
        if 2 * node < below:
            stack[height] = 2 * node + 1
            stack[height + 1] = 2 * node
            height += 2


@kernel
def box_distance2(boxes: Floats, node: int, x: float, y: float, z: float) -> float:
    """Return the squared distance from (x, y, z) to the box of `node`, 0 inside.

    Rounding is monotone, so this never exceeds the squared distance of a point of the node
    worked out as dx dx + dy dy + dz dz: pruning by it is exact.
    """
    dx = max(boxes[node, 0] - x, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, z - boxes[node, 5])
    dx = max(dx, 0.0)
    dy = max(dy, 0.0)
    dz = max(dz, 0.0)
    distance2: float = dx * dx + dy * dy + dz * dz
    return distance2


@kernel
def box_far_distance2(boxes: Floats, node: int, x: float, y: float, z: float) -> float:
    """Return the squared distance from (x, y, z) to the farthest corner of the box of `node`."""
    dx = max(boxes[node, 3] - x, x - boxes[node, 0])
    dy = max(boxes[node, 4] - y, y - boxes[node, 1])
    dz = max(boxes[node, 5] - z, z - boxes[node, 2])
    distance2: float = dx * dx + dy * dy + dz * dz
    return distance2


@kernel
def comes_first(points: Floats, a: int, b: int) -> bool:
    """Say whether sorted point a precedes b by content: x, then y, then z, then place."""
    for axis in range(3):
        if points[a, axis] != points[b, axis]:
            return bool(points[a, axis] < points[b, axis])
    return a < b
