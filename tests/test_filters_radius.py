"""ROR: scipy's counts, whatever the order."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dougong.filters.radius import Radius, halo_m, radius


def test_counts_are_scipys_in_any_order():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((3000, 3)), rng.random((100, 3)) * 50, np.ones((5, 3))])
    params = Radius(radius_m=0.1, min_neighbours=5)
    chosen = radius(points, params)
    expected = cKDTree(points).query_ball_point(points, 0.1, return_length=True) - 1
    np.testing.assert_array_equal(chosen.attributes["neighbour_count"], expected)
    np.testing.assert_array_equal(chosen.is_kept, expected >= 5)
    shuffle = rng.permutation(len(points))
    np.testing.assert_array_equal(radius(points[shuffle], params).is_kept, chosen.is_kept[shuffle])


@pytest.mark.parametrize("n", [0, 1, 2, 40])
def test_small_and_duplicate_clouds(n):
    chosen = radius(np.full((n, 3), 2.5), Radius(radius_m=0.1, min_neighbours=1))
    assert chosen.is_kept.tolist() == [n > 1] * n


def test_a_point_of_a_line_counts_the_ends_of_its_ball():
    line = np.arange(9.0)[:, None] * [1.0, 0, 0]
    counts = radius(line, Radius(radius_m=2.0)).attributes["neighbour_count"]
    assert counts.tolist() == [2, 3, 4, 4, 4, 4, 4, 3, 2]
    assert halo_m(Radius(radius_m=2.0)) == 2.0
