"""What stands about: small things apart from all else, and whether the other cloud shows them.

A building's copy fits as well as the building: the opposite corner, the next gallery, the twin
house. What stands about is nowhere twice. A thing of one cloud is *found* where the other shows
something standing in its place, *gone* where the other shows the bare ground it stood on, and says
nothing where the other shows neither. Things come and go between two surveys, so a true pose too
leaves some gone; but a wrong one finds no more of them than chance does. Things that a rival pose
finds as well (the columns of an arcade, two lions at a gate) repeat as the building does and are
not asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.stats import binom

from dougong._boxes import cells_in_plan
from dougong.filters.clusters import clusters_of, members
from dougong.filters.clutter_shapes import Shape, shape_of
from dougong.filters.neighbourhood import Neighbourhood, build_index, nearest
from dougong.kernels.raster import cell_min
from dougong.registration.evidence import Court
from dougong.registration.overlap import Rung, apply, inverse
from dougong.registration.prepare import Prepared
from dougong.typing import Index, Mask, Points, Transform, Values

_FOOT_M = 0.35
"""Lower than this above the ground is the ground's own roughness, kerbs and grass."""
_TOP_M = 0.6
_LARGEST_M = 6.0
_FEWEST = 15
_GAP_M = 0.3
_GAP_SPACINGS = 2.5
_ASKED = 64
"""Points of a thing that are looked for."""
_CELL_M = 0.5
_MOST_CELLS = 2000
"""Along one side of the picture of the floor."""
_SAME_FLOOR_M = 0.5
_FOUND = 0.4
"""A thing is found by so much of it: from another side another part of it is seen."""
_CLOSE_M = 0.5
_LEFT = 0.1
"""Of what is gone no more than this share is left, ..."""
_BARE = 0.5
"""... and on so much of its place the other cloud shows the ground."""
_BESIDE_M = (4.0, 7.0)
"""Chance is measured by moving everything so far in eight directions."""
_PRIOR = (1.0, 10.0)
"""One thing in ten is found by chance where nothing is known of it."""
_MANY = 3
"""Fewer things gone say nothing."""
_BY_CHANCE = 0.05
_BEYOND_CHANCE = 0.005
_TOGETHER_M = 4.0
"""Things no farther apart than this may have been moved together."""
_PERSON_M = ((0.9, 2.2), 1.1)
"""Top above the ground, longest side in plan of what may have walked away ..."""
_VEHICLE_M = ((1.1, 2.8), (2.6, 6.0), (1.2, 2.6))
"""... and top, length and width of what may have driven off: gone, it says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fates:
    """What became of the things of both clouds, the source's first, under one pose."""

    is_found: Mask
    is_gone: Mask


class _Floor(NamedTuple):
    """The height of the ground in plan, NaN where a cloud shows none."""

    low: NDArray[np.float64]
    cell_m: float
    height: NDArray[np.float64]

    def at(self, points: Points) -> Values:
        """Return the height (n,) of the ground at `points` (n, 3)."""
        is_on, i, j = cells_in_plan(points, self.low, self.cell_m, self.height.shape)
        height: Values = np.where(is_on, self.height[i, j], np.nan)
        return height


@dataclass(frozen=True, slots=True, kw_only=True)
class _Side:
    """The things of one cloud, and what it shows in the places of others'."""

    points: Points
    """(k, 3) of the things, above their foot."""
    height: Values
    """(k,) above the ground."""
    thing: Index
    """(k,) which thing, 0 .. count - 1."""
    may_go: Mask
    """(count,) of the size of a person or a vehicle."""
    standing: Neighbourhood
    """All of the cloud that stands above the ground."""
    floor: _Floor

    @property
    def count(self) -> int:
        """Return how many things there are."""
        return len(self.may_go)

    def middles(self) -> Points:
        """Return the middle (count, 3) of each thing."""
        held = np.maximum(np.bincount(self.thing, minlength=self.count), 1)
        sums = [np.bincount(self.thing, axis, self.count) for axis in self.points.T]
        middles: Points = np.column_stack(sums) / held[:, None]
        return middles


