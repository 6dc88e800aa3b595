"""Thinning of prepared clouds for the ladder of rungs."""

import numpy as np
import pytest

from dougong.registration.overlap import thin


@pytest.mark.parametrize("extent_m", [1e2, 1e5, 1e6])
def test_points_in_voxels_of_their_own_all_stay(extent_m):
    """Keys were packed in a double: of five points 1e6 m apart two were left."""
    points = np.array(
        [[0, 0, 0], [0, 0, extent_m], [0, 0, extent_m + 0.06], [0, 0.06, extent_m], [extent_m] * 3]
    )
    assert len(thin(points, 0.05)) == len(points)


def test_a_voxel_keeps_the_point_nearest_its_centre():
    points = np.array([[0.01, 0.01, 0.01], [0.5, 0.5, 0.4], [0.5, 0.5, 0.6], [1.5, 0.5, 0.5]])
    assert thin(points, 1.0).tolist() == [1, 3]
