"""Groups of points that hold together: which are large, and which are pieces of one thing.

The part of the protective rule that judges things, not points: a bird, a leaf or a passer-by's
fringe is a group that is smaller than its distance from everything large. Groups are known by
number, and what is known of them adds up: those of two parts of a cloud that are one group become
one without their points. Kernels are imported when called.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.filters.local_spacing import SMALLEST_M, STEPS
from dougong.typing import Index, Mask, Points, Values

LINK = 2.0
"""Points within this many spacings make a group: an even surface holds together from 1.2 on."""
GROUP = 2.0
"""A group that extends farther than this many reaches is large; a wider gap is taken as this."""
MANY = 1000
"""A group of so many points is large: whatever it is, it was scanned, not stirred up."""
FLAT, SOLID = 0.03, 100
"""And one of so many points whose surface variation is less than this: they show a surface or a
line, while of points that were stirred up one in a thousand is so flat."""
PIECE = 8
"""A group of more points than this is a piece of something, ..."""
BETWEEN = 0.5
"""... and of one thing with a piece no farther away than this share of the smaller one's size: the
links of a chain, a bell below its bracket, a relief that the scanner saw in patches."""


class Sizes(NamedTuple):
    """What is known of g groups."""

    held: Index
    """(g,) points."""
    steps: Index
    """(g,) the sum of their spacings, in whole steps: the order of adding changes nothing."""
    flat: Index
    """(g,) of the points, those on a surface or a line."""
    boxes: NDArray[np.float64]
    """(g, 6) low and high corner, metres."""

    @property
    def longest_m(self) -> Values:
        """(g,) the longest side of the box."""
        longest: Values = (self.boxes[:, 3:] - self.boxes[:, :3]).max(axis=1, initial=0.0)
        return longest

    @property
    def size_m(self) -> Values:
        """(g,) the longest side, or the side of the square that the points would cover.

        At the spacing that is usual there, if that square's is longer.
        """
        usual = self.steps / self.held * (SMALLEST_M / STEPS)
        size: Values = np.maximum(usual * np.sqrt(self.held), self.longest_m)
        return size

    @property
    def gap_m(self) -> Values:
        """(g,) no farther than this is another piece of the same thing."""
        gap: Values = BETWEEN * self.size_m
        return gap

    def are_large(self, reach_m: float) -> Mask:
        """Say which groups (g,) are large."""
        # One place held many times over shows no surface.
        longest = self.longest_m
        is_solid = (self.flat >= SOLID) & (longest > 0.0)
        return (longest > GROUP * reach_m) | (self.held >= MANY) | is_solid

    def merged(self, into: Index) -> Sizes:
        """Return the groups after each became a part of the one that `into` (g,) names."""
        count = int(into.max(initial=-1)) + 1
        held, steps, flat = np.zeros((3, count), np.int64)
        boxes = np.full((count, 6), np.inf)
        boxes[:, 3:] = -np.inf
        for values, total in ((self.held, held), (self.steps, steps), (self.flat, flat)):
            np.add.at(total, into, values)
        np.minimum.at(boxes[:, :3], into, self.boxes[:, :3])
        np.maximum.at(boxes[:, 3:], into, self.boxes[:, 3:])
        return Sizes(held, steps, flat, boxes)


def sizes_of(points: Points, spacing_m: Values, variation: Values, group: Index) -> Sizes:
    """Return what is to be known of the groups 0, 1, 2 ... that points (n, 3) are in.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
    spacing_m : ndarray, shape (n,)
        What is usual round each point.
    variation : ndarray, shape (n,)
        Surface variation of each point's neighbourhood.
    group : ndarray, shape (n,)
        The number of its group; every number is one's.
    """
    from dougong.kernels import protective as kernels

    count = int(group.max(initial=-1)) + 1
    held, sums = np.zeros((2, count), np.int64)
    boxes = np.empty((count, 6))
    steps = np.rint(spacing_m / SMALLEST_M * STEPS).astype(np.int64)
    kernels.measure(points, steps, group, held, sums, boxes)
    flat = np.bincount(group[variation < FLAT], minlength=count)
    return Sizes(held, sums, flat, boxes)


def joined(count: int, one: Index, other: Index) -> Index:
    """Return what each of `count` groups becomes a part of, numbered 0, 1, 2 ...

    Those of each pair `one` (m,), `other` (m,) become one, and so do chains of pairs.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(one):
        return np.arange(count)
    pairs = coo_array((np.ones(len(one), np.bool_), (one, other)), shape=(count, count))
    into: Index = connected_components(pairs, directed=False)[1].astype(np.int64)
    return into


def are_pieces(sizes: Sizes, is_large: Mask) -> Mask:
    """Say which groups (g,) are pieces of something."""
    return (sizes.held > PIECE) & ~is_large


def piece_links(points: Points, group: Index, gap_m: Values) -> Index:
    """Return the pairs of groups (k, 2) whose pieces come near enough to be of one thing.

    points (m, 3) of pieces, the group (m,) that each is in and the widest gap (m,) from its piece
    to another. Of a part of a cloud: of all pairs, the links of some chain.
    """
    from dougong.filters.neighbourhood import build_index
    from dougong.kernels import clusters as kernels

    if not len(points):
        return np.zeros((0, 2), np.int64)
    tree = build_index(points)
    mine, gap = group[tree.order], gap_m[tree.order]
    _, first, number = np.unique(mine, return_index=True, return_inverse=True)
    together = first[number]
    kernels.link_within(tree.points, tree.boxes, gap, float(gap.min()), together)
    is_new = mine != mine[together]
    pairs: Index = np.unique(np.column_stack([mine, mine[together]])[is_new], axis=0)
    return pairs


def pieces_joined(points: Points, group: Index, sizes: Sizes, is_large: Mask) -> Index:
    """Return what each group becomes a part of (g,) when pieces of one thing become one.

    points (m, 3) and their group (m,) hold those of all groups that are not large, at least.
    """
    chosen = np.flatnonzero(are_pieces(sizes, is_large)[group])
    mine = group[chosen]
    pairs = piece_links(points[chosen], mine, sizes.gap_m[mine])
    return joined(len(sizes.held), pairs[:, 0], pairs[:, 1])
