"""Clusters of points: joined where they are no farther apart than is usual there.

Kernels are imported when called.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dougong.filters.neighbourhood import Neighbourhood, blocks_of_leaves, self_knn_block
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

NEIGHBOURS = 8
"""The distance to this many nearest others says how densely a place is sampled."""
_BLOCK = 1 << 13


class Clusters(NamedTuple):
    """Which points of an index are joined; everything in sorted order."""

    root: Index
    """(n,) the same number for all points of a cluster: the place of one of them."""
    held: Index
    """(n,) points of the cluster, at its root; 0 elsewhere."""
    longest_m: Values
    """(n,) longest side of the cluster's box, at its root; 0 elsewhere."""


def eighth_nearest(index: Neighbourhood, most_m: float) -> Values:
    """Return the distance (n,) to the 8th nearest other, in sorted order; inf beyond `most_m`."""
    eighth = np.full(len(index.points), np.inf)

    def task(first: int, last: int) -> None:
        start, _, distance2 = self_knn_block(index, NEIGHBOURS, most_m**2, first, last)
        eighth[start : start + len(distance2)] = np.sqrt(distance2[:, -1])

    if len(eighth):
        for_blocks(*blocks_of_leaves(index), task)
    return eighth


def spacing_of(eighth_m: Values) -> Values:
    """Return the side of the square grid that is as dense as so far an 8th nearest says."""
    spacing: Values = eighth_m * math.sqrt(math.pi / NEIGHBOURS)
    return spacing


def clusters_of(index: Neighbourhood, gap: Values, least_m: float) -> Clusters:
    """Return the clusters of points that chains of pairs join.

    A pair is joined where it is no farther apart than the smaller `gap` (n,) of the two, of which
    none is below `least_m`.
    """
    from dougong.kernels import clusters as kernels
    from dougong.kernels import protective

    n = len(index.points)
    parent = np.arange(n, dtype=np.int64)
    held, unused = np.zeros(n, np.int64), np.zeros(n, np.int64)
    boxes = np.empty((n, 6))
    longest = np.zeros(n)
    if n:
        kernels.link_within(index.points, index.boxes, gap, least_m, parent)
        protective.measure(index.points, unused, parent, held, unused.copy(), boxes)
        is_root = held > 0
        longest[is_root] = (boxes[is_root, 3:] - boxes[is_root, :3]).max(axis=1)
    return Clusters(parent, held, longest)


def distance_to(index: Neighbourhood, chosen: Mask, queries: Points, limit_m: float) -> Values:
    """Return the distance (m,) from `queries` (m, 3) to the nearest `chosen` (n,) point.

    At most `limit_m`, which stands for anything farther. chosen is in sorted order.
    """
    from dougong.kernels import protective as kernels

    nodes = np.zeros(len(index.boxes), bool)
    kernels.flag_nodes(chosen, nodes)
    gap2 = np.empty(len(queries))

    def task(start: int, stop: int) -> None:
        kernels.gaps(
            index.points,
            index.boxes,
            chosen,
            nodes,
            limit_m**2,
            queries[start:stop],
            gap2[start:stop],
        )

    for_blocks(len(queries), _BLOCK, task)
    return np.sqrt(gap2)


def members(clusters: Clusters, roots: Index) -> list[Index]:
    """Return the places, in sorted order, of the points of each cluster of `roots`."""
    wanted = np.zeros(len(clusters.root), bool)
    wanted[roots] = True
    places = np.flatnonzero(wanted[clusters.root])
    places = places[np.argsort(clusters.root[places], kind="stable")]
    starts = np.searchsorted(clusters.root[places], roots)
    return [places[a : a + clusters.held[root]] for a, root in zip(starts, roots, strict=True)]
