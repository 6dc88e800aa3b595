"""Pairs that are hard or impossible, made of a survey whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dougong.evaluation.mesh import FINE, GROUND, SURFACE
from dougong.evaluation.metrics import Truth, fit_rigid
from dougong.evaluation.scenes import Scene
from dougong.evaluation.survey import rotation
from dougong.registration.overlap import apply, inverse

Points = NDArray[np.float64]
_SEEN_M = 0.3
"""Surface this near to a scan's points was seen by it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """A scene with both clouds about the drone cloud's middle: the true motion is the identity."""

    lidar: Points
    drone: Points
    lidar_label: NDArray[np.uint8]
    drone_label: NDArray[np.uint8]
    station: NDArray[np.int64]
    surface: Points
    """What both saw, scan coordinates; `bent` is where the drone cloud has it."""
    bent: Points
    T_best: Points


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One pair to register. `truth` None: no motion is true."""

    source: Points
    target: Points
    truth: Truth | None
    source_kind: Literal["lidar", "photogrammetry"] = "lidar"
    target_kind: Literal["lidar", "photogrammetry"] = "photogrammetry"


def base_of(scene: Scene) -> Base:
    """Bring the scan onto the map, and both near zero."""
    drone = scene.photogrammetry.frame.to_file(scene.photogrammetry.xyz)
    origin = np.round(drone.mean(axis=0))
    T, best = scene.truth.T_target_source.copy(), scene.truth.T_best.copy()
    T[:3, 3] -= origin
    best[:3, 3] -= origin
    labels = [cloud.attribute("truth_label") for cloud in (scene.lidar, scene.photogrammetry)]
    return Base(
        lidar=apply(T, scene.lidar.frame.to_file(scene.lidar.xyz)),
        drone=drone - origin,
        lidar_label=np.asarray(labels[0]),
        drone_label=np.asarray(labels[1]),
        station=np.asarray(scene.lidar.attribute("station"), dtype=np.int64),
        surface=apply(T, scene.truth.surface_points),
        bent=scene.truth.surface_bent - origin,
        T_best=best @ inverse(T),
    )


def pose(rng: np.random.Generator, tilt_deg: float = 0.4) -> Points:
    """Draw a scanner frame: any yaw, `tilt_deg` off level, metres away."""
    towards = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(tilt_deg) * np.array([np.cos(towards), np.sin(towards), 0.0])
    T = np.eye(4)
    T[:3, :3] = rotation(tilt) @ rotation((0.0, 0.0, rng.uniform(0, 2 * np.pi)))
    T[:3, 3] = rng.uniform(-20, 20, 3) * [1, 1, 0.2]
    return T


def truth_of(base: Base, T: Points, inside: Callable[[Points], Any] | None = None) -> Truth:
    """Return the truth for a source that `T` moved away, judged on the surface `inside`.

    The best rigid pose is that of the judged surface: a part is laid on the part as it was bent.
    """
    chosen = np.ones(len(base.surface), bool) if inside is None else inside(base.surface)
    surface, bent = apply(T, base.surface[chosen]), base.bent[chosen]
    return Truth(
        T_target_source=inverse(T),
        T_best=base.T_best @ inverse(T) if inside is None else fit_rigid(surface, bent),
        surface_points=surface,
        surface_bent=bent,
    )


def exact(base: Base, T: Points) -> Truth:
    """Return the truth where both clouds are one sensor's: nothing bends between them."""
    return replace(truth_of(base, T), T_best=inverse(T), surface_bent=base.surface)


def plain(base: Base, rng: np.random.Generator, tilt_deg: float = 0.4) -> Trial:
    """Take both whole clouds, the scanner off level by `tilt_deg`."""
    T = pose(rng, tilt_deg)
    return Trial(source=apply(T, base.lidar), target=base.drone, truth=truth_of(base, T))


