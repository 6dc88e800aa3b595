"""Density, noise and lie of a point set per zone: small cubes of space.

Sums run over integer lattice coordinates, so they are exact: no zone depends on the order of the
points or the thread count.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import corners_of
from dougong._sorting import distinct, grouped
from dougong.typing import Index, Mask, Points, Values

_LATTICE_M = 1e-4
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_FEWEST = 12
"""Points of a zone that are enough to fit a plane and judge what is left."""
_FLAT = 0.1
"""Share of the smallest spread in the middle one, up to which a zone is a piece of plane."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Where the zones lie."""

    low: NDArray[np.float64]
    """(3,) metres: a corner below every point, a zone away."""
    size: Index
    """(3,) zones along each axis, one spare on either side."""
    edge_m: float

    def cells(self, points: Points) -> Index:
        """Return the zone (n, 3) of each point, as whole numbers."""
        cells: Index = np.floor((points - self.low) / self.edge_m).astype(np.int64)
        return cells

    def keys(self, cells: Index) -> Index:
        """Return zones (n, 3) as single numbers (n,)."""
        keys: Index = cells @ self.strides()
        return keys

    def strides(self) -> Index:
        """Return what one step along x, y, z adds to a key, (3,)."""
        return np.array([self.size[1] * self.size[2], self.size[2], 1], dtype=np.int64)


def grid_over(sets: Iterable[Points], edge_m: float) -> Grid:
    """Return the zones over all of `sets` of points, anchored at their common low corner."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points in sets:
        if len(points):
            lowest, highest = corners_of(points)
            low, high = np.minimum(low, lowest), np.maximum(high, highest)
    size = np.floor((high - low) / edge_m).astype(np.int64) + 3
    return Grid(low=low - edge_m, size=size, edge_m=edge_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Zones:
    """The occupied zones of one point set, m of them, sorted by key."""

    grid: Grid
    keys: Index
    counts: Index
    noise_m: Values
    """(m,) standard deviation across the fitted plane; NaN where the zone is not flat."""
    normals: Points
    """(m, 3) unit normal of the plane; zero where the zone is not flat."""

    @property
    def typical_noise_m(self) -> float:
        """Median noise of the flat zones; NaN without any."""
        flat = np.isfinite(self.noise_m)
        return float(np.median(self.noise_m[flat])) if flat.any() else float("nan")

    def around(self, keys: Index) -> Index:
        """Return how many points lie in the 27 zones about each of `keys` (k,)."""
        total = np.zeros(len(keys), dtype=np.int64)
        strides = self.grid.strides()
        for step in itertools.product((-1, 0, 1), repeat=3):
            at, is_there = self.find(keys + int(np.dot(step, strides)))
            total += np.where(is_there, self.counts[at], 0)
        return total

    def of(self, points: Points) -> Index:
        """Return which of the zones each of `points` (n, 3) is in; these made them."""
        place: Index = np.searchsorted(self.keys, self.grid.keys(self.grid.cells(points)))
        return place

    def are_in(self, points: Points, keys: Index) -> Mask:
        """Return which of `points` (n, 3) lie in zones of these keys."""
        return np.isin(self.grid.keys(self.grid.cells(points)), keys)

    def find(self, keys: Index) -> tuple[Index, Mask]:
        """Return the place of each key among the zones, and whether it is there at all."""
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        is_there: Mask = self.keys[at] == keys
        return at, is_there


def zones_of(points: Points, grid: Grid) -> Zones:
    """Return the zones of `points` (n, 3), metres, n > 0."""
    sums = ZoneSums(grid)
    sums.add(points)
    return sums.zones()


class ZoneSums:
    """What zones are made from, as points come: 88 bytes per occupied zone."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._keys = np.empty(0, np.int64)
        # Count, first and second moments of the lattice coordinates about the zone's corner.
        self._sums = np.empty((0, 10))

    def add(self, points: Points) -> None:
        """Count `points` (n, 3), metres, in."""
        cells = self.grid.cells(points)
        keys, place, counts = grouped(self.grid.keys(cells))
        lattice = np.rint((points - (self.grid.low + cells * self.grid.edge_m)) / _LATTICE_M)
        count = len(keys)
        # Whole numbers far below 2**53: every sum is exact, whatever its order.
        first = [np.bincount(place, lattice[:, k], count) for k in range(3)]
        second = [np.bincount(place, lattice[:, a] * lattice[:, b], count) for a, b in _PAIRS]
        new = np.stack([counts.astype(np.float64), *first, *second], axis=1)
        both = distinct(np.concatenate([self._keys, keys]))
        sums = np.zeros((len(both), 10))
        sums[np.searchsorted(both, self._keys)] = self._sums
        sums[np.searchsorted(both, keys)] += new
        self._keys, self._sums = both, sums

    def zones(self) -> Zones:
        """Return the zones of all points that came."""
        counts, first, second = self._sums[:, 0], self._sums[:, 1:4], self._sums[:, 4:]
        mean = first / counts[:, None]
        spread = second - counts[:, None] * np.stack(
            [mean[:, a] * mean[:, b] for a, b in _PAIRS], 1
        )
        noise = np.full(len(counts), np.nan)
        normals = np.zeros((len(counts), 3))
        enough = np.flatnonzero(counts >= _FEWEST)
        values, vectors = np.linalg.eigh(
            spread[enough][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        )
        is_flat = values[:, 0] <= _FLAT * values[:, 1]
        flat = enough[is_flat]
        left = np.clip(values[is_flat, 0], 0.0, None) / (counts[flat] - 3)
        noise[flat] = np.sqrt(left) * _LATTICE_M
        normals[flat] = vectors[is_flat][:, :, 0]
        return Zones(
            grid=self.grid,
            keys=self._keys,
            counts=counts.astype(np.int64),
            noise_m=noise,
            normals=normals,
        )
