"""The guard: what lies below the ground goes, real lower levels stay."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong import threads
from dougong.errors import InputError
from dougong.filters.cloth_simulation import ClothSimulation, cloth_notes, cloth_simulation
from dougong.filters.low_outliers import LowOutliers, halo_m, low_notes, low_outliers
from dougong.filters.pass_through import unknown_notes
from dougong.filters.statistical import stray_notes
from dougong.kernels import low_outliers as kernels
from reference.cloth import hall_site, terrain


def is_low(points, **parameters):
    return ~low_outliers(points, LowOutliers(**parameters)).is_kept


def patch(rng, density, box, height, noise=0.01):
    """Points of a surface z = height(x) over a box (x low, x high, y low, y high)."""
    number = int(density * (box[1] - box[0]) * (box[3] - box[2]))
    x, y = rng.uniform(box[0], box[1], number), rng.uniform(box[2], box[3], number)
    z = height(x) if callable(height) else np.full(number, float(height))
    return np.column_stack([x, y, z + rng.normal(0, noise, number)])


def without(points, box):
    x, y = points[:, 0], points[:, 1]
    return points[~((x > box[0]) & (x < box[1]) & (y > box[2]) & (y < box[3]))]


def strays(rng, number, low, high):
    return rng.uniform([0, 0, low], [40, 40, high], (number, 3))


@pytest.mark.parametrize("number", [60_000, 300_000])
@pytest.mark.parametrize("slope", [0.05, 0.2])
def test_stray_points_go_and_nothing_else(number, slope):
    points, label = hall_site(number, outliers=0.015, slope=slope)
    depth = terrain(points[:, 0], points[:, 1], slope) - points[:, 2]
    low = is_low(points)
    assert low[(label == 5) & (depth > 1.0)].mean() > 0.97
    assert not low[label != 5].any()
    assert not low[depth < 0].any()


def test_a_point_as_high_as_the_floor_stays_in_any_frame():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 20, (8000, 2)), np.zeros(8000)])
    deep = np.column_stack([rng.uniform(2, 18, (60, 2)), np.tile([-1.65, -0.3, -0.301], 20)])
    points = np.round(np.vstack([ground, deep]), 3)
    low = is_low(points)
    assert 20 < low.sum() < 60
    assert not low[points[:, 2] >= -0.3].any()
    for up in (0.64, -0.7, 301.011):
        np.testing.assert_array_equal(is_low(points + [0.0, 0.0, up]), low)


LEVELS = {
    "courtyard 12 x 12 m, 3 m deep": ((15, 27, 15, 27), 3.0),
    "moat 4 m wide, 4 m deep": ((5, 9, 0, 40), 4.0),
    "ditch 1 m wide, 1.5 m deep": ((20, 21, 0, 40), 1.5),
    "pit 2 x 2.5 m, 1.5 m deep": ((20, 22, 20, 22.5), 1.5),
}


@pytest.mark.parametrize("density", [20, 150])
@pytest.mark.parametrize("name", LEVELS)
def test_lower_levels_stay(name, density):
    """Seen from above, without their walls, and with strays all around."""
    box, depth = LEVELS[name]
    rng = np.random.default_rng(1)
    upper = without(patch(rng, density, (0, 40, 0, 40), 0.0), box)
    real = np.concatenate([upper, patch(rng, density, box, -depth)])
    points = np.concatenate([real, strays(rng, len(real) // 70, -8, 10)])
    low = is_low(points)
    assert not low[: len(real)].any()
    assert low[len(real) :][points[len(real) :, 2] < -depth - 1].mean() > 0.95


def test_steps_terraces_and_hillsides_stay():
    rng = np.random.default_rng(2)
    for height in (
        lambda x: -0.15 * np.floor(np.clip(x - 15, 0, 10) / 0.3),
        lambda x: -2.5 * np.floor(x / 8),
        lambda x: 0.8 * x,
    ):
        points = patch(rng, 60, (0, 40, 0, 40), height)
        assert not is_low(points).any()


def test_ground_under_trees_stays():
    rng = np.random.default_rng(3)
    crowns = patch(rng, 100, (5, 35, 5, 35), 9.0, noise=1.0)
    ground = without(patch(rng, 100, (0, 40, 0, 40), 0.0), (5, 35, 5, 35))
    thin = patch(rng, 6, (5, 35, 5, 35), 0.0)
    low = is_low(np.concatenate([crowns, ground, thin]))
    assert low.mean() < 1e-4


@pytest.mark.parametrize("density", [30, 150])
def test_clusters_below_the_ground_go(density):
    """Multipath: blobs of a metre, a fifth as dense as the floor or denser, 1-4 m under it."""
    rng = np.random.default_rng(4)
    ground = patch(rng, density, (0, 40, 0, 40), lambda x: 0.05 * x)
    blobs = []
    for x in range(4, 40, 8):
        for y in range(4, 40, 8):
            number = int(density * rng.choice([0.2, 1.5]))
            z = 0.05 * x - rng.uniform(1, 4)
            blobs.append(rng.normal([x, y, z], [0.25, 0.25, 0.05], (number, 3)))
    points = np.concatenate([ground, *blobs])
    low = is_low(points)
    assert low[len(ground) :].all()
    assert not low[: len(ground)].any()
    found = cloth_simulation(points, ClothSimulation(class_threshold_m=0.2)).attributes
    assert found["is_ground"][: len(ground)].mean() > 0.995


def test_a_single_point_far_below_goes():
    points = patch(np.random.default_rng(5), 30, (0, 40, 0, 40), 0.0)
    for depth in (2.0, 100.0, 1e6):
        low = is_low(np.concatenate([points, [[20.0, 20.0, -depth]]]))
        assert np.flatnonzero(low).tolist() == [len(points)]
    high = is_low(np.concatenate([points, [[20.0, 20.0, 1e6]]]))
    assert not high.any()


@pytest.mark.parametrize("far", [9e9, 1e16, 3.4028235e38])
@pytest.mark.parametrize("strays", [(1,), (-1,), (-1, 1)])
def test_a_stray_at_no_place_leaves_the_guard_on(far, strays):
    points = patch(np.random.default_rng(5), 30, (0, 40, 0, 40), 0.0)
    below = np.array([[20.0, 20.0, -2.0], [12.0, 9.0, -5.0]])
    odd = [[10.0 + side, 10.0, side * far] for side in strays]
    low = is_low(np.concatenate([points, below, odd]))
    expected = [len(points), len(points) + 1]
    expected += [len(points) + 2] if strays[0] < 0 else []
    assert np.flatnonzero(low).tolist() == expected


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000))
def test_order_offset_and_threads_change_nothing(seed):
    points = np.rint(hall_site(5_000, seed, outliers=0.05)[0] * 1000) / 1000
    low = is_low(points)
    assert low.any()
    order = np.random.default_rng(seed).permutation(len(points))
    np.testing.assert_array_equal(low[order], is_low(points[order]))
    np.testing.assert_array_equal(low, is_low(points + [5e5, 4e6, 100.0]))
    before = threads.get_threads()
    try:
        threads.set_threads(3)
        np.testing.assert_array_equal(low, is_low(points))
    finally:
        threads.set_threads(before)


def test_clouds_of_no_and_of_few_points():
    assert len(low_outliers(np.empty((0, 3))).is_kept) == 0
    for number in (1, 2, 5):
        points = np.random.default_rng(0).random((number, 3)) * 10
        assert low_outliers(points).is_kept.all()
    same = np.zeros((1000, 3))
    assert low_outliers(same).is_kept.all()


def test_what_it_says_and_refuses():
    points = np.random.default_rng(0).random((1000, 3)) * [1e4, 1e4, 1]
    with pytest.raises(InputError, match=r"Set cell_m to a larger value"):
        low_outliers(points, LowOutliers(cell_m=0.1))
    ground = patch(np.random.default_rng(5), 30, (0, 20, 0, 20), 0.0)
    found = low_outliers(np.concatenate([ground, [[10.0, 10.0, -3.0]]]))
    assert found.notes == ("1 of 12,001 points lies below the ground",)
    assert halo_m(LowOutliers(ground_window_m=12.0)) == 12.0


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000))
def test_voxel_kernels_equal_their_definitions(seed):
    rng = np.random.default_rng(seed)
    shape = (5, 6, 8)
    cells = rng.integers(0, shape, (60, 3))
    keys = np.sort((cells[:, 0] * 6 + cells[:, 1]) * 8 + cells[:, 2])
    unique, count = np.empty((2, 60), np.int64)
    number = kernels.runs(keys, unique, count)
    unique, count = unique[:number], count[:number]
    np.testing.assert_array_equal((unique, count), np.unique(keys, return_counts=True))
    starts = np.empty(31, np.int64)
    kernels.column_starts(unique, 8, starts)
    np.testing.assert_array_equal(starts, np.searchsorted(unique, np.arange(31) * 8))
    where = np.column_stack(np.unravel_index(unique, shape))
    gap = np.abs(where[:, None] - where[None])
    support = np.empty(number, np.int64)
    kernels.count_support(unique, count, starts, shape, 0, number, support)
    np.testing.assert_array_equal(support, ((gap <= 1).all(axis=2) * count).sum(axis=1))
    is_strong = rng.random(number) < 0.7
    parent = np.empty(number, np.int64)
    kernels.link_surfaces(unique, starts, is_strong, shape, 2, parent)
    expected = np.arange(number)
    linked = (gap <= [1, 1, 2]).all(axis=2) & is_strong & is_strong[:, None]
    for _ in range(number):
        expected = np.array(
            [expected[linked[v] | (np.arange(number) == v)].min() for v in range(number)]
        )
    np.testing.assert_array_equal(parent, expected)


def upright(rng, density, origin, along, height, noise=0.004):
    """Points of a wall over `along` (2,) from `origin` (3,), this high."""
    number = int(density * np.hypot(*along) * height)
    u, v = rng.random((2, number))
    xyz = np.array(origin) + np.column_stack([u[:, None] * along, v * height])
    return xyz + rng.normal(0, noise, xyz.shape)


WALLS = {
    "moat wall 10 x 4.5 m": ((15, 20, -4.5), (10, 0), 4.5),
    "moat wall, turned": ((15, 15, -4.5), (8.5, 5), 4.5),
    "back of a vault 3 x 2 m": ((20, 20, -2.5), (0, 3), 2.0),
}


@pytest.mark.parametrize("name", WALLS)
def test_walls_below_the_ground_stay(name):
    """A wall has next to no area in plan: its 88,571 points went as stray ones."""
    rng = np.random.default_rng(6)
    wall = upright(rng, 300, *WALLS[name])
    noise = strays(rng, 400, -8, -1)
    low = is_low(np.concatenate([wall, patch(rng, 300, (0, 40, 0, 40), 0.0), noise]))
    assert not low[: len(wall)].any()
    assert low[-len(noise) :].mean() > 0.95


def test_a_clump_below_the_ground_goes():
    rng = np.random.default_rng(7)
    clump = rng.normal([20.0, 20.0, -2.0], 0.15, (300, 3))
    points = np.concatenate([clump, patch(rng, 300, (0, 40, 0, 40), 0.0)])
    low = is_low(points)
    assert low[: len(clump)].all()
    assert not low[len(clump) :].any()


@pytest.mark.parametrize(
    ("notes", "said"),
    [
        (low_notes(1, 3000), "1 of 3,000 points lies below the ground"),
        (low_notes(2, 3000), "2 of 3,000 points lie below the ground"),
        (cloth_notes(0, 1, 1), "1 of 1 point is too far from any ground for a height"),
        (unknown_notes(1), "1 point has no known ground below and was not cropped by height"),
        (stray_notes(2), "2 points lie far from all others and do not count for the mean"),
    ],
)
def test_one_point_is_not_said_as_many_are(notes, said):
    assert notes == (said,)
