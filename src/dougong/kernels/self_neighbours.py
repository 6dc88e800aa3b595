"""Exact nearest neighbours of the indexed points themselves, leaf by leaf.

The points of a leaf have nearly the same neighbours. One of them is searched for in the tree; the
triangle inequality then says how far those of the others can be, and every leaf within that is
looked at in one go, without asking the tree again.
"""

from typing import NamedTuple

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.boxtree import LEAF, comes_first
from dougong.kernels.neighbours import descend, insert, scan_leaf

_DEPTH = 64
_MOST = 1024
"""More candidates than this are not worth it: each point is then searched for in the tree."""
_FEW = 4
"""So many candidates for each that is looked for are ranked at once; more are inserted in turn."""
_SLACK = 1.0 + 1e-9
"""What rounding may do to a sum of distances, and more."""


@kernel
def _search(
    points: Floats,
    boxes: Floats,
    i: int,
    leaf: int,
    max_distance2: float,
    stack: Ints,
    bound: Floats,
    places: Ints,
    d2s: Floats,
) -> int:
    """Fill the sorted lists (k,) with the others nearest to point i of a leaf; return how many.

    Climbs from the point's own leaf, so most of the tree is never looked at.
    """
    leaves = boxes.shape[0] // 2
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    d2s[:] = max_distance2
    held = scan_leaf(points, leaf, leaves, x, y, z, i, places, d2s, 0)
    node = leaves + leaf
    while node > 1:
        held = descend(points, boxes, node ^ 1, x, y, z, i, stack, bound, places, d2s, held)
        node >>= 1
    return held


@kernel
def _middle_of(points: Floats, boxes: Floats, node: int, begin: int, end: int) -> int:
    """Return which of points begin .. end - 1 is nearest to the middle of their box."""
    best, place = np.inf, begin
    for i in range(begin, end):
        d2 = 0.0
        for axis in range(3):
            off = points[i, axis] - 0.5 * (boxes[node, axis] + boxes[node, 3 + axis])
            d2 += off * off
        if d2 < best:
            best, place = d2, i
    return place


@kernel
def _distance(points: Floats, i: int, j: int) -> float:
    dx, dy, dz = (
        points[i, 0] - points[j, 0],
        points[i, 1] - points[j, 1],
        points[i, 2] - points[j, 2],
    )
    return float(np.sqrt(dx * dx + dy * dy + dz * dz))


@kernel
def _gap2(boxes: Floats, a: int, b: int) -> float:
    """Return the squared distance between boxes a and b."""
    gap2 = 0.0
    for axis in range(3):
        ahead = boxes[b, axis] - boxes[a, 3 + axis]
        behind = boxes[a, axis] - boxes[b, 3 + axis]
        gap = max(ahead, behind, 0.0)
        gap2 += gap * gap
    return gap2


@kernel
def gather_near(
    points: Floats, boxes: Floats, asked: int, reach2: float, stack: Ints, near: Floats, who: Ints
) -> int:
    """Fill near (3, ..) and who (..) with the points of leaves within reach of leaf node `asked`.

    Returns how many; -1 where there is no room for all. Subtrees are climbed to from the leaf: one
    that is wholly out of reach is asked once.
    """
    n, leaves = points.shape[0], boxes.shape[0] // 2
    held = 0
    node, climbed = asked, asked
    while True:
        stack[0] = node
        height = 1
        while height > 0:
            height -= 1
            at = stack[height]
            if _gap2(boxes, asked, at) > reach2:
                continue
            if at < leaves:
                stack[height] = 2 * at + 1
                stack[height + 1] = 2 * at
                height += 2
                continue
            first, last = (at - leaves) * n // leaves, (at - leaves + 1) * n // leaves
            if held + last - first > who.shape[0]:
                return -1
            for i in range(first, last):
                near[0, held], near[1, held], near[2, held] = (
                    points[i, 0],
                    points[i, 1],
                    points[i, 2],
                )
                who[held] = i
                held += 1
        if climbed == 1:
            return held
        node = climbed ^ 1
        climbed >>= 1


@kernel
def _squares(near: Floats, held: int, x: float, y: float, z: float, out: Floats) -> None:
    """Fill out[:held] with squared distances; no branch, so it is vectorised."""
    for c in range(np.uint64(held)):
        dx, dy, dz = near[0, c] - x, near[1, c] - y, near[2, c] - z
        out[c] = dx * dx + dy * dy + dz * dz


class _Near(NamedTuple):
    """The candidates of a leaf, and room to choose among them."""

    points: Floats
    """(3, `_MOST`)."""
    who: Ints
    """(`_MOST`,) their places."""
    squares: Floats
    chosen: Ints
    """Places of those that are near enough, ..."""
    chosen2: Floats
    """... and how far they are, squared."""
    ranked: Ints
    """The same, nearest first."""
    ranked2: Floats


@kernel
def _within(near: _Near, held: int, limit2: float, skip: int) -> int:
    """List which of near.squares[:held] are at most limit2; no branch, for none could be foreseen.

    Point `skip` is none of them. Returns how many.
    """
    count = 0
    for c in range(held):
        near.chosen[count] = near.who[c]
        near.chosen2[count] = near.squares[c]
        count += (near.squares[c] <= limit2) & (near.who[c] != skip)
    return count


@kernel
def _below(values: Floats, count: int, limit: float) -> int:
    """Return how many of values[:count] are less than limit; no branch, so it is vectorised."""
    below = 0
    for c in range(np.uint64(count)):
        below += values[c] < limit
    return below


