"""What stands round a building: ground, paths, steles, side houses, trees, people, cars."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.buildings.base import Building
from dougong.evaluation.buildings.roofs import Slope, hipped
from dougong.evaluation.buildings.timber import lattice, podium
from dougong.evaluation.mesh import CLUTTER, FINE, GROUND, VEGETATION, Mesh, join, material
from dougong.evaluation.solids import ball, block, box, extruded, lathe, sheet
from dougong.typing import Values

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Terrain:
    """Level within the building's half extents, sloping and undulating beyond."""

    half: tuple[float, float]
    slope: NDArray[np.float64]
    """(2,) metres per metre in x and y."""
    waves: NDArray[np.float64]
    """(k, 4): wave numbers in x and y, phase, amplitude in metres."""
    ripple: float = 0.012
    """Height of the small ripples that no ground is without, metres."""
    margin: float = 14.0

    def height(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the ground at plan positions."""
        beyond = np.hypot(
            np.maximum(np.abs(x) - self.half[0], 0.0), np.maximum(np.abs(y) - self.half[1], 0.0)
        )
        share = np.clip(beyond / self.margin, 0.0, 1.0)
        share = share * share * (3 - 2 * share)
        total = self.slope[0] * x + self.slope[1] * y
        for kx, ky, phase, size in self.waves:
            total = total + size * np.sin(kx * x + ky * y + phase)
        fine = self.ripple * np.sin(1.9 * x + 0.7 * y) * np.sin(0.8 * x - 1.6 * y)
        height: Floats = share * total + fine
        return height


def draw_terrain(building: Building, rng: np.random.Generator, is_flat: bool) -> Terrain:
    """Draw the terrain round a building."""
    waves = np.column_stack(
        [
            rng.normal(0.0, 0.10, (6, 2)),
            rng.uniform(0, 2 * np.pi, 6),
            rng.uniform(0.05, 0.28, 6),
        ]
    )
    size = 0.0 if is_flat else 1.0
    waves[:, 3] *= size
    return Terrain(
        half=building.half,
        slope=size * rng.normal(0.0, 0.022, 2),
        waves=waves,
        ripple=0.012 * size,
    )


def ground(terrain: Terrain, reach: float, building: Building) -> Mesh:
    """Return the ground as a closed sheet, grass with paved strips, `reach` metres each way."""
    stop = reach if building.back is None else min(reach, building.back)
    strips = np.clip(np.array(building.paths).reshape(-1, 2, 2), -reach, (reach, stop))
    x = _lines(-reach, reach, strips[..., 0].ravel())
    y = _lines(-reach, stop, strips[..., 1].ravel())
    grid = np.empty((len(x), len(y), 3))
    grid[..., 0], grid[..., 1] = x[:, None], y
    grid[..., 2] = terrain.height(grid[..., 0], grid[..., 1])
    mesh = sheet(grid, grid - (0.0, 0.0, 1.5), "grass", GROUND)
    centre = mesh.corners().mean(axis=1)
    paint = mesh.materials.copy()
    outside = np.abs(centre[:, :2]) - building.half
    edge = 0.8 * np.sin(0.9 * centre[:, 0]) + 0.8 * np.sin(1.1 * centre[:, 1] + 0.6)
    paint[np.hypot(*np.maximum(outside + 2.0, 0.0).T) < 2.2 + edge] = material("soil")
    for x0, y0, x1, y1 in building.paths:
        on = (centre[:, 0] > x0) & (centre[:, 0] < x1) & (centre[:, 1] > y0) & (centre[:, 1] < y1)
        paint[on] = material("paving")
    return replace(mesh, materials=paint)


def _lines(low: float, high: float, extra: Floats, step: float = 0.8) -> Floats:
    """Return grid lines about `step` apart that include the edges `extra`."""
    even = np.linspace(low, high, int((high - low) / step) + 1)
    far = np.abs(even[:, None] - extra[None]).min(axis=1, initial=np.inf) > 0.3 * step
    far[[0, -1]] = True
    return np.unique(np.round(np.concatenate([even[far], extra]), 6))


def side_house(rng: np.random.Generator) -> Mesh:
    """Return a small house of three bays, its front towards -y."""
    half_x, half_y = rng.uniform(3.6, 5.2), rng.uniform(2.2, 2.9)
    tall = rng.uniform(2.8, 3.3)
    width = 2 * half_x / 5
    door = lattice(width * 0.9, tall - 0.5, 0.9)
    slope = Slope.seated(0.35 + tall, 0.9, 1.9, half_y + 0.9)
    return join(
        [
            podium(half_x + 0.7, half_y + 0.7, 0.35),
            box((-half_x, -half_y, 0.3), (half_x, half_y, 0.35 + tall), "plaster"),
            door.repeated((0.0, (k * width, -half_y - 0.07, 0.36)) for k in (-1, 0, 1)),
            hipped(half_x + 0.9, half_y + 0.9, slope, gable=half_x - 0.1),
        ]
    )


def stele() -> Mesh:
    """Return an inscribed tablet on a tortoise."""
    letters = [
        block((0.13 * i - 0.26, -0.135, 1.1 + 0.2 * k), (0.07, 0.02, 0.12), "stone", FINE)
        for i in range(5)
        for k in range(7)
    ]
    return join(
        [
            ball((0, -0.1, 0.35), (0.6, 0.95, 0.42), "stone", 0, 16),
            ball((0, -1.1, 0.55), (0.2, 0.26, 0.2), "stone", 0, 10),
            block((0, 0, 0.6), (0.95, 0.25, 2.1), "stone"),
            ball((0, 0, 2.85), (0.55, 0.16, 0.4), "stone", 0, 14),
            *letters,
        ]
    )


def lion() -> Mesh:
    """Return a guardian lion on its pedestal, looking towards -y."""
    return join(
        [
            block((0, 0, -0.3), (0.9, 1.3, 1.1), "stone"),
            ball((0, 0.2, 1.15), (0.36, 0.5, 0.42), "stone"),
            ball((0, -0.2, 1.5), (0.33, 0.33, 0.5), "stone"),
            ball((0, -0.36, 1.98), (0.3, 0.32, 0.3), "stone"),
            lathe([(0.1, 0.75), (0.1, 1.4)], 8).turned(0, (0.2, -0.45, 0)),
            lathe([(0.1, 0.75), (0.1, 1.4)], 8).turned(0, (-0.2, -0.45, 0)),
        ]
    )


def burner() -> Mesh:
    """Return a bronze incense burner on three legs."""
    bowl = [
        (0.2, 0.5),
        (0.6, 0.62),
        (0.72, 0.95),
        (0.62, 1.15),
        (0.7, 1.22),
        (0.5, 1.24),
        (0.35, 0.9),
    ]
    leg = lathe([(0.1, -0.1), (0.13, 0.7)], 8, "timber")
    legs = leg.repeated(
        (0.0, (0.42 * np.cos(a), 0.42 * np.sin(a), 0)) for a in np.radians([90, 210, 330])
    )
    return join([lathe(bowl, 18, "timber"), legs])


def furniture(building: Building, terrain: Terrain, rng: np.random.Generator) -> Mesh:
    """Return the still things on the site; none of it repeats the building's own symmetry."""
    hx, hy = building.half
    parts = []

    def put(mesh: Mesh, yaw: float, x: float, y: float) -> None:
        z = float(terrain.height(np.array(x), np.array(y)))
        parts.append(mesh.turned(yaw, (x, y, z)))

    put(stele(), rng.uniform(-20, 20), hx * 0.55, -hy - rng.uniform(2, 4))
    put(stele(), rng.uniform(60, 120), -hx - rng.uniform(2, 3), hy * rng.uniform(-0.2, 0.5))
    for side in (-1, 1):
        put(lion(), rng.uniform(-5, 5), side * 4.2, -hy - 1.0)
    put(burner(), 0.0, rng.uniform(-0.6, 0.6), -hy - rng.uniform(4, 6))
    put(side_house(rng), 90 + rng.uniform(-6, 6), hx + rng.uniform(9, 12), rng.uniform(-8, 2))
    put(side_house(rng), -70 + rng.uniform(-8, 8), -hx - rng.uniform(10, 13), rng.uniform(-14, -6))
    return join(parts)


def tree_places(
    building: Building,
    terrain: Terrain,
    rng: np.random.Generator,
    reach: float,
    is_wooded: bool = False,
) -> Floats:
    """Draw where the trees stand: x, y, ground height and tree height, (k, 4).

    `is_wooded`: five times as many and taller, up to the walls and over the paths, as round a
    temple in a wood.
    """
    hx, hy = building.half
    most, apart, off, tries = (55, 3.5, 1.0, 1500) if is_wooded else (11, 6.5, 5.0, 200)
    low, tall = (7.0, 14.0) if is_wooded else (5.0, 11.0)
    found: list[tuple[float, float, float, float]] = []
    for _ in range(tries):
        x, y = rng.uniform(-reach * 0.75, reach * 0.75, 2)
        is_near = abs(x) < hx + off and abs(y) < hy + off
        is_path = abs(x) < (1.5 if is_wooded else 6) and y < 0
        is_rock = building.back is not None and y > building.back - 6
        is_house = hx + 3 < abs(x) < hx + 19 and -22 < y < 10 and not is_wooded
        close = any(np.hypot(x - a, y - b) < apart for a, b, _, _ in found)
        to_station = np.hypot(building.stations[:, 0] - x, building.stations[:, 1] - y).min()
        at_station = to_station < (2.5 if is_wooded else 5)
        if is_near or is_path or is_rock or is_house or close or at_station:
            continue
        found.append(
            (x, y, float(terrain.height(np.array(x), np.array(y))), rng.uniform(low, tall))
        )
        if len(found) == most:
            break
    return np.array(found).reshape(-1, 4)


def trunks(places: Floats) -> Mesh:
    """Return the trunks, the same in both surveys."""
    parts = [
        lathe([(0.26, -0.4), (0.18, 0.3 * h), (0.1, 0.75 * h)], 9, "bark", VEGETATION).turned(
            0, (x, y, z)
        )
        for x, y, z, h in places
    ]
    return join(parts)


def foliage(places: Floats, rng: np.random.Generator) -> Mesh:
    """Return the leaves as of one survey: loose triangles in a few clumps per tree."""
    triangles = []
    for x, y, z, h in places:
        for _ in range(9):
            spot = rng.normal(0.0, 1.0, 3) * (0.16 * h, 0.16 * h, 0.13 * h)
            clump = np.array([x, y, z + 0.72 * h]) + spot
            off = rng.normal(size=(180, 3))
            off *= (
                (rng.random((180, 1)) ** (1 / 3)) * 0.15 * h / np.linalg.norm(off, axis=1)[:, None]
            )
            leaf = rng.normal(0.0, 0.09, (180, 3, 3))
            triangles.append((clump + off)[:, None, :] + leaf)
    if not triangles:
        return join([])
    corners = np.concatenate(triangles).reshape(-1, 3)
    return Mesh.of(corners, np.arange(len(corners)), "leaf", VEGETATION)


def person(rng: np.random.Generator) -> Mesh:
    """Return a standing visitor."""
    tall = rng.uniform(0.9, 1.08)
    legs = [
        lathe([(0.09, 0.0), (0.11, 0.8)], 8, "dark", CLUTTER).turned(0, (s * 0.1, 0, 0))
        for s in (-1, 1)
    ]
    body = lathe([(0.17, 0.75), (0.22, 1.2), (0.2, 1.42), (0.07, 1.5)], 10, "cloth", CLUTTER)
    head = ball((0, 0, 1.62), (0.1, 0.1, 0.13), "earth", CLUTTER, 10)
    return join([*legs, body, head]).scaled(tall, tall, tall)


def car(rng: np.random.Generator) -> Mesh:
    """Return a parked car, 4.3 m long."""
    outline = [
        (-2.15, 0.3), (2.15, 0.3), (2.15, 0.75), (1.3, 0.92), (0.6, 1.42), (-1.2, 1.45),
        (-1.9, 0.95), (-2.15, 0.9),
    ]  # fmt: skip
    wheel = lathe([(0.31, -0.11), (0.31, 0.11)], 14, "dark", CLUTTER)
    upright = Mesh(wheel.vertices[:, [0, 2, 1]], wheel.faces, wheel.labels, wheel.materials)
    wheels = upright.repeated((0.0, (x, y, 0.31)) for x in (-1.35, 1.3) for y in (-0.78, 0.78))
    size = rng.uniform(0.95, 1.1)
    return join([extruded(outline, -0.85, 0.85, "paint", CLUTTER), wheels]).scaled(size, size, size)


def clutter(building: Building, terrain: Terrain, rng: np.random.Generator) -> Mesh:
    """Return the people and cars of one survey."""
    hx, hy = building.half
    parts = []
    for _ in range(int(rng.integers(7, 13))):
        x, y = rng.uniform(-hx - 6, hx + 6), -hy - rng.uniform(-1, 11)
        parts.append(_set_down(person(rng), x, y, terrain, rng))
    for _ in range(int(rng.integers(2, 5))):
        side = rng.choice([-1.0, 1.0])
        x, y = side * rng.uniform(8, hx + 8), -hy - rng.uniform(13, 18)
        parts.append(_set_down(car(rng), x, y, terrain, rng))
    return join(parts)


def _set_down(mesh: Mesh, x: float, y: float, terrain: Terrain, rng: np.random.Generator) -> Mesh:
    z = float(terrain.height(np.array(x), np.array(y)))
    return mesh.turned(rng.uniform(0, 360), (x, y, z))


def lift_to_ground(stations: Floats, terrain: Terrain, eye: Values) -> Floats:
    """Return the stations with their instruments `eye` metres over the floor they stand on."""
    lifted = stations.copy()
    lifted[:, 2] += eye + terrain.height(stations[:, 0], stations[:, 1])
    return lifted
