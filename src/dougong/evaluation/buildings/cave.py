"""A cave temple: a rock face with niches and statues, walkways, a tall timber front."""

from __future__ import annotations

import numpy as np

from dougong.evaluation.buildings.base import Building
from dougong.evaluation.buildings.hall import bays, frame, roof_on
from dougong.evaluation.buildings.roofs import hipped, skirt
from dougong.evaluation.buildings.timber import podium, steps
from dougong.evaluation.mesh import FINE, Mesh, join
from dougong.evaluation.solids import Floats, ball, beam, box, lathe, mound, pipe


class _Rock:
    """The rock face as depth y over x and height, without niches."""

    def __init__(self, rng: np.random.Generator) -> None:
        count = 34
        size = np.exp(rng.uniform(np.log(0.12), np.log(2.4), count))
        self.numbers = rng.normal(0.0, 1.0, (count, 2)) * (0.55 / size)[:, None]
        self.sizes = 0.34 * size * rng.uniform(0.4, 1.0, count)
        self.phases = rng.uniform(0, 2 * np.pi, count)
        self.tall = rng.uniform(17.0, 21.0)

    def depth(self, x: Floats, z: Floats) -> Floats:
        """Return y of the face: leaning back, bulging, with ledges."""
        total = 0.16 * z + 0.0016 * np.minimum(np.abs(x), 34.0) ** 2 + 0.012 * x
        for (kx, kz), size, phase in zip(self.numbers, self.sizes, self.phases, strict=True):
            total = total + size * np.sin(kx * x + kz * z + phase)
        ledge = 0.18 * np.tanh(3 * np.sin(1.15 * z + 0.05 * x))
        shaped: Floats = total + ledge
        return shaped


Niche = tuple[float, float, float, float, float]
"""Centre x, foot z, width, height, depth."""


def _carve(y: Floats, x: Floats, z: Floats, niches: list[Niche]) -> Floats:
    """Return the face with round-headed niches cut to an upright back."""
    carved = y.copy()
    for cx, foot, width, tall, deep in niches:
        u = np.abs(x - cx) / (width / 2)
        arch = foot + tall - 0.4 * width * (1 - np.sqrt(np.clip(1 - u**2, 0, 1)))
        edge = np.minimum.reduce([(1 - u) * width / 2, z - foot, arch - z])
        share = np.clip(edge / 0.3, 0.0, 1.0)
        back = np.max(y[(np.abs(x - cx) < width / 2) & (z > foot) & (z < foot + tall)], initial=0.0)
        target = np.maximum(carved, back + deep)
        carved = carved + share * (target - carved)
    return carved


def _face(rock: _Rock, half: float, niches: list[Niche]) -> Mesh:
    """Return the rock: its face, then the plateau behind its brow."""
    side = half + np.cumsum(np.linspace(0.2, 1.9, 30))
    x = np.concatenate([-side[::-1], np.linspace(-half, half, int(half * 2 / 0.15)), side])
    z = np.linspace(-1.5, rock.tall, int((rock.tall + 1.5) / 0.13))
    xx, zz = np.meshgrid(x, z, indexing="ij")
    y = _carve(rock.depth(xx, zz), xx, zz, niches)
    face = np.stack([xx, y, zz], axis=2)
    back = np.geomspace(0.4, 58.0, 32)
    plateau = np.repeat(face[:, -1:], len(back), axis=1)
    plateau[..., 1] += back
    sway = np.sin(0.35 * plateau[..., 0] + 0.2 * plateau[..., 1])
    plateau[..., 2] += (0.9 + 0.5 * sway) * (1 - np.exp(-back / 3.0)) + 0.02 * back
    grid = np.concatenate([face, plateau], axis=1)
    return mound(grid, (0.0, 25.0, -20.0))


def _buddha(tall: float) -> Mesh:
    """Return a seated figure on a lotus throne, facing -y, foot at the origin."""
    body = join(
        [
            lathe([(0.36, 0.0), (0.42, 0.06), (0.33, 0.1), (0.3, 0.16), (0.4, 0.24)], 18, "rock"),
            ball((0, -0.03, 0.3), (0.4, 0.26, 0.1), "gold", 0, 16),
            ball((0, 0.03, 0.5), (0.22, 0.16, 0.24), "gold", 0, 16),
            ball((0, 0.02, 0.64), (0.25, 0.13, 0.09), "gold", 0, 14),
            ball((0, 0, 0.83), (0.105, 0.11, 0.135), "gold", 0, 14),
            ball((0, 0.02, 0.97), (0.05, 0.05, 0.045), "gold", FINE, 10),
            ball((0.2, -0.08, 0.45), (0.07, 0.1, 0.17), "gold", 0, 10),
            ball((-0.2, -0.08, 0.45), (0.07, 0.1, 0.17), "gold", 0, 10),
            lathe([(0.3, 0.0), (0.3, 0.025)], 20, "gold").scaled(1, 1, 1).turned(0, (0, 0, 0.22)),
        ]
    )
    return body.scaled(tall, tall, tall)


def _guard(tall: float) -> Mesh:
    """Return a standing attendant."""
    parts = [
        lathe([(0.16, 0), (0.17, 0.04), (0.12, 0.06)], 12, "rock"),
        lathe(
            [(0.1, 0.05), (0.11, 0.3), (0.09, 0.5), (0.12, 0.7), (0.11, 0.78), (0.04, 0.82)],
            12,
            "gold",
        ),
        ball((0, 0, 0.9), (0.065, 0.07, 0.085), "gold", 0, 12),
        ball((0, -0.1, 0.62), (0.05, 0.05, 0.06), "gold", FINE, 8),
    ]
    return join(parts).scaled(tall, tall, tall)


