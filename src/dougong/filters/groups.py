"""Groups of points that hold together, and how far the small ones hover from everything large.

The part of the protective rule that judges things, not points: a bird, a leaf or a passer-by's
fringe is a group that is smaller than its distance from everything large. Kernels are imported
when called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dougong.filters.local_spacing import SMALLEST_M, STEPS
from dougong.typing import Index, Mask, Values

if TYPE_CHECKING:
    from dougong.filters.neighbourhood import Neighbourhood

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


class Groups(NamedTuple):
    """What was found of the groups that own points belong to."""

    has_large: bool
    most: int
    """Points of the one with most points."""


class _Sizes(NamedTuple):
    """The groups of all points, in sorted order; at a group's root, and 0 elsewhere."""

    parent: Index
    """(n,) the root of each point's group."""
    held: Index
    """(n,) points."""
    flat: Index
    """(n,) of them, those on a surface or a line."""
    longest: Values
    """(n,) longest side of the box, metres."""
    size: Values
    """(n,) that, or the side of the square that the points would cover at the spacing here, if
    that is longer."""

    def are_large(self, limit_m: float, many: int) -> Mask:
        """Say which roots (n,) are those of large groups."""
        # One place held many times over shows no surface.
        is_solid = (self.flat >= SOLID) & (self.longest > 0.0)
        return (self.longest > limit_m) | (self.held >= many) | is_solid


def group_margin(
    index: Neighbourhood,
    parent: Index,
    spacing: Values,
    variation: Values,
    *,
    limit_m: float,
    many: int,
    own: int,
    is_whole: bool,
) -> tuple[Values, Groups]:
    """Return gap / size (n,) of each point's group, 0 in a large one, and what groups there are.

    Parameters
    ----------
    index : Neighbourhood
        Everything is in its sorted order.
    parent : ndarray, shape (n,)
        The root of each point's group of linked points.
    spacing : ndarray, shape (n,)
        Metres.
    variation : ndarray, shape (n,)
        Surface variation of each point's neighbourhood.
    limit_m, many
        A group that is longer, or has so many points, is large; no wider gap is looked across.
    own : int
        The first so many of the caller's points are its own, the others its halo.
    is_whole : bool
        The points are a whole cloud. Where no group is large, the one of most points then is: a
        small thing alone is what was scanned.
    """
    from dougong.filters.clusters import distance_to

    is_flat = variation < FLAT
    sizes = _sizes_of(index, parent, spacing, is_flat)
    sizes = _with_pieces_joined(index, sizes, spacing, is_flat, sizes.are_large(limit_m, many))
    is_large = sizes.are_large(limit_m, many)
    mine = sizes.parent[index.order < own]
    groups = Groups(bool(is_large[mine].any()), int(sizes.held[mine].max(initial=0)))
    if is_whole and len(parent) and not is_large.any():
        is_large = sizes.held == sizes.held.max()
    chosen = is_large[sizes.parent]
    asked = np.flatnonzero(~chosen)
    margin = np.zeros(len(parent))
    if len(asked):
        root = sizes.parent[asked]
        gap = np.full(len(parent), np.inf)
        np.minimum.at(gap, root, distance_to(index, chosen, asked, limit_m))
        margin[asked] = gap[root] / sizes.size[root]
    return margin, groups


def _sizes_of(index: Neighbourhood, parent: Index, spacing: Values, is_flat: Mask) -> _Sizes:
    from dougong.kernels import protective as kernels

    n = len(parent)
    held, sums = np.zeros(n, np.int64), np.zeros(n, np.int64)
    boxes = np.empty((n, 6))
    steps = np.rint(spacing / SMALLEST_M * STEPS).astype(np.int64)
    kernels.measure(index.points, steps, parent, held, sums, boxes)
    is_root = held > 0
    longest, size = np.zeros(n), np.zeros(n)
    longest[is_root] = (boxes[is_root, 3:] - boxes[is_root, :3]).max(axis=1)
    usual = sums[is_root] / held[is_root] * (SMALLEST_M / STEPS)
    size[is_root] = np.maximum(usual * np.sqrt(held[is_root]), longest[is_root])
    flat = np.bincount(parent[is_flat], minlength=n)
    return _Sizes(parent, held, flat, longest, size)


def _with_pieces_joined(
    index: Neighbourhood, sizes: _Sizes, spacing: Values, is_flat: Mask, is_large: Mask
) -> _Sizes:
    """Return the groups after those small ones that are pieces of one thing became one."""
    from dougong.filters.neighbourhood import build_index
    from dougong.kernels import clusters as kernels

    is_piece = (sizes.held > PIECE) & ~is_large
    chosen = np.flatnonzero(is_piece[sizes.parent])
    if np.count_nonzero(is_piece) < 2:
        return sizes
    tree = build_index(index.points[chosen])
    at = chosen[tree.order]
    gap = BETWEEN * sizes.size[sizes.parent[at]]
    _, first, group = np.unique(sizes.parent[at], return_index=True, return_inverse=True)
    joined = first[group]
    kernels.link_within(tree.points, tree.boxes, gap, float(gap.min()), joined)
    parent = sizes.parent.copy()
    parent[at] = at[joined]
    return _sizes_of(index, parent, spacing, is_flat)
