"""What the bench works on: a generated site, a dense facade, and a pair of scans of the site."""

import numpy as np
from numpy.typing import NDArray

from dougong.typing import Index, Points, Values

Arrays = dict[str, NDArray[np.float64]]

SITE_M = 80.0
OUTLIERS = 0.015
FACADE_SPACING_M = 0.005
_HALL = (25.0, 55.0, 30.0, 50.0)
"""x low, x high, y low, y high of the hall."""
_NOISE_M = 0.01


def terrain(x: Values, y: Values, slope: float = 0.05) -> Values:
    """Return the height of the site's ground at x, y (metres)."""
    height: Values = slope * x + 0.8 * np.sin(x / 15) * np.cos(y / 12)
    return height


def hall_site(
    number: int,
    seed: int = 0,
    outliers: float = 0.0,
    depth: float = 6.0,
    slope: float = 0.05,
    size: float = SITE_M,
) -> tuple[Points, Index]:
    """Return (points, label) of a hall with trees and cars on 80 x 80 m of rolling terrain.

    label: 2 ground, 0 anything standing on it, 5 outliers: that share of all points, uniform
    from `depth` below the ground to 20 m above it. 1 cm noise on every surface; random order.
    """
    rng = np.random.default_rng(seed)
    n = int(number / (1 + outliers))
    x, y = rng.random((2, int(n * 0.6))) * size
    ground = np.column_stack([x, y, terrain(x, y, slope)])
    ground = ground[~((abs(x - 40) < 15) & (abs(y - 40) < 10))]
    points = np.concatenate([ground, *_standing(rng, n, slope, size)])
    points += rng.normal(0, _NOISE_M, points.shape)
    label = np.where(np.arange(len(points)) < len(ground), 2, 0)
    x, y = rng.random((2, int(outliers * len(points)))) * size
    z = terrain(x, y, slope) - depth + (depth + 20) * rng.random(len(x))
    points = np.concatenate([points, np.column_stack([x, y, z])])
    label = np.concatenate([label, np.full(len(x), 5)])
    order = rng.permutation(len(points))
    return points[order], label[order]


def _standing(rng: np.random.Generator, n: int, slope: float, size: float) -> list[Points]:
    """Return what stands on the ground: roof, walls, tree crowns and cars, about 0.4 n points."""
    west, east, south, north = _HALL
    x, y = 25 + 30 * rng.random(int(n * 0.15)), 30 + 20 * rng.random(int(n * 0.15))
    base = terrain(np.array(40.0), np.array(40.0), slope)
    roof = np.column_stack([x, y, base + 7 + 4 * (1 - abs(y - 40) / 10)])
    t = rng.random(int(n * 0.1)) * 100
    corners = np.array([0.0, 30, 50, 80, 100])
    x = np.interp(t, corners, [west, east, east, west, west])
    y = np.interp(t, corners, [south, south, north, north, south])
    walls = np.column_stack([x, y, terrain(x, y, slope) + 7 * rng.random(len(t))])
    stems = np.column_stack([size * rng.random(12), np.where(rng.random(12) < 0.5, 10, 70)])
    stems = stems[rng.integers(0, 12, int(n * 0.13))]
    crown = rng.normal(size=(len(stems), 3))
    crown *= 2.5 * np.cbrt(rng.random((len(stems), 1))) / np.linalg.norm(crown, axis=1)[:, None]
    crown += np.column_stack([stems, terrain(stems[:, 0], stems[:, 1], slope) + 5])
    cars = np.column_stack([size * rng.random(10), 2 + 20 * rng.random(10)])
    cars = cars[rng.integers(0, 10, int(n * 0.02))]
    inside = rng.random((len(cars), 3)) * [4, 1.8, 1.5]
    return [
        roof,
        walls,
        crown,
        np.column_stack([cars, terrain(cars[:, 0], cars[:, 1], slope)]) + inside,
    ]


def site(count: int, seed: int) -> Arrays:
    """Return the site with outliers: points (n, 3) and label (n,)."""
    points, label = hall_site(count, seed, OUTLIERS)
    return {"points": points, "label": label.astype(np.float64)}


def clean_site(count: int, seed: int) -> Arrays:
    """Return the site without outliers."""
    points, label = hall_site(count, seed)
    return {"points": points, "label": label.astype(np.float64)}


def facade(count: int, seed: int) -> Arrays:
    """Return a wall twice as wide as high with pilasters, mouldings and bosses, 5 mm spacing.

    A jittered scan grid with 1 mm noise, in random order; points (n, 3).
    """
    rng = np.random.default_rng(seed)
    rows = max(2, int(np.sqrt(count / 2)))
    columns = count // rows
    x, z = np.meshgrid(np.arange(columns), np.arange(rows))
    plan = np.column_stack([x.ravel(), z.ravel()]) * FACADE_SPACING_M
    plan += rng.uniform(-0.3, 0.3, plan.shape) * FACADE_SPACING_M
    x, z = plan.T
    relief = np.where(x % 2.0 < 0.4, -0.12, 0.0) + 0.03 * np.cos(40 * z) * (z % 1.5 < 0.2)
    boss2 = (x % 0.5 - 0.25) ** 2 + (z % 0.5 - 0.25) ** 2
    relief -= np.sqrt(np.maximum(0.08**2 - boss2, 0.0))
    points = np.column_stack([x, relief + rng.normal(0, 0.001, len(x)), z])
    return {"points": points[rng.permutation(len(points))]}


def pair(count: int, seed: int) -> Arrays:
    """Return two samples of the site, the first turned by 5 degrees and shifted by 0.5 m.

    source (n, 3), target (0.8 n, 3), truth (4, 4): source to target; no outliers.
    """
    source, _ = hall_site(count, 2 * seed + 1)
    target, _ = hall_site(int(0.8 * count), 2 * seed + 2)
    axis = np.array([0.2, -0.3, 1.0])
    x, y, z = np.radians(5.0) * axis / np.linalg.norm(axis)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.radians(5.0)
    turn = np.eye(3) + np.sin(angle) / angle * skew + (1 - np.cos(angle)) / angle**2 * skew @ skew
    centre = np.array([40.0, 40.0, 0.0])
    truth = np.eye(4)
    truth[:3, :3] = turn.T
    truth[:3, 3] = centre - turn.T @ (centre + [0.3, -0.3, 0.26])
    return {"source": (source - truth[:3, 3]) @ truth[:3, :3], "target": target, "truth": truth}


SCENES = {"site": site, "clean_site": clean_site, "facade": facade, "pair": pair}
