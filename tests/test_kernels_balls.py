"""Sums over balls are those of brute force, to the bit; the least eigenvalue is that of LAPACK."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong.filters.balls import CellBalls, ExactBalls, build_lattice
from dougong.filters.octree_voxel_grid import robust_low
from dougong.kernels import balls, least_weighted
from dougong.kernels.ball_walk import CHUNK
from dougong.kernels.moments import least_share

STEP = 2.0**-18
RADIUS_M = 0.3


def sheet(count, seed, thickness=0.01):
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3)) * [1.2, 0.9, thickness]
    points[::97] += rng.normal(0, 30.0, points[::97].shape)
    return np.round(points / STEP) * STEP


def inside(points, i):
    return ((points - points[i]) ** 2).sum(axis=1) <= (RADIUS_M / STEP) ** 2


@pytest.mark.parametrize("count", [1, 5, 16, 17, 60, 300, 5000])
def test_moments_and_totals_are_those_of_brute_force(count):
    lattice = build_lattice(sheet(count, count), RADIUS_M)
    points, steps = lattice.points, np.random.default_rng(1).integers(-3, 1 << 20, count)
    nodes = np.empty((len(lattice.boxes), 10), np.int64)
    balls.node_moments(points, nodes)
    sums, none = np.empty((count, 10), np.int64), np.zeros(0, np.int64)
    leaves, radius2 = len(lattice.boxes) // 2, (RADIUS_M / STEP) ** 2
    balls.ball_sums(points, none, lattice.boxes, nodes, radius2, 0, leaves, sums)
    totals, nodes = np.empty((count, 3), np.int64), np.empty((len(lattice.boxes), 3), np.int64)
    balls.node_sums(steps, nodes)
    balls.ball_sums(points, steps, lattice.boxes, nodes, radius2, 0, leaves, totals)
    for i in range(0, count, 1 + count // 50):
        is_in = inside(points, i)
        x, y, z = (points[is_in] - points[i]).astype(np.int64).T
        products = (x * x, y * y, z * z, x * y, x * z, y * z)
        expected = [len(x), x.sum(), y.sum(), z.sum(), *(p.sum() for p in products)]
        assert sums[i].tolist() == expected
        given_steps = steps[is_in & (steps >= 0)]
        expected = [len(given_steps), given_steps.sum(), (given_steps**2).sum()]
        assert totals[i].tolist() == expected


def test_a_rim_of_more_leaves_than_are_held_at_once_is_summed_too():
    points = np.random.default_rng(3).random((60_000, 3)) * 0.8
    lattice = build_lattice(points, RADIUS_M)
    assert len(lattice.boxes) // 2 > 4 * CHUNK
    steps = np.arange(len(points)) % 1000
    mean, deviation = ExactBalls(lattice, RADIUS_M).statistics(steps)
    for i in range(0, len(points), 3001):
        there = steps[inside(lattice.points, i)]
        assert mean[i] == there.sum() / len(there)
        assert deviation[i] == pytest.approx(there.std(), rel=1e-9)


def test_cells_give_one_sum_to_all_their_points_in_any_part():
    points = sheet(6000, 4)
    steps = np.random.default_rng(5).integers(0, 1000, len(points))
    lattice = build_lattice(points, RADIUS_M)
    means = CellBalls(lattice, RADIUS_M).statistics(steps[lattice.order])[0]
    near = np.flatnonzero((points[:, 0] > 0.2) & (points[:, 0] < 0.9))
    part = build_lattice(points[near], RADIUS_M, robust_low(points))
    again = CellBalls(part, RADIUS_M).statistics(steps[near][part.order])[0]
    whole, parted = lattice.unsorted(means), part.unsorted(again)
    deep = (points[near, 0] > 0.54) & (points[near, 0] < 0.56)
    np.testing.assert_array_equal(parted[deep], whole[near][deep])


@pytest.mark.parametrize("count", [1, 2, 40, 3000])
def test_the_least_weighted_distance_is_that_of_brute_force(count):
    given_points, rng = sheet(count, 7), np.random.default_rng(8)
    given_points[count // 2 :: 3] = given_points[0]
    lattice = build_lattice(given_points, RADIUS_M)
    points = lattice.points
    weights, radii = rng.uniform(1.0, 3.0, count), rng.uniform(0.0, 0.3 / STEP, count)
    found = np.empty(count)
    leaves = len(lattice.boxes) // 2
    least_weighted.least_weighted(points, lattice.boxes, weights, radii, 0, leaves, found)
    for i in range(0, count, 1 + count // 200):
        d2 = ((points - points[i]) ** 2).sum(axis=1)
        is_other = (d2 <= radii[i] ** 2) & (np.arange(count) != i)
        expected = np.sqrt((d2 * weights * weights)[is_other].min(initial=np.inf))
        assert found[i] == expected


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-12, 1.0), st.floats(0.0, 1.0), st.floats(1e-6, 1e12))
def test_the_least_eigenvalue_is_that_of_lapack_or_left_to_others(seed, middle, least, scale):
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    values = np.array([1.0, middle, middle * least])
    matrix = turn @ np.diag(values) @ turn.T * scale
    matrix = (matrix + matrix.T) / 2.0
    found = least_share(matrix, np.trace(matrix))
    expected = np.linalg.eigvalsh(matrix)[0] / np.trace(matrix)
    if found >= 0.0:
        assert found == pytest.approx(max(expected, 0.0), abs=1e-12)
    else:
        assert middle - middle * least < 0.1
