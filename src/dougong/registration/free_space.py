"""What a scanner saw through: points in front of its surfaces contradict a pose.

A scan from one place is a picture with one range per direction. A point of the other cloud that a
pose puts well in front of that range would have stopped the beam. Two fronts of a symmetric
building fit each other as well as the truth, and from opposite sides the truth shares little: what
stands in the garden tells them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.kernels import sights
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

_CELL = np.radians(1.5)
_ROWS = round(np.pi / _CELL)
_LEAST_AROUND = 7
"""Of a cell and its eight neighbours so many must hold a range for it to be trusted."""
_MARGIN_M = 0.4
_MARGIN_SHARE = 0.05
_LEAST_POINTS = 500

# Finding the place: the true one sees one range per direction, any other looks through surfaces.
_TRIED_POINTS = 8000
_TRIED_STEP_M = 2.0
_MOST_TRIED = 1200
_EYE_M = 1.6
_EYE_SPREAD_M = 1.5
_OFF_EYE = 0.004
"""A metre off eye height counts as this share of hidden points: from higher up less is hidden
anyway."""
_BESIDE_M = 4.0
_TRIED_CELL = np.radians(3.0)
_FOUND_CELL = np.radians(2.0)
_HIDDEN = (1.15, 0.5)
"""A point is hidden beyond so many times the nearest range in its direction, and so much more."""
_PLACES = 8
"""Places per task."""
_MOST_HIDDEN = 0.02
# Four metres beside, so much more must be hidden in the typical direction: this many times, and
# this share. Of generated buildings 0.1 to 1.6 % are hidden from the place of one scan; from the
# best place of two or more scans 0.9 to 18 %, and beside it at most 2.4 times as much.
_TYPICAL = (2.2, 0.003)
_LEAST = 0.0005
"""And in every direction this share more: a lone wall looks alike from many places."""
_STARTS = 4
_RING_M = 4.0
_FINEST_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeSpace:
    """The picture of ranges of one scan."""

    place: NDArray[np.float64]
    """(3,) where the scanner stood."""
    ranges: NDArray[np.float64]
    """(rows, columns) nearest range in and around each direction; NaN where none is sure."""

    def mirrored(self) -> FreeSpace:
        """Return the same with x negated: azimuths run the other way."""
        columns = (_ROWS - 1 - np.arange(2 * _ROWS)) % (2 * _ROWS)
        return FreeSpace(
            place=self.place * np.array([-1.0, 1.0, 1.0]), ranges=self.ranges[:, columns]
        )

    def look(self, points: Points) -> tuple[Mask, Mask]:
        """Return which `points` (n, 3) the scanner saw through, and which it could have seen."""
        row, column, distance = _directions(points, self.place, _ROWS)
        seen = self.ranges[row, column]
        # Unknown directions compare false.
        through: Mask = distance < (1.0 - _MARGIN_SHARE) * seen - _MARGIN_M
        visible: Mask = distance < seen + _MARGIN_M
        return through, visible


def free_space(points: Points, seen_from: Points | None) -> FreeSpace | None:
    """Return what the scanner of a cloud saw through; None where it is no single scan.

    Several scans thinned as one have holes in each picture, where a point of another one was kept.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        In canonical order, metres, z about up.
    seen_from : ndarray, shape (n, 3), optional
        Where the scanner of each point stood, NaN where unknown. Without it the place of a scan
        from one station is found from its points, see `find_place`.
    """
    if seen_from is None:
        place = find_place(points)
    else:
        place = seen_from[0] if len(seen_from) and (seen_from == seen_from[0]).all() else None
    return None if place is None else FreeSpace(place=place, ranges=_ranges(points, place))


def find_place(points: Points) -> NDArray[np.float64] | None:
    """Return where a scanner stood that saw all `points` (n, 3); None where no place is sure.

    From its own place a scan has one range per direction; from elsewhere surfaces hide others.
    Places at eye height are tried all over the plan, and the best is shifted while it gets better.
    Good to about a metre in plan and half a metre in height.
    Scans from several stations hide points from everywhere, and a single wall hides none from
    anywhere: both have no answer.
    """
    few = points[:: max(1, len(points) // _TRIED_POINTS)]
    if len(few) < _LEAST_POINTS:
        return None
    tried = _eye_places(few)
    if not len(tried):
        return None
    order = np.argsort(_hidden(few, tried, _TRIED_CELL), kind="stable")
    found = [_settled(few, tried[k]) for k in order[:_STARTS]]
    least, best = min(found, key=lambda item: item[0])
    turns = np.arange(8) * np.pi / 4
    ring = best + _RING_M * np.column_stack([np.cos(turns), np.sin(turns), np.zeros(8)])
    beside = _hidden(few, ring, _FOUND_CELL)
    is_apart = float(np.median(beside)) >= _TYPICAL[0] * least + _TYPICAL[1]
    is_alone = beside.min() >= least + _LEAST
    return best if least <= _MOST_HIDDEN and is_apart and is_alone else None


def _settled(points: Points, place: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return how little is hidden from the best place near `place`, and that place."""
    eye, step = place[2], 1.0
    least = float(_hidden(points, place[None], _FOUND_CELL)[0])
    lowest, highest = eye - _EYE_SPREAD_M, eye + _EYE_SPREAD_M
    while step > _FINEST_M:
        around = place + step * _MOVES
        around = around[(lowest <= around[:, 2]) & (around[:, 2] <= highest)]
        costs = _hidden(points, around, _FOUND_CELL) + _OFF_EYE * np.abs(around[:, 2] - eye)
        if costs.min() < least:
            least, place = float(costs.min()), around[int(np.argmin(costs))]
        else:
            step /= 2.0
    return least, place


