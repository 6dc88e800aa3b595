"""Pairs of clouds with exact truth: a generated building, or any mesh, seen by two sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from dougong._checks import as_points
from dougong.errors import InputError
from dougong.evaluation import drone as drones
from dougong.evaluation import scanner as scanners
from dougong.evaluation import site as sites
from dougong.evaluation import stations as places
from dougong.evaluation.buildings import cave, hall, pagoda, tulou, wall
from dougong.evaluation.buildings.base import Building
from dougong.evaluation.chart import Map
from dougong.evaluation.mesh import SURFACE, Bytes, Mesh, Tracer, join
from dougong.evaluation.metrics import Truth
from dougong.evaluation.survey import Scene, World, stream, survey
from dougong.typing import Points

__all__ = ["BUILDERS", "Map", "Scene", "SceneKind", "Truth", "make_scene", "scan_mesh"]

SceneKind = Literal["hall", "pagoda", "tulou", "wall", "cave"]
BUILDERS: dict[str, Callable[..., Building]] = {
    "hall": hall.build,
    "pagoda": pagoda.build,
    "tulou": tulou.build,
    "wall": wall.build,
    "cave": cave.build,
}


def make_scene(
    kind: str,
    seed: int = 0,
    *,
    lidar_points: int = 1_000_000,
    photogrammetry_points: int = 600_000,
    bending: bool = True,
    outliers: float = 0.015,
    site: bool = True,
    woods: bool = False,
    max_tilt_deg: float = 0.6,
    scanner: scanners.Scanner | None = None,
    drone: drones.Drone | None = None,
    on_map: Map | None = None,
) -> Scene:
    """Generate a building with its surroundings and survey it twice.

    Parameters
    ----------
    kind : {"hall", "pagoda", "tulou", "wall", "cave"}
    seed : int
        Draws everything: building, site, poses, noise. The same seed gives the same bytes.
    lidar_points, photogrammetry_points : int
        How many points to aim at, before outliers.
    bending : bool
        Bend the drone cloud slowly, by centimetres.
    outliers : float
        Share of outliers in each cloud.
    site : bool
        False: the building alone, as symmetric as its kind can be, on level ground, with nothing
        that breaks its symmetry (a truly ambiguous pair, where its kind is symmetric).
    woods : bool
        True: tall trees stand all round, up to the walls; their leaves differ between the surveys.
    max_tilt_deg : float
        The scanner frame is off level by up to this.
    scanner, drone : Scanner, Drone, optional
        Further settings of the sensors; their points and outliers are overridden.
    on_map : Map, optional
        The drone cloud's reference system and place; by default a map that is true to scale.

    Raises
    ------
    InputError
        Unknown kind.
    """
    if kind not in BUILDERS:
        msg = f"there is no scene {kind!r}. Take one of {', '.join(get_args(SceneKind))}."
        raise InputError(msg)
    world, tracer = _world(kind, seed, site, woods)
    surveyor = (scanner or scanners.Scanner()).model_copy(
        update={"points": lidar_points, "outliers": outliers}
    )
    pilot = (drone or drones.Drone()).model_copy(
        update={"points": photogrammetry_points, "outliers": outliers}
    )
    return survey(kind, seed, world, surveyor, pilot, bending, max_tilt_deg, tracer, on_map)


def _world(kind: str, seed: int, site: bool, woods: bool = False) -> tuple[World, Tracer]:
    """Return what the sensors meet, and the tracer of its still part."""
    building = BUILDERS[kind](stream(seed, f"{kind} building"), is_symmetric=not site)
    if not site:
        building = replace(building, paths=())
    rng = stream(seed, f"{kind} site")
    terrain = sites.draw_terrain(building, rng, is_flat=not site)
    reach = max(building.half) + 32.0
    static = [building.mesh, sites.ground(terrain, reach, building)]
    extras = [join([]), join([])]
    if site:
        static.append(sites.furniture(building, terrain, rng))
        trees = sites.tree_places(building, terrain, rng, reach, woods)
        static.append(sites.trunks(trees))
        for k, epoch in enumerate(("scan", "flight")):
            drawn = stream(seed, f"{kind} {epoch}")
            extras[k] = join([sites.foliage(trees, drawn), sites.clutter(building, terrain, drawn)])
    eye = rng.uniform(1.55, 1.85, len(building.stations))
    still = join(static)
    tracer = Tracer(still)
    lifted = sites.lift_to_ground(building.stations, terrain, eye)
    world = World(
        static=still,
        during_scan=extras[0],
        during_flight=extras[1],
        stations=places.step_aside(tracer, lifted, rng),
        centre=np.zeros(3),
        radius=max(building.half) + 8.0,
        reach=reach,
        top=float(building.mesh.vertices[:, 2].max()),
    )
    return world, tracer


def _labels_or_surface(labels: ArrayLike | None, count: int) -> Bytes:
    if labels is None:
        return np.full(count, SURFACE, dtype=np.uint8)
    values = np.asarray(labels, dtype=np.uint8)
    if values.shape != (count,):
        msg = f"face_labels must have shape ({count},), got {values.shape}: one label per face."
        raise InputError(msg)
    return values


def scan_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    seed: int = 0,
    name: str = "mesh",
    face_labels: ArrayLike | None = None,
    stations: ArrayLike | int = 8,
    ground: bool = True,
    woods: bool = False,
    lidar_points: int = 1_000_000,
    photogrammetry_points: int = 600_000,
    bending: bool = True,
    outliers: float = 0.015,
    max_tilt_deg: float = 0.6,
    scanner: scanners.Scanner | None = None,
    drone: drones.Drone | None = None,
    on_map: Map | None = None,
) -> Scene:
    """Survey any triangle mesh twice, as `make_scene` does its own buildings.

    Parameters
    ----------
    vertices, faces : array_like, shapes (n, 3) and (m, 3)
        Metres, z up; single-sided meshes and holes are fine.
    seed : int
    name : str
    face_labels : array_like, shape (m,), optional
        Truth label of each face; 0, surface, by default.
    stations : int or array_like, shape (k, 3)
        How many scanner positions to find, or the positions, in the mesh's coordinates.
    ground : bool
        Lay gently rolling ground under and round the mesh, at its foot.
    woods : bool
        Plant tall trees all round; needs `ground`. Their leaves differ between the surveys.
    lidar_points, photogrammetry_points, bending, outliers, max_tilt_deg, scanner, drone, on_map
        As for `make_scene`.

    Raises
    ------
    InputError
        Wrong shapes, or no free place for a scanner.
    """
    points = as_points(vertices, "vertices")
    triangles = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    labels = _labels_or_surface(face_labels, len(triangles))
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.array([*(low[:2] + high[:2]) / 2, _foot(points)])
    plain = Mesh.of(points - middle, triangles, "plaster")
    mesh = Mesh(plain.vertices, plain.faces, labels, plain.materials)
    given = np.asarray(stations, dtype=np.float64)
    if woods and not ground:
        msg = "woods=True with ground=False: trees need ground to stand on. Pass ground=True."
        raise InputError(msg)
    world, tracer = _world_of_mesh(
        mesh,
        int(given) if given.ndim == 0 else as_points(given - middle, "stations"),
        ground,
        stream(seed, f"{name} site"),
    )
    if woods:
        world, tracer = _planted(world, mesh, name, seed)
    update = {"outliers": outliers}
    surveyor = (scanner or scanners.Scanner()).model_copy(update={"points": lidar_points, **update})
    pilot = (drone or drones.Drone()).model_copy(update={"points": photogrammetry_points, **update})
    return survey(name, seed, world, surveyor, pilot, bending, max_tilt_deg, tracer, on_map)


def _world_of_mesh(
    mesh: Mesh, stations: Points | int, ground: bool, rng: np.random.Generator
) -> tuple[World, Tracer]:
    """Return a world round a mesh that stands on z = 0 with its middle at the origin."""
    low, high = mesh.extent()
    half = (high - low)[:2] / 2
    reach = float(half.max()) + 25.0
    static = mesh
    if ground:
        shape = _shape_of(mesh, np.zeros((1, 3)))
        terrain = sites.draw_terrain(shape, rng, is_flat=False)
        # Just under the mesh's own ground, if it has one.
        bare = sites.ground(terrain, reach, shape).turned(0.0, (0.0, 0.0, -0.03))
        static = join([mesh, bare])
    tracer = Tracer(static)
    found = places.choose(tracer, mesh, stations, rng) if isinstance(stations, int) else stations
    world = World(
        static=static,
        during_scan=join([]),
        during_flight=join([]),
        stations=found,
        centre=np.zeros(3),
        radius=float(half.max()) + 4.0,
        reach=reach,
        top=float(high[2]),
    )
    return world, tracer


def _shape_of(mesh: Mesh, stations: Points) -> Building:
    low, high = mesh.extent()
    half = (high - low)[:2] / 2
    return Building(mesh=mesh, stations=stations, half=(float(half[0]) + 1, float(half[1]) + 1))


def _planted(world: World, mesh: Mesh, name: str, seed: int) -> tuple[World, Tracer]:
    """Return the world of a mesh with trees all round it, and the tracer of its still part."""
    shape = _shape_of(mesh, world.stations)
    # The ground is drawn first from this stream: the same ground as the world's own.
    terrain = sites.draw_terrain(shape, stream(seed, f"{name} site"), is_flat=False)
    rng = stream(seed, f"{name} trees")
    trees = sites.tree_places(shape, terrain, rng, world.reach, is_wooded=True)
    static = join([world.static, sites.trunks(trees)])
    leaves = [sites.foliage(trees, stream(seed, f"{name} {epoch}")) for epoch in ("scan", "flight")]
    planted = replace(world, static=static, during_scan=leaves[0], during_flight=leaves[1])
    return planted, Tracer(static)


def _foot(points: Points) -> float:
    """Return the height of the foot of a mesh: stray spikes below it do not count."""
    return float(np.percentile(points[:, 2], 0.5))
