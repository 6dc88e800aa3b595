"""A length of city wall: sloped brick faces, bastions, crenellations, an arched gate, its tower."""

from __future__ import annotations

import numpy as np

from dougong.evaluation.buildings.base import Building
from dougong.evaluation.buildings.hall import bays, frame, roof_on
from dougong.evaluation.buildings.roofs import hipped, skirt
from dougong.evaluation.buildings.timber import rail
from dougong.evaluation.mesh import FINE, Mesh, join
from dougong.evaluation.solids import Floats, block, box, extruded, skin

_LEAN = 0.14


def _arch(half: float, tall: float, gate: float, spring: float) -> Floats:
    """Return the outline of a wall section with an arched opening, x and z."""
    angle = np.linspace(0.0, np.pi, 13)
    opening = np.column_stack([gate * np.cos(angle), spring + gate * np.sin(angle)])
    return np.vstack(
        [
            (-half, -1.0),
            (-half, tall),
            (half, tall),
            (half, -1.0),
            (gate, -1.0),
            opening,
            (-gate, -1.0),
        ]
    )


def _solid(
    x0: float, x1: float, front: float, back: float, tall: float, lean_x: float = 0.0
) -> Mesh:
    """Return a block with battered sides from y = -front to y = back at its top."""
    foot = -1.0
    extra = _LEAN * (tall - foot)
    rings = []
    for z, out in ((foot, extra), (tall, 0.0)):
        s = out * lean_x
        rings.append(
            [
                (x0 - s, -front - out, z),
                (x1 + s, -front - out, z),
                (x1 + s, back + out, z),
                (x0 - s, back + out, z),
            ]
        )
    return skin(np.array(rings), "brick")


def _merlons(x0: float, x1: float, y: float, z: float) -> Mesh:
    """Return a crenellated parapet along x on its outer edge."""
    parts = [box((x0, y - 0.28, z), (x1, y + 0.28, z + 0.75), "brick")]
    for x in np.arange(x0 + 0.55, x1 - 0.4, 1.65):
        parts.append(block((x, y, z + 0.75), (1.05, 0.46, 0.95), "brick", FINE))
        parts.append(block((x, y, z + 1.7), (1.15, 0.58, 0.09), "stone", FINE))
    return join(parts)


def _tower(rng: np.random.Generator, z: float, depth: float) -> tuple[Mesh, float]:
    """Return the gate tower, two roofs one over the other, and its half length."""
    lines_x = bays(5, 4.2, rng.uniform(3.1, 3.5))
    lines_y = bays(2, 0.40 * depth, 0.40 * depth)
    tall = rng.uniform(3.5, 3.9)
    half_x, half_y = float(lines_x[-1]), float(lines_y[-1])
    over = 2.0
    slope = roof_on(z, tall, over, 2.6, half_y + over)
    lower = frame(lines_x, lines_y, z, tall, slope, over, is_same_behind=True)
    inner_x, inner_y = lines_x * 0.86, lines_y * 0.8
    run = over + float(lines_y[-1] - inner_y[-1]) - 0.5
    floor = slope.above(run) + 0.35
    hx, hy = float(inner_x[-1]), float(inner_y[-1])
    stage = box((-hx - 0.7, -hy - 0.7, floor - 1.2), (hx + 0.7, hy + 0.7, floor), "timber")
    top = roof_on(floor, 2.6, over, 0.62 * (hy + over), hy + over)
    upper = frame(inner_x, inner_y, floor, 2.6, top, over, is_same_behind=True, has_bases=False)
    fence = rail(2 * hx + 1.2).turned(0, (0, -hy - 0.6, floor))
    parts = [
        lower,
        skirt(half_x + over, half_y + over, slope, run),
        stage,
        upper,
        fence,
        fence.turned(180),
        hipped(hx + over, hy + over, top, gable=hx - 0.7),
    ]
    return join(parts), half_x


