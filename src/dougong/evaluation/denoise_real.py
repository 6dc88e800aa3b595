"""Real buildings and clouds with known noise: what a filter does to surfaces that nobody drew.

"Fine" points are the quarter with the largest surface variation, since none comes with labels.
A building's mesh is scanned from two places before its front, so its noise is of every kind and the
distance of each noise point from the surface is known. Of a cloud its own noise stays in and
counts as surface, and it is scaled to a spacing of `SPACING_M`: some have no unit, and the noise
is made in metres.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.denoise_noise import (
    Sample,
    fine_labels,
    local_spacing,
    make_sample,
    noise_round,
)
from dougong.evaluation.denoise_shapes import Shape
from dougong.evaluation.mesh import Mesh, load_mesh
from dougong.filters.neighbourhood import build_index, nearest, normals
from dougong.formats import read
from dougong.typing import Points

FILES = (
    "lion_takanawa/lion_takanawa.copc.laz",
    "lion_scans/lionscan1.xyz",
    "lion_scans/lionscan2.xyz",
    "espacio_escultorico/espacio_escultorico_uav_lod3.laz",
)
"""Clouds under the data folder; those that are missing are left out."""


class Building(NamedTuple):
    """A mesh under the data folder, and how it is scanned."""

    name: str
    file: str
    is_y_up: bool
    density: float
    """Points per square metre, square on at its middle."""
    half_m: float
    """What lies within this of its highest point, in plan, is scanned: without its neighbours."""


BUILDINGS = (
    Building("nuyda_house", "nuyda_house/nuyda.ply", False, 300.0, 50.0),
    Building("monastery", "monastery_mesh/samurai_monastry.obj.gz", True, 400.0, 15.0),
)
"""Those that are missing are left out."""
STAND_OFF_M, EYE_M = 9.0, 1.7
"""How far before the front, and how high over the foot, the scanner stands."""
FINE_SHARE = 0.25
MOST = 60_000
"""Points of a cloud that are used: those nearest to its median, as dense as they are."""
NOISE_SHARE = 0.03
SPACING_M = 0.02


def real_samples(folder: Path, seed: int) -> Iterator[Sample]:
    """Yield a sample of each of `BUILDINGS` and `FILES` that is there."""
    for building in BUILDINGS:
        file = folder / building.file
        if file.is_file():
            vertices, faces = load_mesh(file, is_y_up=building.is_y_up)
            yield scanned(building, Mesh.of(vertices, faces), seed)
    for name in FILES:
        if (folder / name).is_file():
            cloud = read(folder / name)
            yield sample_of(Path(name).name.split(".")[0], cloud.xyz, seed)


def scanned(building: Building, mesh: Mesh, seed: int, share: float = NOISE_SHARE) -> Sample:
    """Return a scan of a building's `mesh` with every kind of noise, equally of each."""
    part = _round_the_top(mesh, building.half_m)
    return make_sample(
        building.name,
        Shape(part, _before_the_front(part)),
        density=building.density,
        pattern="scan",
        noise_share=share,
        seed=seed,
        fine_share=FINE_SHARE,
    )


def _round_the_top(mesh: Mesh, half_m: float) -> Mesh:
    """Return the faces that lie within `half_m` of the highest point, in plan."""
    top = mesh.vertices[np.argmax(mesh.vertices[:, 2]), :2]
    is_near = np.abs(mesh.corners()[:, :, :2] - top).max(axis=(1, 2)) <= half_m
    faces = mesh.faces[is_near]
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh.of(mesh.vertices[used], faces.reshape(-1, 3))


def _before_the_front(mesh: Mesh) -> NDArray[np.float64]:
    """Return two places (2, 3) before the side towards -y, at a quarter and three quarters."""
    low, high = np.percentile(mesh.vertices, [0.5, 99.5], axis=0)
    across = low[0] + (high[0] - low[0]) * np.array([0.25, 0.75])
    return np.column_stack([across, np.full(2, low[1] - STAND_OFF_M), np.full(2, low[2] + EYE_M)])


def sample_of(name: str, points: Points, seed: int, share: float = NOISE_SHARE) -> Sample:
    """Return `points` (n, 3) with isolated, near-surface and clustered noise, a third each.

    Added noise is separable where it is farther from every point than 1.5 times the spacing there.
    """
    rng = np.random.default_rng([seed, len(name)])
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    clean = points[np.argsort(off, kind="stable")[:MOST]]
    some = clean[:: max(1, len(clean) // 2000)]
    clean = clean * (SPACING_M / float(np.median(local_spacing(clean, some))))
    labels = fine_labels(clean, FINE_SHARE)
    facing = np.nan_to_num(normals(clean).normals)
    added, kinds = noise_round(clean, facing, round(share * len(clean) / 3), SPACING_M, rng)
    _, distance = nearest(build_index(clean), added)
    is_separable = np.concatenate(
        [np.zeros(len(clean), bool), distance > 1.5 * local_spacing(clean, added)]
    )
    everything = np.concatenate([clean, added])
    shuffle = rng.permutation(len(everything))
    return Sample(
        name=name,
        points=everything[shuffle],
        labels=np.concatenate([labels, kinds]).astype(np.uint8)[shuffle],
        is_separable=is_separable[shuffle],
        spacing_m=SPACING_M,
    )
