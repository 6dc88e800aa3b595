"""What stands about on a site: people, vehicles, poles, wires, and the heritage they resemble.

Every thing is a mesh in metres on z = 0 with a truth label of its own (`THINGS`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.mesh import Mesh, join
from dougong.evaluation.site import burner, car, lion, side_house, stele
from dougong.evaluation.solids import ball, beam, block, extruded, lathe, pipe

Rng = np.random.Generator

PERSON, VEHICLE, POLE, WIRE = 20, 21, 22, 23
STELE, LION, BURNER, LANTERN, STATUE, COLUMN, GATE_POST, HOUSE = range(30, 38)
THINGS: dict[int, str] = {
    PERSON: "person",
    VEHICLE: "vehicle",
    POLE: "pole",
    WIRE: "wire",
    STELE: "stele",
    LION: "lion",
    BURNER: "burner",
    LANTERN: "lantern",
    STATUE: "statue",
    COLUMN: "column",
    GATE_POST: "gate post",
    HOUSE: "small house",
}
"""The truth labels of what stands about; the first four are clutter."""


def visitor(rng: Rng) -> Mesh:
    """Return a person: grown-up or child, standing or walking, arms down or akimbo, some bags."""
    stride, hip = rng.choice([0.0, rng.uniform(0.1, 0.4)]), 0.09
    parts = []
    for side in (-1, 1):
        foot = (side * hip, side * stride, 0.0)
        parts.append(beam(foot, (side * hip, 0.0, 0.85), (0.14, 0.14), "dark"))
        out = rng.choice([0.02, rng.uniform(0.05, 0.25)])
        elbow = (side * (0.24 + out), rng.uniform(-0.1, 0.2), 1.12)
        parts.append(beam((side * 0.2, 0.0, 1.42), elbow, (0.09, 0.09), "cloth"))
        parts.append(beam(elbow, (side * 0.26, rng.uniform(-0.1, 0.3), 0.88), (0.07, 0.07)))
    trunk = lathe([(0.17, 0.8), (0.19, 1.1), (0.22, 1.38), (0.09, 1.5)], 12, "cloth")
    parts.append(trunk.scaled(1.0, 0.62, 1.0))
    parts.append(ball((0, 0, 1.63), (0.085, 0.1, 0.13), "earth", 0, 10))
    if rng.random() < 0.4:
        parts.append(block((0.0, -0.22, 1.02), (0.3, 0.18, 0.45), "dark"))
    tall = rng.choice([rng.uniform(0.88, 1.1), rng.uniform(0.68, 0.85)], p=[0.8, 0.2])
    return join(parts).scaled(tall, tall, tall).labelled(PERSON)


def vehicle(rng: Rng) -> Mesh:
    """Return a car, or a van."""
    if rng.random() < 0.65:
        return car(rng).labelled(VEHICLE)
    long, wide, tall = rng.uniform(4.7, 5.8), rng.uniform(1.8, 2.0), rng.uniform(1.9, 2.4)
    nose = -long / 2
    outline = [
        (nose, 0.35), (long / 2, 0.35), (long / 2, tall), (nose + 1.3, tall), (nose + 0.6, 1.15),
        (nose, 1.0),
    ]  # fmt: skip
    wheels = [
        block((x, y, 0.0), (0.6, 0.2, 0.5), "dark")
        for x in (nose + 0.9, -nose - 0.9)
        for y in (-wide / 2 + 0.1, wide / 2 - 0.1)
    ]
    body = extruded(outline, -wide / 2, wide / 2, "paint")
    return join([body, *wheels]).labelled(VEHICLE)


def pole(rng: Rng) -> Mesh:
    """Return a lamp post with an arm, a post with a sign, or a flagpole."""
    sort = rng.integers(3)
    if sort == 0:
        tall, thick = rng.uniform(4.0, 7.2), rng.uniform(0.05, 0.09)
        arm = rng.uniform(0.4, 1.1)
        parts = [
            lathe([(thick * 1.3, 0.0), (thick, 0.4), (thick * 0.7, tall)], 10, "dark"),
            beam((0, 0, tall - 0.05), (arm, 0, tall + 0.1), (0.05, 0.05), "dark"),
            block((arm, 0, tall + 0.05), (0.5, 0.2, 0.1), "dark"),
        ]
    elif sort == 1:
        tall, wide = rng.uniform(2.2, 3.2), rng.uniform(0.4, 0.7)
        parts = [
            lathe([(0.035, 0.0), (0.035, tall)], 8, "paint"),
            block((0, -0.045, tall - wide), (wide, 0.01, wide), "paint"),
        ]
    else:
        tall = rng.uniform(4.5, 7.5)
        parts = [lathe([(0.06, 0.0), (0.03, tall)], 10, "paint")]
    return join(parts).labelled(POLE)


def wire_pole(tall: float) -> Mesh:
    """Return a pole that carries wires, with its arm along y."""
    trunk = lathe([(0.13, 0.0), (0.09, tall)], 10, "stone")
    arm = block((0, 0, tall - 0.25), (0.08, 1.2, 0.08), "timber")
    return join([trunk, arm]).labelled(POLE)


def wire(start: NDArray[np.float64], stop: NDArray[np.float64], sag: float) -> Mesh:
    """Return a wire 14 mm thick between two points (3,), hanging by `sag` in its middle."""
    t = np.linspace(0.0, 1.0, 40)[:, None]
    path = start + t * (stop - start)
    path[:, 2] -= 4.0 * sag * (t * (1.0 - t))[:, 0]
    return pipe(path, (0.014, 0.014), "dark", WIRE)


def lantern(rng: Rng) -> Mesh:
    """Return a stone lantern: foot, shaft, light box, cap and jewel."""
    size = rng.uniform(0.85, 1.25)
    parts = [
        block((0, 0, -0.1), (0.75, 0.75, 0.3)),
        lathe([(0.3, 0.2), (0.2, 0.35), (0.13, 0.4), (0.12, 1.0), (0.3, 1.1)], 12),
        block((0, 0, 1.1), (0.38, 0.38, 0.38)),
        lathe([(0.46, 1.48), (0.42, 1.55), (0.12, 1.78), (0.1, 1.82)], 8),
        ball((0, 0, 1.9), (0.09, 0.09, 0.13), "stone", 0, 8),
    ]
    return join(parts).scaled(size, size, size).labelled(LANTERN)


def statue(rng: Rng) -> Mesh:
    """Return a standing figure in a long robe on a plinth."""
    size, plinth = rng.uniform(0.8, 1.15), rng.uniform(0.3, 0.8)
    robe = lathe([(0.26, 0.0), (0.24, 0.6), (0.2, 1.0), (0.23, 1.35), (0.08, 1.5)], 14)
    figure = join(
        [
            robe.scaled(1.0, 0.8, 1.0),
            beam((0.2, 0, 1.35), (0.1, -0.25, 1.05), (0.12, 0.12)),
            beam((-0.2, 0, 1.35), (-0.1, -0.25, 1.05), (0.12, 0.12)),
            ball((0, 0, 1.63), (0.11, 0.12, 0.15), "stone", 0, 12),
        ]
    ).scaled(size, size, size)
    foot = block((0, 0, -0.1), (0.75 * size, 0.65 * size, plinth + 0.1))
    return join([foot, figure.turned(0.0, (0, 0, plinth))]).labelled(STATUE)


def column(rng: Rng) -> Mesh:
    """Return a free-standing column on a base, carved like a huabiao, or plain."""
    thick, tall = rng.uniform(0.16, 0.3), rng.uniform(2.5, 5.5)
    parts = [
        block((0, 0, -0.1), (3.4 * thick, 3.4 * thick, 0.45)),
        lathe([(thick, 0.3), (thick * 0.85, tall)], 16),
        lathe([(thick * 1.5, tall), (thick * 1.5, tall + 0.12)], 16),
    ]
    if rng.random() < 0.5:
        parts.append(block((0, 0, tall - 0.7), (1.3, 0.1, 0.35)))
    parts.append(ball((0, 0, tall + 0.35), (0.2, 0.25, 0.25), "stone", 0, 10))
    return join(parts).labelled(COLUMN)


def gate_post(rng: Rng) -> Mesh:
    """Return one square stone post of a gate that is lost."""
    wide, tall = rng.uniform(0.28, 0.5), rng.uniform(1.6, 3.2)
    parts = [
        block((0, 0, -0.1), (wide, wide, tall + 0.1)),
        block((0, 0, tall), (wide * 1.25, wide * 1.25, 0.12)),
        ball((0, 0, tall + 0.25), (0.12, 0.12, 0.15), "stone", 0, 8),
    ]
    return join(parts).labelled(GATE_POST)


HERITAGE: dict[int, Callable[[Rng], Mesh]] = {
    STELE: lambda _: stele().labelled(STELE),
    LION: lambda _: lion().labelled(LION),
    BURNER: lambda _: burner().labelled(BURNER),
    LANTERN: lantern,
    STATUE: statue,
    COLUMN: column,
    GATE_POST: gate_post,
    HOUSE: lambda rng: side_house(rng).labelled(HOUSE),
}
"""What must not be taken for clutter, by its label."""
