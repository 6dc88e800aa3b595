"""Octree voxel grid: the twin's choice, whatever the order; far points shape no voxel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from dougong import threads
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.octree_voxel_grid import (
    OctreeVoxelGrid,
    Root,
    octree_voxel_grid,
    robust_box,
    root_cube,
)
from reference.filters import octree_voxel_grid as twin


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 300),
    st.sampled_from([0.1, 0.3, 0.25]),
    st.booleans(),
)
def test_is_the_twin_in_any_order(seed, n, voxel_m, on_lattice):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 1, (n, 3))
    if on_lattice:  # ties and exact duplicates in plenty
        points = np.round(points * 8) / 8
    records = np.zeros(n, dtype=[("intensity", "<u2"), ("red", "u1")])
    records["intensity"] = rng.integers(0, 3, n)
    params = OctreeVoxelGrid(voxel_m=voxel_m)
    chosen = octree_voxel_grid(points, params, records=records)
    is_kept, count = twin(points, root_cube(points, params).low, voxel_m, records)
    np.testing.assert_array_equal(chosen.attributes["voxel_count"], count)
    assert chosen.is_kept.sum() == is_kept.sum()
    rows = np.column_stack([points, records["intensity"]])
    np.testing.assert_array_equal(
        np.unique(rows[chosen.is_kept], axis=0), np.unique(rows[is_kept], axis=0)
    )
    shuffle = rng.permutation(n)
    again = octree_voxel_grid(points[shuffle], params, records=records[shuffle])
    np.testing.assert_array_equal(
        np.unique(rows[shuffle][again.is_kept], axis=0), np.unique(rows[chosen.is_kept], axis=0)
    )


def test_depth_halves_the_root_and_a_far_point_shapes_nothing():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 8, (20_000, 3))
    near = octree_voxel_grid(points, OctreeVoxelGrid(depth=4))
    assert near.is_kept.sum() == pytest.approx(16**3, rel=0.02)
    far = np.concatenate([points, [[1e6, -1e6, 1e6], [-3e5, 0, 0]]])
    stray = octree_voxel_grid(far, OctreeVoxelGrid(depth=4))
    np.testing.assert_array_equal(stray.is_kept[:-2], near.is_kept)
    assert stray.is_kept[-2:].all()
    assert root_cube(far, OctreeVoxelGrid(depth=4))[1] == pytest.approx(8, rel=0.01)


def test_the_box_keeps_sparse_ends_and_drops_isolated_ones():
    rng = np.random.default_rng(1)
    wall = np.column_stack([100 * rng.random(5000) ** 6, rng.random((5000, 2))])
    low, high = robust_box(np.concatenate([wall, [[1e6, 0, 0]]]))
    np.testing.assert_array_equal(low, wall.min(0))
    np.testing.assert_array_equal(high, wall.max(0))


MAP = np.array([431_234.567, 4_001_234.123, 301.011])


@pytest.mark.parametrize(
    "params",
    [
        *(OctreeVoxelGrid(voxel_m=edge) for edge in (0.005, 0.003, 0.007, 0.02, 0.0125, 1 / 300)),
        *(OctreeVoxelGrid(depth=depth) for depth in (6, 8, 9)),
    ],
    ids=str,
)
def test_the_origin_of_the_frame_changes_no_choice(params):
    rng = np.random.default_rng(4)
    millimetres = np.unique(rng.integers(0, [700, 40, 700], (40_000, 3)), axis=0)
    given_points = rng.permutation(millimetres) / 1000
    kept = octree_voxel_grid(given_points, params).is_kept
    for shift in ([1000.0, 2000.0, 10.0], [0.37, 0.21, 0.64], MAP):
        moved = Cloud.from_points(given_points + np.array(shift)).xyz
        np.testing.assert_array_equal(octree_voxel_grid(moved, params).is_kept, kept)
    order = rng.permutation(len(given_points))
    shuffled = octree_voxel_grid(given_points[order], params).is_kept
    np.testing.assert_array_equal(shuffled, kept[order])
    if params.voxel_m in (0.005, 0.003, 0.007, 0.02):
        voxels = (millimetres - millimetres.min(0)) // round(params.voxel_m * 1000)
        assert kept.sum() == len(np.unique(voxels, axis=0))


def test_a_part_beside_the_root_cube_is_decimated():
    points = np.array([[-5.0, -7, -9], [-6.0, -8, -9]])
    beside = octree_voxel_grid(points, OctreeVoxelGrid(voxel_m=1.0), root=Root(MAP, 10.0, 1.0))
    assert beside.is_kept.all()


def test_cells_beyond_the_curve_are_still_voxels():
    points = np.array([[0.0, 0, 0], [0.4, 0, 0], [5e6, 0, 0], [5e6 + 0.4, 0, 0], [-5e6, 0, 0]])
    root = Root(np.zeros(3), 1.0, 1.0)
    chosen = octree_voxel_grid(points, OctreeVoxelGrid(voxel_m=1.0), root=root)
    assert chosen.attributes["voxel_count"].tolist() == [2, 2, 2, 2, 1]
    assert chosen.is_kept.tolist() == [False, True, False, True, True]


@pytest.mark.parametrize(
    ("points", "kept"),
    [
        (np.empty((0, 3)), 0),
        (np.zeros((1, 3)), 1),
        (np.array([[0, 0, 0], [1.0, 0, 0]]), 2),
        (np.full((50, 3), 7.7), 1),
        (np.linspace(0, 1, 101)[:, None] * [1.0, 0, 0], 11),
    ],
)
def test_small_and_degenerate_clouds(points, kept):
    chosen = octree_voxel_grid(points, OctreeVoxelGrid(voxel_m=0.1))
    assert chosen.is_kept.sum() == kept
    assert octree_voxel_grid(points, OctreeVoxelGrid(depth=3)).is_kept.shape == (len(points),)


def test_threads_change_nothing_and_every_voxel_keeps_one():
    points = np.random.default_rng(3).random((300_000, 3)) * 30
    before = threads.get_threads()
    try:
        masks = []
        for count in (1, 3):
            threads.set_threads(count)
            masks.append(octree_voxel_grid(points, OctreeVoxelGrid(voxel_m=0.5)).is_kept)
    finally:
        threads.set_threads(before)
    np.testing.assert_array_equal(*masks)
    low = points.min(0)
    cells = np.floor((points - low) / 0.5).astype(int)
    assert len(np.unique(cells[masks[0]], axis=0)) == masks[0].sum()
    assert len(np.unique(cells, axis=0)) == masks[0].sum()


def test_one_size_is_given_and_faults_are_named():
    assert OctreeVoxelGrid().voxel_m == 0.005
    assert OctreeVoxelGrid(depth=14).voxel_m is None
    assert OctreeVoxelGrid(**OctreeVoxelGrid(depth=14).model_dump()) == OctreeVoxelGrid(depth=14)
    with pytest.raises(ValidationError, match="not both or none"):
        OctreeVoxelGrid(voxel_m=0.1, depth=9)
    with pytest.raises(InputError, match="one record per point, got 1 for 2"):
        octree_voxel_grid(np.zeros((2, 3)), records=np.zeros(1))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(5, 2000), st.sampled_from([0.0, 1.0, 30.0, 1e6]))
def test_the_short_proof_that_none_is_far_never_changes_the_box(seed, n, throw):
    rng = np.random.default_rng(seed)
    points = rng.random((n, 3)) ** rng.integers(1, 8) * [10, 10, 1]
    points[: max(1, n // 300)] += rng.normal(0, 1, 3) * throw
    suspects = max(1, int(n * 0.005))
    parted = np.sort(points, axis=0)
    low, high = parted[suspects], parted[n - 1 - suspects]
    reach = (high - low).max()
    near = points[((points >= low - reach) & (points <= high + reach)).all(1)]
    np.testing.assert_array_equal(robust_box(points), [near.min(0), near.max(0)])
