"""Exact nearest neighbours over a box tree (see `boxtree`).

Equal distances are ranked by content (x, then y, then z), so no answer depends on the order in
which the points came; only exact duplicates are told apart by their place.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import inlined_kernel, kernel
from dougong.kernels.boxtree import (
    box_distance2,
    box_far_distance2,
    comes_first,
    points_under,
)

DEPTH = 64
"""Nodes that a search can have before it, at most."""


@inlined_kernel
def next_leaf(
    boxes: Floats,
    x: float,
    y: float,
    z: float,
    limit2: float,
    stack: Ints,
    bound: Floats,
    height: int,
) -> tuple[int, int]:
    """Return the next leaf within sqrt(limit2), inclusive, of x, y, z, and what the stack holds.

    -1 where none is left. Nearest children first. stack and bound (DEPTH,): nodes still to visit
    and their squared distances, `height` of them; the caller puts the root there.
    """
    leaves = boxes.shape[0] // 2
    while height > 0:
        height -= 1
        if bound[height] > limit2:
            continue
        node = stack[height]
        while node < leaves:
            left = box_distance2(boxes, 2 * node, x, y, z)
            right = box_distance2(boxes, 2 * node + 1, x, y, z)
            near = 2 * node if left <= right else 2 * node + 1
            far = max(left, right)
            if far <= limit2:
                stack[height] = 4 * node + 1 - near
                bound[height] = far
                height += 1
            if min(left, right) > limit2:
                break
            node = near
        if node >= leaves:
            return node - leaves, height
    return -1, 0


@kernel
def nearest_one(
    points: Floats,
    boxes: Floats,
    x: float,
    y: float,
    z: float,
    max_distance2: float,
    stack: Ints,
    bound: Floats,
) -> tuple[int, float]:
    """Return the nearest sorted point to x, y, z and its squared distance; -1 and inf if none.

    Within max_distance2, inclusive. stack and bound (DEPTH,): room to work in.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    best = max_distance2
    place = -1
    stack[0] = 1
    bound[0] = box_distance2(boxes, 1, x, y, z)
    height = 1
    while True:
        leaf, height = next_leaf(boxes, x, y, z, best, stack, bound, height)
        if leaf < 0:
            break
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            dx = points[i, 0] - x
            dy = points[i, 1] - y
            dz = points[i, 2] - z
            d2 = dx * dx + dy * dy + dz * dz
            if d2 <= best and (d2 < best or place < 0 or comes_first(points, i, place)):
                best = d2
                place = i
    return place, best if place >= 0 else np.inf


@kernel
def nearest(
    points: Floats,
    boxes: Floats,
    queries: Floats,
    max_distance2: float,
    out_place: Ints,
    out_distance2: Floats,
) -> None:
    """Find the nearest sorted point of each query (m, 3), within max_distance2 inclusive.

    points (n, 3), boxes (2 leaves, 6); out_place (m,) int64, -1 where none is in reach;
    out_distance2 (m,), inf where none is.
    """
    stack = np.empty(DEPTH, np.int64)
    bound = np.empty(DEPTH, np.float64)
    for q in range(queries.shape[0]):
        out_place[q], out_distance2[q] = nearest_one(
            points,
            boxes,
            queries[q, 0],
            queries[q, 1],
            queries[q, 2],
            max_distance2,
            stack,
            bound,
        )


@kernel
def insert(points: Floats, places: Ints, d2s: Floats, held: int, i: int, d2: float) -> int:
    """Put point i at squared distance d2 into the sorted lists (k,); return how many they hold."""
    k = d2s.shape[0]
    at = held if held < k else k - 1
    while at > 0 and d2s[at - 1] > d2:
        d2s[at] = d2s[at - 1]
        places[at] = places[at - 1]
        at -= 1
    while at > 0 and d2s[at - 1] == d2 and comes_first(points, i, places[at - 1]):
        d2s[at] = d2s[at - 1]
        places[at] = places[at - 1]
        at -= 1
    d2s[at] = d2
    places[at] = i
    return held + 1 if held < k else k