@dataclass(frozen=True, slots=True, kw_only=True)
class Telling:
    """How many of the things that are nowhere twice a pose finds."""

    found: int
    gone: int
    chance: float
    """Share of them that is found metres beside the pose."""

    @property
    def is_refuted(self) -> bool:
        """Say whether enough is gone, and no more found than by chance."""
        return self.gone >= _MANY and self._by_chance() > _BY_CHANCE

    @property
    def is_vouched(self) -> bool:
        """Say whether more is found than by chance."""
        return self.found >= _MANY and self._by_chance() <= _BEYOND_CHANCE

    def _by_chance(self) -> float:
        return float(binom.sf(self.found - 1, self.found + self.gone, self.chance))


@dataclass(frozen=True, slots=True, kw_only=True)
class Things:
    """The things of both clouds of a pair."""

    source: _Side
    target: _Side
    near_m: float
    """Two views of one surface lie no farther apart than this."""
    _known: dict[bytes, Fates] = field(default_factory=dict)
    """By pose: the winner is held against every rival, and each rival is asked twice."""

    def fates(self, T: Transform) -> Fates:
        """Return what a pose (source -> target) says of every thing."""
        key = T.tobytes()
        if key not in self._known:
            self._known[key] = self._fates(T)
        return self._known[key]

    def _fates(self, T: Transform) -> Fates:
        one = _fates(self.source, self.target, T, self.near_m)
        two = _fates(self.target, self.source, inverse(T), self.near_m)
        found, gone = zip(one, two, strict=True)
        return Fates(is_found=np.concatenate(found), is_gone=np.concatenate(gone))

    def groups(self, T: Transform) -> Index:
        """Return which things (count,) stand within 4 m of each other, in a chain, under a pose."""
        places = self._middles(T)[:, :2]
        pairs = cKDTree(places).query_pairs(_TOGETHER_M, output_type="ndarray")
        shape = len(places), len(places)
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=shape)
        group: Index = connected_components(graph, directed=False)[1].astype(np.int64)
        return group

    def _middles(self, T: Transform) -> Points:
        """Return the middle (count, 3) of every thing under a pose, in the target's frame."""
        return np.vstack([apply(T, self.source.middles()), self.target.middles()])

    def chance(self, T: Transform, asked: Mask, group: Index | None = None) -> float:
        """Return which share of the `asked` things is found by chance, metres beside a pose."""
        found, tries = _PRIOR
        for reach in _BESIDE_M:
            for turn in np.arange(8) * (np.pi / 4.0):
                beside = T.copy()
                beside[:2, 3] += reach * np.array([np.cos(turn), np.sin(turn)])
                fate = self.fates(beside)
                back, gone = _counted(fate.is_found & asked, fate.is_gone & asked, group)
                found, tries = found + back, tries + back + gone
        return float(found / tries)

    def found_by(self, poses: Sequence[Transform]) -> Mask:
        """Say which things (count,) are found under any of some poses."""
        found: Mask = np.zeros(self.source.count + self.target.count, bool)
        for T in poses:
            found |= self.fates(T).is_found
        return found

    def standing_on(self, is_on: Callable[[Points], Mask], T: Transform) -> Mask:
        """Say which things (count,) stand where `is_on` says so of points in the target's frame."""
        return is_on(self._middles(T))

    def telling(
        self, T: Transform, unasked: Mask | None = None, group: Index | None = None
    ) -> Telling:
        """Return how many things are found and gone under a pose.

        Not counted as gone is what may have walked or driven away.

        Parameters
        ----------
        T : ndarray, shape (4, 4)
            Source -> target.
        unasked : ndarray of bool, shape (count,), optional
            Things that prove nothing, such as what a rival finds as well.
        group : ndarray of int, shape (count,), optional
            Things of one group count once, found if one of them is; see `groups`.
        """
        fate = self.fates(T)
        is_asked = np.ones(len(fate.is_found), bool) if unasked is None else ~unasked
        may_go = np.concatenate([self.source.may_go, self.target.may_go])
        found, gone = _counted(fate.is_found & is_asked, fate.is_gone & is_asked & ~may_go, group)
        return Telling(found=found, gone=gone, chance=self.chance(T, is_asked, group))

    def speak_for(self, rival: Transform, winner: Transform) -> int:
        """Return how many things gone under the winner are found under a rival; 0: by chance."""
        first, second = self.fates(winner), self.fates(rival)
        gone, back = int(first.is_gone.sum()), int((first.is_gone & second.is_found).sum())
        if back < 2:
            return 0
        chance = self.chance(rival, first.is_gone)
        return back if binom.sf(back - 1, gone, chance) <= _BEYOND_CHANCE else 0


