"""The protective rule of CWASF: points are judged by how well the surface near them holds them.

docs/denoising.md has the reasoning and what it was measured on. In short: the spacing that
scans have hereabouts is the yardstick; a neighbour's distance is divided along the surface or the
line it lies on, and counts a little more across a plane; the first to eighth nearest are tested
together, so that pairs do not vouch for each other (`surroundings`); groups that are smaller than
their distance from everything large go (`groups`); rows that chance does not make stay.

Only the surroundings are asked of every point; what comes behind them concerns those in doubt.
Kernels are imported when called.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._checks import as_points
from dougong.filters.groups import GROUP, MANY, Sizes, pieces_joined, sizes_of
from dougong.filters.local_spacing import FAR_CELLS
from dougong.filters.octree_voxel_grid import robust_low
from dougong.filters.ranks import ValueBlocks, at_rank
from dougong.filters.surroundings import (
    CHARGE,
    NEIGHBOURS,
    TESTS,
    Taken,
    Tested,
    Tests,
    distance_limits,
    reach_for,
    test_cloud,
)
from dougong.typing import Index, Mask, Points, Values

__all__ = ["CHARGE", "NEIGHBOURS", "TESTS", "Taken", "distance_limits", "reach_for"]

ROW_NEIGHBOURS, ROW_WIDTH, ROW_ACCIDENTS = 24, 0.5, 1e-3
"""A point stays if, among this many nearest of those that would go, a row (this many spacings to
either side) has so many that chance would make fewer than this number of such rows there."""
ROW_REACH = 0.1
"""In rows the spacing counts as at most this many reaches."""

THIN, THICK = 0.05, 0.10
"""Surface variation that half of all points exceed: up to the first, surfaces are thin; from the
other on the sensor scatters about as far as points are apart, and what it shows has a thickness."""
THICK_EASE = 1.4
"""In a thick cloud neighbours may be so many times as far: on the outside of Gaussian scatter they
are, one point in ten went there, and it is surface. Groups are judged as ever."""


class Verdict(NamedTuple):
    """What the rule says about n points, in the caller's order."""

    margin: Values
    """(n,) above 1: removed. Alone: 1 + the least that the first neighbour out of reach has."""
    reason: NDArray[np.uint8]
    """(n,) `Taken`."""
    spacing_m: Values
    """(n,) the spacing of the surface hereabouts, the yardstick."""
    curvature: Values
    """(n,) surface variation of the 12 nearest."""

    def of_first(self, count: int) -> Verdict:
        """Return what is said about the first `count` points."""
        return Verdict._make(values[:count] for values in self)


class Doubtful(NamedTuple):
    """Points of a cloud or a part that may go: some test or a group speaks against them."""

    points: Points
    """(m, 3) metres."""
    spacing_m: Values
    margin: Values
    """(m,) what the tests say."""
    reason: NDArray[np.uint8]
    group: Index
    """(m,) the number of the group that each is in."""


class Things(NamedTuple):
    """The t things of a whole cloud: its groups, pieces of one thing joined."""

    are_large: Mask
    """(t,)."""
    size_m: Values
    """(t,)."""
    large_from: int
    """Where nothing is large, so many points make a thing that is; else 0."""


def halo_m(reach_m: float | None) -> float:
    """Return how far the rule reaches: a group, its gap, another, its pieces, their surroundings.

    Points in a row with one that would go are judged themselves, so its length comes on top.
    Who joins groups across the borders of parts reads less (`surroundings.HALO`).

    Infinity where the reach is taken from the cloud: find it first, with `reach_for`.
    """
    if reach_m is None:
        return math.inf
    return reach_m * (5.0 * GROUP + 3.0 + 2.0 * FAR_CELLS)


def judge(
    points: ArrayLike,
    tests: Tests,
    reach_m: float | None = None,
    low: NDArray[np.float64] | None = None,
) -> Verdict:
    """Judge the points (n, 3) of a whole cloud, metres.

    low (3,): where its cells begin, by default at its `robust_low`.
    """
    from dougong.filters.clusters import distance_to
    from dougong.filters.neighbourhood import build_index

    index = build_index(points)
    low = robust_low(index.points) if low is None else low
    tested, reach = test_cloud(index, reach_m, tests, low)
    ease = ease_of(lambda: (tested.curvature,), len(tested.margin), reach_m)
    tested = tested._replace(margin=eased(tested.margin, tested.reason, ease))
    margin, reason = tested.margin, tested.reason
    if is_too_few(len(margin), reach_m):
        margin[:], reason[:] = 0.0, Taken.KEPT
        return Verdict(margin, reason, tested.spacing_m, tested.curvature)
    xyz = as_points(points)
    sizes = sizes_of(xyz, tested.spacing_m, tested.curvature, tested.group)
    places = doubtful_of(tested, sizes.are_large(reach))
    few = doubtful(xyz, tested, places)
    into = pieces_joined(few.points, few.group, sizes, sizes.are_large(reach))
    things = things_of(sizes.merged(into), reach, 0 if reach_m is None else None)
    chosen = things.are_large[into[tested.group[index.order]]]
    thing = into[few.group]
    hovers = np.flatnonzero(~things.are_large[thing])
    gap_m = np.where(things.are_large, 0.0, np.inf)
    found_m = distance_to(index, chosen, few.points[hovers], GROUP * reach)
    np.minimum.at(gap_m, thing[hovers], found_m)
    few = hovering(few, gap_m[thing], things.size_m[thing])
    margin[places], reason[places] = rows_excused(few, len(places), reach), few.reason
    reason[margin <= 1.0] = Taken.KEPT
    return Verdict(margin, reason, tested.spacing_m, tested.curvature)


