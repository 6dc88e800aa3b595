"""A building and its forecourt with labelled clutter and the heritage it resembles, scanned."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation import clutter_things as things
from dougong.evaluation import site as sites
from dougong.evaluation import stations as places
from dougong.evaluation.buildings.base import Building
from dougong.evaluation.mesh import Bytes, Mesh, Tracer, join
from dougong.evaluation.scanner import Scanner, scan
from dougong.evaluation.scenes import BUILDERS
from dougong.evaluation.survey import stream
from dougong.typing import Points

_APART_M = {things.PERSON: 0.8, things.VEHICLE: 3.4, things.HOUSE: 6.5}
"""Half the room that a thing needs round it; 1.1 m by default."""
_TRIES = 400


class ClutterSite(NamedTuple):
    """A scan whose every point knows what it lies on."""

    points: Points
    """(n, 3) metres, site coordinates."""
    labels: Bytes
    """(n,) `mesh`'s labels and those of `clutter_things.THINGS`."""
    things: NDArray[np.int64]
    """(n,) number of the thing that the point lies on; -1 elsewhere and for noise."""


class _Ground:
    """The terrain round a building, and what has been set down on it."""

    def __init__(self, building: Building, terrain: sites.Terrain) -> None:
        self.building, self.terrain = building, terrain
        self.taken: list[tuple[float, float, float]] = []
        self.meshes: list[Mesh] = []

    def height(self, x: float, y: float) -> float:
        """Return the ground's height at a place."""
        return float(self.terrain.height(np.array(x), np.array(y)))

    def put(self, mesh: Mesh, room: float, rng: np.random.Generator) -> None:
        """Set a thing down where nothing stands, in front of the building or beside it."""
        hx, hy = self.building.half
        for _ in range(_TRIES):
            x, y = rng.uniform(-hx - 14, hx + 14), rng.uniform(-hy - 20, hy * 0.5)
            is_built = abs(x) < hx + 0.6 + room and abs(y) < hy + 0.6 + room
            near = [np.hypot(x - a, y - b) < room + apart for a, b, apart in self.taken]
            if is_built or any(near):
                continue
            self.taken.append((x, y, room))
            self.meshes.append(mesh.turned(rng.uniform(0, 360), (x, y, self.height(x, y))))
            return

    def string_wires(self, rng: np.random.Generator) -> None:
        """Set up poles in a row with wires between them, and lead one wire to the eaves."""
        hx, hy = self.building.half
        y = -hy - rng.uniform(14, 19)
        tall = rng.uniform(6.2, 7.6)
        xs = [-hx - rng.uniform(4, 8), rng.uniform(-2, 2), hx + rng.uniform(4, 8)]
        tops = []
        for x in xs:
            z = self.height(x, y)
            self.taken.append((x, y, 0.8))
            self.meshes.append(things.wire_pole(tall).turned(0.0, (x, y, z)))
            tops.append(np.array([x, y, z + tall - 0.16]))
        for one, other in pairwise(tops):
            for aside in (-0.5, 0.0, 0.5):
                off = np.array([0.0, aside, 0.0])
                self.meshes.append(things.wire(one + off, other + off, rng.uniform(0.2, 0.6)))
        eave = np.array([xs[1] + rng.uniform(-2, 2), -hy * 0.9, rng.uniform(3.5, 5.0)])
        self.meshes.append(things.wire(tops[1], eave, rng.uniform(0.2, 0.5)))


def _counts(rng: np.random.Generator) -> dict[int, tuple[int, Callable[..., Mesh]]]:
    return {
        **{label: (int(rng.integers(1, 4)), make) for label, make in things.HERITAGE.items()},
        things.HOUSE: (2, things.HERITAGE[things.HOUSE]),
        things.VEHICLE: (int(rng.integers(3, 6)), things.vehicle),
        things.POLE: (int(rng.integers(3, 6)), things.pole),
        things.PERSON: (int(rng.integers(8, 14)), things.visitor),
    }


def clutter_site(kind: str, seed: int, points: int = 1_000_000) -> ClutterSite:
    """Generate a building of `kind` with a forecourt full of things, and scan it.

    Parameters
    ----------
    kind : {"hall", "pagoda", "tulou", "wall", "cave"}
    seed : int
    points : int
        How many points to aim at, before outliers.
    """
    building = BUILDERS[kind](stream(seed, f"{kind} clutter building"), is_symmetric=False)
    rng = stream(seed, f"{kind} clutter site")
    terrain = sites.draw_terrain(building, rng, is_flat=False)
    reach = max(building.half) + 32.0
    ground = _Ground(building, terrain)
    ground.taken += [(x, y, 1.2) for x, y in building.stations[:, :2]]
    ground.string_wires(rng)
    for label, (count, make) in _counts(rng).items():
        for _ in range(count):
            ground.put(make(rng), _APART_M.get(label, 1.1), rng)
    trees = sites.tree_places(building, terrain, rng, reach)
    for x, y, _, _ in trees:
        ground.taken.append((x, y, 1.0))
    still = [building.mesh, sites.ground(terrain, reach, building), sites.trunks(trees)]
    still.append(sites.foliage(trees, rng))
    mesh = join([*still, *ground.meshes])
    number = np.full(len(mesh), -1)
    first = sum(len(part) for part in still)
    number[first:] = np.repeat(np.arange(len(ground.meshes)), [len(m) for m in ground.meshes])
    tracer = Tracer(mesh)
    eye = rng.uniform(1.55, 1.85, len(building.stations))
    stands = places.step_aside(tracer, sites.lift_to_ground(building.stations, terrain, eye), rng)
    seen = scan(tracer, stands, Scanner(points=points), rng)
    thing = np.where(seen.face >= 0, number[seen.face], -1)
    thing[~np.isin(seen.labels, list(things.THINGS))] = -1
    return ClutterSite(seen.xyz, seen.labels, thing)