@kernel
def scan_leaf(
    points: Floats,
    leaf: int,
    leaves: int,
    x: float,
    y: float,
    z: float,
    skip: int,
    places: Ints,
    d2s: Floats,
    held: int,
) -> int:
    """Offer the points of a leaf, but for place `skip`, to the sorted lists of nearest ones."""
    n = points.shape[0]
    last = d2s.shape[0] - 1
    worst = d2s[last]
    for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
        dx = points[i, 0] - x
        dy = points[i, 1] - y
        dz = points[i, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 > worst or i == skip:
            continue
        if d2 == worst and held > last and comes_first(points, places[last], i):
            continue
        held = insert(points, places, d2s, held, i, d2)
        worst = d2s[last]
    return held


@kernel
def descend(
    points: Floats,
    boxes: Floats,
    root: int,
    x: float,
    y: float,
    z: float,
    skip: int,
    stack: Ints,
    bound: Floats,
    places: Ints,
    d2s: Floats,
    held: int,
) -> int:
    """Offer every point under node `root` that may still count; nearest children first."""
    leaves = boxes.shape[0] // 2
    last = d2s.shape[0] - 1
    stack[0] = root
    bound[0] = box_distance2(boxes, root, x, y, z)
    height = 1
    # With k copies of the query at hand, more of them have the same coordinates. Without this a
    # heap of n duplicates would cost n visits for each of them.
    while d2s[last] > 0.0 or held <= last:
        leaf, height = next_leaf(boxes, x, y, z, d2s[last], stack, bound, height)
        if leaf < 0:
            break
        held = scan_leaf(points, leaf, leaves, x, y, z, skip, places, d2s, held)
    return held


@kernel
def knn(
    points: Floats,
    boxes: Floats,
    queries: Floats,
    max_distance2: float,
    places: Ints,
    d2s: Floats,
) -> None:
    """Find the k nearest sorted points of each query (m, 3), nearest first.

    places (m, k) int64 and d2s (m, k) are filled; -1 and inf where fewer than k are in reach
    (max_distance2, inclusive).
    """
    stack = np.empty(DEPTH, np.int64)
    bound = np.empty(DEPTH, np.float64)
    k = d2s.shape[1]
    near = np.empty(k, np.int64)
    near_d2 = np.empty(k, np.float64)
    for q in range(queries.shape[0]):
        near_d2[:] = max_distance2
        held = descend(
            points,
            boxes,
            1,
            queries[q, 0],
            queries[q, 1],
            queries[q, 2],
            -1,
            stack,
            bound,
            near,
            near_d2,
            0,
        )
        places[q, :held] = near[:held]
        d2s[q, :held] = near_d2[:held]
        places[q, held:] = -1
        d2s[q, held:] = np.inf


@kernel
def count_within(points: Floats, boxes: Floats, queries: Floats, radius2: float, out: Ints) -> None:
    """Count the sorted points within sqrt(radius2), inclusive, of each query (m, 3).

    out (m,) int64. Nodes that lie wholly inside are counted without looking at their points.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(DEPTH, np.int64)
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        total = 0
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            if box_distance2(boxes, node, x, y, z) > radius2:
                continue
            first, last = points_under(node, n)
            if box_far_distance2(boxes, node, x, y, z) <= radius2:
                total += last - first
            elif node < leaves:
                stack[height] = 2 * node
                stack[height + 1] = 2 * node + 1
                height += 2
            else:
                for i in range(first, last):
                    dx = points[i, 0] - x
                    dy = points[i, 1] - y
                    dz = points[i, 2] - z
                    total += dx * dx + dy * dy + dz * dz <= radius2
        out[q] = total


@kernel
def sum_distances(
    points: Floats,
    boxes: Floats,
    radius2: float,
    steps_per_m: float,
    start: int,
    stop: int,
    counts: Ints,
    sums: Ints,
) -> None:
    """Sum the distances of sorted points start .. stop - 1 to the others within sqrt(radius2).

    counts (n,) and sums (n,) are filled in sorted order; distances are summed as whole steps of
    1 / steps_per_m metres, so the sum is exact in any order.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(DEPTH, np.int64)
    for q in range(start, stop):
        x, y, z = points[q, 0], points[q, 1], points[q, 2]
        total = 0
        count = -1
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            near2 = box_distance2(boxes, node, x, y, z)
            if near2 > radius2:
                continue
            if boxes[node, 0] == boxes[node, 3] and (
                boxes[node, 1] == boxes[node, 4] and boxes[node, 2] == boxes[node, 5]
            ):
                # A heap of duplicates counts as one: all are equally far.
                first, last = points_under(node, n)
                copies = last - first
                count += copies
                total += copies * int(np.sqrt(near2) * steps_per_m + 0.5)
                continue
            if node < leaves:
                stack[height] = 2 * node
                stack[height + 1] = 2 * node + 1
                height += 2
                continue
            leaf = node - leaves
            for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
                dx = points[i, 0] - x
                dy = points[i, 1] - y
                dz = points[i, 2] - z
                d2 = dx * dx + dy * dy + dz * dz
                if d2 <= radius2:
                    count += 1
                    total += int(np.sqrt(d2) * steps_per_m + 0.5)
        counts[q] = count
        sums[q] = total
