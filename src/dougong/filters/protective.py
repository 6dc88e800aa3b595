"""The protective rule of CWASF: points are judged by how well the surface near them holds them.

docs/denoising.md has the reasoning and what it was measured on. In short: the spacing that
scans have hereabouts is the yardstick; a neighbour's distance is divided along the surface or the
line it lies on, and counts a little more across a plane; the first to eighth nearest are tested
together, so that pairs do not vouch for each other; groups that are smaller than their distance
from everything large go; rows that chance does not make stay.
Kernels are imported when called.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong.filters.groups import GROUP, LINK, MANY, Groups, group_margin
from dougong.filters.local_spacing import FAR_CELLS, SMALLEST_M, local_spacing
from dougong.filters.ranks import ValueBlocks, at_rank
from dougong.threads import for_blocks
from dougong.typing import Values

if TYPE_CHECKING:
    from dougong.filters.neighbourhood import Neighbourhood

NEIGHBOURS = 12
"""Nearest points that a point's surroundings are seen by."""
TESTS = 8
"""The first to this many nearest are tested."""
REACH_M = 0.5
"""Nothing farther is a neighbour: doubled or halved to suit the cloud's median spacing."""
SPARSE, DENSE = 5.0, 50.0
"""Median spacings that the reach must hold, and may hold before it is halved: 0.5 m serves from
100 to 10,000 points/m2. In a longer reach scattered noise would have a spacing of its own."""
CHARGE = 0.25
"""Of what is excused along a plane, so much is charged across it: where all round lies in a plane,
a spacing off it is no accident of sampling."""
ROW_NEIGHBOURS, ROW_WIDTH, ROW_ACCIDENTS = 24, 0.5, 1e-3
"""A point stays if, among this many nearest of those that would go, a row (this many spacings to
either side) has so many that chance would make fewer than this number of such rows there."""
ROW_REACH = 0.1
"""In rows the spacing counts as at most this many reaches."""
_BLOCK = 1 << 13


class Taken(IntEnum):
    """Why the protective rule removes a point: attribute ``removal_reason``."""

    KEPT = 0
    ALONE = 1
    """Fewer than eight others within reach."""
    OFF_SURFACE = 2
    """Its nearest neighbour is too far, for the spacing here and along the surface there."""
    IN_PAIR = 3
    """One to seven others are near, the next is too far."""
    SMALL_GROUP = 4
    """It belongs to a group that is smaller than its distance from everything large."""


_REASONS = np.array([Taken.ALONE, Taken.OFF_SURFACE] + (TESTS - 1) * [Taken.IN_PAIR], np.uint8)
"""By the number of the nearest that is too far; 0: too few are in reach."""


class Whole(NamedTuple):
    """What the rule must know of a whole cloud to judge a part of it, its halo included."""

    reach_m: float
    many: int = MANY
    """Groups of so many points are large (`is_whole` of `group_margin`)."""
    is_few: bool = False
    """So few points that they have no surroundings to be judged by."""
    own: int = 0
    """The first so many of the points are the part's own, the others its halo."""


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
    groups: Groups


def halo_m(reach_m: float | None) -> float:
    """Return how far the rule reaches: a group, its gap, another, its pieces, their surroundings.

    Points in a row with one that would go are judged themselves, so its length comes on top.

    Infinity where the reach is taken from the cloud: find it first, with `reach_for`.
    """
    if reach_m is None:
        return math.inf
    return reach_m * (5.0 * GROUP + 3.0 + 2.0 * FAR_CELLS)


def reach_for(points: ArrayLike) -> float:
    """Return the reach, metres, for a cloud (n, 3): `REACH_M` where it suits."""
    from dougong.filters.neighbourhood import build_index

    return _neighbours(build_index(points), None)[2]


