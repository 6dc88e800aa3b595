"""Signed distances between two registered clouds along the surface's normals: M3C2.

Lague, Brodu and Leroux 2013: at each core point a normal is taken from the ball around it, a
cylinder along it gathers the points of either cloud, and the distance is the difference of their
middles (to 3e-14 m that of py4dgeo: `benchmarks/m3c2_conformance.py`). A distance says something
only beside its level of detection: what noise, roughness and the registration's own uncertainty
would show where nothing differs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dougong._sorting import by_coordinates
from dougong.errors import InputError
from dougong.filters import neighbourhood
from dougong.filters.neighbourhood import Neighbourhood
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid
from dougong.kernels import m3c2
from dougong.params import Parameters
from dougong.registration.cleaning import extent, in_some_blocks, sensor_noise
from dougong.registration.icp_solve import plane_rows
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

Positive = Annotated[float, Field(gt=0)]
_BLOCK = 2048
_LEAST_PLANARITY = 0.03
"""(l2 - l3) / l1 below which a ball holds a line of points: its normal would be chance."""
_MEDIAN_COST = float(np.sqrt(np.pi / 2.0))
"""Standard deviation of a median over that of a mean, for normal errors."""


class Distances(Parameters):
    """How distances between two registered clouds are measured; what is not set is chosen."""

    normal_scale_m: Positive | None = None
    """Diameter of the ball a normal is taken from; by default 25 times the noise of the cloud it
    is taken from (so that roughness turns the normal by less than costs 2 % of a distance: Lague
    2013, 3.2), at least 6 times its spacing and 0.2 m (the wall, not its carving), at most 1 m."""
    projection_scale_m: Positive | None = None
    """Diameter of the cylinder; by default 5 times the wider spacing of the two clouds (about 20
    points of the sparser one), 0.1 to 1 m."""
    max_distance_m: Positive | None = None
    """How far the cylinder reaches to either side; by default 6 times the noise of both clouds
    together, 0.15 to 0.5 m. What lies farther apart is not one surface."""
    core_spacing_m: Positive | None = None
    """Edge of the voxels that core points are thinned to; by default half the projection scale,
    at least 0.05 m, and wider where more than `max_core_points` would remain."""
    max_core_points: Annotated[int, Field(ge=1000)] = 100_000
    """Core points at most, when `core_spacing_m` is not set."""
    min_points: Annotated[int, Field(ge=2)] = 5
    """Fewer points of either cloud in a cylinder: no distance is given."""
    statistic: Literal["median", "mean"] = "median"
    """Middle of the points in a cylinder: median and IQR / 1.349, or the paper's mean and
    standard deviation. A few points of another surface do not move a median."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scales:
    """The lengths distances were measured with, metres, and the noise they follow from."""

    normal_m: float
    projection_m: float
    max_distance_m: float
    core_spacing_m: float
    noise_source_m: float
    noise_target_m: float
    normals_from: Literal["source", "target"]
    """The cloud with less noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SignedDistances:
    """M3C2 distances at k core points, in the local frame of the target."""

    core: Points
    """(k, 3) points of the source near the target."""
    normals: Points
    """(k, 3) unit, NaN where there is none; the sign says nothing of the outside (`outward`)."""
    distance_m: Values
    """(k,) source minus target along the normal; NaN where it is not observable."""
    lod95_m: Values
    """(k,) level of detection at 95 %: smaller distances are none."""
    registration_m: Values
    """(k,) standard deviation of the pose along the normal; 0 where no covariance is known."""
    spread_source_m: Values
    """(k,) spread of the source's points along the normal: noise and roughness."""
    spread_target_m: Values
    count_source: Index
    count_target: Index
    scales: Scales
    has_registration: bool
    """False: `lod95_m` holds noise and roughness only."""

    def __len__(self) -> int:
        return len(self.core)

    @property
    def is_observed(self) -> Mask:
        """(k,) True where there is a distance."""
        observed: Mask = np.isfinite(self.distance_m)
        return observed


