"""A timber hall: podium, columns, bracket sets under curved eaves, hip-and-gable roof."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.buildings.base import Building
from dougong.evaluation.buildings.roofs import THICKNESS, Slope, hipped
from dougong.evaluation.buildings.timber import (
    bracket_height,
    bracket_set,
    column,
    lattice,
    podium,
    rail,
    steps,
)
from dougong.evaluation.mesh import Mesh, join
from dougong.evaluation.solids import box

Floats = NDArray[np.float64]

PURLIN_OUT_M = 1.02
"""How far the eave purlin stands out from the columns, on its brackets."""
_RADIUS = 0.24


def bays(count: int, middle: float, side: float) -> Floats:
    """Return the column lines of `count` bays, the middle one widest."""
    widths = np.full(count, side)
    widths[count // 2] = middle
    lines = np.concatenate([[0.0], np.cumsum(widths)])
    centred: Floats = lines - lines[-1] / 2
    return centred


def purlin_top(floor: float, tall: float) -> float:
    """Return the height of the eave purlin's top, which the roof rests on."""
    return floor + tall + 0.12 + bracket_height() + 0.2


def roof_on(floor: float, tall: float, over: float, rise: float, run: float) -> Slope:
    """Return the slope of a roof that reaches `over` metres beyond the columns of a frame."""
    return Slope.seated(purlin_top(floor, tall), over - PURLIN_OUT_M, rise, run)


def frame(
    lines_x: Floats,
    lines_y: Floats,
    floor: float,
    tall: float,
    slope: Slope,
    over: float,
    *,
    is_same_behind: bool,
    has_bases: bool = True,
) -> Mesh:
    """Return columns, lintels, bracket sets and the walls between, all round, up to the roof."""
    under_roof = slope.above(over) - THICKNESS - 0.02
    top = floor + tall
    half_x, half_y = lines_x[-1], lines_y[-1]
    rim = [(x, y) for x in lines_x for y in (-half_y, half_y)]
    rim += [(x, y) for x in (-half_x, half_x) for y in lines_y[1:-1]]
    one = column(tall - 0.15, _RADIUS, has_base=has_bases)
    parts = [one.repeated((0.0, (*xy, floor)) for xy in rim)]
    for lines, other, yaw in ((lines_x, half_y, 0), (lines_y, half_x, 90)):
        for turn in (yaw, yaw + 180):
            is_front = turn == 0 or (is_same_behind and turn == 180)
            parts.append(_side(lines, other, floor, tall, under_roof, is_front).turned(turn))
    parts.append(box((-half_x, -half_y, top - 0.1), (half_x, half_y, top + 0.05), "timber"))
    return join(parts)


def _side(
    lines: Floats, out: float, floor: float, tall: float, under_roof: float, is_front: bool
) -> Mesh:
    """Return one side of the frame, on y = -out."""
    top = floor + tall
    half = lines[-1]
    parts = [
        box((-half - 0.3, -out - 0.1, top - 0.42), (half + 0.3, -out + 0.1, top), "blue"),
        box((-half - 0.4, -out - 0.2, top), (half + 0.4, -out + 0.2, top + 0.12), "blue"),
        box((-half, -out - 0.09, top - 0.85), (half, -out + 0.09, top - 0.6), "red"),
        box((-half, -out - 0.03, top - 0.62), (half, -out + 0.03, top - 0.4), "blue"),
    ]
    at = [*lines]
    for a, b in pairwise(lines):
        at += list(np.linspace(a, b, 3 if b - a > 3.2 else 2)[1:-1])
        parts.append(_bay(a, b, -out, floor, tall - 0.85, is_front))
    parts.append(bracket_set().repeated((0.0, (x, -out, top + 0.12)) for x in at))
    lift = top + 0.12 + bracket_height()
    reach = half + 1.02
    parts.append(box((-reach, -out - 1.12, lift), (reach, -out - 0.92, lift + 0.2), "timber"))
    parts.append(box((-half, -out - 0.04, top + 0.1), (half, -out + 0.04, under_roof), "plaster"))
    return join(parts)


def _bay(a: float, b: float, y: float, floor: float, tall: float, is_door: bool) -> Mesh:
    """Return what fills one bay: four lattice doors, or a wall with a window."""
    left, right = a + _RADIUS, b - _RADIUS
    if is_door:
        width = (right - left) / 4
        leaf = lattice(width - 0.02, tall, 0.9)
        return leaf.repeated((0.0, (left + width * (k + 0.5), y, floor)) for k in range(4))
    # A brick base under a plastered wall, set a little forward.
    base = box((a, y - 0.2, floor), (b, y + 0.2, floor + 0.95), "brick")
    return join([base, box((a, y - 0.15, floor + 0.9), (b, y + 0.15, floor + tall), "plaster")])


def build(rng: np.random.Generator, *, is_symmetric: bool = False) -> Building:
    """Return a hall of five bays by three or four."""
    lines_x = bays(5, rng.uniform(4.4, 5.0), rng.uniform(3.4, 3.9))
    lines_y = bays(int(rng.integers(3, 5)), rng.uniform(3.2, 3.6), rng.uniform(2.8, 3.3))
    floor, tall = rng.uniform(1.0, 1.5), rng.uniform(4.0, 4.6)
    half_x, half_y = float(lines_x[-1]), float(lines_y[-1])
    over = 2.3
    run = half_y + over
    slope = roof_on(floor, tall, over, 0.62 * run, run)
    roof = hipped(half_x + over, run, slope, gable=half_x - 0.9)
    out_x, out_y = half_x + 2.6, half_y + 2.6
    parts = [
        podium(out_x, out_y, floor),
        frame(lines_x, lines_y, floor, tall, slope, over, is_same_behind=is_symmetric),
        roof,
    ]
    parts += _outside(out_x, out_y, floor, is_symmetric)
    return Building(
        mesh=join(parts),
        stations=_stations(out_x, out_y, floor, rng),
        half=(out_x + 4.5, out_y + 6.0),
        paths=((-2.4, -60.0, 2.4, -out_y - 2.0),),
    )


def _outside(out_x: float, out_y: float, floor: float, is_symmetric: bool) -> list[Mesh]:
    """Return stairs and rails; the terrace of steps is on the front only, unless symmetric."""
    flight = steps(4.2, floor)
    parts = [flight.turned(0, (0, -out_y - 0.1, 0))]
    gap = 2.6
    run = out_x - 0.2 - gap
    front = rail(run).repeated([(0.0, (s * (gap + run / 2), -out_y + 0.1, floor)) for s in (-1, 1)])
    parts.append(front)
    parts.append(
        rail(2 * out_y - 0.4)
        .turned(90)
        .repeated((0.0, (s * (out_x - 0.1), 0, floor)) for s in (-1, 1))
    )
    if is_symmetric:
        parts += [flight.turned(180, (0, out_y + 0.1, 0)), front.turned(180)]
    else:
        parts.append(rail(2 * out_x - 0.4).turned(0, (0, out_y - 0.1, floor)))
    return parts


def _stations(x: float, y: float, floor: float, rng: np.random.Generator) -> Floats:
    ground = [
        (0, -y - 9),
        (x + 6, -y - 5),
        (x + 7, y + 6),
        (-1, y + 8),
        (-x - 7, y + 4),
        (-x - 6, -y - 6),
    ]
    at = np.array([(*xy, 0.0) for xy in ground] + [(x * 0.5, -y + 1.1, floor)])
    at[:, :2] += rng.normal(0.0, 0.4, (len(at), 2))
    return at
