"""The part of a place that alone tells two poses apart, and whether the rest leaves both open.

Scaffolding that has moved to the other side of a house that equals itself turned by 180 degrees
speaks for the turned pose, with many blocks and beyond chance: blocks of one thing are no
independent witnesses of where the house lies. So the part that speaks loudest is left out, and what
is left is asked whether it knows which pose is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from dougong._boxes import cells_in_plan
from dougong.registration.evidence import Court, Testimony, structure_weights
from dougong.registration.overlap import apply
from dougong.registration.verdict import Verdict, compare, is_beaten
from dougong.typing import Mask, Points

_CELL_M = 2.0
_LOUD = 0.02
"""Cells that speak for the winner by this share of the loudest belong to a part."""
_MOST_M2 = 300.0
"""No scaffolding or market covers more: a part that does is the place itself."""
_AS_GOOD = 0.02
"""Without the part such a rival loses by less than this: by 0.002 to 0.005 where scaffolding moved,
by 0.05 between two galleries of a cloister, in too few blocks for a verdict."""
_REST = 0.25
"""A rival that explains less than this share of what the winner does, outside the part, is no pose
of the whole place: the part is the place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DecidingPart:
    """A connected region in plan, in the target's frame."""

    low: NDArray[np.float64]
    """(2,) corner of the raster."""
    held: NDArray[np.bool_]
    """(nx, ny) cells of 2 m."""

    def holds(self, points: Points) -> Mask:
        """Say which `points` (n, 3), in the target's frame, stand on it."""
        is_on, i, j = cells_in_plan(points, self.low, _CELL_M, self.held.shape)
        held: Mask = is_on & self.held[i, j]
        return held

    @property
    def area_m2(self) -> float:
        """Return how much of the plan it covers."""
        return _CELL_M**2 * float(self.held.sum())

    @property
    def size_m(self) -> tuple[float, float]:
        """Return its longer and its shorter side along the axes, metres."""
        sides = sorted(_CELL_M * (1.0 + float(np.ptp(axis))) for axis in np.nonzero(self.held))
        return sides[1], sides[0]


def deciding_part(
    court: Court, winner: Testimony, rival: Testimony, params: Verdict
) -> DecidingPart | None:
    """Return the part without which a beaten rival is as good as the winner; None: there is none.

    The largest region in plan that speaks for the winner, in cells of 2 m. None too where it is
    larger than what can be moved, or little is left beside it.
    """
    places = np.concatenate([apply(winner.T, court.source.points), court.target.points])
    part = _loudest(places, court.weights * (rival.loss - winner.loss))
    is_rest = ~part.holds(places)
    structure = structure_weights(court)
    left = float(structure @ (rival.is_explained & is_rest))
    if left < _REST * float(structure @ winner.is_explained) or part.area_m2 > _MOST_M2:
        return None
    rest = compare(court, winner, rival, params.block_m, is_rest)
    is_open = rest.gain < _AS_GOOD and not is_beaten(rest, params, is_close=True)
    return part if is_open else None


def _loudest(places: Points, speaks: NDArray[np.float64]) -> DecidingPart:
    """Return the connected cells of which the points speak for the winner most."""
    low = places[:, :2].min(axis=0)
    cell = np.floor((places[:, :2] - low) / _CELL_M).astype(np.int64)
    loud = np.zeros(cell.max(axis=0) + 1)
    np.add.at(loud, (cell[:, 0], cell[:, 1]), np.maximum(speaks, 0.0))
    parts, count = label(loud > _LOUD * loud.max(), np.ones((3, 3)))
    sums = np.bincount(parts.ravel(), loud.ravel(), count + 1)
    sums[0] = 0.0
    return DecidingPart(low=low, held=parts == int(np.argmax(sums)))
