"""Samples of a shape with labelled noise of every kind, and which of it can be told apart.

Noise counts as separable where it is farther from the true surface than max(3 sigma of the sensor,
the local spacing) (METHOD.md section 5).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.denoise_shapes import Shape
from dougong.evaluation.mesh import (
    CLUSTER,
    FINE,
    MIXED,
    NEAR_NOISE,
    OUTLIER,
    SURFACE,
    Bytes,
    Mesh,
    Tracer,
)
from dougong.filters.neighbourhood import build_index, knn
from dougong.filters.neighbourhood import normals as surface_normals
from dougong.typing import Index, Mask, Points, Values

SHADOW = 9
"""Truth label of a duplicate shadow: a thin second copy of a surface, behind it."""
NOISE_KINDS = {
    OUTLIER: "isolated", NEAR_NOISE: "near", MIXED: "mixed", CLUSTER: "clustered", SHADOW: "shadow"
}  # fmt: skip
Pattern = Literal["poisson", "gradient", "scan"]
Rng = np.random.Generator


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """A noisy cloud and the truth about it."""

    name: str
    points: Points
    labels: Bytes
    """(n,) truth labels: 0 surface, 1 fine, 3 vegetation, 5 .. 9 noise."""
    is_separable: Mask
    """(n,) noise that a filter can be asked to find."""
    spacing_m: float
    """Median spacing of the clean points."""

    @property
    def is_noise(self) -> Mask:
        """(n,)."""
        noise: Mask = self.labels >= OUTLIER
        return noise


def _scan(tracer: Tracer, stations: Points, density: float, rng: Rng) -> tuple[Points, Index]:
    """Return hits (n, 3) and faces of angular grids whose density is met where the mesh is seen."""
    low, high = tracer.mesh.extent()
    found, faces = [], []
    for place in stations:
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1])
                            for z in (low[2], high[2])]) - place  # fmt: skip
        reach = np.linalg.norm((low + high) / 2 - place)
        step = 1.0 / (reach * np.sqrt(density / len(stations)))
        azimuth = np.arctan2(corners[:, 1], corners[:, 0])
        rise = np.arctan2(corners[:, 2], np.linalg.norm(corners[:, :2], axis=1))
        a, e = np.meshgrid(
            np.arange(azimuth.min(), azimuth.max(), step) + rng.random() * step,
            np.arange(rise.min(), rise.max(), step) + rng.random() * step,
            indexing="ij",
        )
        a, e = a.ravel() + rng.normal(0, 0.05 * step, a.size), e.ravel()
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
        distance, face = tracer.cast(np.broadcast_to(place, rays.shape), rays)
        hit = face >= 0
        slant = np.abs(np.einsum("ij,ij->i", rays[hit], tracer.normals[face[hit]]))
        kept = slant > np.cos(np.radians(86.0))
        found.append((place + rays[hit] * distance[hit, None])[kept])
        faces.append(face[hit][kept])
    return np.concatenate(found), np.concatenate(faces)


def clean_points(
    shape: Shape, density: float, pattern: Pattern, rng: Rng, tracer: Tracer
) -> tuple[Points, Bytes, Points]:
    """Return points (n, 3), labels (n,) and normals (n, 3) on the shape, without any error."""
    mesh = shape.mesh
    if pattern == "scan":
        points, face = _scan(tracer, shape.stations, density, rng)
    else:
        points, face = mesh.samples(max(100, int(density * mesh.areas().sum())), rng)
    if pattern == "gradient":
        # As with one station close by: 1 / range^2 along the piece, to a sixteenth.
        low, high = mesh.extent()
        far = 1.0 + 3.0 * (points[:, 0] - low[0]) / (high[0] - low[0])
        kept = rng.random(len(points)) < far**-2.0
        points, face = points[kept], face[kept]
    return points, mesh.labels[face], tracer.normals[face]


def fine_labels(clean: Points, share: float) -> Bytes:
    """Return labels (n,): fine for the `share` of points with the largest surface variation."""
    variation = surface_normals(clean).variation
    is_fine = variation > np.nanquantile(variation, 1.0 - share)
    return np.where(is_fine, FINE, SURFACE).astype(np.uint8)


def surface_distance(points: Points, mesh: Mesh, rng: Rng) -> Values:
    """Return the distance (n,) of points from a mesh: exact to the triangles that may be nearest.

    Those are the triangles of the 12 nearest of 3e5 points, or two per face, drawn on the mesh.
    """
    drawn, face = mesh.samples(max(300_000, 2 * len(mesh)), rng)
    near, _ = knn(build_index(drawn), points, 12)
    best = np.full(len(points), np.inf)
    corners = mesh.corners()
    for column in range(near.shape[1]):
        best = np.minimum(best, _triangle_distance(points, corners[face[near[:, column]]]))
    return best


def _triangle_distance(points: Points, corners: NDArray[np.float64]) -> Values:
    """Return the distance of each point (n, 3) from its triangle (n, 3, 3)."""
    best = np.full(len(points), np.inf)
    for k in range(3):
        start, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        length2 = np.maximum(np.einsum("ij,ij->i", edge, edge), 1e-30)
        t = np.clip(np.einsum("ij,ij->i", points - start, edge) / length2, 0, 1)
        best = np.minimum(best, np.linalg.norm(points - start - t[:, None] * edge, axis=1))
    a, b, off = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    normal = np.cross(a, b)
    area2 = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-30)
    u = np.einsum("ij,ij->i", np.cross(off, b), normal) / area2
    v = np.einsum("ij,ij->i", np.cross(a, off), normal) / area2
    height = np.abs(np.einsum("ij,ij->i", off, normal)) / np.sqrt(area2)
    is_over = (u >= 0) & (v >= 0) & (u + v <= 1)
    result: Values = np.where(is_over, np.minimum(best, height), best)
    return result


def local_spacing(clean: Points, queries: Points, k: int = 12) -> Values:
    """Return the spacing (n,) of the clean points where each query is nearest to them.

    That of a square grid of the density that the k nearest neighbours there show.
    """
    index = build_index(clean)
    place, _ = knn(index, queries, 1)
    _, distance = knn(index, clean[place[:, 0]], k + 1)
    spacing: Values = distance[:, -1] * np.sqrt(np.pi / k)
    return spacing


def _isolated(clean: Points, count: int, rng: Rng) -> Points:
    return rng.uniform(clean.min(axis=0) - 1.0, clean.max(axis=0) + 1.0, (count, 3))


def _near(clean: Points, normals: Points, count: int, spacing: float, rng: Rng) -> Points:
    """Return points off the surface, half along the normal, half all round (sigma to 15 cm)."""
    pick = rng.integers(0, len(clean), count)
    low = min(0.05, 1.5 * spacing)
    off = np.exp(rng.uniform(np.log(low), np.log(0.5), (count, 1))) * rng.choice(
        [-1, 1], (count, 1)
    )
    moved = normals[pick] * off
    half = count // 2
    moved[:half] = rng.normal(0, min(0.15, 6 * spacing), (half, 3))
    result: Points = clean[pick] + moved
    return result


def _mixed(tracer: Tracer, shape: Shape, clean: Points, count: int, rng: Rng) -> Points:
    """Return points between the front and the back of range edges, along the rays."""
    pick = rng.integers(0, len(clean), 60 * count + 100)
    place = shape.stations[rng.integers(0, len(shape.stations), len(pick))]
    to = clean[pick] - place
    reach = np.linalg.norm(to, axis=1)
    rays = to / reach[:, None]
    first, _ = tracer.cast(place, rays)
    beside = rays + rng.normal(0, 5e-4, rays.shape)
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    second, _ = tracer.cast(place, beside)
    gap = second - first
    is_edge = np.flatnonzero(np.isfinite(gap) & (np.abs(gap) > 0.10) & (np.abs(gap) < 2.5))[:count]
    share = rng.random(len(is_edge))
    between = first[is_edge] + share * gap[is_edge]
    result: Points = place[is_edge] + rays[is_edge] * between[:, None]
    return result


def _clusters(clean: Points, normals: Points, count: int, density: float, rng: Rng) -> Points:
    """Return birds, leaves and fringes of people: together `count` points, about a third each."""
    parts: list[Points] = []
    for size, area, away in (
        ((0.06, 0.06, 0.03), 0.012, (0.4, 2.0)),
        ((0.02, 0.02, 0.006), 0.002, (0.1, 1.0)),
        ((0.15, 0.12, 0.45), 0.05, (0.4, 1.5)),
    ):
        held = int(np.clip(area * density, 3, max(3, count // 6)))
        left = count // 3
        while left >= 3:
            at = rng.integers(len(clean))
            centre = clean[at] + rng.choice([-1, 1]) * normals[at] * rng.uniform(*away)
            number = min(left, int(held * rng.uniform(0.6, 1.4)) + 2)
            parts.append(centre + rng.normal(0, 1, (number, 3)) * size)
            left -= number
    return np.concatenate(parts) if parts else np.empty((0, 3))


def _shadow(shape: Shape, clean: Points, count: int, rng: Rng) -> Points:
    """Return thin copies (a tenth of the density) of patches, 5 to 20 cm farther along the ray."""
    index = build_index(clean)
    parts: list[Points] = []
    left = count
    while left > 0:
        seed = clean[rng.integers(len(clean))][None]
        held = min(left, max(10, count // 3))
        near = knn(index, seed, min(10 * held, len(clean)))[0][0]
        chosen = clean[rng.choice(near[near >= 0], held, replace=False)]
        ray = chosen - shape.stations[0]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        parts.append(chosen + ray * rng.uniform(0.05, 0.20))
        left -= held
    return np.concatenate(parts) if parts else np.empty((0, 3))


def make_sample(
    name: str,
    shape: Shape,
    *,
    density: float,
    pattern: Pattern,
    noise_share: float = 0.03,
    sigma_m: float = 0.002,
    seed: int = 0,
    kinds: tuple[int, ...] = tuple(NOISE_KINDS),
    fine_share: float | None = None,
) -> Sample:
    """Draw a shape with noise: `noise_share` of the clean points, equally of every kind.

    Parameters
    ----------
    name : str
    shape : Shape
    density : float
        Points per square metre (``scan``: seen square on at the middle's distance).
    pattern : {"poisson", "gradient", "scan"}
        Drawn at random by area; so, thinning to a sixteenth; angular grids with occlusion.
    noise_share, sigma_m : float
        Noise among the clean points; standard deviation of the sensor, metres per axis.
    seed : int
    kinds : tuple of int
        Truth labels of the noise to add.
    fine_share : float, optional
        Call so many of the clean points fine, those on the most curved surface (`fine_labels`);
        None: those on faces of the mesh that are labelled so.
    """
    rng = np.random.default_rng([seed, len(name), int(density)])
    tracer = Tracer(shape.mesh)
    clean, labels, normals = clean_points(shape, density, pattern, rng, tracer)
    if fine_share is not None:
        labels = fine_labels(clean, fine_share)
    spacing = float(np.median(local_spacing(clean, clean[:: max(1, len(clean) // 2000)])))
    each = max(6, round(noise_share * len(clean) / len(kinds)))
    makers = {
        OUTLIER: lambda: _isolated(clean, each, rng),
        NEAR_NOISE: lambda: _near(clean, normals, each, spacing, rng),
        MIXED: lambda: _mixed(tracer, shape, clean, each, rng),
        CLUSTER: lambda: _clusters(clean, normals, each, density, rng),
        SHADOW: lambda: _shadow(shape, clean, each, rng),
    }
    noise = [makers[kind]() for kind in kinds]
    added = np.concatenate(noise)
    limit = np.maximum(3 * sigma_m, local_spacing(clean, added))
    is_separable = surface_distance(added, shape.mesh, rng) > limit
    points = np.concatenate([clean + rng.normal(0, sigma_m, clean.shape), added])
    all_labels = np.concatenate(
        [labels, *(np.full(len(part), kind) for part, kind in zip(noise, kinds, strict=True))]
    )
    separable = np.concatenate([np.zeros(len(clean), bool), is_separable])
    shuffle = rng.permutation(len(points))
    return Sample(
        name=name,
        points=points[shuffle],
        labels=all_labels.astype(np.uint8)[shuffle],
        is_separable=separable[shuffle],
        spacing_m=spacing,
    )


def noise_round(
    clean: Points, normals: Points, each: int, spacing: float, rng: Rng
) -> tuple[Points, Bytes]:
    """Return isolated, near-surface and clustered noise round points, and its labels.

    `each` points of each kind; mixed pixels and shadows need the surface itself (`make_sample`).
    """
    parts = {
        OUTLIER: _isolated(clean, each, rng),
        NEAR_NOISE: _near(clean, normals, each, spacing, rng),
        CLUSTER: _clusters(clean, normals, each, spacing**-2, rng),
    }
    labels = [np.full(len(part), kind, np.uint8) for kind, part in parts.items()]
    return np.concatenate(list(parts.values())), np.concatenate(labels)