def _counted(is_found: Mask, is_gone: Mask, group: Index | None) -> tuple[int, int]:
    """Return how many things, or groups of them, are found, and how many are only gone."""
    if group is None:
        return int(is_found.sum()), int(is_gone.sum())
    found = set(group[is_found].tolist())
    return len(found), len(set(group[is_gone].tolist()) - found)


def things_of(court: Court, source: Prepared, target: Prepared) -> Things:
    """Return what stands about in two clouds that are heard in `court`."""
    one, two = court.source.everything, court.target.everything
    return Things(
        source=_side(source, one),
        target=_side(target, two),
        near_m=court.tolerance_m + max(one.spacing_m, two.spacing_m),
    )


def _side(prepared: Prepared, everything: Rung) -> _Side:
    """Return the things of a cloud that stand on the ground by themselves, up to 6 m wide."""
    is_ground = prepared.is_ground[everything.index]
    height = prepared.height_above_ground[everything.index]
    is_standing = ~is_ground & (height > _FOOT_M)
    index = build_index(everything.xyz[is_standing])
    height = height[is_standing][index.order]
    stand = _standing(index, height, everything.spacing_m) if prepared.has_ground else []
    asked = [places[:: -(-len(places) // _ASKED)] for places in stand]
    places = np.concatenate([np.zeros(0, np.int64), *asked])
    may_go = [_may_go(shape_of(index.points[thing], height[thing])) for thing in stand]
    return _Side(
        points=index.points[places],
        height=height[places],
        thing=np.repeat(np.arange(len(asked)), [len(places) for places in asked]),
        may_go=np.array(may_go, dtype=bool),
        standing=index,
        floor=_floor(everything.xyz[is_ground], everything.spacing_m),
    )


def _standing(index: Neighbourhood, height: Values, spacing_m: float) -> list[Index]:
    """Return the places of the points of each thing."""
    gap = max(_GAP_M, _GAP_SPACINGS * spacing_m)
    clusters = clusters_of(index, np.full(len(index.points), gap), gap)
    is_small = (clusters.held >= _FEWEST) & (clusters.longest_m < _LARGEST_M)
    return [
        places
        for places in members(clusters, np.flatnonzero(is_small))
        if height[places].min() < _FOOT_M + gap and height[places].max() > _TOP_M
    ]


def _may_go(shape: Shape) -> bool:
    (low, high), long = _PERSON_M
    is_person = low < shape.top_m < high and shape.length_m < long
    is_vehicle = all(
        low < value < high
        for value, (low, high) in zip(
            (shape.top_m, shape.length_m, shape.width_m), _VEHICLE_M, strict=True
        )
    )
    return is_person or is_vehicle


def _floor(ground: Points, spacing_m: float) -> _Floor:
    if not len(ground):
        return _Floor(np.zeros(2), 1.0, np.full((1, 1), np.nan))
    low = ground[:, :2].min(axis=0)
    widest = float((ground[:, :2].max(axis=0) - low).max())
    cell = max(_CELL_M, 2.0 * spacing_m, widest / _MOST_CELLS)
    i, j = np.ascontiguousarray(np.floor((ground[:, :2] - low) / cell).astype(np.int64).T)
    shape = int(i.max()) + 1, int(j.max()) + 1
    height = np.full(shape, np.nan)
    cell_min(j, i, np.ascontiguousarray(ground[:, 2]), shape, height)
    return _Floor(low, cell, height)


def _fates(from_: _Side, to: _Side, T: Transform, near_m: float) -> tuple[Mask, Mask]:
    """Return which things of one cloud the other shows, and which it shows to be gone."""
    if not from_.count or not len(to.standing.points):
        return np.zeros(from_.count, bool), np.zeros(from_.count, bool)
    held = np.bincount(from_.thing, minlength=from_.count)

    def share(is_so: Mask) -> Values:
        counted: Values = np.bincount(from_.thing[is_so], minlength=from_.count) / held
        return counted

    moved = apply(T, from_.points)
    close = max(_CLOSE_M, near_m)
    at, distance = nearest(to.standing, moved, close)
    distance = np.where(at >= 0, distance, np.inf)
    # NaN, where no ground is shown, compares false.
    is_bare = np.abs(to.floor.at(moved) - (moved[:, 2] - from_.height)) < _SAME_FLOOR_M
    is_found = share(distance <= near_m) >= _FOUND
    is_gone = (share(distance <= close) <= _LEFT) & (share(is_bare) >= _BARE)
    return is_found, is_gone
