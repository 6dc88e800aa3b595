"""What its surroundings say of every point: the distance tests of the protective rule, and links.

Of a cloud, or of a part with a halo of `HALO` reaches. Kernels are imported when called.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._boxes import are_within, corners_of
from dougong.filters.groups import LINK
from dougong.filters.local_spacing import FAR_CELLS, SMALLEST_M, local_spacing
from dougong.filters.ranks import ValueBlocks, at_rank
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

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
HALO = 1.0 + 2.0 * FAR_CELLS
"""Reaches that a part must know beyond its own points: those of a neighbour's spacing."""
_FOUND = 2.0
"""Reaches in which the neighbours of the neighbours of a part's own points lie."""
SLACK = 1.0 + 1e-9
"""What rounding may do to a border, and more."""
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


class Tests(NamedTuple):
    """How strictly points are tested; see `CurvatureWeighted`."""

    alpha: float
    gamma: float
    surface_loss: float


class Tested(NamedTuple):
    """What their surroundings say of the n own points of a cloud or a part, in their order."""

    margin: Values
    """(n,) above 1: too far from the others. Alone: 1 + the least that the first one out of reach
    has."""
    reason: NDArray[np.uint8]
    """(n,) `Taken`, of the test that says most."""
    spacing_m: Values
    """(n,) the spacing of the surface hereabouts, the yardstick."""
    curvature: Values
    """(n,) surface variation of the 12 nearest."""
    group: Index
    """(n,) the number, 0, 1, 2 ..., of the group of linked own points that it is in."""
    across: Index
    """(m, 2) links across the border: the group of own points, the place of a point of the halo."""


def middle_rank(eighth_m: ValueBlocks, points: int) -> int | None:
    """Return which of the eighth distances, ascending, is the middle one; None with too few.

    Of points that lie apart: more than eight at one place, as scanners write missing returns, have
    a distance of 0 and no spacing.
    """
    heaped = sum(int(np.count_nonzero(block == 0.0)) for block in eighth_m())
    apart = points - heaped
    return heaped + apart // 2 if apart > TESTS else None


def reach_of(eighth_m: ValueBlocks, points: int) -> float:
    """Return the reach, metres, of a cloud of so many `points`, by their eighth nearest others."""
    rank = middle_rank(eighth_m, points)
    if rank is None:
        return REACH_M
    spacing = at_rank(eighth_m, rank) * math.sqrt(math.pi / TESTS)
    reach = REACH_M
    while reach < SPARSE * spacing:
        reach *= 2.0
    while reach > 2.0 * DENSE * max(spacing, SMALLEST_M):
        reach /= 2.0
    return reach


def reach_for(points: ArrayLike) -> float:
    """Return the reach, metres, for a cloud (n, 3): `REACH_M` where it suits."""
    from dougong.filters.neighbourhood import build_index

    index = build_index(points)
    n = len(index.points)
    _, eighth = _neighbours(index, None, np.ones(n, bool))
    return reach_of(lambda: (eighth,), n)


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


def spacing_shown(eighth_m: Values, reach_m: float) -> Values:
    """Return the spacing (n,) that the distance to the eighth nearest other shows."""
    spacing: Values = np.minimum(eighth_m, reach_m) * math.sqrt(math.pi / TESTS)
    return spacing


def test_cloud(
    index: Neighbourhood, reach_m: float | None, tests: Tests, low: NDArray[np.float64]
) -> tuple[Tested, float]:
    """Test all points of a cloud; return what is found and the reach, given or found.

    low (3,): where the cells of `local_spacing` begin.
    """
    from dougong.kernels import protective as kernels

    n = len(index.points)
    is_all = np.ones(n, bool)
    places, eighth = _neighbours(index, reach_m, is_all)
    reach = reach_of(lambda: (eighth,), n) if reach_m is None else reach_m
    if reach_m is None:
        for_blocks(
            n,
            _BLOCK,
            lambda start, stop: kernels.drop_far(index.points, places, reach**2, start, stop),
        )
    spacing = local_spacing(index.points, spacing_shown(eighth, reach), reach, n, low)
    return _tested(index, places, spacing, n, is_all, reach, tests), reach


