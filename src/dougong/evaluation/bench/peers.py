"""The peers' nearest equivalents: from an array to an array, index and conversions included.

Each imports its package when called. Where a package counts the point itself as its own first
neighbour it is asked for one more, so that the work is the same.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.bench.ours import (
    CLOTH_M,
    NEIGHBOURS,
    RADIUS_M,
    RELIEF_RADIUS_M,
    ROR_OTHERS,
    ROR_RADIUS_M,
    SIGMAS,
    VOXEL_M,
    Arrays,
)

_ICP_REACH_M = 1.0
_ICP_STEPS = 60


def _open3d_cloud(points: NDArray[np.float64]) -> Any:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(points)
    return cloud


def voxel_numpy(arrays: Arrays, threads: int) -> Any:
    """Keep the point nearest each voxel's centre: lexsort, and the first of each run."""
    del threads
    points = arrays["points"]
    cells = (points - points.min(axis=0)) / VOXEL_M
    whole = np.floor(cells)
    rank = ((cells - whole - 0.5) ** 2).sum(axis=1)
    order = np.lexsort((rank, *whole.T.astype(np.int32)))
    ordered = whole[order]
    return 1 + np.count_nonzero((ordered[1:] != ordered[:-1]).any(axis=1))


def voxel_open3d(arrays: Arrays, threads: int) -> Any:
    """Make a centroid per voxel."""
    del threads
    return len(np.asarray(_open3d_cloud(arrays["points"]).voxel_down_sample(VOXEL_M).points))


def voxel_small_gicp(arrays: Arrays, threads: int) -> Any:
    """Make a centroid per voxel."""
    import small_gicp

    made = small_gicp.voxelgrid_sampling(arrays["points"], VOXEL_M, num_threads=threads)
    return len(made.points())


def knn_scipy(arrays: Arrays, threads: int) -> Any:
    """Query a cKDTree with its own points."""
    from scipy.spatial import cKDTree

    points = arrays["points"]
    return cKDTree(points).query(points, NEIGHBOURS + 1, workers=threads)[0][:, 1:]


def knn_pykdtree(arrays: Arrays, threads: int) -> Any:
    """Query a pykdtree with its own points."""
    from pykdtree.kdtree import KDTree

    del threads
    points = arrays["points"]
    return KDTree(points).query(points, k=NEIGHBOURS + 1)[0][:, 1:]


def knn_pgeof(arrays: Arrays, threads: int) -> Any:
    """Search with nanoflann, in float32."""
    import pgeof

    del threads
    points = arrays["points"].astype(np.float32)
    return np.sqrt(pgeof.knn_search(points, points, NEIGHBOURS + 1)[1][:, 1:])


def knn_small_gicp(arrays: Arrays, threads: int) -> Any:
    """Query small_gicp's tree with its own points."""
    import small_gicp

    points = arrays["points"]
    tree = small_gicp.KdTree(points, num_threads=threads)
    found = tree.batch_knn_search(points, NEIGHBOURS + 1, num_threads=threads)
    return np.sqrt(np.asarray(found[1])[:, 1:])


def knn_open3d(arrays: Arrays, threads: int) -> Any:
    """Search with Open3D's tensor nearest neighbours."""
    import open3d as o3d

    del threads
    points = o3d.core.Tensor.from_numpy(arrays["points"])
    search = o3d.core.nns.NearestNeighborSearch(points)
    search.knn_index()
    return np.sqrt(search.knn_search(points, NEIGHBOURS + 1)[1].numpy()[:, 1:])


def radius_scipy(arrays: Arrays, threads: int) -> Any:
    """Count with a cKDTree."""
    from scipy.spatial import cKDTree

    points = arrays["points"]
    return cKDTree(points).query_ball_point(points, RADIUS_M, workers=threads, return_length=True)


def radius_open3d(arrays: Arrays, threads: int) -> Any:
    """List the neighbours, which is how Open3D counts."""
    import open3d as o3d

    del threads
    points = o3d.core.Tensor.from_numpy(arrays["points"])
    search = o3d.core.nns.NearestNeighborSearch(points)
    search.fixed_radius_index(RADIUS_M)
    return np.diff(search.fixed_radius_search(points, RADIUS_M)[2].numpy())


def normals_open3d(arrays: Arrays, threads: int) -> Any:
    """Estimate normals."""
    import open3d as o3d

    del threads
    cloud = _open3d_cloud(arrays["points"])
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS + 1))
    return np.asarray(cloud.normals)


def normals_small_gicp(arrays: Arrays, threads: int) -> Any:
    """Estimate normals."""
    import small_gicp

    cloud = small_gicp.PointCloud(arrays["points"])
    small_gicp.estimate_normals(cloud, num_neighbors=NEIGHBOURS + 1, num_threads=threads)
    return cloud.normals()[:, :3]


def normals_pgeof(arrays: Arrays, threads: int) -> Any:
    """Search in float32, then compute features, of which the normal is three."""
    import pgeof

    del threads
    points = arrays["points"].astype(np.float32)
    found, _ = pgeof.knn_search(points, points, NEIGHBOURS + 1)
    starts = np.arange(len(points) + 1, dtype=np.uint32) * np.uint32(NEIGHBOURS + 1)
    features = pgeof.compute_features(points, found.ravel(), starts)
    return features[:, 4:7]


