"""One score for all poses: bounds, symmetry, order; ranking, margin; mirrors and units."""

from dataclasses import replace

import numpy as np
import pytest

from dougong.registration.hypotheses import dedupe, rank, score
from dougong.registration.plan_search import PlanSearch, plan_search
from dougong.registration.prepare import prepare
from dougong.registration.result import Hypothesis
from dougong.registration.sanity import is_mirrored, mirrored, propose_scale
from registration_sites import SETTINGS, as_cloud, local_truth, motion, moved, site

QUICK = PlanSearch(cell_m=1.0, fine_cell_m=1.0, yaw_step_deg=4.0, peaks=16)


@pytest.fixture(scope="module")
def pair():
    truth = motion(25.0, (7.0, -3.0, 2.0))
    source = as_cloud(site("lidar", seed=1))
    target = as_cloud(moved(site("photogrammetry", seed=2), truth))
    return (
        prepare(source, "lidar", SETTINGS),
        prepare(target, "photogrammetry", SETTINGS),
        local_truth(truth, source, target),
    )


def about_the_site(source, matrix):
    """Return `matrix`, turning about the middle of the source."""
    there = motion(0.0, source.xyz.mean(axis=0))
    return there @ matrix @ np.linalg.inv(there)


def pose(matrix, value=0.0):
    return Hypothesis(T_target_source=matrix, score=value, method="test")


def test_a_cloud_fits_itself(pair):
    source, *_ = pair
    assert score(np.eye(4), source, source) > 0.97


def test_the_score_falls_as_the_pose_leaves_the_truth(pair):
    source, target, truth = pair
    values = [score(truth @ motion(0.0, (step, 0, 0)), source, target) for step in (0, 0.4, 1.5, 6)]
    assert values[0] > 0.6
    assert values == sorted(values, reverse=True)
    assert values[0] > 1.2 * values[2]
    assert values[0] > 1.5 * values[3]
    turned = score(truth @ about_the_site(source, motion(15.0)), source, target)
    assert 0.0 <= turned < 0.7 * values[0]
    assert score(truth @ motion(0.0, (500, 0, 0)), source, target) == 0.0


def test_both_directions_give_one_score(pair):
    source, target, truth = pair
    for matrix in (truth, truth @ motion(8.0, (1, 1, 0.2))):
        forward = score(matrix, source, target)
        backward = score(np.linalg.inv(matrix), target, source)
        assert forward == pytest.approx(backward, abs=1e-9)


def test_walls_in_the_drones_free_space_count_against_a_pose(pair):
    source, target, truth = pair
    ghost = replace(source, kind="lidar")
    shifted = truth @ motion(0.0, (0, 14, 0))
    blind = replace(target, kind="lidar", has_ground=False)
    assert score(shifted, ghost, target) < score(shifted, ghost, blind)


def test_ranking_is_best_first_and_without_copies(pair):
    source, target, truth = pair
    near = truth @ about_the_site(source, motion(1.0, (0.1, 0, 0)))
    ranked = rank([pose(truth @ motion(180.0)), pose(near), pose(truth)], source, target)
    np.testing.assert_allclose(ranked[0].T_target_source, truth)
    assert len(ranked) == 2
    assert ranked[0].score > ranked[1].score


def test_poses_closer_than_the_limits_are_one(pair):
    source, _, truth = pair
    one = pose(truth, 0.8)
    beside = pose(truth @ about_the_site(source, motion(1.0)), 0.79)
    assert dedupe([beside, one], source) == [one]
    assert len(dedupe([one, pose(truth @ motion(0.0, (0, 0, 0.8)), 0.7)], source)) == 2


def test_a_mirrored_cloud_is_recognised(pair):
    source, target, _ = pair
    plain = plan_search(source, target, QUICK)
    right = is_mirrored(source, target, plain, QUICK)
    assert not right.is_mirrored
    assert right.sentence == ""
    flipped = mirrored(source)
    wrong = is_mirrored(flipped, target, plan_search(flipped, target, QUICK), QUICK)
    assert wrong.is_mirrored
    assert "left-handed" in wrong.sentence


@pytest.mark.parametrize("unit", [1000.0, 304.8])
def test_wild_unit_errors_are_proposed(unit):
    metres = as_cloud(site("lidar", seed=1))
    large = as_cloud(site("photogrammetry", seed=2) * unit)
    found = propose_scale(metres, large)
    assert found is not None
    assert found.factor == unit
    assert f"1/{unit:g}" in found.sentence
    back = propose_scale(large, metres)
    assert back is not None
    assert back.factor == pytest.approx(1.0 / unit)


def test_sizes_that_differ_naturally_are_left_alone():
    whole = site("photogrammetry", seed=2)
    corner = whole[(whole[:, 0] > 5) & (whole[:, 1] > 0)]
    assert propose_scale(as_cloud(corner), as_cloud(whole)) is None
    assert propose_scale(as_cloud(whole), as_cloud(whole * 3.2808)) is None
