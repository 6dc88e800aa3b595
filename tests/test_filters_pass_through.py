"""Pass-through: ranges, polygons with holes, heights and the robust top."""

import matplotlib.path
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from dougong.errors import InputError
from dougong.filters.pass_through import PassThrough, pass_through, robust_top

SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))


def kept(points, **fields):
    return pass_through(points, PassThrough(**fields)).is_kept.tolist()


def test_ranges_are_inclusive_and_open_ended():
    points = np.array([[0.0, 0, 0], [1.0, 2.0, 3.0], [2.0, 5.0, 9.0]])
    assert kept(points) == [True, True, True]
    assert kept(points, x_m=(1.0, None)) == [False, True, True]
    assert kept(points, x_m=(None, 1.0), z_m=(0.5, 3.0)) == [False, True, False]
    assert kept(np.empty((0, 3)), x_m=(0, 1), polygon=SQUARE) == []


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 12))
def test_a_star_is_matplotlibs(seed, corners):
    rng = np.random.default_rng(seed)
    turn = np.sort(rng.uniform(0, 2 * np.pi, corners))
    ring = rng.uniform(0.5, 2, (corners, 1)) * np.column_stack([np.cos(turn), np.sin(turn)])
    points = rng.uniform(-2, 2, (300, 3))
    expected = matplotlib.path.Path(np.vstack([ring, ring[:1]]), closed=True).contains_points(
        points[:, :2]
    )
    polygon = tuple(map(tuple, ring))
    assert kept(points, polygon=polygon) == expected.tolist()
    assert kept(points, polygon=polygon[::-1]) == expected.tolist()


def test_holes_are_cut_and_shared_edges_belong_to_one_side():
    hole = ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0))
    points = np.array([[0.5, 0.5, 0], [1.5, 1.5, 0], [5.0, 1.0, 0]])
    assert kept(points, polygon=SQUARE, holes=(hole,)) == [True, False, False]
    slope = ((0.0, 0.0), (3.0, 0.0), (1.0, 4.0)), ((3.0, 0.0), (3.0, 4.0), (1.0, 4.0))
    edge = np.array([[3 - 2 * t, 4 * t, 0.0] for t in np.linspace(0, 1, 31)[1:-1]])
    sides = [np.array(kept(edge, polygon=area)) for area in slope]
    assert (sides[0] ^ sides[1]).all()


def test_map_coordinates_are_brought_into_the_frame():
    params = PassThrough(
        x_m=(500_000.0, None),
        z_m=(None, 103.0),
        polygon=((5e5, 4e6), (5e5 + 2, 4e6), (5e5, 4e6 + 2)),
    )
    local = params.shifted([5e5, 4e6, 100.0])
    assert local.x_m == (0.0, None)
    assert local.z_m == (None, 3.0)
    assert local.polygon == ((0, 0), (2, 0), (0, 2))
    assert pass_through([[0.5, 0.5, 1.0]], local).is_kept.all()


def test_heights_crop_where_they_are_known():
    height = np.array([-1.0, -0.3, 5.0, np.nan])
    chosen = pass_through(
        np.zeros((4, 3)), PassThrough(margin_below_ground_m=0.4), height_above_ground=height
    )
    assert chosen.is_kept.tolist() == [False, True, True, True]
    assert "1 point has no known ground" in chosen.notes[0]
    chosen = pass_through(
        np.zeros((4, 3)), PassThrough(height_m=(0.0, None)), height_above_ground=height
    )
    assert chosen.is_kept.tolist() == [False, False, True, True]
    with pytest.raises(InputError, match="needs heights, got none"):
        pass_through(np.zeros((4, 3)), PassThrough(height_m=(0.0, 1.0)))
    with pytest.raises(InputError, match=r"shape \(4,\), got \(3,\)"):
        pass_through(np.zeros((4, 3)), PassThrough(height_m=(0, 1)), height_above_ground=height[:3])


def test_the_top_is_the_finial_not_the_bird_and_not_the_wall_hidden_by_eaves():
    rng = np.random.default_rng(0)
    ground, roof = rng.normal(0, 0.02, 6000), rng.uniform(8, 12, 4000)
    finial = np.linspace(12, 14, 40)
    birds = [17.0, 17.1, 30.0, 1e6]
    assert robust_top(np.concatenate([ground, roof, finial, birds])) == 14.0
    height = np.concatenate([ground, roof, finial, birds])
    is_kept = pass_through(
        np.zeros((len(height), 3)), PassThrough(margin_above_top_m=0.4), height_above_ground=height
    ).is_kept
    assert is_kept[:-4].all()
    assert not is_kept[-4:].any()
    assert np.isnan(robust_top(np.array([np.nan])))
    assert robust_top(np.array([2.0])) == 2.0


def test_impossible_conditions_are_refused():
    with pytest.raises(ValidationError, match="x_m must ascend, got 3"):
        PassThrough(x_m=(3, 1))
    with pytest.raises(ValidationError, match="at least 3 corners"):
        PassThrough(polygon=((0, 0), (1, 1)))
    with pytest.raises(ValidationError, match="holes need a polygon"):
        PassThrough(holes=(SQUARE,))
