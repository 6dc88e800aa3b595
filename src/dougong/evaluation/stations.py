"""Where a surveyor would put the scanner round a mesh that nobody described."""

from __future__ import annotations

import numpy as np

from dougong.errors import InputError
from dougong.evaluation.mesh import Mesh, Tracer
from dougong.typing import Mask, Points, Values

_EYE_M = 1.7


def choose(
    tracer: Tracer, mesh: Mesh, count: int, rng: np.random.Generator, margin_m: float = 14.0
) -> Points:
    """Choose scanner positions (k, 3) in free space above the ground that see most of a mesh.

    Candidates stand outdoors on low ground with a metre to spare all round; of these the one that
    sees most of the surface not yet seen is taken, again and again, `count` times.

    Raises
    ------
    InputError
        No candidate stands free.
    """
    spots = _candidates(tracer, mesh, rng, margin_m)
    if not len(spots):
        msg = (
            "no free place for a scanner was found within "
            f"{margin_m:g} m round the mesh. Pass stations=, an array (k, 3) of positions."
        )
        raise InputError(msg)
    spots = spots[:90]
    points, face = mesh.samples(2500, rng)
    normals = mesh.normals()[face]
    sees = np.stack([_sees(tracer, spot, points, normals) for spot in spots])
    chosen: list[int] = []
    left = np.ones(len(points))
    while len(chosen) < min(count, len(spots)):
        gain = sees @ left
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
        # What was seen once still counts a little: overlap between stations is wanted.
        left[sees[chosen[-1]]] *= 0.3
    return spots[chosen]


def step_aside(tracer: Tracer, stations: Points, rng: np.random.Generator) -> Points:
    """Return the stations (k, 3), those that touch something moved to free ground nearby."""
    moved = stations.copy()
    below, _ = tracer.cast(stations, np.broadcast_to((0.0, 0.0, -1.0), stations.shape))
    stands = _is_free(tracer, stations, 0.6) & (np.abs(below - _EYE_M) < 0.3)
    for k in np.flatnonzero(~stands):
        tries = stations[k] + np.column_stack([rng.uniform(-4, 4, (60, 2)), np.full(60, 0.3)])
        tries = tries[np.argsort(np.hypot(*(tries - stations[k])[:, :2].T), kind="stable")]
        below, _ = tracer.cast(tries, np.broadcast_to((0.0, 0.0, -1.0), tries.shape))
        # The same floor, not the top of what stands on it.
        is_level = np.abs(below - _EYE_M - 0.3) < 0.35
        tries[:, 2] += np.where(is_level, _EYE_M - below, 0.0)
        good = np.flatnonzero(is_level & _is_free(tracer, tries, 0.8))
        if len(good):
            moved[k] = tries[good[0]]
    return moved


def _candidates(tracer: Tracer, mesh: Mesh, rng: np.random.Generator, margin: float) -> Points:
    low, high = mesh.extent()
    plan = rng.uniform(low[:2] - margin, high[:2] + margin, (1500, 2))
    above = np.column_stack([plan, np.full(len(plan), high[2] + 5.0)])
    distance, _ = tracer.cast(above, np.broadcast_to((0.0, 0.0, -1.0), above.shape))
    is_hit = np.isfinite(distance)
    ground = above[is_hit] - np.column_stack([np.zeros((is_hit.sum(), 2)), distance[is_hit]])
    level = np.percentile(ground[:, 2], 10)
    ground = ground[ground[:, 2] < level + max(0.8, 0.2 * (high[2] - level))]
    spots: Points = ground + (0.0, 0.0, _EYE_M)
    return spots[_is_free(tracer, spots)]


def _is_free(tracer: Tracer, spots: Points, room_m: float = 1.2) -> Mask:
    """Say which spots have nothing within `room_m` to the sides."""
    free = np.ones(len(spots), dtype=bool)
    for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        for rise in (-0.5, 0.0, 0.5):
            direction = np.array([np.cos(angle), np.sin(angle), rise])
            distance, _ = tracer.cast(spots, np.broadcast_to(direction, spots.shape), room_m)
            free &= np.isinf(distance)
    return free


def _sees(tracer: Tracer, spot: Values, points: Points, normals: Points) -> Mask:
    sight = spot - points
    distance = np.linalg.norm(sight, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", sight, normals)) / distance
    seen: Mask = (cosine > 0.2) & (distance < 45.0)
    at = np.flatnonzero(seen)
    seen[at] = tracer.is_clear(np.broadcast_to(spot, (len(at), 3)), points[at])
    return seen
