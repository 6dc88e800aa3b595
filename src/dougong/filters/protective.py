"""The protective rule of CWASF: points are judged by how well the surface near them holds them.

docs/denoising.md has the reasoning and what it was measured on. In short: the spacing that
scans have hereabouts is the yardstick; a neighbour's distance is divided along the surface or the
line it lies on, and counts a little more across a plane; the first to eighth nearest are tested
together, so that pairs do not vouch for each other (`surroundings`); groups that are smaller than
their distance from everything large go (`groups`); rows that chance does not make stay.

Only the surroundings are asked of every point. What comes behind them concerns the few that are in
doubt, so of a cloud in parts it is settled for all of them at once.
Kernels are imported when called.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._checks import as_points
from dougong.filters.groups import GROUP, Sizes, pieces_joined, sizes_of
from dougong.filters.local_spacing import FAR_CELLS
from dougong.filters.surroundings import (
    CHARGE,
    NEIGHBOURS,
    TESTS,
    Taken,
    Tested,
    Tests,
    distance_limits,
    test_cloud,
)
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

__all__ = ["CHARGE", "NEIGHBOURS", "TESTS", "Taken", "distance_limits"]

ROW_NEIGHBOURS, ROW_WIDTH, ROW_ACCIDENTS = 24, 0.5, 1e-3
"""A point stays if, among this many nearest of those that would go, a row (this many spacings to
either side) has so many that chance would make fewer than this number of such rows there."""
ROW_REACH = 0.1
"""In rows the spacing counts as at most this many reaches."""
_BLOCK = 1 << 13


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
    """The groups of a whole cloud, pieces of one thing joined."""

    into: Index
    """(g,) the number of the thing that each group is a part of."""
    are_large: Mask
    """(t,) of each thing."""
    size_m: Values
    """(t,)."""


def halo_m(reach_m: float | None) -> float:
    """Return how far the rule reaches: a group, its gap, another, its pieces, their surroundings.

    Points in a row with one that would go are judged themselves, so its length comes on top.
    Who joins groups across the borders of parts reads less (`surroundings.HALO`).

    Infinity where the reach is taken from the cloud: find it first, with `reach_for`.
    """
    if reach_m is None:
        return math.inf
    return reach_m * (5.0 * GROUP + 3.0 + 2.0 * FAR_CELLS)


def reach_for(points: ArrayLike) -> float:
    """Return the reach, metres, for a cloud (n, 3): `surroundings.REACH_M` where it suits."""
    from dougong.filters.neighbourhood import build_index

    return test_cloud(build_index(points), None, Tests(0.0, 0.0, 0.1))[1]


def judge(points: ArrayLike, tests: Tests, reach_m: float | None = None) -> Verdict:
    """Judge the points (n, 3) of a whole cloud, metres."""
    from dougong.filters.clusters import distance_to
    from dougong.filters.neighbourhood import build_index

    index = build_index(points)
    tested, reach = test_cloud(index, reach_m, tests)
    margin, reason = tested.margin, tested.reason
    if is_too_few(len(margin), reach_m):
        margin[:], reason[:] = 0.0, Taken.KEPT
        return Verdict(margin, reason, tested.spacing_m, tested.curvature)
    xyz = as_points(points)
    sizes = sizes_of(xyz, tested.spacing_m, tested.curvature, tested.group)
    places = doubtful_of(tested, sizes.are_large(reach))
    few = doubtful(xyz, tested, places)
    things = things_of(few, sizes, reach, is_whole=reach_m is None)
    is_large = things.are_large[things.into]
    hovers = ~is_large[few.group]
    chosen = is_large[tested.group[index.order]]
    gap_m = distance_to(index, chosen, few.points[hovers], GROUP * reach)
    margin[places], reason[places] = settle(few, things, gap_m, reach)
    reason[margin <= 1.0] = Taken.KEPT
    return Verdict(margin, reason, tested.spacing_m, tested.curvature)


def is_too_few(points: int, reach_m: float | None) -> bool:
    """Say whether so few points have no surroundings to be judged by: all stay."""
    return reach_m is None and points <= TESTS


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


def things_of(few: Doubtful, sizes: Sizes, reach_m: float, *, is_whole: bool) -> Things:
    """Return what the groups of a whole cloud are parts of.

    Parameters
    ----------
    few : Doubtful
        All points that may go.
    sizes : Sizes
        Of the groups.
    reach_m : float
    is_whole : bool
        Where nothing is large, what has most points counts as large: a small thing alone is what
        was scanned.
    """
    into = pieces_joined(few.points, few.group, sizes, sizes.are_large(reach_m))
    things = sizes.merged(into)
    are_large = things.are_large(reach_m)
    if is_whole and len(are_large) and not are_large.any():
        are_large = things.held == things.held.max()
    return Things(into, are_large, things.size_m)


def settle(
    few: Doubtful, things: Things, gap_m: Values, reach_m: float
) -> tuple[Values, NDArray[np.uint8]]:
    """Return the margin (m,) and the reason (m,) of the points that may go.

    gap_m (h,): from those whose thing is not large, in their order, to the nearest point of a large
    one; at most `GROUP` reaches.
    """
    margin, reason = few.margin.copy(), few.reason.copy()
    thing = things.into[few.group]
    hovers = np.flatnonzero(~things.are_large[thing])
    gap = np.full(len(things.size_m), np.inf)
    np.minimum.at(gap, thing[hovers], gap_m)
    lonely = gap[thing[hovers]] / things.size_m[thing[hovers]]
    is_worse = lonely > margin[hovers]
    # A point alone is alone whatever else.
    is_named = is_worse & (reason[hovers] != Taken.ALONE)
    margin[hovers[is_worse]] = lonely[is_worse]
    reason[hovers[is_named]] = Taken.SMALL_GROUP
    _excuse_rows(few.points, few.spacing_m, reach_m, margin)
    return margin, reason


def _excuse_rows(points: Points, spacing: Values, reach: float, margin: Values) -> None:
    """Lower the margin (n,) of points that would go but lie in a row with others that would.

    A wire that a scan met in a few places is nothing to its neighbours, and chance makes no rows.
    """
    from dougong.filters.neighbourhood import build_index, knn
    from dougong.kernels import protective as kernels

    chosen = np.flatnonzero(margin > 1.0)
    if not len(chosen):
        return
    points = points[chosen]
    places = knn(build_index(points), None, ROW_NEIGHBOURS, GROUP * reach)[0].astype(np.int32)
    # Where next to nothing is in reach, the spacing says so little that a row would be a road.
    usual = np.minimum(spacing[chosen], ROW_REACH * reach)
    accident = np.zeros(len(chosen))
    for_blocks(
        len(chosen),
        _BLOCK,
        lambda start, stop: kernels.rows(
            points, places, usual, ROW_WIDTH, GROUP * reach, start, stop, accident
        ),
    )
    is_sure = accident < 0.0
    excused = np.full(len(chosen), np.inf)
    excused[is_sure] = math.log(ROW_ACCIDENTS) / accident[is_sure]
    margin[chosen] = np.minimum(margin[chosen], excused)
