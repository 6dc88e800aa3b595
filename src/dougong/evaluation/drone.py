"""A drone and its photogrammetry, simulated: cameras, visibility, noise, slow bending."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dougong.evaluation.mesh import Tracer
from dougong.evaluation.scanner import Returns, with_outliers
from dougong.params import Parameters
from dougong.typing import Mask, Points, Values


class Drone(Parameters):
    """What the simulated flight and its reconstruction do."""

    points: Annotated[int, Field(ge=100)] = 600_000
    """Points, about, before outliers."""
    noise_m: Annotated[float, Field(ge=0)] = 0.012
    """Standard deviation along the viewing direction."""
    correlated_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Share of the noise's variance that neighbours have in common (0.3 to 3 m waves)."""
    max_incidence_deg: Annotated[float, Field(gt=0, le=90)] = 78.0
    """Surfaces met at a flatter angle are not matched."""
    field_of_view_deg: Annotated[float, Field(gt=0, lt=170)] = 66.0
    """Of the longer image side."""
    outliers: Annotated[float, Field(ge=0, lt=0.5)] = 0.015
    """Share of outliers among all points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cameras:
    """Where the photographs were taken from, and which way they look."""

    places: Points
    """(k, 3)"""
    axes: NDArray[np.float64]
    """(k, 3, 3) rows: right, up, forward."""
    partners: NDArray[np.int64]
    """(k, 4) the cameras each one is matched with."""

    def taken(self, are_taken: Mask) -> Cameras:
        """Return those cameras that `are_taken` (k,), five at least, matched among themselves."""
        places = self.places[are_taken]
        return Cameras(places=places, axes=self.axes[are_taken], partners=_partners(places))


def flight(
    tracer: Tracer, centre: Points, radius: float, top: float, rng: np.random.Generator
) -> Cameras:
    """Return a nadir grid and two oblique rings round `centre` that see `radius` and `top`.

    A drone keeps 8 m over whatever stands below it, so no camera is inside a rock or a roof.
    """
    height = top + 12.0 + 0.75 * radius
    offsets = np.linspace(-0.75, 0.75, 4) * radius
    nadir = [(x, y, height) for x in offsets for y in offsets]
    places, targets = list(nadir), [(x, y, 0.0) for x, y, _ in nadir]
    # A high ring at 40 degrees, and a low one at 20 to look below the eaves.
    for count, distance, level, look in (
        (18, 1.25 * radius + 6.0, 0.75 * height, 0.30 * top),
        (20, 0.95 * radius + 14.0, 0.70 * top + 6.0, 0.45 * top),
    ):
        phase = rng.random()
        for k in range(count):
            angle = 2 * np.pi * (k + phase) / count
            places.append((distance * np.cos(angle), distance * np.sin(angle), level))
            targets.append((0.0, 0.0, look))
    at = np.array(places) + rng.normal(0.0, 0.4, (len(places), 3)) + centre
    sky = at + (0.0, 0.0, 1000.0)
    drop, _ = tracer.cast(sky, np.broadcast_to((0.0, 0.0, -1.0), at.shape))
    at[:, 2] = np.maximum(at[:, 2], np.where(np.isfinite(drop), sky[:, 2] - drop + 8.0, -np.inf))
    forward = np.array(targets) + rng.normal(0.0, 0.5, at.shape) + centre - at
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, (0.02, 1.0, 0.0))
    is_oblique = np.arange(len(at)) >= len(nadir)
    right[is_oblique] = np.cross(forward[is_oblique], (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(right, forward), forward], axis=1)
    return Cameras(places=at, axes=axes, partners=_partners(at))


def _partners(places: Points) -> NDArray[np.int64]:
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest: NDArray[np.int64] = np.argsort(apart, axis=1, kind="stable")[:, :4]
    return nearest


def photograph(
    tracer: Tracer, cameras: Cameras, params: Drone, rng: np.random.Generator
) -> Returns:
    """Return the surface that two neighbouring cameras see, in site coordinates, not bent."""
    trial = 500
    found = sum(len(_matched(tracer, cameras, k, trial, params, rng)[0]) for k in _every(cameras))
    pixels = int(trial * params.points / max(found, 1)) + 1
    parts = [_matched(tracer, cameras, k, pixels, params, rng) for k in _every(cameras)]
    xyz = np.concatenate([part[0] for part in parts])
    face = np.concatenate([part[1] for part in parts])
    sensor = np.concatenate([np.full(len(part[1]), k) for k, part in enumerate(parts)])
    sight = xyz - cameras.places[sensor]
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    slow = np.sqrt(params.correlated_share) * smooth_field(xyz, rng)
    fast = np.sqrt(1.0 - params.correlated_share) * rng.normal(size=len(xyz))
    noisy = xyz + params.noise_m * (slow + fast)[:, None] * sight
    noisy += rng.normal(0.0, 0.3 * params.noise_m, xyz.shape)
    sun = np.array([0.45, -0.35, 0.82])
    light = 0.62 + 0.38 * np.abs(tracer.normals[face] @ sun)
    clean = Returns(
        xyz=noisy,
        labels=tracer.mesh.labels[face],
        shade=np.clip(light * rng.normal(1.0, 0.05, len(xyz)), 0.0, 1.2),
        sensor=sensor.astype(np.uint8),
        face=face,
    )
    return with_outliers(clean, cameras.places, params.outliers, rng)


def _every(cameras: Cameras) -> range:
    return range(len(cameras.places))


def _matched(
    tracer: Tracer,
    cameras: Cameras,
    number: int,
    pixels: int,
    params: Drone,
    rng: np.random.Generator,
) -> tuple[Points, NDArray[np.int64]]:
    """Return the points of one depth map that a partner camera confirms, and their faces."""
    wide = np.tan(np.radians(params.field_of_view_deg / 2))
    columns = max(2, round(np.sqrt(pixels * 4 / 3)))
    rows = max(2, round(pixels / columns))
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    spot = np.stack([u.ravel(), v.ravel()], axis=1) + rng.random((u.size, 2))
    x = (2 * spot[:, 0] / columns - 1) * wide
    y = (2 * spot[:, 1] / rows - 1) * wide * 0.75
    right, up, forward = cameras.axes[number]
    directions = x[:, None] * right + y[:, None] * up + forward
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    place = cameras.places[number]
    distance, face = tracer.cast(place, directions)
    cosine = np.abs(np.einsum("ij,ij->i", directions, tracer.normals[face]))
    is_good = (face >= 0) & (cosine > np.cos(np.radians(params.max_incidence_deg)))
    points = place + np.where(is_good, distance, 0.0)[:, None] * directions
    points, face = points[is_good], face[is_good]
    is_matched = np.zeros(len(points), dtype=bool)
    for partner in cameras.partners[number]:
        todo = np.flatnonzero(~is_matched)
        is_matched[todo] = _sees(tracer, cameras, int(partner), points[todo], params)
    return points[is_matched], face[is_matched]


def _sees(tracer: Tracer, cameras: Cameras, number: int, points: Points, params: Drone) -> Mask:
    """Say which points lie in a camera's image with nothing in between."""
    sight = points - cameras.places[number]
    x, y, z = (sight @ cameras.axes[number].T).T
    wide = np.tan(np.radians(params.field_of_view_deg / 2))
    seen: Mask = (z > 0) & (np.abs(x) < wide * z) & (np.abs(y) < 0.75 * wide * z)
    inside = np.flatnonzero(seen)
    start = np.broadcast_to(cameras.places[number], (len(inside), 3))
    seen[inside] = tracer.is_clear(start, points[inside])
    return seen


