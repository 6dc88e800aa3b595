"""An octagonal pagoda: storeys that shrink upwards, bracketed eaves, a mast of rings on top."""

from __future__ import annotations

import numpy as np

from dougong.evaluation.buildings.base import Building
from dougong.evaluation.buildings.roofs import polygonal
from dougong.evaluation.buildings.timber import (
    bracket_height,
    bracket_set,
    column,
    lattice,
    rail,
    steps,
)
from dougong.evaluation.mesh import FINE, Mesh, join
from dougong.evaluation.solids import box, lathe

SIDES = 8
_TAN = float(np.tan(np.pi / SIDES))
_TURN = 180.0 / SIDES


def _prism(apothem: float, low: float, high: float, paint: str, top: float | None = None) -> Mesh:
    """Return an octagonal drum whose sides face the axes."""
    corner = 1.0 / np.cos(np.pi / SIDES)
    upper = apothem if top is None else top
    return lathe([(apothem * corner, low), (upper * corner, high)], SIDES, paint, 0, _TURN)


def _storey(apothem: float, floor: float, tall: float, doors: tuple[int, ...]) -> Mesh:
    """Return one storey: a walled core, corner columns, doors and windows, bracket sets."""
    top = floor + tall
    half = apothem * _TAN
    scale = 0.78
    parts = [_prism(apothem - 0.12, floor, top + 0.9, "plaster")]
    corner = (half, -apothem, floor)
    at = np.linspace(-half, half, 4)[:-1]
    side = [
        column(tall - 0.15, 0.2).turned(0, corner),
        box((-half, -apothem - 0.1, top - 0.36), (half, -apothem + 0.1, top), "blue"),
        box((-half - 0.05, -apothem - 0.17, top), (half + 0.05, -apothem + 0.1, top + 0.1), "blue"),
        bracket_set(scale, 1).repeated((0.0, (x, -apothem, top + 0.1)) for x in at[1:]),
        bracket_set(scale, 1).turned(_TURN, (half, -apothem, top + 0.1)),
    ]
    lift = top + 0.1 + bracket_height(scale, 1)
    reach = half + 0.55 * _TAN
    side.append(
        box((-reach, -apothem - 0.62, lift), (reach, -apothem - 0.46, lift + 0.16), "timber")
    )
    parts.append(join(side).repeated((360 / SIDES * k, (0, 0, 0)) for k in range(SIDES)))
    for k in range(SIDES):
        parts.append(
            _opening(half, tall, k in doors).turned(0, (0, -apothem, floor)).turned(45 * k)
        )
    return join(parts)


def _opening(half: float, tall: float, is_door: bool) -> Mesh:
    """Return a double door, or a window over a sill, on the plane y = 0."""
    if is_door:
        leaf = lattice(0.42 * half, tall - 0.7, 0.8)
        frame = [
            box(
                (s * 0.46 * half - 0.06, -0.16, 0),
                (s * 0.46 * half + 0.06, 0.15, tall - 0.6),
                "red",
            )
            for s in (-1, 1)
        ]
        leaves = leaf.repeated((0.0, (s * 0.22 * half, 0.04, 0.1)) for s in (-1, 1))
        return join([leaves, *frame])
    window = lattice(0.9 * half, 0.42 * tall, 0.0).turned(0, (0, 0.04, 0.34 * tall))
    sill = box((-0.5 * half, -0.14, 0.31 * tall), (0.5 * half, 0.1, 0.34 * tall), "stone", FINE)
    return join([window, sill])


def build(rng: np.random.Generator, *, is_symmetric: bool = False) -> Building:
    """Return a pagoda of five or seven storeys on an octagonal base."""
    storeys = int(rng.choice([5, 7]))
    apothem, floor = rng.uniform(5.2, 6.0), rng.uniform(1.4, 1.8)
    tall = rng.uniform(3.3, 3.7)
    base = apothem + 2.4
    parts = [
        _prism(base, -0.6, floor - 0.2, "stone"),
        _prism(base + 0.1, floor - 0.2, floor, "stone"),
    ]
    half = base * _TAN
    doors = tuple(range(0, SIDES, 2))
    flights = doors if is_symmetric else (0, 4)
    for k in range(SIDES):
        side = [_base_side(half, base, floor, k in flights)]
        parts.append(join(side).turned(45 * k))
    z = floor
    for level in range(storeys):
        parts.append(_storey(apothem, z, tall, doors))
        is_last = level == storeys - 1
        eave = z + tall + 0.1 + bracket_height(0.78, 1) + 0.16 - 0.25
        out = apothem + 1.9
        run = out - 0.35 if is_last else 2.4
        parts.append(polygonal(SIDES, out, eave, 3.6 if is_last else 1.25, run))
        z = eave + (3.6 if is_last else 1.15)
        if not is_last:
            apothem -= rng.uniform(0.28, 0.36)
            parts.append(_balcony(apothem, z))
            tall *= 0.94
    parts.append(_finial(z - 0.6))
    return Building(
        mesh=join(parts),
        stations=_stations(base, floor, rng),
        half=(base + 4.0, base + 4.0),
        paths=((-1.8, -60.0, 1.8, -base - 1.5),),
    )


def _base_side(half: float, base: float, floor: float, has_steps: bool) -> Mesh:
    if not has_steps:
        return rail(2 * half - 0.2).turned(0, (0, -base + 0.15, floor))
    run = half - 1.5
    rails = rail(run).repeated((0.0, (s * (half - run / 2), -base + 0.15, floor)) for s in (-1, 1))
    return join([steps(2.4, floor).turned(0, (0, -base, 0)), rails])


def _balcony(apothem: float, z: float) -> Mesh:
    """Return the gallery floor of an upper storey and its low rail."""
    out = apothem + 0.75
    half = out * _TAN
    bars = [
        box((-half, -out, z + h), (half, -out + 0.08, z + h + 0.1), "red", FINE)
        for h in (0.15, 0.5, 0.85)
    ]
    posts = [
        box((x - 0.05, -out, z), (x + 0.05, -out + 0.1, z + 1.0), "red", FINE)
        for x in np.linspace(-half, half, 6)[:-1]
    ]
    side = join([*bars, *posts]).repeated((45 * k, (0, 0, 0)) for k in range(SIDES))
    return join([_prism(out + 0.1, z - 1.0, z, "timber", out + 0.1), side])


def _finial(z: float) -> Mesh:
    """Return the mast: inverted bowl, nine rings, a jewel."""
    profile = [(1.0, z), (0.9, z + 0.6), (0.4, z + 0.9), (0.16, z + 1.0), (0.12, z + 4.6)]
    rings = [
        lathe([(0.16, h), (r, h + 0.04), (r, h + 0.16), (0.16, h + 0.2)], 16, "gold", FINE)
        for h, r in zip(z + 1.3 + 0.34 * np.arange(9), np.linspace(0.62, 0.3, 9), strict=True)
    ]
    jewel = lathe([(0.05, z + 4.5), (0.26, z + 4.8), (0.05, z + 5.2)], 12, "gold", FINE)
    return join([lathe(profile, 16, "gold"), *rings, jewel])


def _stations(base: float, floor: float, rng: np.random.Generator) -> np.ndarray:
    angle = np.radians(-90 + 60 * np.arange(6) + rng.normal(0, 6, 6))
    far = base + rng.uniform(8, 15, 6)
    at = np.column_stack([far * np.cos(angle), far * np.sin(angle), np.zeros(6)])
    return np.vstack([at, [0.6, -base + 1.2, floor]])
