"""Reference systems through every writer, and axes that were swapped or turned round."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS

import dougong
from dougong.cli import call
from dougong.cloud import Cloud, Frame
from dougong.errors import FrameError, InputError
from dougong.formats.check import check
from dougong.formats.units import as_wkt, in_system, is_same_crs, las_wkt, units_of
from dougong.pipeline import registering
from dougong.pipeline.axes import mirrored_axes, upside_down
from dougong.registration import Register
from dougong.registration.plan_search import PlanSearch
from dougong.registration.result import Registration
from registration_sites import SETTINGS, site

PLACE = np.array([500_000.0, 4_000_000.0, 30.0])
SYSTEMS = {
    "UTM": CRS.from_epsg(32650),
    "axes northing, easting": CRS.from_epsg(4549),
    "compound": CRS.from_user_input("EPSG:32650+5773"),
    "compound, heights in feet": CRS.from_user_input("EPSG:6346+6360"),
    "all in feet": CRS.from_user_input("EPSG:2225+6360"),
    "three-dimensional map": CRS.from_epsg(32650).to_3d(),
    "no code": CRS.from_proj4(
        "+proj=tmerc +lon_0=118.3 +k=1 +x_0=500000 +y_0=-3000000 +ellps=GRS80 +units=m +type=crs"
    ),
    "with a datum shift": CRS.from_proj4(
        "+proj=utm +zone=50 +ellps=krass +towgs84=20,-150,-80 +units=m +type=crs"
    ),
    "site grid": CRS.from_wkt(
        'ENGCRS["site",EDATUM["site"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],'
        'AXIS["z",up],LENGTHUNIT["metre",1]]'
    ),
}


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz", ".ply", ".e57"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_survives_every_writer(tmp_path, suffix, name):
    wkt = SYSTEMS[name].to_wkt()
    unit = units_of(wkt).unit_m
    points = PLACE + np.random.default_rng(0).uniform(0, 20, (50, 3))
    cloud = Cloud.from_points(points)
    frame = Frame(origin=np.floor(points.min(0) * unit), crs=wkt, unit_m=unit)
    cloud = replace(cloud, xyz=points * unit - frame.origin, frame=frame)
    dougong.write(cloud, tmp_path / f"a{suffix}")
    again = dougong.read(tmp_path / f"a{suffix}")
    metres = again.xyz + again.frame.origin
    by_x = [values[values[:, 0].argsort()] for values in (metres, points * unit)]
    np.testing.assert_allclose(*by_x, atol=1e-4)  # COPC has an order of its own
    if suffix == ".e57" and unit != (1.0, 1.0, 1.0):
        # E57 is in metres by definition: the same map, its axes in metres.
        assert again.frame.unit_m == (1.0, 1.0, 1.0)
        assert "in metres" in units_of(again.frame.crs).name
        return
    assert is_same_crs(again.frame.crs, wkt)
    assert again.frame.unit_m == pytest.approx(unit, rel=1e-12)


@pytest.mark.parametrize("code", ["EPSG:4549", "EPSG:31467", "EPSG:4549+5737", "EPSG:2053"])
def test_the_order_of_named_axes_makes_no_other_system(code):
    wkt = CRS.from_user_input(code).to_wkt()
    assert is_same_crs(wkt, las_wkt(wkt))
    assert as_wkt(las_wkt(wkt)) == as_wkt(wkt)
    assert not is_same_crs(wkt, CRS.from_epsg(4548).to_wkt())


def on_map(name, matrix=None, crs=None, seed=0):
    points = PLACE + np.random.default_rng(seed).uniform(0, 30, (300, 3))
    return Cloud.from_points(points if matrix is None else points @ np.array(matrix), name=name,
                             crs=crs)  # fmt: skip


SWAPPED = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (SWAPPED, "x and y are swapped"),
        (np.diag([-1, 1, 1]), "x is negated"),
        (np.diag([1, -1, 1]), "y is negated"),
    ],
)
def test_the_wrong_axis_is_named_between_clouds_of_one_map(matrix, said):
    wrong, right = on_map("scan", matrix, seed=1), on_map("drone", crs="EPSG:32650")
    for pair in ((wrong, right), (right, wrong)):
        text = mirrored_axes(*pair)
        assert text.startswith(f"scan is a mirror image of the site: {said}")
        with pytest.raises(FrameError, match=said):
            registering.register(*pair)


def test_right_axes_and_scanner_frames_are_left_alone():
    assert mirrored_axes(on_map("scan", seed=1), on_map("drone")) is None
    scan = Cloud.from_points(np.random.default_rng(2).uniform(-9, 9, (99, 3)))
    assert mirrored_axes(scan, on_map("drone")) is None


def test_check_names_swapped_axes(tmp_path):
    dougong.write(on_map("a", SWAPPED, "EPSG:32650"), tmp_path / "swapped.laz")
    worst = check(tmp_path / "swapped.laz")[0]
    assert worst.severity == "error"
    assert re.search(r"x = 40000\d\d is a northing", worst.text)


@pytest.mark.parametrize(
    ("flip", "said"), [((1, 1, -1), "negate z"), ((1, -1, -1), "Turn it by 180 deg")]
)
def test_a_cloud_with_z_down_is_told_from_one_on_its_head(flip, said):
    scan, drone = (
        Cloud.from_points(site(kind, seed), name=kind)
        for seed, kind in enumerate(("lidar", "photogrammetry"))
    )
    params = Register(prepare=SETTINGS, plan=PlanSearch(peaks=24), filtered=True)
    wrong = replace(scan, xyz=scan.xyz * np.array(flip, dtype=float))
    text = upside_down(wrong, drone, nothing(), params, "lidar", "photogrammetry")
    assert text.startswith("lidar fits only with its z turned round")
    assert said in text
    assert upside_down(scan, drone, nothing(), params, "lidar", "photogrammetry") is None


def nothing(matrix=None):
    return Registration(
        status="failed" if matrix is None else "ok", matrix=matrix, reason="", probability=0.0,
        scale=1.0, dof=6, coarse_method="plan", hypotheses=(), margin=0.0, fine=None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("systems", "rise", "is_said"),
    [
        (("EPSG:32650", "EPSG:32650+5773"), 45.0, True),
        (("EPSG:32650", "EPSG:32650"), -28.4, True),
        (("EPSG:32650", "EPSG:32650"), 0.3, False),
        (("EPSG:32650", "EPSG:32650"), 400.0, False),
        ((None, "EPSG:32650"), 45.0, False),
    ],
)
def test_heights_from_two_surfaces_are_named(monkeypatch, systems, rise, is_said):
    matrix = np.eye(4)
    matrix[2, 3] = rise
    monkeypatch.setattr(registering, "search", lambda *_, **__: nothing(matrix))
    pair = [on_map(name, crs=crs) for name, crs in zip(("scan", "drone"), systems, strict=True)]
    said = " ".join(registering.register(*pair).notes)
    assert (f"drone lies {rise:+.2f} m higher: as heights above the ellipsoid" in said) is is_said


def test_a_file_without_a_system_can_be_given_one():
    plain = on_map("drone.xyz")
    named = in_system(plain, "EPSG:32650+5773")
    np.testing.assert_array_equal(named.frame.to_file(named.xyz), plain.frame.to_file(plain.xyz))
    assert units_of(named.frame.crs).name == "WGS 84 / UTM zone 50N + EGM96 height"
    assert not named.is_moved
    assert in_system(named, named.frame.crs) is named
    assert in_system(plain, None) is plain


def test_feet_of_a_given_system_become_metres():
    feet = in_system(on_map("a"), "EPSG:2225+6360")
    unit = 1200 / 3937
    assert feet.frame.unit_m == pytest.approx((unit,) * 3)
    np.testing.assert_allclose(feet.frame.to_file(feet.xyz), on_map("a").xyz + PLACE // 1, atol=1)
    np.testing.assert_allclose(np.ptp(feet.xyz, axis=0), unit * np.ptp(on_map("a").xyz, axis=0))


def test_a_given_system_must_be_one_and_must_not_contradict_the_file():
    with pytest.raises(InputError, match=r"'nonsense' of a is not understood"):
        in_system(on_map("a"), "nonsense")
    with pytest.raises(FrameError, match="a names WGS 84 / UTM zone 50N itself"):
        in_system(on_map("a", crs="EPSG:32650"), "EPSG:32651")


def test_the_given_system_reaches_registration_and_result(tmp_path, monkeypatch, capsys):
    dougong.write(Cloud.from_points(SCAN), tmp_path / "scan.laz")
    np.savetxt(tmp_path / "drone.xyz", SCAN + PLACE, fmt="%.4f")
    monkeypatch.setattr(registering, "search", lambda *_, **__: nothing(np.eye(4)))
    for module in ("overview", "slices"):
        monkeypatch.setattr(f"dougong.report.render.{module}", lambda *_: [])
    tokens = ["register", str(tmp_path / "scan.laz"), str(tmp_path / "drone.xyz"), "--out",
              str(tmp_path / "out"), "--target-crs", "EPSG:32650", "--target-kind",
              "photogrammetry", "--source-kind", "lidar", "--quiet"]  # fmt: skip
    assert call(tokens) == 0, capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "registration.json").read_text())
    assert found["grid"]["target"]["system"] == "WGS 84 / UTM zone 50N"
    assert found["scale"] == pytest.approx(0.9996, abs=1e-5)
    assert "UTM zone 50N" in found["target_frame"]["crs_wkt"]


SCAN = np.random.default_rng(7).uniform(0, 20, (3000, 3))


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz", ".ply"])
@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("in", 0.0254), ("ftUS", 1200 / 3937)])
def test_a_unit_alone_is_a_system_of_local_coordinates(tmp_path, suffix, unit, metres):
    numbers = np.random.default_rng(0).uniform(0, 20, (50, 3)) / metres
    given = in_system(Cloud.from_points(numbers), unit)
    np.testing.assert_allclose(given.xyz + given.frame.origin, numbers * metres, atol=1e-9)
    dougong.write(given, tmp_path / f"a{suffix}")
    again = dougong.read(tmp_path / f"a{suffix}")
    assert again.frame.unit_m == pytest.approx((metres,) * 3, rel=1e-12)
    by_x = [v[v[:, 0].argsort()] for v in (again.xyz + again.frame.origin, numbers * metres)]
    np.testing.assert_allclose(*by_x, atol=1e-4)
    assert is_same_crs(again.frame.crs, given.frame.crs)


@pytest.mark.parametrize("is_tiled", [False, True])
def test_filter_takes_millimetres_for_what_they_are(tmp_path, is_tiled, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.filtering.is_too_large", lambda *_: is_tiled)
    points = site("photogrammetry")
    for name, factor in (("m", 1.0), ("mm", 1000.0)):
        dougong.write(Cloud.from_points(points * factor), tmp_path / f"{name}.ply")
    told = {}
    for name in ("m", "mm"):
        asked = ["--kind", "photogrammetry", "--crs", name, "--json"]
        assert call(["filter", f"{tmp_path}/{name}.ply", f"{tmp_path}/{name}.laz", *asked]) == 0
        told[name] = json.loads(capsys.readouterr().out)
    assert told["mm"]["points_kept"] == told["m"]["points_kept"] > 30_000
    assert told["mm"]["ground_points"] == told["m"]["ground_points"] > 0
    assert not any("millimetres" in note for note in told["mm"]["notes"])
    cleaned = [dougong.read(tmp_path / f"{name}.laz") for name in ("m", "mm")]
    by_x = [v[v[:, 0].argsort()] for v in (c.xyz + c.frame.origin for c in cleaned)]
    np.testing.assert_allclose(*by_x, atol=2e-4)


def test_local_coordinates_are_no_place_that_two_files_share(tmp_path, capsys):
    points = site("photogrammetry")
    dougong.write(Cloud.from_points(points * 1000.0), tmp_path / "a.ply")
    dougong.write(Cloud.from_points((points + [3.0, 1.0, 0.5]) * 1000.0), tmp_path / "b.ply")
    ends = [f"{tmp_path}/a.ply", f"{tmp_path}/b.ply", "--out", f"{tmp_path}/out"]
    units = ["--source-crs", "mm", "--target-crs", "mm", "--filtered", "--json"]
    assert call(["register", *ends, "--coarse", "none", *units]) in (0, 3)
    matrix = np.array(json.loads(capsys.readouterr().out)["matrix"])
    np.testing.assert_allclose(matrix[:3, 3], [3000.0, 1000.0, 500.0], atol=5.0)
    found = ["--matrix", f"{tmp_path}/out/registration.json", "--accept-best", "--json"]
    assert call(["transform", f"{tmp_path}/a.ply", f"{tmp_path}/moved.ply", *found]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert not any("moved twice" in note for note in notes)


def test_an_unknown_unit_is_told_the_known_ones():
    with pytest.raises(InputError, match=r"'furlong'.*mm, cm, m, in, ft or ftUS"):
        in_system(Cloud.from_points(PLACE[None]), "furlong")