def is_seen(
    tracer: Tracer, cameras: Cameras, points: Points, normals: Points, params: Drone
) -> Mask:
    """Say which surface points (n, 3) at least two cameras see, by the flight's own limits."""
    times = np.zeros(len(points), dtype=np.int64)
    limit = np.cos(np.radians(params.max_incidence_deg))
    for k in _every(cameras):
        todo = np.flatnonzero(times < 2)
        sight = cameras.places[k] - points[todo]
        cosine = np.einsum("ij,ij->i", sight, normals[todo]) / np.linalg.norm(sight, axis=1)
        todo = todo[np.abs(cosine) > limit]
        times[todo] += _sees(tracer, cameras, k, points[todo], params)
    return times >= 2


def smooth_field(points: Points, rng: np.random.Generator, waves: int = 14) -> Values:
    """Return a random field of unit variance at `points` (n, 3), of 0.3 to 3 m waves."""
    direction = rng.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    number = 2 * np.pi / np.exp(rng.uniform(np.log(0.3), np.log(3.0), waves))
    phase = rng.uniform(0, 2 * np.pi, waves)
    total = np.zeros(len(points))
    for k in range(waves):
        total += np.cos(points @ (direction[k] * number[k]) + phase[k])
    field: Values = total * np.sqrt(2.0 / waves)
    return field


@dataclass(frozen=True, slots=True, kw_only=True)
class Bending:
    """The slow deformation of a photogrammetric block: bowl, tilt and scale drift."""

    centre: NDArray[np.float64]
    """(3,) about which the block tilts and shrinks."""
    bowl_centre: NDArray[np.float64]
    """(2,) where the bowl has its bottom."""
    bowl_per_m: float
    """Height gained per square metre of squared distance."""
    tilt: NDArray[np.float64]
    """(2,) radians about x and y."""
    scale_drift: float
    """Relative: 1e-4 is 100 ppm."""

    def at(self, points: Points) -> Points:
        """Return the displacement (n, 3) at `points` (n, 3)."""
        local = points - self.centre
        from_bowl = points[:, :2] - self.bowl_centre
        lift = self.bowl_per_m * np.einsum("ij,ij->i", from_bowl, from_bowl)
        moved: Points = self.scale_drift * local
        moved[:, 2] += lift + self.tilt[0] * local[:, 1] - self.tilt[1] * local[:, 0]
        moved[:, 1] -= self.tilt[0] * local[:, 2]
        moved[:, 0] += self.tilt[1] * local[:, 2]
        return moved


def draw_bending(
    centre: Points, radius: float, rng: np.random.Generator, is_on: bool = True
) -> Bending:
    """Draw a bending of centimetres over `radius` metres about `centre` (3,)."""
    size = 1.0 if is_on else 0.0
    sag = size * rng.choice([-1.0, 1.0]) * rng.uniform(0.006, 0.020)
    return Bending(
        centre=np.asarray(centre, dtype=np.float64),
        bowl_centre=np.asarray(centre[:2]) + rng.uniform(-0.5, 0.5, 2) * radius,
        bowl_per_m=sag / radius**2,
        tilt=size * rng.normal(0.0, 0.010, 2) / radius,
        scale_drift=size * rng.normal(0.0, 0.005) / radius,
    )
