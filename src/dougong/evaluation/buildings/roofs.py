"""Tiled roofs: concave slopes, upturned corners, rows of round tiles, an underside, rafters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.mesh import FINE, Mesh, join
from dougong.evaluation.solids import ball, beam, block, extruded, lathe, pipe, sheet

Floats = NDArray[np.float64]

THICKNESS = 0.22
"""Of tiles, bedding and boards, metres, measured upright."""


class Slope:
    """The shape every face of one roof shares: height over the distance from the eave."""

    def __init__(self, eave: float, rise: float, run: float, upturn: float, reach: float) -> None:
        self.eave, self.rise, self.run = eave, rise, run
        self.upturn, self.reach = upturn, reach

    def at(self, inward: Floats, from_corner: Floats) -> Floats:
        """Return the height `inward` metres behind the eave, `from_corner` along it."""
        # Juzhe: the slope steepens towards the ridge.
        share = np.clip(inward / self.run, 0.0, 1.0)
        height = self.eave + self.rise * (0.45 * share + 0.55 * share**2)
        near = np.clip(1.0 - from_corner / self.reach, 0.0, 1.0)
        fade = np.clip(1.0 - inward / self.reach, 0.0, 1.0)
        lifted: Floats = height + self.upturn * near**2.2 * fade
        return lifted

    @classmethod
    def seated(cls, purlin_top: float, inward: float, rise: float, run: float) -> Slope:
        """Return the slope whose underside rests on a purlin `inward` metres behind the eave."""
        loose = cls(0.0, rise, run, 0.11 * run, 0.75 * run)
        loose.eave = purlin_top + THICKNESS - loose.above(inward)
        return loose

    def above(self, inward: float) -> float:
        """Return the height `inward` metres behind the eave, far from any corner."""
        return float(self.at(np.array([inward]), np.array([1e3]))[0])


def face(
    half: float,
    apothem: float,
    slope: Slope,
    length: Callable[[Floats], Floats],
    *,
    pitch: float = 0.36,
    thickness: float = THICKNESS,
    paint: str = "tile",
) -> Mesh:
    """Return one tiled face, its eave along x at y = -apothem, climbing towards +y.

    length(x) is how far in the face reaches at x. Columns follow the tiles, six to a row.
    """
    rows = max(2, round(2 * half / pitch))
    x = np.linspace(-half + 0.01, half - 0.01, 6 * rows + 1)
    deep = np.maximum(length(x), 0.02)
    share = np.linspace(0.0, 1.0, 9) ** 1.1
    inward = share[:, None] * deep
    grid = np.empty((*inward.shape, 3))
    grid[..., 0] = x
    grid[..., 1] = inward - apothem
    grid[..., 2] = slope.at(inward, half - np.abs(x) + 0 * inward)
    under = grid - (0.0, 0.0, thickness)
    # Round tiles over flat ones: half of each row is a raised round back.
    wave = np.maximum(0.0, np.sin(2 * np.pi * np.arange(len(x)) / 6))
    grid[..., 2] += 0.075 * wave
    return sheet(grid, under, paint, 0)


def rafters(half: float, apothem: float, slope: Slope, depth: float) -> Mesh:
    """Return the rafters under the eave of a face."""
    parts = []
    for x in np.arange(-half + 0.3, half - 0.25, 0.42):
        reach = min(depth, half - abs(x))
        if reach < 0.3:
            continue
        ends = np.array([0.06, reach])
        z = slope.at(ends, np.full(2, half - abs(x))) - 0.22 - 0.06
        start, stop = ((x, y - apothem, h) for y, h in zip(ends, z, strict=True))
        parts.append(beam(start, stop, (0.12, 0.12), "timber", FINE))
    return join(parts)


def hip_line(
    corner: tuple[float, float], inner: tuple[float, float], slope: Slope, tangent: float
) -> Mesh:
    """Return the ridge along a hip from a corner inwards, with its row of small beasts."""
    start, stop = np.array(corner), np.array(inner)
    share = np.linspace(-0.02, 1.0, 12)[:, None]
    line = start + share * (stop - start)
    # On a hip the way in equals the way along the eave times the tangent of half the corner.
    whole = np.linalg.norm(stop - start) / np.hypot(1.0, tangent)
    inward = np.maximum(share[:, 0], 0.0) * whole
    z = slope.at(inward, inward * tangent) - 0.05
    parts = [pipe(np.column_stack([line, z]), (0.28, 0.3), "glazed", FINE)]
    long = float(np.linalg.norm(stop - start))
    for k in range(min(5, int(long / 0.7))):
        at = (0.2 + 0.34 * k) / long
        here = start + at * (stop - start)
        height = slope.at(np.array([at * whole]), np.array([at * whole * tangent]))[0]
        parts.append(block((*here, height + 0.3), (0.13, 0.13, 0.2), "glazed", FINE))
        parts.append(ball((*here, height + 0.5), (0.1, 0.1, 0.13), "glazed", FINE, 8))
    return join(parts)


def main_ridge(half: float, height: float) -> Mesh:
    """Return the ridge along x with an owl-tail ornament at each end."""
    x = np.linspace(-half, half, 13)
    z = height + 0.25 * (np.abs(x) / half) ** 3
    parts = [pipe(np.column_stack([x, np.zeros(13), z - 0.15]), (0.42, 0.75), "glazed", FINE)]
    for side in (-1.0, 1.0):
        curl = np.array([(1.0, 0.0), (1.04, 0.5), (0.99, 1.0), (0.9, 1.35)])
        path = np.column_stack(
            [side * (half - 0.45 * (1 - curl[:, 0]) * 8), 0 * curl[:, 0], height + curl[:, 1]]
        )
        for a, b, size in zip(path[:-1], path[1:], (0.75, 0.6, 0.4), strict=True):
            parts.append(beam(a, b, (0.34, size), "glazed", FINE))
    parts.append(ball((0.0, 0.0, height + 0.95), (0.28, 0.28, 0.42), "glazed", FINE))
    return join(parts)


def hipped(half_x: float, half_y: float, slope: Slope, *, gable: float | None = None) -> Mesh:
    """Return a hip roof, or a hip-and-gable roof whose ridge is `gable` metres half-long."""
    ridge = half_x - half_y if gable is None else gable
    deep_side = half_x - ridge

    def front(x: Floats) -> Floats:
        reach = half_x - np.abs(x)
        return np.where(np.abs(x) <= ridge, half_y, np.minimum(reach, half_y))

    def side(x: Floats) -> Floats:
        return np.minimum(half_y - np.abs(x), deep_side)

    parts = [_round(half_x, half_y, slope, front, side, deep_side)]
    if gable is not None:
        parts += [_gable(end, ridge, half_y, deep_side, slope) for end in (-1.0, 1.0)]
    top = slope.above(half_y)
    if ridge < 0.3:
        # A square plan has no ridge but a jewel.
        jewel = [
            (0.5, top - 0.3),
            (0.42, top + 0.3),
            (0.2, top + 0.5),
            (0.3, top + 0.8),
            (0.04, top + 1.2),
        ]
        parts.append(lathe(jewel, 16, "glazed", FINE))
    else:
        parts.append(main_ridge(ridge, top))
    return join(parts)


def skirt(half_x: float, half_y: float, slope: Slope, run: float) -> Mesh:
    """Return the eaves of a lower storey, reaching `run` metres in to a ridge along its wall."""

    def front(x: Floats) -> Floats:
        return np.minimum(half_x - np.abs(x), run)

    def side(x: Floats) -> Floats:
        return np.minimum(half_y - np.abs(x), run)

    x, y, z = half_x - run, half_y - run, slope.above(run) - 0.1
    along, across = (
        pipe([(-x, -y, z), (x, -y, z)], (0.3, 0.4)),
        pipe([(-x, -y, z), (-x, y, z)], (0.3, 0.4)),
    )
    bars = join([along, across]).labelled(FINE)
    return join([_round(half_x, half_y, slope, front, side, run), bars, bars.turned(180)])


def _round(
    half_x: float,
    half_y: float,
    slope: Slope,
    front: Callable[[Floats], Floats],
    side: Callable[[Floats], Floats],
    hip: float,
) -> Mesh:
    """Return the four faces of a rectangular roof, their rafters and hips (`hip` metres in)."""
    front_face = join([face(half_x, half_y, slope, front), rafters(half_x, half_y, slope, 1.5)])
    side_face = join([face(half_y, half_x, slope, side), rafters(half_y, half_x, slope, 1.5)])
    parts = [front_face, front_face.turned(180), side_face.turned(90), side_face.turned(270)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            corner, inner = (sx * half_x, sy * half_y), (sx * (half_x - hip), sy * (half_y - hip))
            parts.append(hip_line(corner, inner, slope, 1.0))
    return join(parts)


def _gable(side: float, ridge: float, half_y: float, deep: float, slope: Slope) -> Mesh:
    """Return the upright triangle over a side face, with its barge boards."""
    y = np.linspace(-(half_y - deep), half_y - deep, 15)
    z = slope.at(half_y - np.abs(y), np.full(15, 99.0)) - 0.12
    low = slope.at(np.array([deep]), np.array([99.0]))[0] - 0.3
    outline = np.column_stack([np.r_[y, y[-1], y[0]], np.r_[z, low, low]])
    wall = extruded(outline, -0.12, 0.12, "red").turned(90, (side * (ridge - 0.35), 0.0, 0.0))
    board = pipe(
        np.column_stack([np.full(15, side * ridge), y, z - 0.25]), (0.12, 0.5), "red", FINE
    )
    return join([wall, board])


def polygonal(sides: int, apothem: float, eave: float, rise: float, run: float) -> Mesh:
    """Return the eaves round a regular tower: one face per side, reaching `run` metres in."""
    tangent = float(np.tan(np.pi / sides))
    half = apothem * tangent
    slope = Slope(eave, rise, run, 0.16 * run + 0.2, 0.9 * half)

    def length(x: Floats) -> Floats:
        return np.minimum((half - np.abs(x)) / tangent, run)

    one = join([face(half, apothem, slope, length), rafters(half, apothem, slope, min(1.2, run))])
    corner = (half, -apothem)
    inner = (half - run * tangent, -(apothem - run))
    hip = hip_line(corner, inner, slope, tangent)
    return join([one, hip]).repeated((360 * k / sides, (0, 0, 0)) for k in range(sides))