def signed_distances(
    source: Points,
    target: Points,
    params: Distances | None = None,
    *,
    covariance: NDArray[np.float64] | None = None,
    covariance_about: NDArray[np.float64] | None = None,
    core: Points | None = None,
    normals: Points | None = None,
) -> SignedDistances:
    """Measure signed distances from `target` to the registered `source` where they overlap.

    Parameters
    ----------
    source, target : ndarray, shape (n, 3) and (m, 3)
        Metres, in one local frame; the source moved by its registration.
    params : Distances, optional
    covariance : ndarray, shape (6, 6) or (7, 7), optional
        Of (omega rad, v m[, ln s]), the pose's, about `covariance_about` (3,) in that frame.
    core : ndarray, shape (k, 3), optional
        Core points; by default the source, thinned, where the target is near.
    normals : ndarray, shape (k, 3), optional
        Unit normals at `core`; by default from the cloud with less noise.

    Returns
    -------
    SignedDistances

    Raises
    ------
    InputError
        A cloud is empty.

    Notes
    -----
    LoD95 = 1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + sigma of the pose along the normal): eq. 1 of the
    paper, its registration term worked out at each point from the covariance and added in full,
    since neighbours share it. With medians s^2 / n is times pi / 2. Errors that the points of one
    cylinder have in common (a drone cloud's bending within a block) are in no term but the pose's.
    Deterministic; independent of thread count, point order and coordinate offset. Tile class:
    local, halo max(normal_m / 2, hypot(max_distance_m, projection_m / 2)). About 110 bytes per
    point for the two indices, and 200 per core point.
    """
    params = params or Distances()
    for name, points in (("source", source), ("target", target)):
        if len(points) == 0:
            raise InputError(f"{name} has no points, so there is nothing to measure to.")
    indices = neighbourhood.build_index(source), neighbourhood.build_index(target)
    scales = choose_scales(source, target, indices, params)
    if core is None:
        core, scales = _core_points(source, indices[1], scales, params)
    core = np.ascontiguousarray(core)
    if normals is None:
        giver = indices[0] if scales.normals_from == "source" else indices[1]
        normals = normals_at(giver, core, scales.normal_m / 2)
    use_median = params.statistic == "median"
    counts, middles, spreads = zip(
        *(_projected(index, core, normals, scales, use_median) for index in indices), strict=True
    )
    is_seen = np.minimum(counts[0], counts[1]) >= params.min_points
    pose = _along_normals(core, normals, covariance, covariance_about)
    cost = _MEDIAN_COST if use_median else 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = cost * np.sqrt(spreads[0] ** 2 / counts[0] + spreads[1] ** 2 / counts[1])
    return SignedDistances(
        core=core,
        normals=normals,
        distance_m=np.where(is_seen, middles[0] - middles[1], np.nan),
        lod95_m=np.where(is_seen, 1.96 * (noise + pose), np.nan),
        registration_m=pose,
        spread_source_m=spreads[0],
        spread_target_m=spreads[1],
        count_source=counts[0],
        count_target=counts[1],
        scales=scales,
        has_registration=covariance is not None,
    )


def choose_scales(
    source: Points, target: Points, indices: tuple[Neighbourhood, Neighbourhood], params: Distances
) -> Scales:
    """Return the lengths to measure with: the given ones, else chosen from noise and spacing."""
    # Whole micrometres: sums over points in another order differ in their last digit.
    noise = round(sensor_noise(source), 6), round(sensor_noise(target), 6)
    spacing = _spacing(source, indices[0]), _spacing(target, indices[1])
    giver = 0 if noise[0] <= noise[1] else 1
    normal = float(np.clip(max(25.0 * noise[giver], 6.0 * spacing[giver]), 0.2, 1.0))
    projection = params.projection_scale_m or float(np.clip(5.0 * max(spacing), 0.1, 1.0))
    return Scales(
        normal_m=params.normal_scale_m or normal,
        projection_m=projection,
        max_distance_m=params.max_distance_m or float(np.clip(6.0 * np.hypot(*noise), 0.15, 0.5)),
        core_spacing_m=params.core_spacing_m or max(0.05, projection / 2.0),
        noise_source_m=noise[0],
        noise_target_m=noise[1],
        normals_from="source" if giver == 0 else "target",
    )


