"""Contour feature points: on the outline and the eaves, not inside, not on the ground."""

import numpy as np
import pytest

from dougong.registration.contour import Contour, contour_points
from dougong.registration.prepare import prepare
from registration_sites import SETTINGS, as_cloud, motion, moved, polygon, site


@pytest.fixture(scope="module")
def drone():
    points = site("photogrammetry", seed=4, outline=polygon(6, 9.0), extras=False, size=16.0)
    return prepare(as_cloud(points), "photogrammetry", SETTINGS), as_cloud(points).frame.origin


def test_edges_lie_on_the_outline(drone):
    cloud, origin = drone
    chosen = contour_points(cloud)
    plan = (cloud.xyz + origin)[chosen, :2]
    # Distance from a hexagon's side: apothem minus the largest projection on the side normals.
    angle = np.radians(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    reach = (plan @ (polygon(6, 1.0) @ turn.T).T).max(axis=1)
    apothem = 9.0 * np.cos(angle)
    assert np.quantile(reach, 0.1) > apothem - 1.5
    assert reach.max() < 1.08 * apothem + 1.0
    assert not cloud.is_ground[chosen].any()


def test_they_are_few_unique_and_high(drone):
    cloud, _ = drone
    chosen = contour_points(cloud)
    assert 20 < len(chosen) < 0.5 * (~cloud.is_ground).sum()
    assert len(np.unique(chosen)) == len(chosen)
    assert np.median(cloud.height_above_ground[chosen]) > 4.0


def test_a_finer_percentile_finds_fewer(drone):
    cloud, _ = drone
    some = contour_points(cloud, Contour(high_percentile=80.0, low_share=1.0))
    few = contour_points(cloud, Contour(high_percentile=98.0, low_share=1.0))
    assert len(few) < len(some)


def test_a_cloud_of_ground_only_gives_points_still():
    rng = np.random.default_rng(0)
    plain = np.column_stack([*rng.uniform(0, 20, (2, 20_000)), rng.normal(0, 0.01, 20_000)])
    cloud = prepare(as_cloud(plain), "lidar", SETTINGS)
    assert len(contour_points(cloud)) >= 3


def test_translation_changes_nothing(drone):
    cloud, _ = drone
    points = site("photogrammetry", seed=4, outline=polygon(6, 9.0), extras=False, size=16.0)
    shifted = as_cloud(moved(points, motion(0.0, (4096.0, -512.0, 64.0))))
    other = prepare(shifted, "photogrammetry", SETTINGS)
    one = contour_points(cloud)
    two = contour_points(other)
    assert len(one) == pytest.approx(len(two), rel=0.02)
