"""Normals point to the side that was seen, where that is sure: a roof has two sides."""

from dataclasses import replace

import numpy as np
import pytest

from dougong.cloud import Cloud, Frame
from dougong.registration.icp import refine
from dougong.registration.orientation import sights
from dougong.registration.prepare import Prepare, prepare

SETTINGS = Prepare(min_spacing_m=0.15)
THICK_M = 0.06


def patch(rng, corner, u, v, noise_m, per_m2=60.0):
    u, v = np.asarray(u, float), np.asarray(v, float)
    count = int(np.linalg.norm(np.cross(u, v)) * per_m2)
    at = np.asarray(corner) + rng.random((count, 1)) * u + rng.random((count, 1)) * v
    return at + rng.normal(0.0, noise_m, at.shape)


def pavilion(seed, roof_z, noise_m=0.003):
    """Ground, four walls, and one side of a wide flat roof on them."""
    rng = np.random.default_rng(seed)
    walls = [
        patch(rng, (-4, -3, 0), (8, 0, 0), (0, 0, 4), noise_m),
        patch(rng, (-4, 3, 0), (8, 0, 0), (0, 0, 4), noise_m),
        patch(rng, (-4, -3, 0), (0, 6, 0), (0, 0, 4), noise_m),
        patch(rng, (4, -3, 0), (0, 6, 0), (0, 0, 4), noise_m),
    ]
    ground = patch(rng, (-14, -14, 0), (28, 0, 0), (0, 28, 0), noise_m, 12.0)
    outside = (np.abs(ground[:, 0]) > 4) | (np.abs(ground[:, 1]) > 3)
    roof = patch(rng, (-7, -6, roof_z), (14, 0, 0), (0, 12, 0), noise_m)
    return np.vstack([ground[outside], *walls, roof])


def scan(knows_place):
    cloud = Cloud.from_points(pavilion(1, 4.0))
    place = np.array([[-6.0, -5.5, 1.7]])
    return replace(cloud, viewpoints=place - cloud.frame.origin) if knows_place else cloud


def height_of(source, target, is_naive=False):
    """Return the height by which the fit lifts the source; the true one is 0."""
    one, two = prepare(source, "lidar", SETTINGS), prepare(target, "photogrammetry", SETTINGS)
    if is_naive:
        one = replace(one, may_be_underside=False)
    T = np.eye(4)
    T[:3, 3] = source.frame.origin - target.frame.origin + [0.03, -0.02, 0.0]
    found = refine(one, two, T).T_target_source
    return float(found[2, 3] - (source.frame.origin - target.frame.origin)[2])


def test_a_roofs_top_does_not_pair_with_its_underside():
    flown = Cloud.from_points(pavilion(2, 4.0 + THICK_M, 0.015))
    assert abs(height_of(scan(knows_place=True), flown)) < 0.0015
    # Without the scanner's place nothing says which side it saw, so the roof has no say.
    assert abs(height_of(scan(knows_place=False), flown)) < 0.0015
    # Were its points taken for tops, it would pull the scan up.
    assert height_of(scan(knows_place=False), flown, is_naive=True) > 0.004


def test_a_drone_saw_tops_and_every_sensor_saw_ground_from_above():
    flown = prepare(Cloud.from_points(pavilion(2, 4.06)), "photogrammetry", SETTINGS)
    is_roof = (flown.xyz[:, 2] > 3.9) & (np.abs(flown.normals[:, 2]) > 0.97)
    assert flown.normal_is_oriented[is_roof].mean() > 0.95
    assert (flown.normals[is_roof & flown.normal_is_oriented, 2] > 0).all()
    scanned = prepare(scan(knows_place=False), "lidar", SETTINGS)
    sure = scanned.normal_is_oriented
    assert sure[scanned.is_ground].mean() > 0.9
    assert not sure[scanned.height_above_ground > 1.3].any()


def test_a_scanner_saw_what_faces_it():
    scanned = prepare(scan(knows_place=True), "lidar", SETTINGS)
    sure = scanned.normal_is_oriented
    is_roof = (scanned.xyz[:, 2] > 3.9) & sure & (np.abs(scanned.normals[:, 2]) > 0.97)
    assert is_roof.sum() > 200
    assert (scanned.normals[is_roof, 2] < 0).all()


@pytest.mark.parametrize("place", [(500.0, 0.0, 1.7), (-4.0, 0.0, 2.0), (np.nan, 0.0, 0.0)])
def test_a_place_where_no_scanner_stood_is_not_believed(place):
    points = pavilion(1, 4.0)
    points[0] = (-4.0, 0.0, 2.1)
    cloud = Cloud.from_points(points)
    cloud = replace(cloud, viewpoints=np.array([place]) - cloud.frame.origin)
    assert sights(cloud, np.arange(len(points))) is None


def test_viewpoints_move_with_the_cloud():
    cloud = scan(knows_place=True)
    T = np.eye(4)
    T[:3, 3] = 100.0, 200.0, 3.0
    moved = cloud.moved(T, Frame(origin=np.array([90.0, 190.0, 0.0])))
    want = cloud.viewpoints + cloud.frame.origin + [10.0, 10.0, 3.0]
    np.testing.assert_allclose(moved.viewpoints, want)
    np.testing.assert_allclose(
        cloud.rebased(np.zeros(3)).viewpoints, cloud.viewpoints + cloud.frame.origin
    )


def test_each_station_has_its_own_place():
    cloud = scan(knows_place=True)
    station = (np.arange(len(cloud)) % 2).astype(np.uint16)
    both = np.vstack([cloud.viewpoints, cloud.viewpoints + [11.0, 10.0, 0.0]])
    cloud = replace(cloud.with_attribute("station", station), viewpoints=both)
    found = sights(cloud, np.arange(len(cloud)))
    np.testing.assert_allclose(found, both[station])