def _walkway(x0: float, x1: float, z: float, rock: _Rock) -> Mesh:
    """Return a plank walkway on brackets along the face, with a rail."""
    line = np.linspace(x0, x1, max(3, int((x1 - x0) / 1.8) + 1))
    y = np.minimum(
        rock.depth(line, np.full(len(line), z)), rock.depth(line, np.full(len(line), z + 1.0))
    )
    parts = [
        pipe(np.column_stack([line, y - 0.75, np.full(len(line), z - 0.12)]), (1.7, 0.12), "timber")
    ]
    for h in (0.45, 0.95):
        path = np.column_stack([line, y - 1.5, np.full(len(line), z + h)])
        parts.append(pipe(path, (0.08, 0.09), "timber", FINE))
    for a, b in zip(line, y, strict=True):
        parts.append(beam((a, b - 1.55, z - 0.2), (a, b + 0.8, z - 0.2), (0.16, 0.18), "timber"))
        parts.append(
            beam((a, b - 1.3, z - 0.25), (a, b + 0.5, z - 1.5), (0.12, 0.12), "timber", FINE)
        )
        parts.append(box((a - 0.05, b - 1.56, z), (a + 0.05, b - 1.46, z + 1.05), "timber", FINE))
    return join(parts)


def _front(storeys: int) -> Mesh:
    """Return the timber front before the great niche: galleries with a roof each."""
    lines_x = bays(3, 3.8, 3.0)
    depth = 4.2
    z, parts = 0.9, [podium(7.6, 4.2, 0.9), steps(3.6, 0.9).turned(0, (0, -4.3, 0))]
    for level in range(storeys):
        lines = lines_x * (1 - 0.05 * level)
        lines_y = np.array([-0.5, 0.5]) * depth * (1 - 0.06 * level)
        tall = 3.2 - 0.2 * level
        over = 1.7
        hx, hy = float(lines[-1]) + over, float(lines_y[-1]) + over
        slope = roof_on(z, tall, over, 0.5 * hy, hy)
        has_bases = level == 0
        parts.append(
            frame(lines, lines_y, z, tall, slope, over, is_same_behind=False, has_bases=has_bases)
        )
        if level == storeys - 1:
            parts.append(hipped(hx, hy, slope, gable=hx - 2.2))
            break
        run = over + 0.02
        z = slope.above(run) + 0.3
        parts.append(skirt(hx, hy, slope, run))
        x, y = hx - over, hy - over
        parts.append(box((-x, -y, z - 1.2), (x, y, z), "timber"))
    return join(parts)


def build(rng: np.random.Generator, *, is_symmetric: bool = False) -> Building:
    """Return a rock face of 60 m with niches on two or three levels and a three-storeyed front."""
    del is_symmetric
    rock, half = _Rock(rng), 31.0
    niches: list[Niche] = [(-17.0, 0.9, 6.4, 8.6, 2.6)]
    for foot, size in ((1.0, 2.6), (6.4, 2.2), (11.0, 1.7)):
        x = -27.0 + rng.uniform(0, 2)
        while x < 28:
            width = size * rng.uniform(0.75, 1.15)
            tall = width * rng.uniform(1.1, 1.4)
            is_free = all(
                abs(x - cx) > (width + w) / 2 + 0.5 or foot > z + t for cx, z, w, t, _ in niches[:1]
            )
            if is_free and rng.random() < 0.8 and not (foot < 9 and abs(x - 4.0) < 8.0):
                niches.append(
                    (x, foot + rng.uniform(-0.3, 0.3), width, tall, rng.uniform(0.7, 1.4))
                )
            x += width + rng.uniform(0.8, 2.6)
    parts = [_face(rock, half, niches)]
    parts += _statues(rock, niches, rng)
    base = float(rock.depth(np.linspace(-2, 10, 30), np.full(30, 2.0)).min())
    parts.append(_front(3).turned(0, (4.0, base - 2.2, 0)))
    parts += [
        _walkway(-13.0, -4.5, 5.9, rock),
        _walkway(12.0, 27.0, 5.9, rock),
        _walkway(-12.0, -2.0, 10.6, rock),
    ]
    return Building(
        mesh=join(parts),
        stations=_stations(base, rng),
        half=(half - 2.0, 13.0),
        back=4.0,
        paths=((-29.0, base - 12.0, 29.0, base - 8.5), (2.0, -60.0, 6.0, base - 6.0)),
    )


def _statues(rock: _Rock, niches: list[Niche], rng: np.random.Generator) -> list[Mesh]:
    """Return one seated figure per niche, attendants where there is room."""
    parts = []
    for cx, foot, width, tall, deep in niches:
        x = np.linspace(cx - width / 2, cx + width / 2, 12)
        z = np.linspace(foot, foot + tall, 12)
        xx, zz = np.meshgrid(x, z)
        y = float(rock.depth(xx, zz).max()) + deep * 0.45
        size = min(0.8 * tall, 0.95 * width)
        parts.append(_buddha(size * 0.95).turned(rng.uniform(-3, 3), (cx, y, foot)))
        if width > 2.3:
            for side in (-1, 1):
                parts.append(
                    _guard(0.62 * size).turned(0, (cx + side * 0.36 * width, y - 0.05, foot))
                )
    return parts


def _stations(base: float, rng: np.random.Generator) -> Floats:
    y = base - 12.0
    at = np.array(
        [
            (4, y - 3, 0),
            (-8, y - 1, 0),
            (-20, y, 0),
            (16, y - 1, 0),
            (26, y + 1, 0),
            (-17, y + 7, 0),
            (4, y - 14, 0),
        ],
        dtype=np.float64,
    )
    at[:, :2] += rng.normal(0.0, 0.5, (len(at), 2))
    return at
