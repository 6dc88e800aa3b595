"""Plan search: right poses on sites of any symmetry, whatever the frame; kernels against twins."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong import threads
from dougong.kernels import plan as kernels
from dougong.registration import plan_refine
from dougong.registration.plan_search import PlanSearch, plan_search
from dougong.registration.prepare import prepare
from dougong.registration.rasters import plan_raster
from reference import plan as reference
from registration_sites import (
    SETTINGS,
    as_cloud,
    local_truth,
    motion,
    moved,
    polygon,
    pose_error,
    site,
)

QUICK = PlanSearch(peaks=24)


def survey(truth, *, source_kind="lidar", source_part=None, **options):
    source_points = site(source_kind, seed=1, **options)
    if source_part is not None:
        source_points = source_points[source_part(source_points)]
    source = as_cloud(source_points)
    target = as_cloud(moved(site("photogrammetry", seed=2, **options), truth))
    return (
        prepare(source, source_kind, SETTINGS),
        prepare(target, "photogrammetry", SETTINGS),
        local_truth(truth, source, target),
        source.xyz.mean(axis=0),
    )


@pytest.mark.parametrize(("yaw", "tilt"), [(37.0, 0.5), (-90.9, -0.3), (179.6, 0.0)])
def test_finds_the_pose_in_map_coordinates(yaw, tilt):
    source, target, truth, centre = survey(motion(yaw, (5.1e5, 4.2e6, 87.0), tilt))
    best = plan_search(source, target, QUICK)[0]
    turn, plan, height = pose_error(best.T_target_source, truth, centre)
    assert turn < 1.0
    assert plan < 0.3
    assert height < 0.3
    assert 0.4 < best.score <= 1.0


def test_photogrammetry_pairs_with_photogrammetry():
    source, target, truth, centre = survey(motion(71.0, (30, -8, 4)), source_kind="photogrammetry")
    assert pose_error(plan_search(source, target, QUICK)[0].T_target_source, truth, centre)[:2] < (
        1,
        0.3,
    )


def test_one_facade_finds_its_place_in_the_whole_site():
    truth = motion(-64.0, (100, 50, 3))
    source, target, local, centre = survey(
        truth, source_part=lambda p: (p[:, 1] < -3) & (p[:, 1] > -22) & (np.abs(p[:, 0]) < 20)
    )
    assert pose_error(plan_search(source, target, QUICK)[0].T_target_source, local, centre)[:2] < (
        1,
        0.4,
    )


@pytest.mark.parametrize("sides", [8])
def test_equal_poses_are_all_listed(sides):
    truth = motion(20.0, (3, 4, 5))
    source, target, local, centre = survey(
        truth, outline=polygon(sides, 9.0), extras=False, size=16.0
    )
    # The patch of ground is square, so only quarter turns are equal for the whole site.
    found = plan_search(source, target, QUICK)
    for turn in range(0, 360, 90):
        wanted = local @ _about(centre_of(source), turn)
        errors = [pose_error(h.T_target_source, wanted, centre) for h in found]
        assert any(yaw < 2.0 and plan < 0.5 for yaw, plan, _ in errors), turn


def centre_of(cloud):
    middle = 0.5 * (cloud.xyz.min(axis=0) + cloud.xyz.max(axis=0))
    return np.array([middle[0], middle[1], 0.0])


def _about(centre, turn):
    spin = motion(turn)
    spin[:3, 3] = centre - spin[:3, :3] @ centre
    return spin


def test_yaw_hint_restricts_the_search():
    source, target, truth, centre = survey(motion(40.0))
    near = plan_search(source, target, PlanSearch(fine_cell_m=0.5, yaw_hint_deg=50.0))
    assert pose_error(near[0].T_target_source, truth, centre)[0] < 1.0
    away = plan_search(source, target, PlanSearch(fine_cell_m=0.5, yaw_hint_deg=-120.0))
    off = [(h.yaw_deg + 120.0 + 180.0) % 360.0 - 180.0 for h in away]
    assert all(abs(x) < 18.0 for x in off)


def test_rasters_of_a_wide_site_stay_small():
    """Peaks were refined on cells of 0.25 m however far apart the points lay: 3 km took 49 GB."""
    source, target, _, _ = survey(motion(40.0))
    far = replace(target, xyz=target.xyz.copy())
    far.xyz[:40] += [3000.0, 2500.0, 0.0]
    sizes = []

    def measured(view, cell_m, *args):
        raster = plan_raster(view, cell_m, *args)
        sizes.append(raster.size)
        return raster

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan_refine, "plan_raster", measured)
        plan_search(source, far, PlanSearch())
    assert max(sizes) < 17 * 2.1e6


def test_result_depends_on_neither_threads_nor_order():
    truth = motion(10.0, (1, 2, 3))
    points = site("lidar", seed=1)
    target = prepare(
        as_cloud(moved(site("photogrammetry", seed=2), truth)), "photogrammetry", SETTINGS
    )
    before = threads.get_threads()
    results = []
    try:
        for count, order in ((1, slice(None)), (2, slice(None, None, -1))):
            threads.set_threads(count)
            source = prepare(as_cloud(points[order]), "lidar", SETTINGS)
            results.append(plan_search(source, target, QUICK))
    finally:
        threads.set_threads(before)
    one, two = results
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.T_target_source, b.T_target_source, atol=1e-9)
        assert a.score == pytest.approx(b.score, abs=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_splat_agrees_with_its_definition(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-9, 9, (2, 12))
    values = rng.normal(size=(12, 3)).astype(np.float32)
    out = np.zeros((3, 5, 6), np.float32)
    kernels.splat(x, y, values, out)
    np.testing.assert_allclose(out, reference.splat(x, y, values, (5, 6)), atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_match_agrees_with_its_definition(seed):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-5, 5, (20, 2))
    values = rng.normal(size=(20, 8)).astype(np.float32)
    field = rng.normal(size=(9, 7, 8)).astype(np.float32)
    poses = np.column_stack([rng.uniform(-4, 4, 5), rng.uniform(0, 7, 5), rng.uniform(0, 9, 5)])
    out = np.empty((5, 3))
    kernels.match_at_poses(xy, values, field, poses, out)
    expected = [reference.match_at_pose(xy, values, field, pose) for pose in poses]
    np.testing.assert_allclose(out, expected, atol=1e-4)


def test_votes_agree_with_their_definition():
    rng = np.random.default_rng(3)
    cell = rng.integers(-1, 4, 15)
    z, weight = rng.uniform(0, 2, 15), rng.uniform(0, 1, 15)
    starts = np.array([0, 3, 3, 7, 9])
    target_z, target_weight = rng.uniform(0, 2, 9), rng.uniform(0, 1, 9)
    out = np.zeros(60)
    kernels.vote_heights(cell, z, weight, starts, target_z, target_weight, -3.0, 0.1, out)
    expected = reference.vote_heights(
        cell, z, weight, starts, target_z, target_weight, -3.0, 0.1, 60
    )
    np.testing.assert_allclose(out, expected, atol=1e-12)
