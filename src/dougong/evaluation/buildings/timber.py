"""Timber and stone parts: columns, bracket sets, doors, podiums, steps, rails."""

from __future__ import annotations

import numpy as np

from dougong.evaluation.mesh import FINE, Mesh, join
from dougong.evaluation.solids import ball, beam, block, box, lathe


def column(height: float, radius: float, *, has_base: bool = True) -> Mesh:
    """Return a column with entasis, on a stone base or not, foot at the origin."""
    z = np.array([0.0, 0.3, 0.6, 0.85, 0.97, 1.0]) * height
    r = np.array([1.0, 1.0, 0.97, 0.9, 0.82, 0.72]) * radius
    base = [(1.9, -0.05), (1.9, 0.06), (1.6, 0.16), (1.15, 0.2)]
    shaft = lathe(np.stack([r, z * (1 + 0.15 / height) + 0.0], 1), 14, "red")
    if not has_base:
        return shaft
    return join([shaft, lathe([(a * radius, b) for a, b in base], 14, "stone")])


def bracket_set(scale: float = 1.0, steps: int = 2) -> Mesh:
    """Return one dougong: its foot at the origin, reaching out towards -y.

    The great block carries crossed arms; every step reaches further out, carries a longer arm
    with three small blocks, and a slanted lever (ang) points out and down through them.
    """
    parts = [block((0, 0, 0), (0.42, 0.42, 0.24), "blue", FINE)]
    z = 0.2
    for step in range(steps + 1):
        out, half = 0.34 * step, 0.42 + 0.16 * (step % 2)
        parts.append(box((-half, -out - 0.07, z), (half, -out + 0.07, z + 0.18), "blue", FINE))
        parts.append(box((-0.07, -out - 0.42, z), (0.07, 0.34, z + 0.18), "blue", FINE))
        for x in (-half + 0.09, 0.0, half - 0.09):
            parts.append(block((x, -out, z + 0.18), (0.2, 0.2, 0.11), "blue", FINE))
        parts.append(block((0, -out - 0.34, z + 0.18), (0.2, 0.2, 0.11), "blue", FINE))
        z += 0.29
    tip = 0.34 * (steps + 1)
    parts.append(beam((0, 0.2, z), (0, -tip - 0.3, z - 0.42), (0.12, 0.17), "red", FINE))
    return join(parts).scaled(scale, scale, scale)


def bracket_height(scale: float = 1.0, steps: int = 2) -> float:
    """Return how high a bracket set lifts the purlin."""
    return scale * (0.2 + 0.29 * (steps + 1))


def lattice(width: float, height: float, solid_below: float) -> Mesh:
    """Return a door or window leaf in the x-z plane: a frame, bars, a panel behind and below."""
    parts = [
        box((-width / 2 - 0.015, 0.02, 0.0), (width / 2 + 0.015, 0.06, height), "timber"),
        box((-width / 2, -0.05, 0.0), (-width / 2 + 0.08, 0.02, height), "red", FINE),
        box((width / 2 - 0.08, -0.05, 0.0), (width / 2, 0.02, height), "red", FINE),
    ]
    for z in (0.0, solid_below, height - 0.1):
        parts.append(box((-width / 2, -0.05, z), (width / 2, 0.02, z + 0.1), "red", FINE))
    for x in np.arange(-width / 2 + 0.2, width / 2 - 0.1, 0.16):
        low, high = (x - 0.02, -0.03, solid_below), (x + 0.02, 0.02, height)
        parts.append(box(low, high, "red", FINE))
    for z in np.arange(solid_below + 0.22, height - 0.1, 0.2):
        low, high = (-width / 2, -0.035, z - 0.02), (width / 2, 0.015, z + 0.02)
        parts.append(box(low, high, "red", FINE))
    if solid_below > 0.5:
        low, high = (-width / 2 + 0.16, -0.03, 0.2), (width / 2 - 0.16, 0.02, solid_below - 0.12)
        parts.append(box(low, high, "red", FINE))
    return join(parts)


def steps(width: float, height: float, count: int | None = None) -> Mesh:
    """Return a flight that climbs from y = -run to y = 0 with a sloped stone at each side."""
    count = count or max(2, round(height / 0.16))
    rise, tread = height / count, 0.32
    parts = [
        box((-width / 2, -tread * (count - k), -0.3), (width / 2, 0.05, rise * (k + 1)), "stone")
        for k in range(count)
    ]
    run = tread * count
    for side in (-1, 1):
        x = side * (width / 2 + 0.18)
        parts.append(beam((x, -run - 0.1, -0.1), (x, 0.1, height), (0.36, 0.34), "stone"))
    return join(parts)


def rail(length: float, spacing: float = 1.5) -> Mesh:
    """Return a stone balustrade along x, its middle at the origin."""
    count = max(1, round(length / spacing))
    at = np.linspace(-length / 2, length / 2, count + 1)
    post = join(
        [
            block((0, 0, 0), (0.17, 0.17, 1.0), "stone"),
            ball((0, 0, 1.12), (0.1, 0.1, 0.16), sides=8),
        ]
    ).labelled(FINE)
    low = box((-length / 2, -0.05, 0.05), (length / 2, 0.05, 0.42), "stone", FINE)
    top = box((-length / 2, -0.06, 0.72), (length / 2, 0.06, 0.84), "stone", FINE)
    middle = (at[1:] + at[:-1]) / 2
    vase = block((0, 0, 0.42), (0.22, 0.1, 0.3), "stone", FINE)
    return join(
        [
            low,
            top,
            post.repeated((0.0, (x, 0.0, 0.0)) for x in at),
            vase.repeated((0.0, (x, 0.0, 0.0)) for x in middle),
        ]
    )


def podium(half_x: float, half_y: float, height: float) -> Mesh:
    """Return a stone platform with a plinth and a projecting cornice."""
    return join(
        [
            box((-half_x, -half_y, -0.6), (half_x, half_y, height - 0.18), "stone"),
            box(
                (-half_x - 0.1, -half_y - 0.1, height - 0.18), (half_x + 0.1, half_y + 0.1, height)
            ),
            box((-half_x - 0.12, -half_y - 0.12, -0.6), (half_x + 0.12, half_y + 0.12, 0.22)),
        ]
    )