def sor_open3d(arrays: Arrays, threads: int) -> Any:
    """Remove statistical outliers."""
    del threads
    cloud = _open3d_cloud(arrays["points"])
    return len(cloud.remove_statistical_outlier(NEIGHBOURS + 1, SIGMAS)[1])


def _two_pass(distances: NDArray[np.float64]) -> int:
    mean = distances.mean(axis=1)
    return int(np.count_nonzero(mean <= mean.mean() + SIGMAS * mean.std()))


def sor_pykdtree(arrays: Arrays, threads: int) -> Any:
    """Search with pykdtree, then the definition in numpy."""
    return _two_pass(knn_pykdtree(arrays, threads))


def sor_scipy(arrays: Arrays, threads: int) -> Any:
    """Search with scipy, then the definition in numpy."""
    return _two_pass(knn_scipy(arrays, threads))


def ror_open3d(arrays: Arrays, threads: int) -> Any:
    """Remove radius outliers: a point stays with more than so many, itself counted."""
    del threads
    cloud = _open3d_cloud(arrays["points"])
    return len(cloud.remove_radius_outlier(ROR_OTHERS, ROR_RADIUS_M)[1])


def ror_scipy(arrays: Arrays, threads: int) -> Any:
    """Look for the fourth other point within the radius."""
    from scipy.spatial import cKDTree

    points = arrays["points"]
    reach = np.nextafter(ROR_RADIUS_M, np.inf)
    found = cKDTree(points).query(
        points, [ROR_OTHERS + 1], distance_upper_bound=reach, workers=threads
    )
    return np.count_nonzero(np.isfinite(found[0]))


def curvature_jakteristics(arrays: Arrays, threads: int) -> Any:
    """Compute one feature."""
    import jakteristics

    return jakteristics.compute_features(
        arrays["points"],
        RELIEF_RADIUS_M,
        num_threads=threads,
        max_k_neighbors=100_000,
        feature_names=["surface_variation"],
    )[:, 0]


def _variations(covariances: NDArray[np.float64]) -> Any:
    values = np.linalg.eigvalsh(covariances)
    return values[:, 0] / values.sum(axis=1)


def curvature_open3d(arrays: Arrays, threads: int) -> Any:
    """Estimate covariances, then eigenvalues in numpy."""
    import open3d as o3d

    del threads
    cloud = _open3d_cloud(arrays["points"])
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamRadius(RELIEF_RADIUS_M))
    return _variations(np.asarray(cloud.covariances))


def curvature_scipy(arrays: Arrays, threads: int) -> Any:
    """List the neighbours with a cKDTree and take their covariance, point by point."""
    from scipy.spatial import cKDTree

    points = arrays["points"]
    tree = cKDTree(points)
    covariances = np.empty((len(points), 3, 3))
    for start in range(0, len(points), 1000):
        part = points[start : start + 1000]
        for i, found in enumerate(tree.query_ball_point(part, RELIEF_RADIUS_M, workers=threads)):
            covariances[start + i] = np.cov(points[found].T, bias=True)
    return _variations(covariances)


def csf_published(arrays: Arrays, threads: int) -> Any:
    """Run the published cloth simulation filter."""
    import CSF

    del threads
    cloth = CSF.CSF()
    cloth.params.cloth_resolution = CLOTH_M
    cloth.params.rigidness = 3
    cloth.params.class_threshold = 0.5
    cloth.params.bSloopSmooth = False
    cloth.setPointCloud(arrays["points"])
    ground, rest = CSF.VecInt(), CSF.VecInt()
    cloth.do_filtering(ground, rest, False)
    return np.array(ground, dtype=np.int64)


def icp_small_gicp_plane(arrays: Arrays, threads: int) -> Any:
    """Point-to-plane ICP, voxels of 0.25 m."""
    return _small_gicp(arrays, threads, "PLANE_ICP")


def icp_small_gicp(arrays: Arrays, threads: int) -> Any:
    """Generalised ICP, voxels of 0.25 m."""
    return _small_gicp(arrays, threads, "GICP")


def _small_gicp(arrays: Arrays, threads: int, method: str) -> Any:
    import small_gicp

    return small_gicp.align(
        arrays["target"],
        arrays["source"],
        registration_type=method,
        downsampling_resolution=0.25,
        max_correspondence_distance=_ICP_REACH_M,
        max_iterations=_ICP_STEPS,
        num_threads=threads,
    ).T_target_source


def icp_open3d(arrays: Arrays, threads: int) -> Any:
    """Point-to-plane ICP, voxels of 0.25 m."""
    import open3d as o3d

    del threads
    source, target = (
        _open3d_cloud(arrays[name]).voxel_down_sample(0.25) for name in ("source", "target")
    )
    target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    method = o3d.pipelines.registration
    return method.registration_icp(
        source,
        target,
        _ICP_REACH_M,
        np.eye(4),
        method.TransformationEstimationPointToPlane(),
        method.ICPConvergenceCriteria(1e-8, 1e-8, _ICP_STEPS),
    ).transformation