def overlap(share: float) -> Callable[[Base, np.random.Generator], Trial]:
    """Let each cloud end along x; `share` of the shared surface's length is in both."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        low, high = np.quantile(base.surface[:, 0], [0.02, 0.98])
        a, b = low + np.array([0.5 - share / 2, 0.5 + share / 2]) * (high - low)
        T = pose(rng)
        return Trial(
            source=apply(T, base.lidar[base.lidar[:, 0] < b]),
            target=base.drone[base.drone[:, 0] > a],
            truth=truth_of(base, T, lambda x: (x[:, 0] > a) & (x[:, 0] < b)),
        )

    return make


def density(base: Base, rng: np.random.Generator) -> Trial:
    """Keep one drone point in ten."""
    trial = plain(base, rng)
    return replace(trial, target=trial.target[rng.random(len(trial.target)) < 0.1])


def part(base: Base, rng: np.random.Generator) -> Trial:
    """Pair the scan within 13 m of one corner of the site with the whole drone cloud."""
    corner = np.quantile(base.surface[:, :2], 0.3, axis=0)

    def near(x: Points) -> Any:
        return np.hypot(*(x[:, :2] - corner).T) < 13.0

    T = pose(rng)
    source = apply(T, base.lidar[near(base.lidar)])
    return Trial(source=source, target=base.drone, truth=truth_of(base, T, near))


def one_station(base: Base, rng: np.random.Generator) -> Trial:
    """Take a single station, which sees one facade."""
    first = base.lidar[base.station == base.station[base.station >= 0].min()]

    def seen(x: Points) -> Any:
        return cKDTree(first).query(x, distance_upper_bound=_SEEN_M)[0] < np.inf

    T = pose(rng)
    return Trial(source=apply(T, first), target=base.drone, truth=truth_of(base, T, seen))


def outliers(base: Base, rng: np.random.Generator) -> Trial:
    """Add ten per cent of points anywhere in either cloud's box."""

    def dirty(x: Points) -> Points:
        box = rng.uniform(x.min(axis=0), x.max(axis=0), (len(x) // 10, 3))
        return np.vstack([x, box])

    trial = plain(base, rng)
    return replace(trial, source=dirty(trial.source), target=dirty(trial.target))


def sloping(base: Base, rng: np.random.Generator) -> Trial:
    """Shear the whole site upright so that its terrain slopes 15 %; walls stay upright."""
    shear = np.eye(4)
    shear[2, :2] = 0.12, 0.09
    clouds = ("lidar", "drone", "surface", "bent")
    # T_best stays: bending shears along, by less than a millimetre.
    changed: dict[str, Any] = {name: apply(shear, getattr(base, name)) for name in clouds}
    return plain(replace(base, **changed), rng)


def without(label: int, of: Literal["source", "target"]) -> Callable[..., Trial]:
    """Take a class out of one cloud."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        trial = plain(base, rng)
        if of == "source":
            return replace(trial, source=trial.source[base.lidar_label != label])
        return replace(trial, target=trial.target[base.drone_label != label])

    return make


def nothing_but(label: int) -> Callable[..., Trial]:
    """Leave one class only in both clouds."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        trial = plain(base, rng)
        return replace(
            trial,
            source=trial.source[base.lidar_label == label],
            target=trial.target[base.drone_label == label],
        )

    return make


def spoilt(change: Callable[[Points], Points]) -> Callable[..., Trial]:
    """Mirror the source, turn it over or change its unit: no rigid motion is true."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        trial = plain(base, rng)
        return replace(trial, source=change(trial.source), truth=None)

    return make


def two_flights(base: Base, rng: np.random.Generator) -> Trial:
    """Pair two halves of the drone cloud, a centimetre of noise added to one."""
    T, first = pose(rng), rng.random(len(base.drone)) < 0.5
    rest = base.drone[~first]
    return Trial(
        source=apply(T, base.drone[first]),
        target=rest + rng.normal(0.0, 0.01, rest.shape),
        truth=exact(base, T),
        source_kind="photogrammetry",
    )


def two_scans(base: Base, rng: np.random.Generator) -> Trial:
    """Pair even stations with odd ones."""
    T, even = pose(rng), base.station % 2 == 0
    return Trial(
        source=apply(T, base.lidar[even]),
        target=base.lidar[~even],
        truth=exact(base, T),
        target_kind="lidar",
    )


def halls(of_source: int, of_target: int) -> Callable[..., Trial]:
    """Build a compound: the site's middle repeated at equal spacing along x."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        x = base.lidar[base.lidar_label != GROUND][:, 0]
        low, high = np.quantile(x, [0.02, 0.98])
        step = 1.2 * (high - low)

        def row(points: Points, count: int) -> Points:
            one = points[np.abs(points[:, 0] - (low + high) / 2) < step / 2]
            return np.vstack([one + [k * step, 0.0, 0.0] for k in range(count)])

        T = pose(rng)
        return Trial(
            source=apply(T, row(base.lidar, of_source)),
            target=row(base.drone, of_target),
            truth=truth_of(base, T),
        )

    return make


@dataclass(frozen=True, slots=True, kw_only=True)
class Facade:
    """An upright surface in a base's frame: the point (2,) at its middle, its outward yaw."""

    middle: NDArray[np.float64]
    outward: NDArray[np.float64]
    floor: float

    def place(self, x: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how far points lie along the facade and before it (behind: negative)."""
        off = x[:, :2] - self.middle
        along = np.array([-self.outward[1], self.outward[0]])
        return off @ along, off @ self.outward


def find_facade(base: Base) -> Facade:
    """Return the facade that the scan shows best: the fullest straight row of wall points."""
    wall = base.lidar[np.isin(base.lidar_label, (SURFACE, FINE))]
    best = (-1, 0.0, 0.0)
    for yaw in np.radians(np.arange(0.0, 180.0, 2.0)):
        off = wall[:, 0] * np.cos(yaw) + wall[:, 1] * np.sin(yaw)
        count, edges = np.histogram(off, np.arange(off.min(), off.max() + 1.0, 0.5))
        best = max(best, (int(count.max()), yaw, float(edges[int(np.argmax(count))]) + 0.25))
    _, yaw, at = best
    outward = np.array([np.cos(yaw), np.sin(yaw)])
    off = wall[:, :2] @ outward - at
    near = base.lidar[base.lidar_label == GROUND][:, :2] @ outward - at
    # Outdoors is where most of the ground near it was seen.
    if ((near < -1.0) & (near > -15.0)).sum() > ((near > 1.0) & (near < 15.0)).sum():
        outward, at, off = -outward, -at, -off
    row = wall[np.abs(off) < 0.5]
    along = np.median(row[:, :2] @ [-outward[1], outward[0]])
    middle = at * outward + along * np.array([-outward[1], outward[0]])
    return Facade(middle=middle, outward=outward, floor=float(np.quantile(row[:, 2], 0.02)))


def facade(base: Base, rng: np.random.Generator) -> Trial:
    """Pair a scan of one facade, 3 m before it to 2 m behind its face, with the whole flight."""
    found = find_facade(base)

    def near(x: Points) -> Any:
        _, before = found.place(x)
        return (before < 3.0) & (before > -2.0)

    T = pose(rng)
    source = apply(T, base.lidar[near(base.lidar)])
    return Trial(source=source, target=base.drone, truth=truth_of(base, T, near))


def doorway(base: Base, rng: np.random.Generator) -> Trial:
    """Pair a scan of a room, which sees the outside through its door only, with the flight.

    The room (walls, floor, ceiling, four columns) lies 0.4 m behind the facade. No motion is
    called true: what shows through a door cannot prove one.
    """
    found = find_facade(base)
    room = _room(rng) * [10.0, 7.0, 3.8] - [5.0, 7.4, 0.0]
    is_door = (np.abs(room[:, 0]) < 0.8) & (room[:, 1] > -0.45) & (room[:, 2] < 2.2)
    room = room[~is_door] + rng.normal(0.0, 0.002, (int((~is_door).sum()), 3))
    along = np.array([-found.outward[1], found.outward[0]])
    inside = np.column_stack(
        [
            found.middle + room[:, :1] * along + room[:, 1:2] * found.outward,
            found.floor + room[:, 2],
        ]
    )
    # From an eye 2 m behind the door.
    aside, before = found.place(base.lidar)
    ahead, above = before + 2.4, base.lidar[:, 2] - found.floor - 1.6
    through = 2.0 / np.maximum(ahead, 1e-9)
    is_seen = (ahead > 2.0) & (ahead < 14.0) & (np.abs(aside * through) < 0.8)
    is_seen &= (above * through > -1.6) & (above * through < 0.6)
    source = apply(pose(rng), np.vstack([inside, base.lidar[is_seen]]))
    return Trial(source=source, target=base.drone, truth=None)


def _room(rng: np.random.Generator, count: int = 60_000) -> Points:
    """Return points (n, 3) on the six faces of a unit box and on four columns in it."""
    points = rng.random((count, 3))
    face = rng.integers(0, 6, count)
    points[np.arange(count), face // 2] = face % 2
    turn = rng.uniform(0, 2 * np.pi, count // 6)
    corner = rng.integers(0, 2, (count // 6, 2)) * 0.4 + 0.3
    columns = np.column_stack(
        [corner + 0.025 * np.column_stack([np.cos(turn), np.sin(turn)]), rng.random(count // 6)]
    )
    return np.vstack([points, columns])
