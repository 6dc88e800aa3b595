"""Wires: points on thin, level lines high over the ground with nothing else near them.

Kernels are imported when called.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dougong.filters.clusters import NEIGHBOURS
from dougong.filters.neighbourhood import Neighbourhood, build_index, count_within
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Values

BALL_M = 0.3
"""In this ball round a point of a wire there is nothing but the wire ..."""
THICK_M = 0.04
"""... which lies within this of a straight line, stray points apart."""
STRAY = 0.15
"""Share of the points in the ball that may lie elsewhere."""
LEAST_POINTS = 4
"""Points that there must be in the ball ..."""
CROWDED = 4.0
"""... and at most so many times what a line would hold on which the 8th nearest is as far."""
STEEPEST = 0.7
"""Sine of the slope that a wire may have."""
AHEAD_M = 2.0
"""A wire goes on for nearly so far to one side of each of its points at least ..."""
STEP_M = 0.4
"""... with no longer gap than this, ..."""
SPREAD = 0.1
"""... this much farther off the line per metre: it hangs, and its direction is uncertain."""
ROWS = 0.15
"""Where more of the high points than this lie on thin lines, these are the scanner's own rows, too
far apart to tell a wire by."""
_BLOCK = 1 << 12


class Lines(NamedTuple):
    """The points of an index that lie on thin lines; places in sorted order."""

    place: Index
    """(m,)"""
    line: Values
    """(m, 3) unit directions."""
    high: Mask
    """(n,) the points that were looked at: those high enough over the ground."""

    def counts(self, is_own: Mask) -> tuple[int, int]:
        """Return how many of the own points (n,) are high, and how many of these on lines."""
        return int((self.high & is_own).sum()), int(is_own[self.place].sum())


def are_rows(high: int, on_lines: int) -> bool:
    """Say whether so many of the `high` points of a cloud on lines are the scanner's rows."""
    return on_lines > ROWS * high


def halo_m() -> float:
    """Return how far outside a tile a point can matter."""
    return AHEAD_M + BALL_M


def thin_lines(index: Neighbourhood, height: Values, eighth_m: Values, least_m: float) -> Lines:
    """Find the points that lie on thin lines at least `least_m` above the ground.

    Parameters
    ----------
    index : Neighbourhood
    height : ndarray, shape (n,)
        Above the ground, in sorted order, as is everything here. Unknown (NaN) is no wire.
    eighth_m : ndarray, shape (n,)
        Distance to the 8th nearest other.
    least_m : float
    """
    high = height >= least_m
    return Lines(*_on_thin_lines(index, np.flatnonzero(high), eighth_m), high)


def runs_of_wires(index: Neighbourhood, lines: Lines) -> Values:
    """Return how far a wire goes on from each point (n,), metres in steps; 0: there is none."""
    from dougong.kernels import clusters as kernels

    run = np.zeros(len(index.points))
    asked = lines.place
    if not len(asked):
        return run
    others = build_index(index.points[asked])
    line = np.ascontiguousarray(lines.line[others.order])
    found = np.zeros(len(asked))

    def task(start: int, stop: int) -> None:
        kernels.runs_along(
            others.points, others.boxes, line, AHEAD_M, THICK_M, SPREAD, STEP_M, start, stop, found
        )

    for_blocks(len(asked), _BLOCK, task)
    run[asked[others.order]] = found
    return run


def _on_thin_lines(index: Neighbourhood, asked: Index, eighth_m: Values) -> tuple[Index, Values]:
    """Return those of the `asked` points (m,) that lie on a thin line, and its direction (k, 3)."""
    from dougong.kernels import clusters as kernels

    held = count_within(index, index.points[asked], BALL_M) if len(asked) else asked
    # Four of the eight lie on either side along a line.
    usual = 2.0 * BALL_M * (NEIGHBOURS / 2) / np.maximum(eighth_m[asked], 1e-9)
    is_possible = (held >= LEAST_POINTS) & (held <= np.maximum(CROWDED * usual, NEIGHBOURS + 1))
    asked, held = asked[is_possible], held[is_possible]
    line = np.empty((len(asked), 3))

    def task(start: int, stop: int) -> None:
        kernels.thin_lines(
            index.points,
            index.boxes,
            asked[start:stop],
            held[start:stop],
            BALL_M,
            THICK_M,
            0.5 * BALL_M,
            STEEPEST,
            STRAY,
            line[start:stop],
        )

    for_blocks(len(asked), _BLOCK, task)
    is_thin = np.isfinite(line[:, 0])
    return asked[is_thin], line[is_thin]