def is_too_few(points: int, reach_m: float | None) -> bool:
    """Say whether so few points have no surroundings to be judged by: all stay."""
    return reach_m is None and points <= TESTS


def ease_of(variation: ValueBlocks, points: int, reach_m: float | None) -> float:
    """Return what margins in a whole cloud are divided by, by the surface variation of its points.

    1 where the reach is given, since then the cloud may be a part, and with few points.
    """
    if reach_m is not None or points < MANY:
        return 1.0
    share = (at_rank(variation, points // 2) - THIN) / (THICK - THIN)
    return 1.0 + (THICK_EASE - 1.0) * min(max(share, 0.0), 1.0)


def eased(margin: Values, reason: NDArray[np.uint8], ease: float) -> Values:
    """Return the margins (n,) of the tests as a thick cloud has them; alone is alone in any."""
    as_thick: Values = np.where(reason == Taken.ALONE, margin, margin / ease)
    return as_thick


def ease_notes(ease: float) -> tuple[str, ...]:
    """Return what is to be said of a thick cloud."""
    note = (
        "the points scatter off their surfaces about as far as they are apart: neighbours may be "
        f"{ease:.2f} times as far as usual, and more noise near surfaces stays"
    )
    return (note,) if ease > 1.0 else ()


def doubtful_of(tested: Tested, are_large: Mask) -> Index:
    """Return the places of the points that may go; `are_large` (g,) says it of their groups."""
    return np.flatnonzero((tested.margin > 1.0) | ~are_large[tested.group])


def doubtful(points: Points, tested: Tested, places: Index) -> Doubtful:
    """Return the points at `places` and what is known of them."""
    return Doubtful(
        points[places],
        tested.spacing_m[places],
        tested.margin[places],
        tested.reason[places],
        tested.group[places],
    )


def things_of(sizes: Sizes, reach_m: float, most_beside: int | None = None) -> Things:
    """Return which things of a whole cloud are large.

    Parameters
    ----------
    sizes : Sizes
        Of the things.
    reach_m : float
    most_beside : int, optional
        If given, and nothing is large, what has most points counts as large: a small thing alone
        is what was scanned. There are others beside these, none large, of at most so many points.
    """
    are_large = sizes.are_large(reach_m)
    large_from = 0
    if most_beside is not None and not are_large.any():
        large_from = max(int(sizes.held.max(initial=0)), most_beside)
        are_large = sizes.held == large_from
    return Things(are_large, sizes.size_m, large_from)


def hovering(few: Doubtful, gap_m: Values, size_m: Values) -> Doubtful:
    """Return the points in doubt after groups were judged by what lies between them and the rest.

    gap_m (m,): from each one's thing to the nearest large one, at most `GROUP` reaches; 0 for large
    things. size_m (m,) of each one's thing.
    """
    lonely = gap_m / size_m
    is_worse = lonely > few.margin
    # A point alone is alone whatever else.
    is_named = is_worse & (few.reason != Taken.ALONE)
    return few._replace(
        margin=np.where(is_worse, lonely, few.margin),
        reason=np.where(is_named, np.uint8(Taken.SMALL_GROUP), few.reason),
    )


def rows_excused(few: Doubtful, own: int, reach_m: float) -> Values:
    """Return the margin (own,) of the first points, lower where they lie in rows.

    A wire that a scan met in a few places is nothing to its neighbours, and chance makes no rows:
    those count that would go, as others do within `row_halo_m`.
    """
    from dougong.filters.neighbourhood import build_index, over_leaves, self_knn_block
    from dougong.kernels import protective as kernels

    chosen = np.flatnonzero(few.margin > 1.0)
    margin = few.margin[:own].copy()
    index = build_index(few.points[chosen])
    place = chosen[index.order]
    # Where next to nothing is in reach, the spacing says so little that a row would be a road.
    usual = np.minimum(few.spacing_m[place], ROW_REACH * reach_m)
    reach = row_halo_m(reach_m)

    def task(first: int, last: int) -> None:
        start, near, _ = self_knn_block(index, ROW_NEIGHBOURS, reach**2, first, last)
        accident = np.empty(len(near))
        kernels.rows(index.points, near, usual, ROW_WIDTH, reach, start, accident)
        mine = place[start : start + len(near)]
        is_sure = (accident < 0.0) & (mine < own)
        sure = mine[is_sure]
        margin[sure] = np.minimum(margin[sure], math.log(ROW_ACCIDENTS) / accident[is_sure])

    over_leaves(index, place < own, task)
    return margin


def row_halo_m(reach_m: float) -> float:
    """Return how far the points lie that make a row with one."""
    return GROUP * reach_m
