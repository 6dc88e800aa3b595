"""FPFH and feature matching: equal to their twins, blind to motion, order, threads and unit."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong import threads
from dougong.errors import InputError
from dougong.registration.features import fpfh, nearest_features
from reference import features as twin


def cloud(count=150, seed=0):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    return rng.random((count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("is_oriented", [True, False])
@pytest.mark.parametrize("most", [8, 100])
def test_features_are_the_twins(is_oriented, most):
    points, normals = cloud()
    if most > 50:  # which of two points at one place comes first is not defined
        points[-3:] = points[:3]
    found = fpfh(points, normals, 0.3, max_neighbours=most, is_oriented=is_oriented)
    expected = twin.fpfh(points, normals, 0.3, most, is_oriented)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    sums = found.reshape(-1, 3, 11).sum(axis=2)
    np.testing.assert_allclose(sums[sums > 0], 100.0)


def test_motion_unit_order_and_threads_change_nothing():
    points, normals = cloud(3000, 1)
    before = fpfh(points, normals, 0.1)
    turn = Rotation.random(random_state=2).as_matrix()
    moved = fpfh(30.0 * points @ turn.T + 5.0, normals @ turn.T, 3.0)
    # A pair on the edge between two bins may fall to either side.
    assert np.mean(np.abs(moved - before).max(axis=1) < 1e-6) > 0.999
    order = np.random.default_rng(3).permutation(len(points))
    np.testing.assert_allclose(fpfh(points[order], normals[order], 0.1), before[order], atol=1e-9)
    count = threads.get_threads()
    threads.set_threads(1)
    alone = fpfh(points, normals, 0.1)
    threads.set_threads(count)
    np.testing.assert_array_equal(alone, before)


def test_signs_of_normals_do_not_matter_unless_oriented():
    points, normals = cloud(400, 4)
    flipped = normals * np.where(np.arange(len(normals)) % 2, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(fpfh(points, normals, 0.3), fpfh(points, flipped, 0.3), atol=1e-9)
    oriented = [fpfh(points, n, 0.3, is_oriented=True) for n in (normals, flipped)]
    assert np.abs(oriented[0] - oriented[1]).max() > 1.0


def test_a_lone_point_has_an_empty_feature():
    points, normals = cloud(50, 5)
    points[0] = 100.0
    found = fpfh(points, normals, 0.5)
    assert not found[0].any()
    assert found[1:].any(axis=1).all()


def test_search_is_the_twins_with_ties():
    rng = np.random.default_rng(6)
    features = rng.integers(0, 3, (300, 6)).astype(float)
    queries = rng.integers(0, 3, (80, 6)).astype(float)
    places, distance = nearest_features(queries, features, 7)
    expected, gaps = twin.nearest_features(queries, features, 7)
    np.testing.assert_allclose(distance, gaps)
    np.testing.assert_array_equal(places, expected)


def test_search_with_fewer_candidates_than_asked_for():
    places, distance = nearest_features(np.zeros((2, 3)), np.ones((1, 3)), 3)
    np.testing.assert_array_equal(places, [[0, -1, -1]] * 2)
    assert np.isinf(distance[:, 1:]).all()
    with pytest.raises(InputError, match="k must be at least 1"):
        nearest_features(np.zeros((2, 3)), np.ones((1, 3)), 0)


def test_normals_of_another_shape_are_refused():
    points, normals = cloud(20)
    with pytest.raises(InputError, match="normals must have the shape"):
        fpfh(points, normals[:-1], 0.1)
