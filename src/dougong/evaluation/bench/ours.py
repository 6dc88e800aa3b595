"""Our operations, as the bench calls them: arrays in, arrays out, kernels imported when called."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[np.float64]]

VOXEL_M = 0.05
NEIGHBOURS = 20
RADIUS_M = 0.3
ROR_RADIUS_M = 0.3
ROR_OTHERS = 4
RELIEF_RADIUS_M = 0.3
CLOTH_M = 0.5
SIGMAS = 2.0


def voxel(arrays: Arrays, threads: int) -> Any:
    """Return how many points the voxel grid keeps."""
    from dougong.filters import OctreeVoxelGrid, octree_voxel_grid

    del threads
    kept = octree_voxel_grid(arrays["points"], OctreeVoxelGrid(voxel_m=VOXEL_M)).is_kept
    return np.count_nonzero(kept)


def knn(arrays: Arrays, threads: int) -> Any:
    """Return distances (n, k) to the nearest others."""
    from dougong.filters import neighbourhood

    del threads
    return neighbourhood.knn(neighbourhood.build_index(arrays["points"]), None, NEIGHBOURS)[1]


def radius(arrays: Arrays, threads: int) -> Any:
    """Return counts (n,), the point itself included."""
    from dougong.filters import neighbourhood

    del threads
    return neighbourhood.count_within(neighbourhood.build_index(arrays["points"]), None, RADIUS_M)


def normals(arrays: Arrays, threads: int) -> Any:
    """Return normals (n, 3)."""
    from dougong.filters import neighbourhood

    del threads
    return neighbourhood.normals(arrays["points"], NEIGHBOURS).normals


def sor(arrays: Arrays, threads: int) -> Any:
    """Return how many points are kept."""
    from dougong.filters import Statistical, statistical

    del threads
    params = Statistical(neighbours=NEIGHBOURS, multiplier=SIGMAS)
    return np.count_nonzero(statistical(arrays["points"], params).is_kept)


def ror(arrays: Arrays, threads: int) -> Any:
    """Return how many points are kept."""
    from dougong.filters import Radius
    from dougong.filters import radius as verb

    del threads
    params = Radius(radius_m=ROR_RADIUS_M, min_neighbours=ROR_OTHERS)
    return np.count_nonzero(verb(arrays["points"], params).is_kept)


def curvature(arrays: Arrays, threads: int) -> Any:
    """Return surface variation (n,), exact."""
    from dougong.filters.balls import ExactBalls, build_lattice

    del threads
    lattice = build_lattice(arrays["points"], RELIEF_RADIUS_M)
    return lattice.unsorted(ExactBalls(lattice, RELIEF_RADIUS_M).variation())


def csf(arrays: Arrays, threads: int) -> Any:
    """Return which points are ground, without the guard against low outliers."""
    return _cloth(arrays, threads, is_guarded=False)


def csf_guarded(arrays: Arrays, threads: int) -> Any:
    """Return which points are ground, with the guard against low outliers."""
    return _cloth(arrays, threads, is_guarded=True)


def _cloth(arrays: Arrays, threads: int, *, is_guarded: bool) -> Any:
    from dougong.filters import ClothSimulation, LowOutliers, cloth_simulation

    del threads
    params = ClothSimulation(
        cloth_resolution_m=CLOTH_M,
        rigidness=3,
        slope_smoothing=False,
        guard=LowOutliers() if is_guarded else None,
    )
    found = cloth_simulation(arrays["points"], params)
    return np.flatnonzero(found.attributes["is_ground"])


def icp(arrays: Arrays, threads: int) -> Any:
    """Return the pose (4, 4) from where the clouds are."""
    from dougong.cloud import Cloud
    from dougong.registration.icp import refine
    from dougong.registration.prepare import prepare

    del threads
    clouds = [Cloud.from_points(arrays[name]) for name in ("source", "target")]
    source, target = (prepare(cloud, "lidar") for cloud in clouds)
    own, other = (cloud.frame.T_file_local() for cloud in clouds)
    T = refine(source, target, np.linalg.inv(other) @ own).T_target_source
    return other @ T @ np.linalg.inv(own)


def cwasf(arrays: Arrays, threads: int) -> Any:
    """Return how many points the curvature-weighted filter keeps by rule ``paper``."""
    return _cwasf(arrays, threads, rule="paper")


def cwasf_fast(arrays: Arrays, threads: int) -> Any:
    """Return the same with fast balls."""
    return _cwasf(arrays, threads, rule="paper", balls="fast")


def cwasf_protective(arrays: Arrays, threads: int) -> Any:
    """Return the same for rule ``protective``."""
    return _cwasf(arrays, threads, rule="protective")


def _cwasf(arrays: Arrays, threads: int, **params: Any) -> Any:
    from dougong.filters import CurvatureWeighted, curvature_weighted

    del threads
    chosen = CurvatureWeighted(radius_init_m=RELIEF_RADIUS_M, **params)
    return np.count_nonzero(curvature_weighted(arrays["points"], chosen).is_kept)
