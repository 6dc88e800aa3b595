"""Real clouds with known noise added: what a noise filter does to surfaces that nobody drew.

Their own noise stays in and counts as surface. "Fine" points are the quarter with the largest
surface variation, since no cloud comes with labels. Each cloud is scaled to a spacing of
`SPACING_M`: some have no unit, and the noise is made in metres.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dougong.evaluation.denoise_noise import Sample, local_spacing, noise_round
from dougong.evaluation.mesh import FINE, SURFACE
from dougong.filters.neighbourhood import build_index, nearest, normals
from dougong.formats import read
from dougong.typing import Points

FILES = (
    "lion_takanawa/lion_takanawa.copc.laz",
    "lion_scans/lionscan1.xyz",
    "lion_scans/lionscan2.xyz",
    "espacio_escultorico/espacio_escultorico_uav_lod3.laz",
)
"""Under the data folder; those that are missing are left out."""
MOST = 60_000
"""Points of a cloud that are used: those nearest to its median, as dense as they are."""
NOISE_SHARE = 0.03
SPACING_M = 0.02


def real_samples(folder: Path, seed: int) -> Iterator[Sample]:
    """Yield a sample of each of `FILES` that is there."""
    for file in FILES:
        if (folder / file).is_file():
            cloud = read(folder / file)
            yield sample_of(Path(file).name.split(".")[0], cloud.xyz, seed)


def sample_of(name: str, points: Points, seed: int, share: float = NOISE_SHARE) -> Sample:
    """Return `points` (n, 3) with isolated, near-surface and clustered noise, a third each.

    Added noise is separable where it is farther from every point than 1.5 times the spacing there.
    """
    rng = np.random.default_rng([seed, len(name)])
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    clean = points[np.argsort(off, kind="stable")[:MOST]]
    some = clean[:: max(1, len(clean) // 2000)]
    clean = clean * (SPACING_M / float(np.median(local_spacing(clean, some))))
    surface = normals(clean)
    is_fine = surface.variation > np.nanquantile(surface.variation, 0.75)
    labels = np.where(is_fine, FINE, SURFACE)
    added, kinds = noise_round(
        clean, np.nan_to_num(surface.normals), round(share * len(clean) / 3), SPACING_M, rng
    )
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
