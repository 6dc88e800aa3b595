"""Pose errors in cases whose answer is known by hand, at the size of map coordinates."""

import numpy as np
import pytest

from dougong.errors import InputError
from dougong.evaluation.metrics import (
    Truth,
    displacements,
    fit_rigid,
    pose_errors,
    rotation_angle_deg,
)


def rotation_z(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def pose(degrees=37.0, shift=(512_345.6, 3_456_789.1, 43.2)):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_z(degrees)
    matrix[:3, 3] = shift
    return matrix


@pytest.fixture
def truth():
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (4000, 3))
    T = pose()
    return Truth(
        T_target_source=T,
        T_best=T,
        surface_points=points,
        surface_bent=points @ T[:3, :3].T + T[:3, 3],
    )


def test_the_truth_has_no_error(truth):
    errors = pose_errors(truth.T_target_source, truth)
    assert errors.tre95_m == 0
    assert errors.rotation_error_deg == 0
    assert errors.bending_floor95_m < 2e-9
    assert errors.is_correct
    assert errors.is_accurate


@pytest.mark.parametrize(
    ("shift", "is_correct", "is_accurate"),
    [(0.019, True, True), (0.021, True, False), (0.049, True, False), (0.051, False, False)],
)
def test_a_shift_is_its_own_error(truth, shift, is_correct, is_accurate):
    moved = truth.T_target_source.copy()
    moved[:3, 3] += np.array([0.6, 0.0, -0.8]) * shift
    errors = pose_errors(moved, truth)
    assert errors.tre95_m == pytest.approx(shift, abs=2e-9)
    assert errors.total95_m == pytest.approx(shift, abs=5e-9)
    np.testing.assert_allclose(
        errors.translation_at_centroid_m, np.array([0.6, 0.0, -0.8]) * shift, atol=2e-9
    )
    assert (errors.is_correct, errors.is_accurate) == (is_correct, is_accurate)


def test_a_turn_about_the_middle_grows_with_distance(truth):
    angle = 0.015
    centre = truth.surface_points.mean(axis=0)
    turn = np.eye(4)
    turn[:3, :3] = rotation_z(angle)
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    errors = pose_errors(truth.T_target_source @ turn, truth)
    radii = np.linalg.norm((truth.surface_points - centre)[:, :2], axis=1)
    expected = np.percentile(2 * radii * np.sin(np.radians(angle) / 2), 95)
    assert errors.rotation_error_deg == pytest.approx(angle, rel=1e-9)
    assert errors.tre95_m == pytest.approx(expected, abs=5e-9)
    assert np.linalg.norm(errors.translation_at_centroid_m) < 5e-9


def test_too_much_rotation_is_not_accurate_however_small_the_distance(truth):
    small = Truth(
        T_target_source=truth.T_target_source,
        T_best=truth.T_best,
        surface_points=truth.surface_points / 20,
        surface_bent=truth.surface_bent,
    )
    turned = truth.T_target_source.copy()
    turned[:3, :3] = rotation_z(37.05)
    errors = pose_errors(turned, small)
    assert errors.tre95_m < 0.02
    assert not errors.is_accurate


def test_scale_is_told_apart_from_rotation(truth):
    scaled = truth.T_target_source.copy()
    scaled[:3, :3] *= 1.0002
    errors = pose_errors(scaled, truth)
    assert errors.scale_error_ppm == pytest.approx(200, rel=1e-6)
    assert errors.rotation_error_deg < 1e-6


def test_the_floor_is_what_the_best_pose_leaves(truth):
    rng = np.random.default_rng(3)
    bend = 0.01 * np.sin(truth.surface_points[:, :1] / 6) * [0, 0, 1.0]
    bent = truth.surface_bent + bend
    best = truth.T_target_source @ fit_rigid(
        truth.surface_points, (bent - truth.T_target_source[:3, 3]) @ truth.T_target_source[:3, :3]
    )
    known = Truth(
        T_target_source=truth.T_target_source,
        T_best=best,
        surface_points=truth.surface_points,
        surface_bent=bent,
    )
    errors = pose_errors(best, known)
    assert 0 < errors.bending_floor95_m < 0.011
    assert errors.total95_m == pytest.approx(errors.bending_floor95_m, abs=1e-12)

    def integral(matrix):
        left = displacements(matrix, truth.T_target_source, truth.surface_points) - bend
        return float((left**2).sum())

    lowest = integral(best)
    for _ in range(20):
        nudge = np.eye(4)
        nudge[:3, :3] = rotation_z(rng.normal(0, 1e-3))
        nudge[:3, 3] = rng.normal(0, 1e-4, 3)
        assert integral(best @ nudge) > lowest


def test_fit_rigid_finds_a_known_motion_and_never_mirrors():
    rng = np.random.default_rng(5)
    source = rng.normal(size=(50, 3))
    known = pose(123.0, (5e5, 4e6, 100.0))
    found = fit_rigid(source, source @ known[:3, :3].T + known[:3, 3])
    np.testing.assert_allclose(found[:3, :3], known[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found[:3, 3], known[:3, 3], atol=1e-8)
    mirrored = fit_rigid(source, source * [1, 1, -1])
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 12.0, 179.999])
def test_the_angle_between_rotations(angle):
    found = rotation_angle_deg(rotation_z(angle + 5), rotation_z(5))
    assert found == pytest.approx(angle, rel=1e-6, abs=1e-12)


def test_bad_input_is_refused(truth):
    with pytest.raises(InputError, match="mirrors"):
        pose_errors(np.diag([1, 1, -1, 1.0]), truth)
    empty = Truth(
        T_target_source=truth.T_best,
        T_best=truth.T_best,
        surface_points=np.zeros((0, 3)),
        surface_bent=np.zeros((0, 3)),
    )
    with pytest.raises(InputError, match="no surface"):
        pose_errors(np.eye(4), empty)