def build(rng: np.random.Generator, *, is_symmetric: bool = False) -> Building:
    """Return a straight wall of 60 to 70 m with the gate off its middle."""
    half, tall = rng.uniform(29, 34), rng.uniform(8.0, 9.5)
    depth = rng.uniform(8.5, 10.0)
    gate_x = 0.0 if is_symmetric else rng.uniform(-5, 5)
    gate, block_half, proud = 2.3, 12.0, 2.6
    top = depth / 2
    parts = [
        _solid(-half, gate_x - block_half, top, top, tall),
        _solid(gate_x + block_half, half, top, top, tall),
    ]
    outline = _arch(block_half, tall, gate, 3.0)
    batter = _LEAN

    def front(z: Floats) -> Floats:
        return -(top + proud + batter * (tall - z))

    def back(z: Floats) -> Floats:
        return top + (proud if is_symmetric else 0.0) + batter * (tall - z)

    parts.append(extruded(outline, front, back, "brick").turned(0, (gate_x, 0, 0)))
    parts.append(
        _gate_trim(gate, 3.0, -(top + proud + batter * (tall - 3.0))).turned(0, (gate_x, 0, 0))
    )
    tower, _ = _tower(rng, tall + 0.1, depth)
    parts.append(tower.turned(0, (gate_x, 0, 0)))
    parts += _parapets(half, top, tall, gate_x, block_half, proud, is_symmetric)
    at = [-0.8 * half, 0.72 * half] if not is_symmetric else [-0.76 * half, 0.76 * half]
    for x in at:
        parts.append(_solid(x - 3.2, x + 3.2, top + 4.2, 0.0, tall, 1.0))
        parts.append(_merlons(x - 3.2, x + 3.2, -top - 4.2 + 0.3, tall))
    if is_symmetric:
        parts += [part.turned(180) for part in parts[-4:]]
    if not is_symmetric:
        parts.append(_ramp(gate_x + block_half + 2.0, top, tall))
    return Building(
        mesh=join(parts),
        stations=_stations(half, top, tall, gate_x, rng),
        half=(half + 3.0, top + 8.0),
        paths=((gate_x - 2.4, -60.0, gate_x + 2.4, 60.0),),
    )


def _gate_trim(gate: float, spring: float, y: float) -> Mesh:
    """Return the ring of voussoirs round the arch and the inscribed tablet above it."""
    stones = []
    for angle in np.linspace(0.0, 180.0, 19):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        centre = np.array([(gate + 0.3) * c, 0.0, spring + (gate + 0.3) * s])
        one = box((-0.18, y - 0.06, -0.26), (0.18, y + 0.9, 0.26), "stone", FINE)
        x, z = one.vertices[:, 0].copy(), one.vertices[:, 2].copy()
        one.vertices[:, 0], one.vertices[:, 2] = x * s + z * c, z * s - x * c
        stones.append(one.turned(0.0, tuple(centre)))
    high = spring + gate + 1.2
    lean = _LEAN * (high - spring)
    tablet = box((-1.4, y - 0.1 + lean, high), (1.4, y + 0.9 + lean, high + 0.9), "stone")
    letters = [
        box((x - 0.2, y - 0.14 + lean, high + 0.2), (x + 0.2, y + lean, high + 0.7), "dark", FINE)
        for x in (-0.8, 0.0, 0.8)
    ]
    return join([*stones, tablet, *letters])


def _courses(x0: float, x1: float, y: float, tall: float) -> Mesh:
    """Return the moulded brick courses under a parapet and the stone waterspouts."""
    parts = [
        box((x0, y - 0.10, tall - 0.12), (x1, y + 0.3, tall + 0.02), "brick", FINE),
        box((x0, y - 0.05, tall - 0.30), (x1, y + 0.3, tall - 0.2), "brick", FINE),
    ]
    spout = box((-0.12, y - 0.75, tall - 0.5), (0.12, y + 0.3, tall - 0.32), "stone", FINE)
    places = np.arange(x0 + 3.0, x1 - 1.0, 6.0)
    return join([*parts, spout.repeated((0.0, (x, 0.0, 0.0)) for x in places)])


def _parapets(
    half: float, top: float, tall: float, gate_x: float, block_half: float, proud: float, both: bool
) -> list[Mesh]:
    """Return the battlements outside and the low parapet towards the town."""
    left, right = gate_x - block_half, gate_x + block_half
    outer = [
        _merlons(-half, left, -top + 0.3, tall),
        _merlons(left, right, -top - proud + 0.3, tall),
        _merlons(right, half, -top + 0.3, tall),
        _courses(-half, left, -top, tall),
        _courses(left, right, -top - proud, tall),
        _courses(right, half, -top, tall),
    ]
    if both:
        return [*outer, *(part.turned(180) for part in outer)]
    return [*outer, box((-half, top - 0.5, tall), (half, top - 0.05, tall + 0.8), "brick")]


def _ramp(x: float, top: float, tall: float) -> Mesh:
    """Return the horse ramp up the town side, in long steps."""
    count = 26
    length = 2.2 * tall
    parts = [
        box(
            (x + length * k / count, top - 0.2, -0.6),
            (x + length, top + 3.4 + 0.0 * k, tall * (k + 1) / count - 0.05),
            "brick",
        )
        for k in range(count)
    ]
    return join(parts)


def _stations(
    half: float, top: float, tall: float, gate_x: float, rng: np.random.Generator
) -> Floats:
    front, back = -top - 14.0, top + 13.0
    at = [
        (gate_x, front, 0),
        (-0.62 * half, front + 1, 0),
        (0.6 * half, front, 0),
        (0.5 * half, back, 0),
        (gate_x - 1, back, 0),
        (-0.6 * half, back - 2, 0),
        (gate_x, -2.0, 0.0),
        (-0.55 * half, 0.4, tall),
        (0.45 * half, -0.5, tall),
    ]
    places = np.array(at, dtype=np.float64)
    places[:6, :2] += rng.normal(0.0, 0.8, (6, 2))
    return places
