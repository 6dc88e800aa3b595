"""Preparation: noise and far points go, ground and heights are right, tilts are judged soberly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong.cloud import Cloud
from dougong.errors import RegistrationError
from dougong.registration.cleaning import far_points, isolated_points, sensor_noise
from dougong.registration.levelling import levelling, rotation_to_vertical
from dougong.registration.prepare import Prepare, describe, prepare, thin
from registration_sites import L_PLAN, SETTINGS, as_cloud, motion, moved, site, walls


@pytest.fixture(scope="module")
def clean():
    return site("photogrammetry", seed=5)


def test_facts_about_a_clean_site(clean):
    found = prepare(as_cloud(clean), "photogrammetry", SETTINGS)
    assert np.linalg.norm(found.normals, axis=1) == pytest.approx(1.0)
    true_height = moved(found.xyz, motion(0.0, as_cloud(clean).frame.origin))[:, 2]
    is_low = true_height < 0.06
    assert found.is_ground[is_low].mean() > 0.97
    assert found.is_ground[true_height > 0.5].mean() < 0.02
    error = np.abs(found.height_above_ground - true_height)
    assert np.median(error) < 0.03
    assert error.max() < 0.6  # where the cloth leans on a wall's foot
    assert found.has_ground
    assert found.sigma_m == pytest.approx(0.012, rel=0.35)
    # The points of a plane stand for its area.
    assert found.weights_area[is_low].sum() == pytest.approx(60 * 60 - 236, rel=0.25)


def test_outliers_are_dropped_and_counted(clean):
    rng = np.random.default_rng(1)
    noise = rng.uniform([-30, -30, -6], [30, 30, 20], (len(clean) // 20, 3))
    far = np.array([[1e6, 0.0, 0.0], [0.0, 0.0, -9e4]])
    cloud = as_cloud(np.vstack([clean, noise, far]))
    found = prepare(cloud, "photogrammetry", SETTINGS)
    height = found.xyz[:, 2] + cloud.frame.origin[2]
    assert height.min() > -1.0
    assert np.ptp(found.xyz, axis=0).max() < 100.0
    assert any("2 of" in note and "far off" in note for note in found.notes)
    assert any("stand alone" in note for note in found.notes)


def test_strays_beside_the_surfaces_are_dropped_where_there_are_many(clean):
    rng = np.random.default_rng(2)
    count = len(clean) // 8
    strays = clean[rng.integers(0, len(clean), count)] + rng.normal(0, 1.5, (count, 3))
    cloud = as_cloud(np.vstack([clean, strays]))
    is_stray = {tuple(point) for point in cloud.xyz[len(clean) :]}
    thinned, undisturbed = (thin(each, SETTINGS) for each in (cloud, as_cloud(clean)))
    found = describe(thinned.without_strays(), "photogrammetry", SETTINGS)
    left = sum(tuple(point) in is_stray for point in found.xyz)
    assert undisturbed.without_strays() is undisturbed
    assert left < 0.2 * count
    assert len(found.xyz) - left > 0.95 * len(undisturbed.kept)
    assert any("stand off every surface: dropped" in note for note in found.notes)
    assert not any("stand off" in note for note in prepare(cloud, "lidar", SETTINGS).notes)


def test_order_and_origin_play_no_part(clean):
    one = prepare(as_cloud(clean), "lidar", SETTINGS)
    base = as_cloud(clean)
    reversed_cloud = Cloud.from_points(clean[::-1])
    other = prepare(reversed_cloud, "lidar", SETTINGS)
    assert base.frame.origin.tolist() == reversed_cloud.frame.origin.tolist()
    a, b = (np.lexsort(found.xyz.T) for found in (one, other))
    np.testing.assert_array_equal(one.xyz[a], other.xyz[b])
    np.testing.assert_array_equal(one.is_ground[a], other.is_ground[b])
    np.testing.assert_allclose(one.weights_area[a], other.weights_area[b])
    assert one.sigma_m == pytest.approx(other.sigma_m, rel=1e-9)


def test_kept_points_are_original_points(clean):
    cloud = as_cloud(clean)
    found = prepare(cloud, "lidar", SETTINGS)
    originals = {tuple(point) for point in cloud.xyz}
    assert all(tuple(point) in originals for point in found.xyz[::50])
    assert len(found.xyz) < len(clean)


def test_number_of_points_is_bounded(clean):
    found = prepare(as_cloud(clean), "lidar", Prepare(min_spacing_m=0.05, max_points=15_000))
    assert 5_000 < len(found.xyz) <= 15_000


def test_without_ground_heights_start_near_the_lowest_points():
    rng = np.random.default_rng(0)
    wall = walls(rng, L_PLAN, 2.0, 8.0, 60.0)
    found = prepare(as_cloud(wall), "lidar", SETTINGS)
    assert found.height_above_ground.min() > -1.0
    assert 4.0 < found.height_above_ground.max() < 7.0


def test_too_few_points_are_refused():
    with pytest.raises(RegistrationError, match="usable points"):
        prepare(as_cloud(np.random.default_rng(0).random((50, 3))), "lidar")


def test_a_tilted_instrument_is_levelled_by_its_walls():
    tilted = moved(site("lidar", seed=3), motion(30.0, (0, 0, 0), 3.0))
    found = prepare(as_cloud(tilted), "lidar", SETTINGS)
    true_up = motion(30.0, (0, 0, 0), 3.0)[:3, 2]
    assert found.is_relevelled
    assert np.degrees(np.arccos(found.up @ true_up)) < 0.3
    assert any("levelled by the walls" in note for note in found.notes)


def test_a_level_instrument_stays_level():
    found = prepare(as_cloud(site("lidar", seed=3)), "lidar", SETTINGS)
    assert not found.is_relevelled
    assert found.levelling.tilt_deg < 3.0 * found.levelling.sigma_deg + 0.1
    assert found.levelling.tilt_deg + 2.0 * found.levelling.sigma_deg < 1.0


def test_a_badly_tilted_cloud_is_refused():
    tilted = moved(site("lidar", seed=3), motion(30.0, (0, 0, 0), 8.5))
    with pytest.raises(RegistrationError, match=r"not levelled.*8\.\d deg"):
        prepare(as_cloud(tilted), "lidar", SETTINGS)


def test_leaning_walls_on_level_ground_do_not_fake_a_tilt():
    """A corner of a battered wall: both faces lean 5 degrees the way a tilted scanner shows."""
    rng = np.random.default_rng(2)
    lean = np.tan(np.radians(5.0))
    u, h = rng.uniform(0, 30, 40_000), rng.uniform(0, 8, 40_000)
    half = len(u) // 2
    front = np.column_stack([u[:half], h[:half] * lean, h[:half]])
    side = np.column_stack([h[half:] * lean, u[half:], h[half:]])
    ground = np.column_stack([*rng.uniform(-20, 0, (2, 40_000)), np.zeros(40_000)])
    points = np.vstack([front, side, ground]) + rng.normal(0, 0.003, (80_000, 3))
    found = prepare(as_cloud(points), "lidar", SETTINGS)
    assert found.levelling.tilt_deg > 2.0  # the walls alone would say so
    assert not found.is_relevelled


def test_levelling_says_nothing_where_there_are_no_walls():
    rng = np.random.default_rng(0)
    points = np.column_stack([*rng.uniform(0, 30, (2, 5000)), np.zeros(5000)])
    normals = np.tile([0.0, 0.0, 1.0], (5000, 1))
    found = levelling(points, normals, np.ones(5000))
    assert found.sigma_deg == np.inf
    assert not found.is_tilted(0.1)


def test_rotation_to_vertical_is_the_smallest():
    up = np.array([0.06, -0.03, 1.0])
    up /= np.linalg.norm(up)
    rotation = rotation_to_vertical(up)
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    angle = np.arccos((np.trace(rotation) - 1) / 2)
    assert angle == pytest.approx(np.arccos(up[2]))


@pytest.mark.parametrize("sigma", [0.002, 0.02])
def test_sensor_noise_of_planes_is_recovered(sigma):
    rng = np.random.default_rng(0)
    points = np.vstack([site("lidar", seed=1, per_m2=100.0)])
    points = points + rng.normal(0, 1, points.shape) * np.sqrt(max(sigma**2 - 0.003**2, 0))
    assert sensor_noise(points) == pytest.approx(max(sigma, 0.003), rel=0.35)


def test_far_and_isolated_points_are_told_apart():
    rng = np.random.default_rng(0)
    surface = np.column_stack([*rng.uniform(0, 20, (2, 20_000)), rng.normal(0, 0.01, 20_000)])
    points = np.vstack([surface, [[10.0, 10.0, 5.0]], [[5000.0, 0.0, 0.0]]])
    assert np.flatnonzero(far_points(points)).tolist() == [20_001]
    assert np.flatnonzero(isolated_points(points[:-1])).tolist() == [20_000]


def round_walls(batter_deg, tilt_deg=0.0, slope=0.0):
    """Return a round building's outer and inner wall, leaning to its middle: points, normals."""
    rng = np.random.default_rng(0)
    turn, height = rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(0, 11, 20_000)
    side = np.where(rng.random(20_000) < 0.7, 1.0, -1.0)
    lean = np.radians(batter_deg)
    radius = np.where(side > 0, 25.0, 20.0) - side * height * np.tan(lean)
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(20_000)])
    points = radius[:, None] * out + height[:, None] * [0, 0, 1]
    normals = side[:, None] * out * np.cos(lean) + [0, 0, np.sin(lean)]
    T = np.array(Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix())
    floor = np.tile([0.0, np.sin(slope), np.cos(slope)], (4000, 1))
    ground = np.column_stack([rng.uniform(-30, 30, (4000, 2)), np.zeros(4000)])
    return np.vstack([points, ground]) @ T.T, np.vstack([normals, floor]) @ T.T


def test_a_battered_round_building_is_no_tilted_instrument():
    # The ground falls by 2 degrees: it cannot tell which of the two it is.
    points, normals = round_walls(2.5, slope=-0.035)
    turn = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360.0
    # Some of the wall was not seen.
    seen = (turn > 40.0) | (normals[:, 2] > 0.9)
    found = levelling(points[seen], normals[seen], np.full(int(seen.sum()), 0.1))
    assert not found.is_tilted(0.6), found
    assert found.battered > 0.8


def test_an_upright_round_building_shows_a_tilted_instrument():
    points, normals = round_walls(0.0, tilt_deg=3.0)
    found = levelling(points, normals, np.full(len(points), 0.1))
    assert found.is_tilted(0.6), found
    assert found.tilt_deg == pytest.approx(3.0, abs=0.1)
