"""The filters on real scans: scipy's answers, the twin's curvature, and no order in them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dougong.filters import (
    CurvatureWeighted,
    OctreeVoxelGrid,
    curvature_weighted,
    octree_voxel_grid,
    statistical,
)
from dougong.filters.balls import build_lattice
from dougong.filters.octree_voxel_grid import robust_low, root_cube
from dougong.formats import read
from reference.filters import curvature

# Name, and a radius of a few spacings for its scale (the lion and the pump are small).
SCANS = {
    "formats/pumpA.e57": 0.02,
    "formats/autzen_trim.laz": 1.5,
    "lion_scans/lionscan1.xyz": 0.02,
    "isprs_filter/samp11-utm.laz": 3.0,
    "street_pair/source.ply": 0.3,
}

pytestmark = pytest.mark.data


@pytest.fixture(scope="module", params=list(SCANS))
def scan(request, data):
    points = read(data / request.param).xyz
    shuffle = np.random.default_rng(0).permutation(len(points))
    return points, shuffle, SCANS[request.param]


def test_statistical_is_scipys(scan):
    points, shuffle, _ = scan
    distance, _ = cKDTree(points).query(points, 21)
    mean = distance[:, 1:].mean(1)
    cut = mean.mean() + 2 * mean.std()
    is_close = np.abs(mean - cut) < 1e-6
    is_kept = statistical(points).is_kept
    np.testing.assert_array_equal(is_kept[~is_close], (mean <= cut)[~is_close])
    np.testing.assert_array_equal(statistical(points[shuffle]).is_kept, is_kept[shuffle])


def test_curvature_is_the_twins(scan):
    points, shuffle, radius_m = scan
    params = CurvatureWeighted(
        rule="paper", radius_init_m=radius_m, radius_min_m=radius_m / 6, radius_max_m=radius_m
    )
    lattice = build_lattice(points, radius_m)
    rounded = np.empty_like(points)
    rounded[lattice.order] = lattice.points * lattice.step_m + robust_low(points)
    assert np.abs(rounded - points).max() <= lattice.step_m / 2
    chosen = curvature_weighted(points, params)
    kappa = chosen.attributes["curvature"]
    every = len(points) // 150
    np.testing.assert_allclose(kappa[::every], curvature(rounded, radius_m, every), atol=1e-9)
    again = curvature_weighted(points[shuffle], params)
    np.testing.assert_array_equal(again.attributes["curvature"], kappa[shuffle])
    np.testing.assert_array_equal(again.is_kept, chosen.is_kept[shuffle])


def test_every_voxel_keeps_one_point_whatever_the_order(scan):
    points, shuffle, radius_m = scan
    params = OctreeVoxelGrid(voxel_m=radius_m)
    chosen = octree_voxel_grid(points, params)
    low = root_cube(points, params).low
    cells = np.floor((points - low) / radius_m).astype(int)
    assert len(np.unique(cells, axis=0)) == chosen.is_kept.sum()
    assert len(np.unique(cells[chosen.is_kept], axis=0)) == chosen.is_kept.sum()
    again = octree_voxel_grid(points[shuffle], params)
    np.testing.assert_array_equal(
        np.unique(points[shuffle][again.is_kept], axis=0),
        np.unique(points[chosen.is_kept], axis=0),
    )