def reach_of(eighth_m: ValueBlocks, points: int) -> float:
    """Return the reach, metres, of a cloud of so many `points`, by their eighth nearest others."""
    if points <= TESTS:
        return REACH_M
    spacing = at_rank(eighth_m, points // 2) * math.sqrt(math.pi / TESTS)
    reach = REACH_M
    while reach < SPARSE * spacing:
        reach *= 2.0
    while reach > 2.0 * DENSE * max(spacing, SMALLEST_M):
        reach /= 2.0
    return reach


def distance_limits(surface_loss: float) -> Values:
    """Return how far, in spacings, the k-th nearest may be (`TESTS`,).

    On a surface sampled at random the k-th nearest lies within r with pi r^2 / spacing^2
    distributed as Gamma(k): the share `surface_loss` of such points lies beyond each limit.
    """
    from scipy.special import gammainccinv

    limits: Values = np.sqrt(gammainccinv(np.arange(1, TESTS + 1), surface_loss) / np.pi)
    return limits


def line_stretch(limits: Values) -> float:
    """Return what distances along a line are divided by, in pitches of the line per spacing.

    On a line hit at random the k-th nearest lies within x with 2 x / pitch distributed as
    Gamma(k), where on a surface it is pi r^2 / spacing^2: this turns the limit of the last test on
    a surface into that on a line.
    """
    return float(0.5 * np.pi * limits[-1])


def judge(
    points: ArrayLike,
    alpha: float,
    gamma: float,
    surface_loss: float,
    reach_m: float | None = None,
    whole: Whole | None = None,
) -> Verdict:
    """Judge `points` (n, 3), metres; parameters as in `CurvatureWeighted`.

    Where they are a part of a cloud, `whole` says what it must know of it.
    """
    from dougong.filters.neighbourhood import build_index
    from dougong.kernels import protective as kernels

    index = build_index(points)
    n = len(index.points)
    is_whole = reach_m is None and whole is None
    places, own, reach = _neighbours(index, reach_m if whole is None else whole.reach_m)
    if whole is None:
        whole = Whole(reach, is_few=is_whole and n <= TESTS, own=n)
    spacing = local_spacing(index.points, own, reach)
    curvature, frame = np.zeros(n), np.zeros((n, 9), np.float32)
    margin, decisive = np.empty(n), np.zeros(n, np.uint8)
    limits = distance_limits(surface_loss)
    stretch = line_stretch(limits)

    def see(start: int, stop: int) -> None:
        kernels.frames(
            index.points, places, alpha, gamma, spacing, stretch, start, stop, curvature, frame
        )

    def test(start: int, stop: int) -> None:
        kernels.support(
            index.points, places, frame, spacing, limits, reach, CHARGE, start, stop,
            margin, decisive,
        )  # fmt: skip

    for_blocks(n, _BLOCK, see)
    for_blocks(n, _BLOCK, test)
    reason = _REASONS[decisive]
    parent = np.arange(n)
    kernels.link(index.points, places, frame, spacing, LINK, parent)
    lonely, groups = group_margin(
        index,
        parent,
        spacing,
        curvature,
        limit_m=GROUP * whole.reach_m,
        many=whole.many,
        own=whole.own,
        is_whole=is_whole,
    )
    is_worse = lonely > margin
    margin[is_worse] = lonely[is_worse]
    reason[is_worse & (decisive > 0)] = Taken.SMALL_GROUP
    _excuse_rows(index, spacing, reach, margin)
    if whole.is_few:
        margin[:] = 0.0
    reason[margin <= 1.0] = Taken.KEPT
    back = np.empty(n, np.int64)
    back[index.order] = np.arange(n)
    return Verdict(margin[back], reason[back], spacing[back], curvature[back], groups)


def _excuse_rows(index: Neighbourhood, spacing: Values, reach: float, margin: Values) -> None:
    """Lower the margin (n,) of points that would go but lie in a row with others that would.

    A wire that a scan met in a few places is nothing to its neighbours, and chance makes no rows.
    """
    from dougong.filters.neighbourhood import build_index, knn
    from dougong.kernels import protective as kernels

    chosen = np.flatnonzero(margin > 1.0)
    if not len(chosen):
        return
    points = index.points[chosen]
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


def _neighbours(
    index: Neighbourhood, reach_m: float | None
) -> tuple[NDArray[np.int32], Values, float]:
    """Return the places (n, 12) of every point's nearest, the spacing (n,) they show, the reach.

    Without a `reach_m` all are searched first: what they show says how far they may be.
    """
    from dougong.filters.neighbourhood import blocks_of_leaves, self_knn_block
    from dougong.kernels import protective as kernels

    n = len(index.points)
    places = np.full((n, NEIGHBOURS), -1, np.int32)
    eighth = np.full(n, np.inf)
    limit2 = np.inf if reach_m is None else reach_m**2

    def task(first: int, last: int) -> None:
        start, found, distance2 = self_knn_block(index, NEIGHBOURS, limit2, first, last)
        places[start : start + len(found)] = found
        eighth[start : start + len(found)] = np.sqrt(distance2[:, TESTS - 1])

    if n:
        for_blocks(*blocks_of_leaves(index), task)
    reach = reach_of(lambda: (eighth,), n) if reach_m is None else reach_m
    if reach_m is None:
        for_blocks(
            n,
            _BLOCK,
            lambda start, stop: kernels.drop_far(index.points, places, reach**2, start, stop),
        )
    return places, np.minimum(eighth, reach) * math.sqrt(math.pi / TESTS), reach