def test_part(
    points: Points,
    eighth_m: Values,
    own: int,
    reach_m: float,
    tests: Tests,
    low: NDArray[np.float64],
) -> Tested:
    """Test the first `own` of the points (n, 3) of a part; the others are its halo.

    eighth_m (n,): how far the eighth nearest other is, in the whole cloud. low (3,): of that.
    """
    from dougong.filters.neighbourhood import build_index

    if not own:
        return _nothing()
    lowest, highest = corners_of(points[:own])
    found = _FOUND * reach_m * SLACK
    is_near = are_within(points, lowest - found, highest + found)
    # What is farther has a say in the spacing only. Own points come first still.
    order = np.concatenate([np.flatnonzero(is_near), np.flatnonzero(~is_near)])
    near = int(is_near.sum())
    shown = spacing_shown(eighth_m[order], reach_m)
    spacing = local_spacing(points[order], shown, reach_m, near, low)
    index = build_index(points[order[:near]])
    reach = reach_m * SLACK
    is_seen = are_within(index.points, lowest - reach, highest + reach)
    places, _ = _neighbours(index, reach_m, is_seen)
    tested = _tested(index, places, spacing[index.order], own, is_seen, reach_m, tests)
    tested.across[:, 1] = order[tested.across[:, 1]] - own
    return tested


def _nothing() -> Tested:
    none = np.zeros(0)
    some = np.zeros(0, np.int64)
    return Tested(none, np.zeros(0, np.uint8), none, none, some, np.zeros((0, 2), np.int64))


def _neighbours(
    index: Neighbourhood, reach_m: float | None, is_seen: Mask
) -> tuple[NDArray[np.int32], Values]:
    """Return the places (n, 12) of every seen point's nearest, and the distance of the eighth."""
    from dougong.filters.neighbourhood import over_leaves, self_knn_block

    n = len(index.points)
    places = np.full((n, NEIGHBOURS), -1, np.int32)
    eighth = np.full(n, np.inf)
    limit2 = np.inf if reach_m is None else reach_m**2

    def task(first: int, last: int) -> None:
        start, found, distance2 = self_knn_block(index, NEIGHBOURS, limit2, first, last)
        places[start : start + len(found)] = found
        eighth[start : start + len(found)] = np.sqrt(distance2[:, TESTS - 1])

    over_leaves(index, is_seen, task)
    return places, eighth


def _tested(
    index: Neighbourhood,
    places: NDArray[np.int32],
    spacing: Values,
    own: int,
    is_seen: Mask,
    reach: float,
    tests: Tests,
) -> Tested:
    """Return what is found of the first `own` points; what comes in is in sorted order.

    The places in `across` are those in the array behind the index.
    """
    from dougong.filters.neighbourhood import over_leaves, points_of
    from dougong.kernels import protective as kernels

    n = len(index.points)
    curvature, frame = np.zeros(n), np.zeros((n, 9), np.float32)
    margin, decisive = np.empty(n), np.zeros(n, np.uint8)
    limits = distance_limits(tests.surface_loss)
    stretch = line_stretch(limits)

    def see(first: int, last: int) -> None:
        start, stop = points_of(index, first, last)
        kernels.frames(
            index.points, places, tests.alpha, tests.gamma, spacing, stretch, start, stop,
            curvature, frame,
        )  # fmt: skip

    def test(first: int, last: int) -> None:
        start, stop = points_of(index, first, last)
        kernels.support(
            index.points, places, frame, spacing, limits, reach, CHARGE, start, stop,
            margin, decisive,
        )  # fmt: skip

    is_own = index.order < own
    over_leaves(index, is_seen, see)
    over_leaves(index, is_own, test)
    group, across = _links(index, places, frame, spacing, is_own)
    rows = np.empty(own, np.int64)
    rows[index.order[is_own]] = np.flatnonzero(is_own)
    return Tested(
        margin[rows],
        _REASONS[decisive[rows]],
        spacing[rows],
        curvature[rows],
        group[rows],
        across,
    )


def _links(
    index: Neighbourhood,
    places: NDArray[np.int32],
    frame: NDArray[np.float32],
    spacing: Values,
    is_own: Mask,
) -> tuple[Index, Index]:
    """Return the group (n,) of every own point, and the links of groups with others (m, 2)."""
    from dougong.kernels import protective as kernels

    n = len(index.points)
    parent = np.arange(n)
    across = np.empty((0 if is_own.all() else n, 2), np.int64)
    links = kernels.link(index.points, places, frame, spacing, LINK, is_own, parent, across)
    if links > len(across):
        across = np.empty((links, 2), np.int64)
        kernels.link(index.points, places, frame, spacing, LINK, is_own, parent, across)
    is_root = is_own & (parent == np.arange(n))
    number = np.cumsum(is_root) - 1
    group = number[parent]
    pairs = group[across[:links, 0]] * n + index.order[across[:links, 1]]
    pairs = np.unique(pairs)
    return group, np.column_stack([pairs // n, pairs % n]) if n else across
