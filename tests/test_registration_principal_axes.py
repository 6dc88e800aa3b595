"""Principal axes: right where there are axes, one or several proper rotations, honest scores."""

import numpy as np
import pytest

from dougong.registration.prepare import prepare
from dougong.registration.principal_axes import (
    ImprovedPca,
    _axes,
    _pairings,
    improved_pca,
    traditional_pca,
)
from registration_sites import SETTINGS, as_cloud, local_truth, motion, moved, pose_error, site

BAR = [(-14, -4), (14, -4), (14, 4), (4, 4), (4, 7), (-14, 7)]


@pytest.fixture(scope="module")
def pair():
    truth = motion(57.0, (4e5, 3e6, 50.0))
    options = {"outline": BAR, "extras": False, "size": 20.0}
    source = as_cloud(site("photogrammetry", seed=1, **options))
    target = as_cloud(moved(site("photogrammetry", seed=2, **options), truth))
    return (
        prepare(source, "photogrammetry", SETTINGS),
        prepare(target, "photogrammetry", SETTINGS),
        local_truth(truth, source, target),
        source.xyz.mean(axis=0),
    )


def test_improved_pca_finds_an_oblong_building(pair):
    source, target, truth, centre = pair
    found = improved_pca(source, target)
    yaw, plan, height = pose_error(found[0].T_target_source, truth, centre)
    assert yaw < 4.0
    assert plan < 1.0
    assert height < 0.3
    assert found[0].score > found[1].score


def test_two_hypotheses_half_a_turn_apart(pair):
    source, target, *_ = pair
    found = improved_pca(source, target)
    assert len(found) == 2
    off = (found[0].yaw_deg - found[1].yaw_deg) % 360.0
    assert off == pytest.approx(180.0, abs=1e-6)
    for hypothesis in found:
        rotation = hypothesis.T_target_source[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(rotation[2], [0, 0, 1], atol=1e-12)


def test_traditional_pca_gives_one_rotation(pair):
    source, target, *_ = pair
    found = traditional_pca(source, target)
    assert len(found) == 1
    assert np.linalg.det(found[0].T_target_source[:3, :3]) == pytest.approx(1.0)
    moved_centre = moved(source.xyz.mean(axis=0)[None], found[0].T_target_source)[0]
    np.testing.assert_allclose(moved_centre, target.xyz.mean(axis=0), atol=1e-9)


@pytest.mark.parametrize(
    ("gravity", "values", "count"),
    [
        (True, [0.7, 0.3, 0.0], 2),
        (True, [0.51, 0.49, 0.0], 4),
        (False, [0.6, 0.3, 0.1], 4),
        (False, [0.46, 0.44, 0.1], 8),
        (False, [0.34, 0.33, 0.33], 24),
    ],
)
def test_number_of_proper_pairings(gravity, values, count):
    params = ImprovedPca(gravity_known=gravity)
    found = _pairings(np.array(values), np.array([0.6, 0.3, 0.1]), params)
    assert len(found) == count
    assert all(np.linalg.det(pairing) == pytest.approx(1.0) for pairing in found)


def test_axes_follow_the_cloud():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * [5.0, 2.0, 1.0]
    turned = moved(points, motion(33.0, (1.0, 2.0, 3.0), 20.0))
    one = _axes(points, points.mean(axis=0))
    other = _axes(turned, turned.mean(axis=0))
    np.testing.assert_allclose(one.values, other.values, atol=1e-12)
    np.testing.assert_allclose(one.values.sum(), 1.0)
    rotation = motion(33.0, (0, 0, 0), 20.0)[:3, :3]
    cosines = np.abs((other.vectors * (rotation @ one.vectors)).sum(axis=0))
    np.testing.assert_allclose(cosines, 1.0, atol=1e-12)