_MOVES = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0.5], [0, 0, -0.5]], dtype=np.float64
)


def _eye_places(points: Points) -> Points:
    """Return places (k, 3) at eye height above what lies lowest around them."""
    low, high = np.quantile(points[:, :2], [0.02, 0.98], axis=0)
    step = max(_TRIED_STEP_M, float(np.sqrt(np.prod(high - low) / _MOST_TRIED)))
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    plan = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    cell = np.floor((points[:, :2] - low) / _BESIDE_M).astype(np.int64)
    size = cell.max(axis=0) - cell.min(axis=0) + 1
    cell -= cell.min(axis=0)
    key = cell[:, 0] * size[1] + cell[:, 1]
    order = np.lexsort((points[:, 2], key))
    keys, first, count = np.unique(key[order], return_index=True, return_counts=True)
    # The tenth of the way up: a stray point below the ground is no floor.
    floor = points[order[first + count // 10], 2]
    asked = np.floor((plan - low) / _BESIDE_M).astype(np.int64) - np.floor(
        (points[:, :2].min(axis=0) - low) / _BESIDE_M
    ).astype(np.int64)
    at = np.searchsorted(keys, asked[:, 0] * size[1] + asked[:, 1])
    at = np.minimum(at, len(keys) - 1)
    is_known = keys[at] == asked[:, 0] * size[1] + asked[:, 1]
    places: Points = np.column_stack([plan, floor[at] + _EYE_M])[is_known]
    return places


def _hidden(points: Points, places: Points, cell: float) -> Values:
    """Return the share of points that others would hide from each of `places` (k, 3)."""
    points, places = np.ascontiguousarray(points), np.ascontiguousarray(places)
    shares = np.empty(len(places))

    def task(start: int, stop: int) -> None:
        sights.hidden_shares(points, places, round(np.pi / cell), *_HIDDEN, start, stop, shares)

    for_blocks(len(places), _PLACES, task)
    return shares


def _ranges(points: Points, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest range in and around each direction, NaN where few directions are known."""
    row, column, distance = _directions(points, place, _ROWS)
    nearest = np.full((_ROWS, 2 * _ROWS), np.inf)
    np.minimum.at(nearest, (row, column), distance)
    least, around = nearest.copy(), np.zeros(nearest.shape, np.int64)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            beside = np.roll(nearest, (down, right), axis=(0, 1))
            least = np.minimum(least, beside)
            around += np.isfinite(beside)
    least[~np.isfinite(nearest) | (around < _LEAST_AROUND)] = np.nan
    return least


def _directions(
    points: Points, place: NDArray[np.float64], rows: int
) -> tuple[Index, Index, Values]:
    """Return row (elevation), column (azimuth) and distance of each point seen from `place`."""
    sight = points - place
    distance = np.maximum(np.linalg.norm(sight, axis=1), 1e-6)
    elevation = np.arcsin(np.clip(sight[:, 2] / distance, -1.0, 1.0))
    azimuth = np.arctan2(sight[:, 1], sight[:, 0])
    row = np.clip(((elevation / np.pi + 0.5) * rows).astype(np.int64), 0, rows - 1)
    column = ((azimuth / np.pi + 1.0) * rows).astype(np.int64) % (2 * rows)
    return row, column, distance
