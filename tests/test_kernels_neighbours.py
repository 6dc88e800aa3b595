"""Neighbour search and normals: equal to scipy, whatever the density, order, threads or extent."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dougong import threads
from dougong.errors import InputError
from dougong.filters import neighbourhood as nb


def uneven_cloud(n: int = 6000) -> np.ndarray:
    """A floor and a wall whose density falls 100 : 1, a far point, and exact duplicates."""
    rng = np.random.default_rng(3)
    reach = 30.0 * rng.random(n) ** 3
    turn = rng.uniform(0, 2 * np.pi, n)
    points = np.column_stack([reach * np.cos(turn), reach * np.sin(turn), rng.normal(0, 0.01, n)])
    points[: n // 3, 2] = points[: n // 3, 0]
    points[: n // 3, 0] = 5.0
    points[-50:] = points[:50]
    points[-51] = [1e6, -1e6, 1e6]
    return points


CLOUDS = {
    "uneven": uneven_cloud(),
    "lattice": np.stack(np.meshgrid(*[np.arange(12) * 0.1] * 3), -1).reshape(-1, 3),
    "one place": np.ones((100, 3)),
    "line": np.linspace(0, 1, 300)[:, None] * [1.0, 2.0, 3.0],
    "two towns": np.random.default_rng(0).normal(0, 5, (2000, 3))
    + np.repeat([[0.0], [1e6]], 1000, 0),
    "one": np.array([[1.0, 2.0, 3.0]]),
    "two": np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]]),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_is_scipys(name):
    points = CLOUDS[name]
    rng = np.random.default_rng(1)
    queries = points[rng.integers(0, len(points), 500)] + rng.normal(0, 0.3, (500, 3))
    place, distance = nb.nearest(nb.build_index(points), queries)
    expected, _ = cKDTree(points).query(queries)
    np.testing.assert_allclose(distance, expected, rtol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(points[place] - queries, axis=1), expected)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 7, 40])
def test_knn_of_the_points_themselves_is_scipys_without_the_point(name, k):
    points = CLOUDS[name]
    place, distance = nb.knn(nb.build_index(points), None, k)
    expected, _ = cKDTree(points).query(points, np.arange(1, k + 2))
    np.testing.assert_allclose(distance, expected[:, 1:], rtol=1e-13)
    assert not (place == np.arange(len(points))[:, None]).any()
    is_found = place >= 0
    np.testing.assert_array_equal(is_found, np.isfinite(distance))
    gap = np.linalg.norm(points[place] - points[:, None], axis=2)
    np.testing.assert_allclose(gap[is_found], distance[is_found], rtol=1e-13)
    assert all(len(set(row[row >= 0])) == (row >= 0).sum() for row in place)


@pytest.mark.parametrize("name", CLOUDS)
def test_knn_of_queries_within_a_distance_is_scipys(name):
    points = CLOUDS[name]
    queries = points[::3] + 0.05
    _, distance = nb.knn(nb.build_index(points), queries, 5, max_distance_m=0.25)
    expected, _ = cKDTree(points).query(queries, 5, distance_upper_bound=0.25)
    np.testing.assert_allclose(distance, expected, rtol=1e-13)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("radius", [0.07, 0.31, 50.0])
def test_counts_are_scipys(name, radius):
    points = CLOUDS[name]
    counts = nb.count_within(nb.build_index(points), points, radius)
    expected = cKDTree(points).query_ball_point(points, radius, return_length=True)
    np.testing.assert_array_equal(counts, expected)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.integers(1, 4))
def test_ties_are_ranked_by_content(seed, n, k):
    rng = np.random.default_rng(seed)
    points = np.unique(rng.integers(0, 4, (n, 3)), axis=0).astype(float)
    shuffle = rng.permutation(len(points))
    queries = rng.integers(0, 4, (20, 3)).astype(float)
    place, _ = nb.knn(nb.build_index(points), queries, k)
    shuffled, _ = nb.knn(nb.build_index(points[shuffle]), queries, k)
    np.testing.assert_array_equal(np.where(shuffled < 0, -1, shuffle[shuffled]), place)
    for query, row in zip(queries, place, strict=True):
        d2 = ((points - query) ** 2).sum(1)
        best = np.lexsort((*points.T[::-1], d2))[:k]
        np.testing.assert_array_equal(row[row >= 0], best)
    first, _ = nb.nearest(nb.build_index(points[shuffle]), queries)
    np.testing.assert_array_equal(shuffle[first], place[:, 0])


def test_distance_bound_is_inclusive_and_empty_is_minus_one():
    index = nb.build_index([[0.0, 0, 0], [3.0, 0, 0]])
    place, distance = nb.nearest(index, [[1.0, 0, 0], [1.5, 4, 0]], 1.0)
    assert place.tolist() == [0, -1]
    assert distance.tolist() == [1.0, np.inf]
    place, distance = nb.nearest(nb.build_index(np.empty((0, 3))), [[1.0, 0, 0]])
    assert place.tolist() == [-1]
    assert nb.knn(nb.build_index(np.empty((0, 3))), None, 3)[0].shape == (0, 3)


def test_threads_and_many_queries_change_nothing():
    points = np.random.default_rng(5).random((90_000, 3))
    queries = np.random.default_rng(6).random((80_000, 3))
    before = threads.get_threads()
    answers = []
    try:
        for count in (1, 3):
            threads.set_threads(count)
            index = nb.build_index(points)
            answers.append(
                (*nb.nearest(index, queries), *nb.knn(index, None, 6), *nb.normals(index, 6))
            )
    finally:
        threads.set_threads(before)
    for one, three in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, three)
    np.testing.assert_allclose(answers[0][1], cKDTree(points).query(queries)[0], rtol=1e-13)


def test_normals_are_numpys():
    points = uneven_cloud(3000)
    points = np.unique(points[np.abs(points).max(1) < 1e3], axis=0)
    surface = nb.normals(points, neighbours=12)
    place, _ = nb.knn(nb.build_index(points), None, 12)
    for i in range(0, len(points), 7):
        values, axes = np.linalg.eigh(np.cov(points[[i, *place[i]]].T, bias=True))
        if values[1] - values[0] > 1e-3 * values[2]:
            assert abs(axes[:, 0] @ surface.normals[i]) > 1 - 1e-9
        assert surface.variation[i] == pytest.approx(max(values[0], 0) / values.sum(), abs=1e-12)
        planarity = (values[1] - max(values[0], 0)) / values[2]
        assert surface.planarity[i] == pytest.approx(planarity, abs=1e-12)


def test_normals_point_up_and_survive_flat_straight_and_single_neighbourhoods():
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.random((500, 2)), np.zeros(500)])
    np.testing.assert_allclose(nb.normals(floor).normals, np.tile([0, 0, 1.0], (500, 1)), atol=1e-9)
    wall = nb.normals(floor[:, [2, 0, 1]])
    np.testing.assert_allclose(wall.normals, np.tile([1.0, 0, 0], (500, 1)), atol=1e-9)
    assert np.abs(wall.variation).max() < 1e-15
    line = nb.normals(CLOUDS["line"], 4)
    np.testing.assert_allclose(line.normals @ [1, 2, 3], 0, atol=1e-6)
    same = nb.normals(CLOUDS["one place"], 4)
    assert (same.variation == 0).all()
    assert np.isnan(nb.normals(CLOUDS["two"]).normals).all()
    assert nb.normals(np.empty((0, 3))).normals.shape == (0, 3)


def test_normals_turn_with_the_cloud():
    points = CLOUDS["uneven"][np.abs(CLOUDS["uneven"]).max(1) < 1e3]
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    before, after = nb.normals(points), nb.normals(points @ turn.T)
    is_clear = before.planarity > 0.5
    along = ((before.normals @ turn.T) * after.normals).sum(1)
    assert np.median(np.abs(along[is_clear])) > 1 - 1e-9
    assert (np.abs(along[is_clear]) > 1 - 1e-6).mean() > 0.99


def test_bad_arguments_are_named():
    index = nb.build_index([[0.0, 0, 0]])
    with pytest.raises(InputError, match="k must be at least 1, got 0"):
        nb.knn(index, None, 0)
    with pytest.raises(InputError, match="max_distance_m must be a positive"):
        nb.nearest(index, [[0.0, 0, 0]], np.nan)
    with pytest.raises(InputError, match="neighbours must be at least 2"):
        nb.normals([[0.0, 0, 0]], 1)
    with pytest.raises(InputError, match=r"queries must have shape \(n, 3\)"):
        nb.nearest(index, [0.0, 0, 0])


@pytest.mark.parametrize("by", ["neighbours", "radius_m"])
def test_a_heap_of_duplicates_costs_no_visit_of_all_for_each(by):
    """60000 copies took minutes, four times as much for twice as many."""
    from dougong.filters.statistical import Statistical, statistical

    rng = np.random.default_rng(0)
    around = rng.uniform(-0.02, 0.02, (500, 3))
    params = Statistical() if by == "neighbours" else Statistical(neighbours=None, radius_m=0.05)
    statistical(around, params)
    seconds = []
    for copies in (15_000, 60_000):
        points = np.vstack([np.zeros((copies, 3)), around])
        start = time.process_time()
        statistical(points, params)
        seconds.append(time.process_time() - start)
    assert seconds[1] < 10 * seconds[0] + 0.5


@pytest.mark.parametrize("limit_m", [np.inf, 0.2])
@pytest.mark.parametrize("k", [1, 12, 33])
def test_leaves_that_reach_far_and_heaps_find_the_same_neighbours(k, limit_m):
    rng = np.random.default_rng(4)
    heavy = rng.normal(size=(4000, 3)) ** 5
    heap = np.repeat(rng.random((3, 3)), [700, 40, 2], axis=0)
    points = np.concatenate([heavy, heap, rng.random((1500, 3)) * [1.0, 1.0, 0.0]])
    index = nb.build_index(points)
    _, distance = nb.knn(index, None, k, limit_m)
    wanted = cKDTree(points).query(points, k + 1)[0][:, 1:]
    wanted[wanted > limit_m] = np.inf
    np.testing.assert_allclose(distance, wanted, rtol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 400), st.integers(1, 40), st.integers(2, 40))
def test_ties_among_the_points_themselves_are_ranked_by_content(seed, n, k, wide):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, wide, (n, 3)).astype(float)
    # Copies are told apart by their place only.
    points[: n // 8] = points[-1]
    place, _ = nb.knn(nb.build_index(points), None, k)
    for i, row in enumerate(place):
        others = np.delete(points, i, axis=0)
        best = np.lexsort((*others.T[::-1], ((others - points[i]) ** 2).sum(1)))[:k]
        found = row[row >= 0]
        assert len(set(found.tolist()) - {i}) == len(found)
        np.testing.assert_array_equal(points[found], others[best])
