"""One survey of a world by two sensors: clouds in their own frames, and the truth between."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong.cloud import Cloud
from dougong.evaluation import drone as drones
from dougong.evaluation import scanner as scanners
from dougong.evaluation.chart import Chart, Map, chart_of
from dougong.evaluation.mesh import COLOURS, FINE, GROUND, SURFACE, Mesh, Tracer
from dougong.evaluation.metrics import Truth, fit_rigid
from dougong.typing import Points, Transform


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A laser cloud and a drone cloud of one place, and the truth between them."""

    name: str
    seed: int
    lidar: Cloud
    """Scanner frame; attributes intensity, station, truth_label."""
    photogrammetry: Cloud
    """Map coordinates with CRS; attributes red, green, blue, truth_label."""
    truth: Truth


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """What the two sensors meet, in site coordinates."""

    static: Mesh
    during_scan: Mesh
    during_flight: Mesh
    stations: Points
    centre: NDArray[np.float64]
    radius: float
    """Of what the flight looks at."""
    reach: float
    """Half the side of the ground."""
    top: float


def stream(seed: int, purpose: str) -> np.random.Generator:
    """Return a stream of its own for each purpose, so that one does not shift another."""
    return np.random.default_rng([seed, *purpose.encode()])


def survey(
    name: str,
    seed: int,
    world: World,
    scanner: scanners.Scanner,
    drone: drones.Drone,
    bending: bool,
    max_tilt_deg: float,
    tracer: Tracer | None = None,
    on_map: Map | None = None,
) -> Scene:
    """Let both sensors survey a world; `tracer`, of its still part, spares building it again."""
    still = tracer or Tracer(world.static)
    scan_tracer = still.together_with(world.during_scan)
    flight_tracer = still.together_with(world.during_flight)
    cameras = drones.flight(
        flight_tracer, world.centre, world.radius, world.top, stream(seed, f"{name} cameras")
    )
    bend = drones.draw_bending(world.centre, world.reach, stream(seed, f"{name} bend"), bending)
    T_lidar_site, drawn = draw_poses(world, stream(seed, f"{name} pose"), max_tilt_deg)
    chart = chart_of(on_map or Map(), drawn)
    seen = _shared_surface(
        world,
        (scan_tracer, scanner),
        (flight_tracer, cameras, drone),
        stream(seed, f"{name} truth"),
    )
    truth = _truth(seen, bend, T_lidar_site, chart)
    scanned = scanners.scan(scan_tracer, world.stations, scanner, stream(seed, f"{name} lidar"))
    flown = drones.photograph(flight_tracer, cameras, drone, stream(seed, f"{name} drone"))
    return Scene(
        name=name,
        seed=seed,
        lidar=_lidar_cloud(scanned, T_lidar_site),
        photogrammetry=_drone_cloud(
            flown, bend, chart, flight_tracer.mesh, stream(seed, f"{name} paint")
        ),
        truth=truth,
    )


def draw_poses(
    world: World, rng: np.random.Generator, max_tilt_deg: float
) -> tuple[Transform, ...]:
    """Draw where the scanner frame and the map lie: T_lidar_site and T_map_site."""
    scan, chart = np.eye(4), np.eye(4)
    tilt = np.radians(max_tilt_deg * rng.uniform(0.3, 1.0))
    towards = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    scan[:3, :3] = rotation(axis * tilt) @ rotation((0, 0, rng.uniform(0, 2 * np.pi)))
    scan[:3, 3] = -scan[:3, :3] @ (world.stations[0] + rng.normal(0.0, 0.01, 3))
    chart[:3, :3] = rotation((0, 0, rng.uniform(0, 2 * np.pi)))
    chart[:3, 3] = (
        rng.uniform(4.92e5, 5.08e5),
        rng.uniform(2.8e6, 4.2e6),
        rng.uniform(4.0, 60.0),
    )
    return scan, chart


def rotation(vector: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation (3, 3) about a vector by its length in radians (Rodrigues)."""
    turn = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(turn))
    if angle == 0:
        return np.eye(3)
    x, y, z = turn / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: NDArray[np.float64] = (
        np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    )
    return turned


def _apply(matrix: Transform, points: Points) -> Points:
    moved: Points = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def _shared_surface(
    world: World,
    scan: tuple[Tracer, scanners.Scanner],
    flown: tuple[Tracer, drones.Cameras, drones.Drone],
    rng: np.random.Generator,
    candidates: int = 40_000,
) -> Points:
    """Draw points by area over the still surface that both sensors see, (m, 3), site frame."""
    still = np.isin(world.static.labels, (SURFACE, FINE, GROUND))
    surface = replace(
        world.static,
        faces=world.static.faces[still],
        labels=world.static.labels[still],
        materials=world.static.materials[still],
    )
    points, face = surface.samples(candidates, rng)
    normals = surface.normals()[face]
    tracer, scanner = scan
    seen = scanners.is_seen(tracer, world.stations, points, normals, scanner)
    points, normals = points[seen], normals[seen]
    tracer, cameras, drone = flown
    return points[drones.is_seen(tracer, cameras, points, normals, drone)]


def _truth(seen: Points, bend: drones.Bending, T_lidar_site: Transform, chart: Chart) -> Truth:
    source = _apply(T_lidar_site, seen)
    bent_site = seen + bend.at(seen)
    inverse = np.eye(4)
    inverse[:3, :3] = T_lidar_site[:3, :3].T
    inverse[:3, 3] = -inverse[:3, :3] @ T_lidar_site[:3, 3]
    bent_map = chart.at(bent_site)
    if chart.projection is None:
        # Fitted in site coordinates, where numbers are small; then put on the map.
        best = chart.T_map_site @ fit_rigid(source, bent_site)
    else:
        middle = chart.T_map_site[:3, 3]
        best = fit_rigid(source, bent_map - middle, scale=chart.scale)
        best[:3, 3] += middle
    return Truth(
        T_target_source=chart.T_map_site @ inverse,
        T_best=best,
        surface_points=source,
        surface_bent=bent_map,
    )


def _lidar_cloud(scanned: scanners.Returns, T_lidar_site: Transform) -> Cloud:
    return Cloud.from_points(
        _apply(T_lidar_site, scanned.xyz),
        name="lidar",
        intensity=(scanned.shade * 60_000).astype(np.uint16),
        station=scanned.sensor,
        truth_label=scanned.labels,
    )


def _drone_cloud(
    flown: scanners.Returns,
    bend: drones.Bending,
    chart: Chart,
    mesh: Mesh,
    rng: np.random.Generator,
) -> Cloud:
    paint = COLOURS[mesh.materials[flown.face]] * flown.shade[:, None]
    paint[flown.face < 0] = rng.uniform(40, 230, (int((flown.face < 0).sum()), 3))
    colours = (np.clip(paint + rng.normal(0.0, 5.0, paint.shape), 0, 255) * 257).astype(np.uint16)
    return Cloud.from_points(
        chart.at(flown.xyz + bend.at(flown.xyz)),
        name="photogrammetry",
        crs=chart.crs,
        red=colours[:, 0],
        green=colours[:, 1],
        blue=colours[:, 2],
        truth_label=flown.labels,
    )
