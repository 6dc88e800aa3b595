"""A round earth house (tulou): rammed ring wall, tiled ring roof, timber galleries, a shrine."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dougong.evaluation.buildings.base import Building
from dougong.evaluation.buildings.roofs import Slope, hipped
from dougong.evaluation.buildings.timber import lattice, podium
from dougong.evaluation.mesh import FINE, Mesh, join
from dougong.evaluation.solids import box, ring

_GATE = 1.5


def _swept(
    corners: list[tuple[float, float]], angles: np.ndarray, paint: str, label: int = 0
) -> Mesh:
    flat = np.array(corners)
    return ring(lambda a: np.broadcast_to(flat, (len(a), *flat.shape)), angles, paint, label)


def _wall(outer: float, tall: float, gates: list[float]) -> Mesh:
    """Return the rammed wall, thinner upwards, with a gateway at each angle of `gates`."""
    section = [(outer - 1.5, -0.6), (outer, -0.6), (outer - 0.45, tall), (outer - 1.2, tall)]
    gap = _GATE / outer
    stops = [*gates, gates[0] + 2 * np.pi]
    parts = []
    for a, b in pairwise(stops):
        count = max(8, int((b - a) * outer / 0.9))
        parts.append(_swept(section, np.linspace(a + gap, b - gap, count), "earth"))
        head = 3.3
        lean = 0.45 * head / tall
        over = [
            (outer - 1.45, head),
            (outer - lean, head),
            (outer - 0.45, tall),
            (outer - 1.2, tall),
        ]
        parts.append(_swept(over, np.linspace(a - gap - 0.002, a + gap + 0.002, 9), "earth"))
        frame = box(
            (-_GATE - 0.3, -outer - 0.12, -0.3), (-_GATE + 0.05, -outer + 0.5, 3.5), "stone"
        )
        lintel = box((-_GATE - 0.3, -outer - 0.12, 3.15), (_GATE + 0.3, -outer + 0.5, 3.6), "stone")
        both = [frame, frame.turned(180, (0, -2 * outer + 0.38, 0)), lintel]
        parts.append(join(both).turned(np.degrees(a) + 90))
    return join(parts)


def _windows(outer: float, tall: float, bays: int) -> Mesh:
    """Return the small framed windows of the upper storeys."""
    frame = join(
        [
            box((-0.38, -0.12, -0.06), (0.38, 0.3, 0.06), "timber", FINE),
            box((-0.38, -0.12, 0.84), (0.38, 0.3, 0.96), "timber", FINE),
            box((-0.38, -0.12, 0.0), (-0.28, 0.3, 0.9), "timber", FINE),
            box((0.28, -0.12, 0.0), (0.38, 0.3, 0.9), "timber", FINE),
            box((-0.3, -0.02, 0.0), (0.3, 0.3, 0.9), "dark", FINE),
        ]
    )
    parts = []
    for z in (0.55 * tall, 0.78 * tall):
        radius = outer - 0.45 * z / tall
        one = frame.turned(0, (0, -radius + 0.03, z))
        parts.append(one.repeated((360 / bays * (k + 0.5), (0, 0, 0)) for k in range(bays)))
    return join(parts)


def _roof(outer: float, inner: float, eave: float) -> Mesh:
    """Return the ring roof: two tiled slopes, far overhanging outside, with an underside."""
    rows = round(2 * np.pi * outer / 0.42)
    angles = np.linspace(0.0, 2 * np.pi, 4 * rows + 1)
    out, into = outer + 2.3, inner - 1.0
    ridge = 0.5 * (out + into) - 0.3
    share = np.array([0.0, 0.3, 0.65, 1.0])
    top = [(out + s * (ridge - out), eave + 2.5 * (0.8 * s + 0.2 * s * s)) for s in share]
    top += [
        (into + s * (ridge - into), eave + 0.35 + 2.15 * (0.8 * s + 0.2 * s * s))
        for s in share[2::-1]
    ]
    under = [(r, z - 0.22) for r, z in reversed(top)]
    flat = np.array(top + under)
    is_top = np.arange(len(flat)) < len(top)

    def section(a: np.ndarray) -> np.ndarray:
        corners = np.broadcast_to(flat, (len(a), *flat.shape)).copy()
        wave = np.maximum(0.0, np.sin(2 * np.pi * np.arange(len(a)) / 4))
        corners[:, is_top, 1] += 0.07 * wave[:, None]
        return corners

    z = eave + 2.5
    cap = [
        (ridge - 0.22, z - 0.1),
        (ridge + 0.22, z - 0.1),
        (ridge + 0.16, z + 0.32),
        (ridge - 0.16, z + 0.32),
    ]
    purlin = [
        (inner - 0.8, eave - 0.15),
        (inner - 0.6, eave - 0.15),
        (inner - 0.6, eave + 0.1),
        (inner - 0.8, eave + 0.1),
    ]
    return join(
        [
            ring(section, angles, "tile"),
            _swept(cap, np.linspace(0, 2 * np.pi, 97), "tile", FINE),
            _swept(purlin, np.linspace(0, 2 * np.pi, 97), "timber"),
        ]
    )


def _galleries(
    outer: float, inner: float, tall: float, storeys: int, bays: int, gates: list[float]
) -> Mesh:
    """Return the timber galleries on the courtyard side: floors, posts, rails, doors."""
    high = tall / storeys
    circle = np.linspace(0, 2 * np.pi, 3 * bays + 1)
    room = inner + 1.4
    parts = []
    for level in range(storeys):
        z = level * high
        if level:
            floor = [
                (inner - 0.2, z - 0.2),
                (outer - 1.2, z - 0.2),
                (outer - 1.2, z),
                (inner - 0.2, z),
            ]
            parts.append(_swept(floor, circle, "timber"))
            for h in (0.1, 0.5, 0.9):
                bar = [
                    (inner - 0.1, z + h),
                    (inner, z + h),
                    (inner, z + h + 0.09),
                    (inner - 0.1, z + h + 0.09),
                ]
                parts.append(_swept(bar, circle, "timber", FINE))
        for a, b in _between(gates, (_GATE + 0.1) / room if level == 0 else 0.0):
            wall = [
                (room, z),
                (room + 0.15, z),
                (room + 0.15, z + high - 0.2),
                (room, z + high - 0.2),
            ]
            parts.append(
                _swept(
                    wall,
                    np.linspace(a, b, max(4, round((b - a) / (2 * np.pi) * 3 * bays) + 1)),
                    "timber",
                )
            )
    radius = inner + 0.08
    post = box((-0.11, -radius - 0.11, 0), (0.11, -radius + 0.11, tall + 0.1), "timber")
    width = 2 * np.pi * room / bays
    for k in range(bays):
        yaw = 360 / bays * (k + 0.5)
        parts.append(post.turned(yaw))
        for level in range(storeys):
            if level == 0 and any(
                abs(np.angle(np.exp(1j * (np.radians(360 / bays * k - 90) - g)))) < 0.16
                for g in gates
            ):
                continue
            leaf = lattice(0.34 * width, high - 0.75, 0.8).turned(
                180, (0, -room + 0.1, level * high)
            )
            parts.append(leaf.turned(360 / bays * k))
    return join(parts)


def _between(gates: list[float], gap: float) -> list[tuple[float, float]]:
    """Return the arcs between the gates, each gate `gap` radians wide to either side."""
    if gap == 0.0:
        return [(0.0, 2 * np.pi)]
    stops = [*gates, gates[0] + 2 * np.pi]
    return [(a + gap, b - gap) for a, b in pairwise(stops)]


def build(rng: np.random.Generator, *, is_symmetric: bool = False) -> Building:
    """Return a ring of three or four storeys; one gate, or four when symmetric."""
    bays = 4 * int(rng.integers(6, 9))
    outer = bays * rng.uniform(0.72, 0.80)
    storeys = int(rng.integers(3, 5))
    tall = storeys * rng.uniform(2.9, 3.2)
    inner = outer - rng.uniform(4.6, 5.2)
    gates = [-np.pi / 2 + k * np.pi / 2 for k in range(4)] if is_symmetric else [-np.pi / 2]
    parts = [
        _wall(outer, tall, gates),
        _windows(outer, tall, bays),
        _roof(outer, inner, tall - 0.05),
        _galleries(outer, inner, tall, storeys, bays, gates),
    ]
    parts.append(_shrine(rng, is_symmetric))
    return Building(
        mesh=join(parts),
        stations=_stations(outer, inner, rng),
        half=(outer + 4.0, outer + 4.0),
        paths=((-1.6, -70.0, 1.6, -outer + 6.0),),
    )


def _shrine(rng: np.random.Generator, is_symmetric: bool) -> Mesh:
    """Return the ancestral hall in the middle of the courtyard."""
    x = rng.uniform(3.6, 4.4)
    y = x if is_symmetric else rng.uniform(2.8, 3.3)
    door = lattice(1.1, 2.4, 0.8)
    front = door.repeated((0.0, (s * 1.15, -y - 0.05, 0.4)) for s in (-1, 0, 1))
    sides = [front.turned(90 * k) for k in range(4)] if is_symmetric else [front]
    body = box((-x, -y, 0.2), (x, y, 3.5), "plaster")
    gable = None if is_symmetric else x - 0.2
    slope = Slope.seated(3.5, 1.0, 2.1, y + 1.1)
    roof = hipped(x + 1.1, y + 1.1, slope, gable=gable)
    return join([podium(x + 0.9, y + 0.9, 0.4), body, *sides, roof])


def _stations(outer: float, inner: float, rng: np.random.Generator) -> np.ndarray:
    angle = np.radians(-90 + 72 * np.arange(5) + rng.normal(0, 5, 5))
    far = outer + rng.uniform(9, 14, 5)
    around = np.column_stack([far * np.cos(angle), far * np.sin(angle), np.zeros(5)])
    r = inner - 3.2
    court = [(0.3, -r, 0), (r * 0.85, r * 0.5, 0), (-r * 0.85, r * 0.5, 0)]
    gate = [(0.2, -outer + 0.4, 0.0)]
    return np.vstack([around, court, gate])
