"""Map projections between two clouds: the factor, where it applies, and what the pose gains."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from pyproj import CRS, Proj, Transformer
from scipy.spatial.transform import Rotation

from dougong.cloud import Cloud
from dougong.errors import FrameError, InputError
from dougong.evaluation.chart import Map, chart_of
from dougong.evaluation.metrics import pose_errors
from dougong.evaluation.scenes import make_scene
from dougong.formats.projection import axes_swapped, grid_scale, is_in_use, projection_problem
from dougong.formats.units import as_wkt
from dougong.pipeline import registering
from dougong.pipeline.ground import pair_on_ground
from dougong.registration import Register
from dougong.registration.result import Registration

UTM, XIAN = "EPSG:32650", "EPSG:4547"
PLACE = (410_000.0, 3_900_000.0, 1500.0)


def chart(epsg=32650, place=PLACE, yaw=0.7, raised=0.0):
    drawn = np.eye(4)
    drawn[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    easting, northing, height = place
    wanted = Map(
        epsg=epsg, easting_m=easting, northing_m=northing, height_m=height, heights_raised_m=raised
    )
    return chart_of(wanted, drawn)


@pytest.mark.parametrize(
    ("system", "place"),
    [
        ("EPSG:32650", (410_000, 3_900_000)),
        ("EPSG:4547", (520_000, 3_500_000)),  # axes northing, easting
        ("EPSG:2056", (2_700_000, 1_200_000)),  # oblique Mercator
        ("EPSG:2154", (700_000, 6_600_000)),  # Lambert conic
        ("EPSG:2225", (6_500_000, 2_100_000)),  # US survey feet
        ("EPSG:27700+5701", (400_000, 300_000)),  # compound
    ],
)
def test_point_scale_is_that_of_the_projections_own_formulas(system, place):
    crs = CRS.from_user_input(system)
    plan = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    to_degrees = Transformer.from_crs(plan, plan.geodetic_crs, always_xy=True)
    expected = Proj(plan).get_factors(*to_degrees.transform(*place))
    found = grid_scale(crs.to_wkt(), (*place, 0.0))
    assert found.point_scale == pytest.approx(np.sqrt(expected.areal_scale), abs=1e-8)
    assert found.height_factor == 1.0
    assert found.distortion < 1e-8


@pytest.mark.parametrize("height", [0.0, 45.0, 3650.0])
@pytest.mark.parametrize(("epsg", "place"), [(32650, PLACE), (4547, (520_000, 3_500_000, 0))])
def test_factor_is_the_exact_ratio_of_lengths_on_map_and_ground(epsg, place, height):
    exact = chart(epsg, (*place[:2], height))
    found = grid_scale(as_wkt(f"EPSG:{epsg}"), (*place[:2], height))
    assert 1e6 * (found.factor - exact.scale) == pytest.approx(0.0, abs=0.02)


def test_no_projection_no_factor():
    assert grid_scale(None, PLACE) is None
    assert grid_scale("EPSG:4979", (116.0, 39.0, 50.0)) is None
    # A scanner's own coordinates under a map's name are not on that map.
    assert grid_scale(UTM, (3.0, -2.0, 1.0)) is None
    assert not is_in_use(UTM, 3.0, -2.0)


def test_swapped_axes_and_web_maps_are_refused_by_name():
    assert axes_swapped(UTM, PLACE[1], PLACE[0])
    assert not axes_swapped(UTM, *PLACE[:2])
    assert "x = 3900000 is a northing" in projection_problem(
        UTM, (PLACE[1], PLACE[0], 0.0), "drone.laz"
    )
    assert projection_problem(UTM, PLACE, "drone.laz") is None
    web = projection_problem("EPSG:3857", (13_000_000, 4_000_000, 20), "web.laz")
    assert "depend on their direction" in web
    assert "UTM" in web
    cloud = Cloud.from_points([[4e6, 5e5, 1.0], [4e6 + 9, 5e5 + 9, 2.0]], name="drone", crs=UTM)
    with pytest.raises(FrameError, match=r"drone has its axes swapped.*easting first"):
        registering.register(cloud, Cloud.from_points([[0.0, 0, 0]]))


def test_mixed_units_are_refused_before_anything_is_searched():
    points = np.array(PLACE) + np.random.default_rng(0).uniform(0, 9, (50, 3))
    cloud = Cloud.from_points(points, name="mixed", crs="EPSG:26915+6360")
    cloud = replace(cloud, frame=replace(cloud.frame, unit_m=(1.0, 1.0, 1200 / 3937)))
    with pytest.raises(FrameError, match=r"mixed has heights in units of 0\.304801"):
        registering.register(cloud, Cloud.from_points(points))


def on(place, name, crs, seed=0):
    points = np.random.default_rng(seed).uniform(0, 30, (200, 3))
    return Cloud.from_points(points + place, name=name, crs=crs)


def decided(source, target, setting="auto"):
    pair, notes = pair_on_ground(source, target, setting)
    return pair, " ".join((*notes, *(pair.notes if pair else ())))


def test_which_cloud_is_metric():
    scan, drone = on((0, 0, 0), "scan", None), on(PLACE, "drone", UTM)
    pair, said = decided(scan, drone)
    assert (pair.source.factor, pair.origin) == (1.0, "crs")
    assert pair.factor == pytest.approx(grid_scale(UTM, np.add(PLACE, 15.0)).factor, abs=1e-6)
    assert "UTM zone 50N" in said
    assert "ppm" in said
    turned, _ = decided(drone, scan)
    assert turned.factor * pair.factor == pytest.approx(1.0, abs=1e-15)


def test_clouds_of_one_map_have_no_factor_between_them():
    assert decided(on(PLACE, "scan", UTM, 1), on(PLACE, "drone", UTM))[0] is None
    pair, said = decided(on(PLACE, "scan", None, 1), on(PLACE, "drone", UTM))
    assert pair is None
    assert "taken to be in the same one" in said


def test_a_site_grid_and_a_scanner_frame_may_hold_the_same_small_numbers():
    site = "+proj=tmerc +lat_0=35 +lon_0=116 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +type=crs"
    drone = on((0, 0, 3000.0), "drone", as_wkt(site))
    pair, _ = decided(on((0, 0, 0), "scan", None, 1), drone)
    assert 1e6 * (pair.factor - 1.0) == pytest.approx(-473, abs=5)  # 3000 m of height


def test_two_projections_have_the_ratio_of_their_factors():
    to_other = Transformer.from_crs(UTM, XIAN, always_xy=True)
    other = (*to_other.transform(*PLACE[:2]), PLACE[2])
    pair, _ = decided(on(PLACE, "scan", UTM), on(other, "drone", as_wkt(XIAN)))
    expected = chart(4547, other).scale / chart(32650, PLACE).scale
    assert 1e6 * (expected - 1.0) > 300.0
    assert 1e6 * (pair.factor - expected) == pytest.approx(0.0, abs=0.2)


def test_coordinates_that_no_map_has_are_ground_metres_and_said():
    pair, said = decided(on((0, 0, 0), "scan", UTM), on(PLACE, "drone", UTM))
    assert pair.source.factor == 1.0
    assert pair.target.factor < 1.0
    assert "scan names WGS 84 / UTM zone 50N, but its coordinates" in said
    pair, said = decided(on((120_000, 250_000, 0), "site grid", None), on(PLACE, "drone", UTM))
    assert pair.factor < 1.0
    assert "site grid has coordinates of map size" in said


def test_a_map_true_to_scale_leaves_scans_alone():
    place = (500_000, 3_500_000, 20)
    pair, said = decided(on((0, 0, 0), "scan", None), on(place, "drone", as_wkt("EPSG:4549")))
    assert pair is None
    assert "-5.7 ppm, too little to matter" in said
    given, _ = decided(on((0, 0, 0), "scan", None), on(place, "drone", UTM), 0.999995)
    assert given.factor == 0.999995


def test_the_factor_can_be_given_and_switched_off():
    scan, drone = on((0, 0, 0), "scan", None), on(PLACE, "drone", UTM)
    assert decided(scan, drone, "off") == (
        None,
        "map projections are taken to be true to scale (grid_scale = off)",
    )
    pair, said = decided(scan, drone, 0.99987)
    assert (pair.factor, pair.origin) == (0.99987, "given")
    assert "as given" in said
    with pytest.raises(InputError, match=r"neither scan nor scan is in a map projection"):
        pair_on_ground(scan, scan, 0.99987)
    assert Register(grid_scale="0.9996").grid_scale == 0.9996
    for wrong in ("foo", 1.5, "nan", True):
        with pytest.raises(ValidationError, match=r"neither auto, off nor a factor between"):
            Register(grid_scale=wrong)


def test_the_pose_is_written_between_files_with_the_factor(monkeypatch):
    """The search answers with the exact motion on the ground; the matrix must be the map's."""
    exact = chart()
    here = np.random.default_rng(5).uniform(-30, 30, (400, 3))
    here[:, 2] = np.abs(here[:, 2])
    there = exact.at(here)

    def on_ground(source, target, *_, **__):
        # Ground metres on both sides: the best rigid motion leaves nothing.
        a, b = source.xyz, target.xyz
        turn, left = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
        assert left / np.sqrt(len(a)) < 2e-4
        M = np.eye(4)
        M[:3, :3] = turn.as_matrix()
        M[:3, 3] = b.mean(0) + target.frame.origin - M[:3, :3] @ (a.mean(0) + source.frame.origin)
        return Registration(
            status="ok", matrix=M, reason="Found.", probability=1.0, scale=1.0, dof=6,
            coarse_method="plan", hypotheses=(), margin=1.0, fine=None,
        )  # fmt: skip

    monkeypatch.setattr(registering, "search", on_ground)
    result = registering.register(
        Cloud.from_points(here, name="scan"), Cloud.from_points(there, name="drone", crs=UTM)
    )
    linear = result.matrix[:3, :3]
    np.testing.assert_allclose(linear @ linear.T, result.scale**2 * np.eye(3), atol=1e-12)
    left = here @ linear.T + result.matrix[:3, 3] - there
    assert np.abs(left[:, :2]).max() < 3e-4  # of 12 mm that the factor takes away at 30 m
    height = np.abs(left[:, 2]).max()
    assert height < 1.1 * result.grid["height_error_m"] < 1.3 * height
    assert result.scale_source == "grid (crs)"
    middle = float(np.median(here[:, 2]))
    ppm = 1e6 * (chart(place=(*PLACE[:2], PLACE[2] + middle)).scale - 1.0)
    assert result.grid["ppm"] == pytest.approx(ppm, abs=0.05)
    assert f"({ppm:+.1f} ppm) for the map projection" in result.reason
    assert "scales heights as it scales the plan" in " ".join(result.notes)


@pytest.fixture(scope="module")
def scene_in_utm():
    """Scans in ground metres, the drone cloud in UTM, its heights raised as by a geoid."""
    there = Map(epsg=32650, heights_raised_m=45.0)
    return make_scene(
        "hall", 3, lidar_points=80_000, photogrammetry_points=50_000, bending=False, on_map=there
    )


@pytest.mark.parametrize(("setting", "bound"), [("auto", (0.0, 8.0)), ("off", (14.0, 40.0))])
def test_error_with_and_without_the_factor(scene_in_utm, setting, bound):
    scene = scene_in_utm
    result = registering.register(scene.lidar, scene.photogrammetry, Register(grid_scale=setting))
    assert result.status == "ok"  # 45 m between two height systems do not trouble the search
    errors = pose_errors(result.matrix, scene.truth)
    assert bound[0] <= 1e3 * errors.tre95_m <= bound[1]
    expected_ppm = 0.0 if setting == "auto" else 404.0
    # 45 m of geoid, taken for height above the ellipsoid, are 7 ppm.
    assert errors.scale_error_ppm == pytest.approx(expected_ppm, abs=7.2)