@kernel
def _rank(points: Floats, near: _Near, count: int, k: int) -> None:
    """Put the `count` chosen in order of their distance, ties among the first k by content.

    The rank of each is counted: where they are few, twice as fast as inserting one by one.
    """
    near.ranked[:count] = -1
    for c in range(count):
        d2 = near.chosen2[c]
        rank = _below(near.chosen2, count, d2)
        while near.ranked[rank] >= 0:
            rank += 1
        near.ranked[rank], near.ranked2[rank] = near.chosen[c], d2
    for last in range(1, count):
        at = last
        while at > 0 and near.ranked2[at - 1] == near.ranked2[at]:
            before, i = near.ranked[at - 1], near.ranked[at]
            if not comes_first(points, i, before):
                break
            near.ranked[at - 1], near.ranked[at] = i, before
            at -= 1
        if last >= k and near.ranked2[last] > near.ranked2[k - 1]:
            break


@kernel
def _select(points: Floats, near: _Near, count: int, places: Ints, d2s: Floats) -> int:
    """Keep the nearest of the chosen in the sorted lists (k,), whose d2s say how far they may be.

    Returns how many.
    """
    k = d2s.shape[0]
    found: int = 0
    if count <= _FEW * k:
        _rank(points, near, count, k)
        found = min(count, k)
        places[:found], d2s[:found] = near.ranked[:found], near.ranked2[:found]
        return found
    worst = d2s[k - 1]
    for c in range(count):
        d2, i = near.chosen2[c], near.chosen[c]
        if d2 > worst:
            continue
        if d2 == worst and found == k and comes_first(points, places[k - 1], i):
            continue
        found = insert(points, places, d2s, found, i, d2)
        worst = d2s[k - 1]
    return found


@kernel
def _finish(places: Ints, d2s: Floats, held: int) -> None:
    """Say where fewer than k were found."""
    places[held:] = -1
    d2s[held:] = np.inf


@kernel
def _choose(
    points: Floats,
    near: _Near,
    held: int,
    i: int,
    begin: int,
    stop: int,
    known_m: Floats,
    max_distance2: float,
    places: Ints,
    d2s: Floats,
) -> int:
    """Fill the sorted lists (k,) with the nearest of the candidates to point i; return how many.

    known_m (stop - begin,): how far the k-th neighbour of points begin .. stop - 1 is; inf where
    it is not known. They say how far this one's can be, for their neighbours are in its reach.
    """
    reach = np.inf
    for j in range(begin, stop):
        reach = min(reach, known_m[j - begin] + _distance(points, j, i))
    limit2 = min(reach * reach * _SLACK, max_distance2)
    d2s[:] = limit2
    _squares(near.points, held, points[i, 0], points[i, 1], points[i, 2], near.squares)
    count = _within(near, held, limit2, i)
    return _select(points, near, count, places, d2s)


@kernel
def _reach2(
    points: Floats, first: int, begin: int, end: int, known_m: float, max_distance2: float
) -> float:
    """Return the squared distance within which all k neighbours of points begin .. end - 1 lie."""
    reach = 0.0
    for i in range(begin, end):
        reach = max(reach, known_m + _distance(points, first, i))
    return float(min(reach * reach * _SLACK, max_distance2))


@kernel
def self_knn(
    points: Floats,
    boxes: Floats,
    max_distance2: float,
    first_leaf: int,
    last_leaf: int,
    places: Ints,
    d2s: Floats,
) -> None:
    """Find the k nearest *other* points of the sorted points in leaves first_leaf .. last_leaf - 1.

    Rows follow the sorted order, from the first point of first_leaf: places and d2s (m, k), nearest
    first; -1 and inf where fewer than k are in reach (max_distance2, inclusive).
    """
    n, k, leaves = points.shape[0], d2s.shape[1], boxes.shape[0] // 2
    stack, bound = np.empty(_DEPTH, np.int64), np.empty(_DEPTH, np.float64)
    near = _Near(
        np.empty((3, _MOST), np.float64),
        np.empty(_MOST, np.int64),
        np.empty(_MOST, np.float64),
        np.empty(_MOST, np.int64),
        np.empty(_MOST, np.float64),
        np.empty(_MOST, np.int64),
        np.empty(_MOST, np.float64),
    )
    known_m = np.empty(LEAF, np.float64)
    offset = first_leaf * n // leaves
    for leaf in range(first_leaf, last_leaf):
        begin, end = leaf * n // leaves, (leaf + 1) * n // leaves
        first = _middle_of(points, boxes, leaves + leaf, begin, end)
        known_m[:] = np.inf
        held = -1
        for turn in range(begin, end):
            # The middle one comes first, then the others in their order.
            i = first if turn == begin else turn - 1 if turn <= first else turn
            row = i - offset
            if held < 0:
                found = _search(
                    points, boxes, i, leaf, max_distance2, stack, bound, places[row], d2s[row]
                )
            else:
                found = _choose(
                    points, near, held, i, begin, end, known_m, max_distance2, places[row], d2s[row]
                )
            _finish(places[row], d2s[row], found)
            known_m[i - begin] = np.sqrt(d2s[row, k - 1])
            if i == first:
                reach2 = _reach2(points, i, begin, end, known_m[i - begin], max_distance2)
                if reach2 < np.inf:
                    held = gather_near(
                        points, boxes, leaves + leaf, reach2, stack, near.points, near.who
                    )
