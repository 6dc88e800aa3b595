"""Morton keys, the radix sort and the eigen-solver against plain Python and numpy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong.filters.neighbourhood import spatial_order
from dougong.kernels import cells, moments, order


def interleaved(cell):
    """Twin of the key: bit b of axis a goes to bit 3 b + a."""
    return sum(
        ((int(cell[axis]) >> bit) & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3)
    )


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), min_size=1, max_size=20))
def test_keys_interleave_the_bits(cells):
    points = np.array(cells, dtype=float) * 0.25 + 0.1
    keys = np.empty(len(points), np.uint64)
    order.morton_keys(points, np.zeros(3), 0.25, 0, len(points), keys)
    assert keys.tolist() == [interleaved(cell) for cell in cells]


def test_no_keys_are_sorted_too():
    keys, places = np.empty(0, np.uint64), np.empty(0, np.int64)
    # In plain Python, which checks its indices.
    sort = getattr(order.radix_argsort, "py_func", order.radix_argsort)
    sort(keys, 63, places, places.copy(), keys.copy())


@pytest.mark.parametrize("edge", [1e-9, 1e-6, 0.005, 0.3, 1.0, 4096.0, 1e7])
def test_steps_are_below_a_micrometre_and_levels_are_nested(edge):
    steps, halved = cells.steps_per_edge(edge), cells.steps_per_edge(edge / 2)
    assert edge / steps < 1e-6 or steps in (1, 2**30)
    assert halved == steps / 2 or steps in (1, 2**30)
    points = np.random.default_rng(0).normal(0, 30 * edge, (2000, 3))
    wide, narrow = np.empty((2, 2000, 3))
    cells.fill_cells(points, np.zeros(3), edge, wide)
    cells.fill_cells(points, np.zeros(3), edge / 2, narrow)
    if steps not in (1, 2**30):
        np.testing.assert_array_equal(np.floor(narrow / 2), wide)


def test_cells_out_of_range_are_clamped_not_wrapped():
    keys = np.empty(2, np.uint64)
    order.morton_keys(
        np.array([[-5.0, -1e300, 0], [1e9, 1e300, 2**21]]), np.zeros(3), 1.0, 0, 2, keys
    )
    assert keys.tolist() == [0, 2**63 - 1]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=300), st.booleans())
def test_radix_sort_is_numpys_stable_sort(values, has_ties):
    keys = np.array(values, dtype=np.uint64) % np.uint64(7 if has_ties else 2**63)
    expected = np.argsort(keys, kind="stable")
    places, sorted_keys = np.arange(len(keys)), keys.copy()
    order.radix_argsort(sorted_keys, 63, places, np.empty_like(places), np.empty_like(keys))
    np.testing.assert_array_equal(places, expected)
    np.testing.assert_array_equal(sorted_keys, keys[expected])


def test_the_curve_refines_where_a_far_point_makes_its_cells_too_wide():
    points = np.concatenate([np.random.default_rng(0).random((3000, 3)), [[1e6, 0, 0]]])
    places = spatial_order(points)
    assert sorted(places) == list(range(3001))
    steps = np.linalg.norm(np.diff(points[places][:-1], axis=0), axis=1)
    assert np.median(steps) < 0.1


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e6])
def test_eigen3_is_numpys_and_keeps_small_eigenvalues(scale):
    rng = np.random.default_rng(1)
    for spread in ([1, 1, 1], [1, 0.5, 1e-4], [1, 1e-6, 1e-6], [1, 1, 0], [0, 0, 0]):
        for _ in range(20):
            axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            matrix = axes @ np.diag(np.array(spread) * scale) @ axes.T
            matrix = (matrix + matrix.T) / 2
            a, v = matrix.copy(), np.empty((3, 3))
            columns = list(moments.eigen3(a, v))
            values, expected = np.diag(a)[columns], np.linalg.eigvalsh(matrix)
            np.testing.assert_allclose(values, expected, atol=1e-15 * scale)
            np.testing.assert_allclose(v.T @ v, np.eye(3), atol=1e-14)
            np.testing.assert_allclose(v @ np.diag(np.diag(a)) @ v.T, matrix, atol=1e-14 * scale)
