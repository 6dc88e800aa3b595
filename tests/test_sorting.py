"""Sorting by radix is NumPy's stable sort, negative numbers and all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dougong._sorting import (
    by_coordinates,
    count_rows,
    distinct,
    first_places,
    grouped,
    keys_of_rows,
    once,
    sorted_places,
)

SIZES = st.integers(0, 60)
SOME = [-(2**63), -1, 0, 1, 7, 2**40, 2**63 - 1]
SIGNED = arrays(np.int64, SIZES, elements=st.sampled_from(SOME))


@settings(deadline=None)
@given(SIGNED)
def test_signed_numbers_are_sorted_stably(keys):
    np.testing.assert_array_equal(sorted_places(keys), np.argsort(keys, kind="stable"))


@settings(deadline=None)
@given(arrays(np.uint64, SIZES, elements=st.integers(0, 2**64 - 1)))
def test_unsigned_numbers_are_sorted_over_all_64_bits(keys):
    np.testing.assert_array_equal(sorted_places(keys), np.argsort(keys, kind="stable"))


@settings(deadline=None)
@given(SIGNED)
def test_first_places_are_numpys(keys):
    np.testing.assert_array_equal(first_places(keys), np.unique(keys, return_index=True)[1])


@settings(deadline=None)
@given(SIGNED)
def test_groups_are_numpys(keys):
    wanted = np.unique(keys, return_inverse=True, return_counts=True)
    for found, right in zip(grouped(keys), wanted, strict=True):
        np.testing.assert_array_equal(found, right)


@settings(deadline=None)
@given(SIGNED)
def test_distinct_is_numpys_unique(keys):
    np.testing.assert_array_equal(distinct(keys), np.unique(keys))
    np.testing.assert_array_equal(once(np.sort(keys)), np.unique(keys))


@pytest.mark.parametrize("scale", [1, 1 << 60])
@given(
    cells=arrays(np.int64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.integers(-2, 2))
)
def test_rows_are_counted_once_each(cells, scale):
    assert count_rows(cells * scale) == len(np.unique(cells, axis=0))


@given(
    arrays(np.int64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.sampled_from(SOME[1:6]))
)
def test_keys_of_rows_tell_rows_apart_and_keep_their_order(cells):
    keys = keys_of_rows(tuple(cells.T))
    if keys is None:
        assert np.prod(np.ptp(cells, axis=0) + 1.0) >= 2.0**63
        return
    wanted = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    np.testing.assert_array_equal(grouped(keys).place, wanted)


@settings(deadline=None)
@given(
    arrays(
        np.float64,
        st.tuples(SIZES, st.just(3)),
        elements=st.sampled_from([-np.inf, -1.5, -0.0, 0.0, 1e-300, 2.0, 4e6]),
    )
)
def test_points_are_sorted_by_x_then_y_then_z(points):
    x, y, z = points.T
    np.testing.assert_array_equal(by_coordinates(points), np.lexsort((z, y, x)))
