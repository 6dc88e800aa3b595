"""A terrestrial laser scanner, simulated: stations, occlusion, noise, mixed pixels, outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from dougong.evaluation.mesh import MIXED, NEAR_NOISE, OUTLIER, REFLECTANCES, Bytes, Tracer
from dougong.params import Parameters
from dougong.typing import Mask, Points, Values


class Scanner(Parameters):
    """What the simulated scanner does."""

    points: Annotated[int, Field(ge=100)] = 1_000_000
    """Points of all stations together, about, before outliers."""
    range_noise_m: Annotated[float, Field(ge=0)] = 0.002
    """Standard deviation of one range."""
    range_offset_m: float = 0.0
    """Added to every range (a wrong instrument constant)."""
    angle_noise_deg: Annotated[float, Field(ge=0)] = 0.002
    """Standard deviation of one angle, horizontal and vertical."""
    compensator_error_deg: Annotated[float, Field(ge=0)] = 0.0
    """Standard deviation of what the compensator leaves of a station's tilt about x and about y."""
    max_range_m: Annotated[float, Field(gt=0)] = 120.0
    """Nothing farther returns."""
    max_incidence_deg: Annotated[float, Field(gt=0, le=90)] = 86.0
    """Surfaces met at a flatter angle do not return."""
    even_within_m: Annotated[float, Field(ge=0)] = 9.0
    """Ground nearer than this is not sampled more densely (the usual thinning near stations)."""
    mixed_share: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Share of the pulses looked at for a second surface in their footprint."""
    footprint_mrad: Annotated[float, Field(ge=0)] = 0.8
    """Half-angle of the pulse."""
    outliers: Annotated[float, Field(ge=0, lt=0.5)] = 0.015
    """Share of outliers among all points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Returns:
    """Points of a sensor in site coordinates, with what is known of each."""

    xyz: Points
    labels: Bytes
    shade: Values
    """(n,) returned strength or brightness, 0..1."""
    sensor: Bytes
    """(n,) which station or camera."""
    face: np.typing.NDArray[np.int64]
    """(n,) the face that was hit; -1 for outliers."""


def scan(tracer: Tracer, stations: Points, params: Scanner, rng: np.random.Generator) -> Returns:
    """Scan from every station (k, 3); the angular step is chosen to give `params.points`."""
    coarse = 2.2
    trial = sum(_scan_once(tracer, place, coarse, params, rng)[0].sum() for place in stations)
    step = coarse * float(np.sqrt(max(int(trial), 1) / params.points))
    parts = [
        _returns(tracer, place, number, step, params, rng) for number, place in enumerate(stations)
    ]
    if params.compensator_error_deg > 0:
        parts = [
            _tilted(part, place, params, rng) for part, place in zip(parts, stations, strict=True)
        ]
    merged = Returns(
        xyz=np.concatenate([part.xyz for part in parts]),
        labels=np.concatenate([part.labels for part in parts]),
        shade=np.concatenate([part.shade for part in parts]),
        sensor=np.concatenate([part.sensor for part in parts]),
        face=np.concatenate([part.face for part in parts]),
    )
    return with_outliers(merged, stations, params.outliers, rng)


def _tilted(part: Returns, place: Points, params: Scanner, rng: np.random.Generator) -> Returns:
    """Return a station's points turned about x and y by what its compensator did not see."""
    tilt = np.radians(rng.normal(0.0, params.compensator_error_deg, 2))
    turn = Rotation.from_rotvec([*tilt, 0.0]).as_matrix()
    return replace(part, xyz=place + (part.xyz - place) @ turn.T)


def _directions(step_deg: float, params: Scanner, rng: np.random.Generator) -> Points:
    """Return the pulses of one turn (n, 3): rows of equal elevation, each begun anywhere."""
    rows = []
    step = np.radians(step_deg)
    for elevation in np.arange(np.radians(-62.0), np.radians(88.0), step):
        spread = 1.0
        if elevation < 0:
            spread = max(1.0, params.even_within_m * np.sin(-elevation) / 1.7)
        count = max(6, round(2 * np.pi * np.cos(elevation) / (step * spread)))
        azimuth = 2 * np.pi * (np.arange(count) + rng.random()) / count
        rows.append(np.stack([azimuth, np.full(count, elevation)], axis=1))
    angles = np.concatenate(rows)
    angles += rng.normal(0.0, 0.15 * step, angles.shape)
    return _unit(angles)


def _unit(angles: Points) -> Points:
    azimuth, elevation = angles.T
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )


def _scan_once(
    tracer: Tracer, place: Points, step: float, params: Scanner, rng: np.random.Generator
) -> tuple[Mask, Points, Values, np.typing.NDArray[np.int64], Values]:
    """Return which pulses come back, their directions, ranges, faces and cosines of incidence."""
    directions = _directions(step, params, rng)
    distance, face = tracer.cast(place, directions, params.max_range_m)
    cosine = np.abs(np.einsum("ij,ij->i", directions, tracer.normals[face]))
    comes_back = (face >= 0) & (cosine > np.cos(np.radians(params.max_incidence_deg)))
    return comes_back & (distance > 0.6), directions, distance, face, cosine


