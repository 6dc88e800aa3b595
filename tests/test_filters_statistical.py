"""SOR: the twin's and scipy's choice, exact sums, strays that do not blind it."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial import cKDTree

from dougong import threads
from dougong.filters.statistical import Statistical, mean_distances, statistical
from dougong.filters.totals import LARGEST, Totals
from reference.filters import statistical as twin


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 150), st.floats(0.2, 3), st.booleans())
def test_is_the_twin_in_any_order(seed, n, multiplier, by_radius):
    rng = np.random.default_rng(seed)
    points = rng.random((n, 3))
    points[: n // 10] = points[-(n // 10) or n :][: n // 10]
    size = {"radius_m": 0.3} if by_radius else {"neighbours": min(6, n - 1)}
    is_kept = statistical(points, Statistical(multiplier=multiplier, **size)).is_kept
    np.testing.assert_array_equal(is_kept, twin(points, multiplier, **size))
    shuffle = rng.permutation(n)
    again = statistical(points[shuffle], Statistical(multiplier=multiplier, **size)).is_kept
    np.testing.assert_array_equal(again, is_kept[shuffle])


def test_mean_distances_are_scipys():
    points = np.random.default_rng(1).random((5000, 3)) * [5, 5, 0.1]
    expected = cKDTree(points).query(points, 21)[0][:, 1:].mean(1)
    np.testing.assert_allclose(mean_distances(points, Statistical()), expected, rtol=1e-12)


def test_one_far_point_does_not_blind_it():
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.random((4000, 3)) * [10, 10, 0.01], [[5, 5, 3.0]]])
    plain = statistical(points)
    assert not plain.is_kept[-1]
    far = statistical(np.concatenate([points, [[1e6, 1e6, 1e6]]]))
    np.testing.assert_array_equal(far.is_kept, [*plain.is_kept, False])
    assert "1 point lies far" in far.notes[0]


@pytest.mark.parametrize("size", [{}, {"radius_m": 0.5}])
def test_small_and_degenerate_clouds(size):
    params = Statistical(**size)
    assert statistical(np.empty((0, 3)), params).is_kept.tolist() == []
    assert statistical([[1.0, 2, 3]], params).is_kept.tolist() == [False]
    assert statistical([[1.0, 2, 3], [1.0, 2, 3.1]], params).is_kept.all()
    assert statistical(np.full((60, 3), 4.2), params).is_kept.all()
    line = np.arange(200)[:, None] * [0.1, 0.0, 0.0]
    assert statistical(line, params).is_kept[20:-20].all()


def test_threads_change_nothing():
    points = np.random.default_rng(4).random((70_000, 3))
    before = threads.get_threads()
    try:
        means = []
        for count in (1, 3):
            threads.set_threads(count)
            means.append(mean_distances(points, Statistical(neighbours=5)))
    finally:
        threads.set_threads(before)
    np.testing.assert_array_equal(*means)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, LARGEST), max_size=200), st.integers(0, 200))
def test_totals_are_exact_and_add_up(values, cut):
    array = np.array(values, dtype=np.int64)
    totals = Totals.of(array)
    assert totals == Totals(len(values), sum(values), sum(v * v for v in values))
    assert Totals.of(array[:cut]) + Totals.of(array[cut:]) == totals
    if values:
        assert totals.mean == pytest.approx(np.mean(values))
        assert totals.deviation == pytest.approx(np.std(array.astype(float)), rel=1e-6, abs=1e-3)


def thin_facade(seed=0, density=400.0, thinner=2.0):
    """Return ground, a facade seen `thinner` times as far apart, and strays; the slices of each."""
    rng = np.random.default_rng(seed)
    held = int(400 * density)
    ground = np.column_stack([rng.uniform(0, 20, (held, 2)), rng.normal(0, 0.01, held)])
    count = int(200 * density / thinner**2)
    facade = np.column_stack(
        [rng.uniform(0, 20, count), 10 + rng.normal(0, 0.01, count), rng.uniform(0, 10, count)]
    )
    strays = rng.uniform([0, 0, 0.6], [20, 20, 14], (int(density / 4), 3))
    parts = [ground, facade, strays]
    ends = np.cumsum([0, *map(len, parts)])
    return np.vstack(parts), [slice(a, b) for a, b in pairwise(ends)]


@pytest.mark.parametrize(("density", "thinner"), [(25.0, 3.0), (100.0, 4.0), (400.0, 4.0)])
def test_a_facade_that_is_thinner_than_the_ground_is_spared(density, thinner):
    points, (_, facade, strays) = thin_facade(density=density, thinner=thinner)
    plain = statistical(points)
    spared = statistical(points, Statistical(spare_places=True))
    assert plain.is_kept[facade].mean() < 0.5
    assert spared.is_kept[facade].mean() > 0.9
    assert spared.is_kept[strays].mean() < 0.1
    assert not (plain.is_kept & ~spared.is_kept).any()
    assert (spared.attributes["removal_margin"][~spared.is_kept] > 1).all()
    assert (spared.attributes["removal_margin"][spared.is_kept] <= 1).all()
    assert "stay (spare_places)" in spared.notes[-1]


def test_where_no_place_goes_nothing_is_spared():
    points, _ = thin_facade(thinner=1.0)
    plain, spared = statistical(points), statistical(points, Statistical(spare_places=True))
    assert not plain.is_kept.all()
    np.testing.assert_array_equal(plain.is_kept, spared.is_kept)
    assert spared.notes == plain.notes


def test_either_a_number_or_a_radius():
    assert Statistical(radius_m=0.1).neighbours is None
    with pytest.raises(ValidationError, match="not both or none"):
        Statistical(radius_m=0.1, neighbours=3)
    with pytest.raises(ValidationError, match="Extra inputs"):
        Statistical(radius=0.1)
