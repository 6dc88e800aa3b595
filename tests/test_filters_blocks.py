"""What a filter must know of the whole cloud is the same however the cloud is cut into blocks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong.filters.cloth_simulation import (
    ClothSimulation,
    classify,
    cloth_notes,
    cloth_simulation,
    guarded_cloth,
)
from dougong.filters.extent import plan_box, plan_box_of
from dougong.filters.low_outliers import (
    LowOutliers,
    find_levels,
    is_low_outlier,
    low_outliers,
)


def site(seed, count=6000):
    """Ground with a step, a wall, points below the ground, and some far away."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(-15, 15, (count, 3))
    ground[:, 2] = 0.5 * (ground[:, 0] > 5) + 0.01 * rng.normal(size=count)
    wall = np.column_stack([rng.uniform(-4, 4, count), np.zeros(count), rng.uniform(0, 5, count)])
    below = rng.uniform([-15, -15, -6], [15, 15, -1], (30, 3))
    far = rng.uniform(900, 2000, (3, 3))
    points = np.vstack([ground, wall, below, far])
    return np.round(points[rng.permutation(len(points))], 3)


def cut(points, seed):
    """Return the points in blocks of uneven length, an empty one among them."""
    at = np.sort(np.random.default_rng(seed).integers(0, len(points), 6))
    return lambda: iter(np.split(points, [*at, at[-1]]))


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_blocks_say_what_the_whole_says(seed):
    points = site(seed)
    blocks = cut(points, seed)
    for one, other in zip(plan_box(points), plan_box_of(blocks, len(points)), strict=True):
        np.testing.assert_array_equal(one, other)
    levels = find_levels(blocks, len(points), LowOutliers())
    is_low = np.concatenate([is_low_outlier(block, levels) for block in blocks()])
    np.testing.assert_array_equal(~is_low, low_outliers(points).is_kept)
    assert is_low.any()


@pytest.mark.parametrize("particle_height", ["nearest", "lowest"])
def test_a_cloth_under_blocks_is_the_cloth_under_the_whole(particle_height):
    params = ClothSimulation(particle_height=particle_height, support_distance_m=4.0)
    points = site(7)
    blocks = cut(points, 1)
    whole = cloth_simulation(points, params)
    found, lows = guarded_cloth(blocks, len(points), params)
    parts = [classify(block, found, params) for block in blocks()]
    for name, values in whole.attributes.items():
        joined = np.concatenate([part.attributes[name] for part in parts])
        np.testing.assert_array_equal(joined, values)
    lost = int(np.isnan(whole.attributes["height_above_ground"]).sum())
    assert cloth_notes(lows, lost, len(points)) == whole.notes
    assert lows > 0