def _returns(
    tracer: Tracer,
    place: Points,
    number: int,
    step: float,
    params: Scanner,
    rng: np.random.Generator,
) -> Returns:
    is_back, directions, distance, face, cosine = _scan_once(tracer, place, step, params, rng)
    directions, distance = directions[is_back], distance[is_back]
    face, cosine = face[is_back], cosine[is_back]
    labels = tracer.mesh.labels[face].copy()
    distance = _mix(tracer, place, directions, distance, labels, params, rng)
    measured = distance + params.range_offset_m + rng.normal(0.0, params.range_noise_m, len(face))
    sway = np.radians(params.angle_noise_deg) * rng.normal(size=(len(face), 3))
    sway -= directions * np.einsum("ij,ij->i", sway, directions)[:, None]
    shade = REFLECTANCES[tracer.mesh.materials[face]] * cosine
    shade = shade * rng.normal(1.0, 0.06, len(face)) / (1.0 + distance / 60.0)
    return Returns(
        xyz=place + measured[:, None] * (directions + sway),
        labels=labels,
        shade=np.clip(shade, 0.0, 1.0),
        sensor=np.full(len(face), number, dtype=np.uint8),
        face=face,
    )


def _mix(
    tracer: Tracer,
    place: Points,
    directions: Points,
    distance: Values,
    labels: Bytes,
    params: Scanner,
    rng: np.random.Generator,
) -> Values:
    """Return ranges where pulses that straddle an edge fall between its two surfaces."""
    chosen = np.flatnonzero(rng.random(len(distance)) < params.mixed_share)
    aside = rng.normal(size=(len(chosen), 3))
    aside -= directions[chosen] * np.einsum("ij,ij->i", aside, directions[chosen])[:, None]
    aside *= params.footprint_mrad * 1e-3 / np.linalg.norm(aside, axis=1, keepdims=True)
    other, _ = tracer.cast(place, directions[chosen] + aside, params.max_range_m)
    share = rng.random(len(chosen))
    gap = np.abs(other - distance[chosen])
    # Surfaces farther apart than a pulse is long come back as two echoes, not as one between.
    is_mixed = (gap > 0.03) & (gap < 2.5)
    at = chosen[is_mixed]
    mixed: Values = distance.copy()
    mixed[at] += share[is_mixed] * (other[is_mixed] - distance[at])
    labels[at] = MIXED
    return mixed


def with_outliers(
    clean: Returns, sensors: Points, share: float, rng: np.random.Generator
) -> Returns:
    """Return the points with outliers among them, so that they are `share` of the whole.

    Four kinds: 40 % somewhere along a ray, 20 % anywhere in the box of the cloud, 20 % below the
    surface by up to 6 m, 20 % 3 to 30 cm off the surface (labelled apart: near-surface noise).
    """
    count = round(len(clean.xyz) * share / (1.0 - share))
    if not count:
        return clean
    along, anywhere, below = (round(count * part) for part in (0.4, 0.2, 0.2))
    near = max(0, count - along - anywhere - below)
    pick = rng.integers(0, max(1, len(clean.xyz)), count)
    base, sensor = clean.xyz[pick], clean.sensor[pick]
    off = base.copy()
    part = slice(0, along)
    origin = sensors[sensor[part]]
    off[part] = origin + (base[part] - origin) * rng.uniform(0.15, 1.25, (along, 1))
    part = slice(along, along + anywhere)
    low, high = clean.xyz.min(axis=0), clean.xyz.max(axis=0)
    off[part] = rng.uniform(low, high + (0.0, 0.0, 2.0), (anywhere, 3))
    part = slice(along + anywhere, count - near)
    off[part, 2] = np.minimum(base[part, 2], np.median(base[:, 2])) - rng.uniform(0.2, 6.0, below)
    part = slice(count - near, count)
    aside = rng.normal(size=(near, 3))
    aside *= rng.uniform(0.03, 0.30, (near, 1)) / np.linalg.norm(aside, axis=1, keepdims=True)
    off[part] += aside
    labels = np.full(count, OUTLIER, dtype=np.uint8)
    labels[part] = NEAR_NOISE
    # Outliers stand among the points, as in a file, not at its end.
    order = rng.permutation(len(clean.xyz) + count)
    return Returns(
        xyz=np.concatenate([clean.xyz, off])[order],
        labels=np.concatenate([clean.labels, labels])[order],
        shade=np.concatenate([clean.shade, rng.random(count)])[order],
        sensor=np.concatenate([clean.sensor, sensor])[order],
        face=np.concatenate([clean.face, np.full(count, -1)])[order],
    )


def is_seen(
    tracer: Tracer, stations: Points, points: Points, normals: Points, params: Scanner
) -> Mask:
    """Say which surface points (n, 3) any station sees, by the scanner's own limits."""
    seen = np.zeros(len(points), dtype=bool)
    for place in stations:
        todo = np.flatnonzero(~seen)
        sight = place - points[todo]
        distance = np.linalg.norm(sight, axis=1)
        cosine = np.einsum("ij,ij->i", sight, normals[todo]) / distance
        is_open = (np.abs(cosine) > np.cos(np.radians(params.max_incidence_deg))) & (
            distance < params.max_range_m
        )
        todo = todo[is_open]
        seen[todo] = tracer.is_clear(np.broadcast_to(place, (len(todo), 3)), points[todo])
    return seen