def _spacing(points: Points, index: Neighbourhood) -> float:
    """Return the median distance to the nearest other place, on some blocks of the cloud."""
    edge = max(float(np.max(np.subtract(*extent(points)[::-1]))) / 64.0, 1e-6)
    _, distance = neighbourhood.knn(index, points[in_some_blocks(points, edge)], 4)
    # The point itself, and copies of it, lie at distance 0.
    nearest = np.where(distance > 0.0, distance, np.inf).min(axis=1)
    known = nearest[np.isfinite(nearest)]
    return float(np.median(known)) if len(known) else 1e-3


def _core_points(
    source: Points, target: Neighbourhood, scales: Scales, params: Distances
) -> tuple[Points, Scales]:
    """Return the source thinned where the target is near, in canonical order."""
    reach = float(np.hypot(scales.max_distance_m, scales.projection_m / 2.0))
    spacing = scales.core_spacing_m
    while True:
        kept = octree_voxel_grid(source, OctreeVoxelGrid(voxel_m=spacing)).is_kept
        core = source[kept]
        _, distance = neighbourhood.nearest(target, core, reach)
        core = core[np.isfinite(distance)]
        if params.core_spacing_m is not None or len(core) <= params.max_core_points:
            break
        spacing *= max(1.05, 1.02 * float(np.sqrt(len(core) / params.max_core_points)))
    core = core[by_coordinates(core)]
    return core, replace(scales, core_spacing_m=spacing)


def normals_at(index: Neighbourhood, core: Points, radius_m: float) -> Points:
    """Return the unit normal (k, 3) of the ball round each core point; NaN where it has none."""
    k = len(core)
    counts, normals = np.zeros(k, np.int64), np.full((k, 3), np.nan)
    variation, planarity = np.full(k, np.nan), np.full(k, np.nan)
    for_blocks(
        k,
        _BLOCK,
        lambda start, stop: m3c2.ball_normals(
            index.points, index.boxes, core, radius_m, start, stop,
            counts, normals, variation, planarity,
        ),
    )  # fmt: skip
    normals[~(planarity >= _LEAST_PLANARITY)] = np.nan
    return normals


def _projected(
    index: Neighbourhood, core: Points, normals: Points, scales: Scales, use_median: bool
) -> tuple[Index, Values, Values]:
    """Return count, middle and spread of a cloud in the cylinder of each core point."""
    k = len(core)
    counts, middles, spreads = np.zeros(k, np.int64), np.full(k, np.nan), np.full(k, np.nan)
    for_blocks(
        k,
        _BLOCK,
        lambda start, stop: m3c2.project(
            index.points, index.boxes, core, normals, scales.projection_m / 2.0,
            scales.max_distance_m, use_median, start, stop, counts, middles, spreads,
        ),
    )  # fmt: skip
    return counts, middles, spreads


def _along_normals(
    core: Points,
    normals: Points,
    covariance: NDArray[np.float64] | None,
    about: NDArray[np.float64] | None,
) -> Values:
    """Return the standard deviation of the pose along each normal, metres (k,)."""
    if covariance is None or about is None:
        return np.zeros(len(core))
    rows = plane_rows(core - about, normals, with_scale=covariance.shape == (7, 7))
    variance = np.einsum("ki,ij,kj->k", rows, covariance, rows)
    sigma: Values = np.sqrt(np.clip(variance, 0.0, None))
    return sigma
