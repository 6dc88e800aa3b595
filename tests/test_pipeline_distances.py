"""Distances of a registered pair: per face, in words, as a file and as columns of a cloud."""

import json
import re

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import read, write_merged
from dougong.pipeline.distances import (
    Painter,
    distances_document,
    measure,
    write_distances,
)
from dougong.pipeline.outputs import finite
from dougong.registration.result import FineResult, Registration
from test_registration_faces import house

MAP = np.array([500_000.0, 4_000_000.0, 100.0])
CRS = "EPSG:4549"


def wkt():
    import pyproj

    return pyproj.CRS(CRS).to_wkt()


def survey(seed, noise, north_m=0.0):
    """The house and its ground, dense and noisy; the north wall moved out by `north_m`."""
    rng = np.random.default_rng(seed)
    points, _, what, site = house()
    ground = site[-len(site) // 5 :]
    every = np.repeat(np.vstack([points, ground]), 8, axis=0)
    every[:, :2] += rng.uniform(-0.07, 0.07, (len(every), 2))
    every[:, 2] += rng.uniform(-0.07, 0.07, len(every)) * np.isin(
        np.repeat(what, 8).tolist() + ["ground"] * (8 * len(ground)),
        ["roof", "ground"],
        invert=True,
    )
    walls = np.repeat(what, 8)
    for name, axis, place in (
        ("north", 1, 8.0 + north_m), ("south", 1, 0.0), ("east", 0, 12.0), ("west", 0, 0.0),
    ):  # fmt: skip
        every[np.flatnonzero(walls == name), axis] = place
    return every + rng.normal(0, noise, every.shape)


def pose(covariance=None):
    fine = FineResult(
        T_target_source=np.eye(4), method="point-to-plane", iterations=1, stopped="", fitness=1.0,
        inlier_rmse_m=0.005, max_distance_m=0.1, overlap_source=1.0, overlap_target=1.0,
        covariance=covariance, covariance_about=np.zeros(3),
    )  # fmt: skip
    matrix = np.eye(4)
    matrix[:3, 3] = MAP
    return Registration(
        status="ok", matrix=matrix, reason="", probability=1.0, scale=1.0, dof=6,
        coarse_method="plan", hypotheses=(), margin=1.0, fine=fine,
    )  # fmt: skip


@pytest.fixture(scope="module")
def pair():
    source = Cloud.from_points(survey(0, 0.002, north_m=0.014), name="scan")
    target = Cloud.from_points(survey(1, 0.006) + MAP, name="drone", crs=wkt())
    return source, target


@pytest.fixture(scope="module")
def measured(pair):
    return measure(*pair, pose(np.diag([0.0, 0.0, 0.0, 1e-6, 1e-6, 1e-6])))


def test_the_face_that_stands_off_is_named_with_its_side_and_size(measured):
    document = distances_document(measured, "distances/scan.laz")
    json.dumps(finite(document), allow_nan=False)
    faces = {face["name"]: face for face in document["faces"]}
    north, south = faces["north facade"], faces["south facade"]
    assert north["median_m"] == pytest.approx(0.014, abs=0.001)
    assert north["stands"] == "in front of"
    assert north["significant_share"] > 0.9
    assert 0.001 < north["lod95_m"] < 0.01
    assert south["stands"] == "no difference can be told"
    assert south["significant_share"] < 0.3
    assert re.match(r"On the north facade \(1[12]\.\d x [34]\.\d m\) ", document["sentence"])
    assert "scan stands 14 mm in front of drone (level of detection" in document["sentence"]
    np.testing.assert_allclose(north["centre"][:2], MAP[:2] + [6.0, 8.0], atol=0.3)


def test_the_other_way_round_it_stands_behind(pair):
    source, target = pair
    back = Cloud.from_points(target.xyz + target.frame.origin - MAP, name="drone")
    there = Cloud.from_points(source.xyz + source.frame.origin + MAP, name="scan", crs=wkt())
    document = distances_document(measure(back, there, pose()), "x")
    assert "drone stands 14 mm behind scan" in document["sentence"]
    assert not document["has_registration_term"]


def test_the_core_points_are_a_file_others_can_open(measured, tmp_path):
    import laspy

    path = tmp_path / "distances" / "scan.laz"
    write_distances(measured, path)
    back = read(path)
    expected = measured.signed.core + measured.frame.origin
    order = np.lexsort(np.round(expected, 4).T)
    got = back.xyz + back.frame.origin
    np.testing.assert_allclose(got, expected, atol=2e-4)
    assert back.frame.crs is not None
    with laspy.open(path) as file:
        las = file.read()
    values = np.asarray(las["m3c2_distance"])
    assert values.dtype == np.float32
    np.testing.assert_array_equal(values[order], measured.distance_m.astype(np.float32)[order])
    assert np.isnan(values).any()
    assert "m3c2_lod95" in set(las.point_format.extra_dimension_names)


def test_merged_points_carry_the_distance_of_their_place(pair, measured, tmp_path):
    source, target = pair
    moved = source.moved(pose().matrix, target.frame)
    clouds = [Painter([measured]).painted(moved), Painter([measured]).painted(target)]
    write_merged(clouds, tmp_path / "merged.copc.laz", source_ids=[1, 2])
    back = read(tmp_path / "merged.copc.laz")
    distance = back.attribute("m3c2_distance")
    xyz = back.xyz + back.frame.origin - MAP
    north = (np.abs(xyz[:, 1] - 8.0) < 0.05) & (xyz[:, 2] > 1.0) & (xyz[:, 2] < 3.0)
    north &= (xyz[:, 0] > 1.0) & (xyz[:, 0] < 11.0)
    for source_id in (1, 2):
        own = north & (back.attribute("source_id") == source_id)
        assert np.isfinite(distance[own]).mean() > 0.95
        assert np.nanmedian(distance[own]) == pytest.approx(0.014, abs=0.001)
    nowhere = Painter([]).painted(target)
    assert np.isnan(nowhere.attribute("m3c2_distance")).all()


def test_distances_of_an_earlier_run_are_replaced_whatever_type_they_came_back_in():
    """A text file's column of zeros is read as whole numbers, which hold no distance."""
    cloud = Cloud.from_points(np.zeros((3, 3)), m3c2_distance=np.zeros(3, np.uint8))
    painted = Painter([]).painted(cloud)
    assert np.isnan(painted.attribute("m3c2_distance")).all()


def test_nothing_is_measured_without_a_pose_or_a_meeting(pair):
    from dataclasses import replace

    source, target = pair
    assert measure(source, target, replace(pose(), matrix=None)) is None
    far = pose()
    far.matrix[2, 3] += 50.0
    assert measure(source, target, far) is None
