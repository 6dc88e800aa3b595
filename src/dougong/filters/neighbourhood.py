"""Neighbours and normals: one index over a cloud, asked as often as needed.

`build_index` halves the points at medians into a balanced tree of tight boxes, so neither density
(100 : 1 within one scan) nor a single far point costs anything. All
answers are exact; equal distances are ranked by content (x, y, z), so no answer depends on point
order, thread count or, since work is in local metres, on the coordinates' size.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._boxes import corners_of
from dougong._checks import as_points
from dougong._sorting import Scalar, unsorted
from dougong.errors import InputError
from dougong.kernels import boxtree, moments, neighbours, order, self_neighbours
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

_SUBTREES = 32
"""Parts of the tree that are built apart, on the threads."""
_BLOCK = 32_768
"""Queries per task: fixed, so results do not depend on the thread count."""
_FEW_LEAVES = 16
"""So many leaves are passed over or looked at together where only some points are wanted."""
_SEARCHES = 4096
"""The same for `nearest`, which a fit asks many times for few points: enough work for a task."""


class Neighbourhood(NamedTuple):
    """An index over n points; build it with `build_index`."""

    points: Points
    """(n, 3) metres, in sorted order."""
    order: Index
    """(n,) place in the caller's array of each sorted point."""
    boxes: NDArray[np.float64]
    """(2 leaves, 6) low and high corner of every node (see `kernels.boxtree`)."""

    def unsorted(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return `values` (n, ...) of the points in sorted order in the caller's order."""
        return unsorted(values, self.order)


class Surface(NamedTuple):
    """What the neighbourhood of each of n points looks like."""

    normals: Points
    """(n, 3) unit; upward (level ones towards +x, then +y). NaN with fewer than 2 neighbours."""
    variation: Values
    """(n,) surface variation l3 / (l1 + l2 + l3), 0 .. 1/3 (METHOD.md eq. 3)."""
    planarity: Values
    """(n,) (l2 - l3) / l1, 0 .. 1."""


def spatial_order(points: Points) -> Index:
    """Return the places of `points` (n, 3) along a Morton curve that refines where it must.

    The curve has 2**21 cells along the longest side of the points' box. Where a far point makes
    such a cell hold many points, those are sorted again within their own box.
    """
    n = len(points)
    places = np.arange(n, dtype=np.int64)
    if n < 2:
        return places
    low, high = corners_of(points)
    edge = max(float((high - low).max()), 1e-9)
    keys = np.empty(n, np.uint64)
    for_blocks(
        n,
        1 << 18,
        lambda start, stop: order.morton_keys(
            points, low, edge * 2.0**-order.KEY_BITS, start, stop, keys
        ),
    )
    order.radix_argsort(
        keys, 3 * order.KEY_BITS, places, np.empty(n, np.int64), np.empty(n, np.uint64)
    )
    starts = np.flatnonzero(np.concatenate(([True], keys[1:] != keys[:-1])))
    _sort_crowded(points, places, starts)
    return places


def _sort_crowded(points: Points, places: Index, starts: Index) -> None:
    """Sort again, in place, the runs of `places` that begin at `starts` and are too long."""
    stops = np.append(starts[1:], len(places))
    # A run as long as the whole is either one place repeated or too small to be told apart.
    is_crowded = (stops - starts > 2 * boxtree.LEAF) & (stops - starts < len(places))
    for first, last in zip(starts[is_crowded], stops[is_crowded], strict=True):
        run = places[first:last]
        inside = points[run]
        if (inside != inside[0]).any():
            places[first:last] = run[spatial_order(inside)]


def build_index(points: ArrayLike) -> Neighbourhood:
    """Return an index over `points` (n, 3) metres. O(n log n), about 45 bytes per point."""
    return sort_into_index(as_points(points).copy())


def sort_into_index(ordered: Points) -> Neighbourhood:
    """Return an index over the points `ordered` (n, 3), finite, which are sorted in place."""
    n = len(ordered)
    places = np.arange(n, dtype=np.int64)
    leaves = 1
    while n > leaves * boxtree.LEAF:
        leaves *= 2
    boxes = np.full((2 * leaves, 6), np.inf)
    top = min(leaves, _SUBTREES)

    def split(level: int, below: int) -> None:
        def task(first: int, last: int) -> None:
            for node in range(level + first, level + last):
                boxtree.split(ordered, places, boxes, node, below)

        for_blocks(level, 1, task)

    if n:
        for depth in range(top.bit_length() - 1):
            split(1 << depth, 2 << depth)
        split(top, 2 * leaves)
    return Neighbourhood(ordered, places, boxes)


def _check_distance(value: float, name: str) -> float:
    if not value > 0:
        raise InputError(f"{name} must be a positive number of metres, got {value}.")
    return float(value) ** 2


def _visiting_order(queries: Points) -> Index:
    """Return the order in which to answer `queries`: along the curve, so the tree stays cached."""
    if len(queries) <= _BLOCK:
        return np.arange(len(queries), dtype=np.int64)
    return spatial_order(queries)


def _back(index: Neighbourhood, places: Index) -> Index:
    """Return places in the caller's array for `places` in sorted order; -1 stays -1."""
    found = places >= 0
    result = np.full(places.shape, -1, np.int64)
    result[found] = index.order[places[found]]
    return result


def nearest(
    index: Neighbourhood, queries: ArrayLike, max_distance_m: float = np.inf
) -> tuple[Index, Values]:
    """Return the nearest indexed point of every query.

    Parameters
    ----------
    index : Neighbourhood
    queries : array_like, shape (m, 3)
        Metres, in the frame of the indexed points.
    max_distance_m : float
        Nothing farther is found; inclusive.

    Returns
    -------
    index : ndarray, shape (m,)
        Places in the array given to `build_index`; -1 where nothing is in reach.
    distance_m : ndarray, shape (m,)
        Inf where nothing is in reach.

    Raises
    ------
    InputError
        `queries` is not (m, 3) or not finite, or `max_distance_m` is not positive.
    """
    limit2 = _check_distance(max_distance_m, "max_distance_m")
    asked = as_points(queries, "queries")
    sequence = _visiting_order(asked)
    found = np.full(len(asked), -1, np.int64)
    distance = np.full(len(asked), np.inf)

    def task(start: int, stop: int) -> None:
        rows = sequence[start:stop]
        places = np.empty(len(rows), np.int64)
        distance2 = np.empty(len(rows))
        neighbours.nearest(index.points, index.boxes, asked[rows], limit2, places, distance2)
        found[rows] = _back(index, places)
        distance[rows] = np.sqrt(distance2)

    if len(index.points):
        for_blocks(len(asked), _SEARCHES, task)
    return found, distance


def knn(
    index: Neighbourhood,
    queries: ArrayLike | None,
    k: int,
    max_distance_m: float = np.inf,
) -> tuple[Index, Values]:
    """Return the k nearest indexed points of every query, nearest first.

    Parameters
    ----------
    index : Neighbourhood
    queries : array_like, shape (m, 3), or None
        None asks for the indexed points themselves, in the caller's order: each point's k nearest
        *other* points (duplicates of it are others, at distance 0).
    k : int
        At least 1.
    max_distance_m : float
        Nothing farther is found; inclusive.

    Returns
    -------
    index : ndarray, shape (m, k)
        Places in the array given to `build_index`; -1 where there are fewer.
    distance_m : ndarray, shape (m, k)
        Inf where there are fewer.

    Raises
    ------
    InputError
        `queries` is not (m, 3) or not finite, `k` is below 1 or `max_distance_m` not positive.
    """
    limit2 = _check_distance(max_distance_m, "max_distance_m")
    if k < 1:
        raise InputError(f"k must be at least 1, got {k}.")
    if queries is None:
        return _self_knn(index, k, limit2)
    asked = as_points(queries, "queries")
    sequence = _visiting_order(asked)
    found = np.full((len(asked), k), -1, np.int64)
    distance = np.full((len(asked), k), np.inf)

    def task(start: int, stop: int) -> None:
        rows = sequence[start:stop]
        places = np.empty((len(rows), k), np.int64)
        distance2 = np.empty((len(rows), k))
        neighbours.knn(index.points, index.boxes, asked[rows], limit2, places, distance2)
        found[rows] = _back(index, places)
        distance[rows] = np.sqrt(distance2)

    if len(index.points):
        for_blocks(len(asked), _BLOCK, task)
    return found, distance


def _self_knn(index: Neighbourhood, k: int, limit2: float) -> tuple[Index, Values]:
    n = len(index.points)
    found = np.empty((n, k), np.int64)
    distance = np.empty((n, k))

    def task(first: int, last: int) -> None:
        start, places, distance2 = self_knn_block(index, k, limit2, first, last)
        rows = index.order[start : start + len(places)]
        found[rows] = _back(index, places)
        distance[rows] = np.sqrt(distance2)

    if n:
        for_blocks(*blocks_of_leaves(index), task)
    return found, distance


def blocks_of_leaves(index: Neighbourhood) -> tuple[int, int]:
    """Return (leaves, leaves per block): what `for_blocks` needs to visit the index in order."""
    return len(index.boxes) // 2, _BLOCK // boxtree.LEAF


def over_leaves(index: Neighbourhood, is_wanted: Mask, task: Callable[[int, int], None]) -> None:
    """Call ``task(first leaf, last leaf + 1)`` over blocks that hold all wanted points, few others.

    On the threads. is_wanted (n,), in sorted order. For passes over a part of an index, such as a
    tile's own points.
    """
    blocks = _leaves_of(index, is_wanted)

    def some(start: int, stop: int) -> None:
        for first, last in blocks[start:stop]:
            task(first, last)

    for_blocks(len(blocks), 1, some)


def _leaves_of(index: Neighbourhood, is_wanted: Mask) -> list[tuple[int, int]]:
    """Return (first leaf, last leaf + 1) of blocks that hold all wanted points (n,), few others."""
    leaves, n = len(index.boxes) // 2, len(index.points)
    if not is_wanted.any():
        return []
    first = np.arange(0, leaves, _FEW_LEAVES)
    is_needed = np.logical_or.reduceat(is_wanted, first * n // leaves)
    blocks: list[tuple[int, int]] = []
    for start in first[is_needed].tolist():
        stop = min(start + _FEW_LEAVES, leaves)
        if blocks and blocks[-1][1] == start and stop - blocks[-1][0] <= _BLOCK // boxtree.LEAF:
            blocks[-1] = (blocks[-1][0], stop)
        else:
            blocks.append((start, stop))
    return blocks


def points_of(index: Neighbourhood, first_leaf: int, last_leaf: int) -> tuple[int, int]:
    """Return (first, last + 1) of the points, in sorted order, in leaves first .. last - 1."""
    n, leaves = len(index.points), len(index.boxes) // 2
    return first_leaf * n // leaves, last_leaf * n // leaves


def self_knn_block(
    index: Neighbourhood, k: int, limit2: float, first_leaf: int, last_leaf: int
) -> tuple[int, Index, Values]:
    """Return (first sorted place, places (m, k), squared distances (m, k)) of a block of leaves.

    Everything in sorted order: for passes that reduce neighbours at once, never holding n k.
    """
    start, stop = points_of(index, first_leaf, last_leaf)
    places = np.empty((stop - start, k), np.int64)
    distance2 = np.empty((stop - start, k))
    self_neighbours.self_knn(
        index.points, index.boxes, limit2, first_leaf, last_leaf, places, distance2
    )
    return start, places, distance2


def count_within(index: Neighbourhood, queries: ArrayLike | None, radius_m: float) -> Index:
    """Return how many indexed points lie within `radius_m` (inclusive) of every query (m, 3).

    None asks for the indexed points themselves, in the caller's order; each counts itself.
    """
    radius2 = _check_distance(radius_m, "radius_m")
    asked = index.points if queries is None else as_points(queries, "queries")
    sequence = np.arange(len(asked)) if queries is None else _visiting_order(asked)
    counts = np.zeros(len(asked), np.int64)

    def task(start: int, stop: int) -> None:
        rows = sequence[start:stop]
        found = np.empty(len(rows), np.int64)
        neighbours.count_within(index.points, index.boxes, asked[rows], radius2, found)
        counts[index.order[rows] if queries is None else rows] = found

    if len(index.points):
        for_blocks(len(asked), _BLOCK, task)
    return counts


def normals(
    points: ArrayLike | Neighbourhood, neighbours: int = 20, max_distance_m: float = np.inf
) -> Surface:
    """Return normal, surface variation and planarity of every point.

    Parameters
    ----------
    points : array_like, shape (n, 3), or Neighbourhood
        Metres. An index is used as it is; answers come in the order of the array behind it.
    neighbours : int
        Nearest other points that, with the point itself, make its neighbourhood; at least 2.
    max_distance_m : float
        Neighbours farther than this are left out; inclusive.

    Returns
    -------
    Surface
        From the covariance about the neighbourhood's mean. The sign of a normal says nothing about
        the outside: it points up.

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite, `neighbours` is below 2 or `max_distance_m` not
        positive.
    """
    if neighbours < 2:
        raise InputError(f"neighbours must be at least 2 to span a plane, got {neighbours}.")
    limit2 = _check_distance(max_distance_m, "max_distance_m")
    index = points if isinstance(points, Neighbourhood) else build_index(points)
    n = len(index.points)
    surface = Surface(np.full((n, 3), np.nan), np.full(n, np.nan), np.full(n, np.nan))

    def task(first: int, last: int) -> None:
        start, places, _ = self_knn_block(index, neighbours, limit2, first, last)
        moments.describe_neighbours(index.points, places, start, *surface)

    if n:
        for_blocks(*blocks_of_leaves(index), task)
    return Surface(*(index.unsorted(values) for values in surface))
