"""A registration for CloudCompare, PDAL and Metashape: read again, applied to raw coordinates."""

import json
import os
import shutil
import subprocess
from xml.etree import ElementTree

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

import dougong
from dougong.cloud import Cloud, Frame
from dougong.pipeline.exports import Ends, global_shift, inverse, write_registration

PLACE = np.array([492_573.1234, 3_993_284.4567, 29.5])
UTM = CRS.from_epsg(32650).to_wkt()


def similarity(seed=1, scale=0.9995953):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(random_state=seed).as_matrix()
    matrix[:3, 3] = PLACE
    return matrix


@pytest.fixture
def points():
    """A scanner's own coordinates, and where they lie on the map."""
    here = np.round(np.random.default_rng(0).uniform(-60, 60, (500, 3)), 4)
    matrix = similarity()
    return here, here @ matrix[:3, :3].T + matrix[:3, 3], matrix


def ends(**more):
    target = Frame(origin=np.floor(PLACE - 40), crs=UTM)
    values = {
        "source": "scan", "target": "drone", "source_frame": Frame(origin=np.full(3, -60.0)),
        "target_frame": target, "files": ("scan.laz",), **more,
    }  # fmt: skip
    return Ends(**values)


def written(folder, matrix, status="ok", accept_best=False, **more):
    document = {
        "status": status, "matrix": None if matrix is None else matrix.tolist(),
        "parameters": {"accept_best": accept_best},
    }  # fmt: skip
    write_registration(folder, "scan", document, ends(**more))
    return {path.name.removeprefix("scan.") for path in folder.iterdir()}


def rows(text):
    return np.array([[float(v) for v in line.split()] for line in text.splitlines()[:4]])


def test_cloudcompare_takes_shifted_source_to_shifted_target(tmp_path, points):
    here, there, matrix = points
    written(tmp_path, matrix)
    text = (tmp_path / "scan.cloudcompare.txt").read_text()
    local = rows(text)
    shift = global_shift(ends().target_frame)
    np.testing.assert_array_equal(shift, [-493_000, -3_993_000, 0])
    assert "with the global shift -493000 -3993000 0" in text
    found = here @ local[:3, :3].T + local[:3, 3] - shift
    np.testing.assert_allclose(found, there, atol=2e-9)


def test_cloudcompare_between_two_maps(tmp_path, points):
    """Both ends large: the translation stays small, as float32 coordinates need."""
    here, there, matrix = points
    far = similarity(2, 1.0)
    source = here @ far[:3, :3].T + far[:3, 3]
    both = matrix @ inverse(far)
    frame = Frame(origin=np.floor(PLACE - 60))
    written(tmp_path, both, source_frame=frame)
    local = rows((tmp_path / "scan.cloudcompare.txt").read_text())
    assert np.abs(local[:3, 3]).max() < 2000
    found = (source + global_shift(frame)) @ local[:3, :3].T + local[:3, 3]
    np.testing.assert_allclose(found - global_shift(ends().target_frame), there, atol=5e-8)


def test_pdal_pipeline_holds_every_digit(tmp_path, points):
    here, there, matrix = points
    written(tmp_path, matrix)
    reader, move, writer = json.loads((tmp_path / "scan.pdal.json").read_text())["pipeline"]
    assert reader == "scan.laz"
    assert move["type"] == "filters.transformation"
    read = np.array(move["matrix"].split(), dtype=float).reshape(4, 4)
    np.testing.assert_array_equal(read, matrix)
    np.testing.assert_array_equal(here @ read[:3, :3].T + read[:3, 3], there)
    assert (writer["scale_x"], writer["offset_x"]) == (1e-4, "auto")
    assert CRS.from_wkt(writer["a_srs"]).to_epsg() == 32650


def test_metashape_transform_is_turn_scale_and_shift(tmp_path, points):
    here, there, matrix = points
    written(tmp_path, matrix, source='a "scan" & more')
    tree = ElementTree.fromstring((tmp_path / "scan.metashape.xml").read_text())
    assert tree.find("chunk").get("label") == 'a "scan" & more onto drone'
    turn, shift, scale = (
        np.array(tree.find(f"chunk/transform/{name}").text.split(), dtype=float)
        for name in ("rotation", "translation", "scale")
    )
    turn = turn.reshape(3, 3)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(scale * (here @ turn.T) + shift, there, atol=2e-9)


def test_the_inverse_goes_back_at_map_size(points):
    here, there, matrix = points
    back = inverse(matrix)
    np.testing.assert_allclose(there @ back[:3, :3].T + back[:3, 3], here, atol=5e-9)


@pytest.mark.parametrize(
    ("status", "accept_best", "is_written"),
    [("ok", False, True), ("ambiguous", False, False), ("ambiguous", True, True)],
)
def test_an_unsure_pose_is_not_handed_to_other_programs(tmp_path, status, accept_best, is_written):
    names = written(tmp_path, similarity(), status, accept_best)
    assert names == {"json", *(("cloudcompare.txt", "pdal.json", "metashape.xml") * is_written)}


def test_what_a_program_could_not_use_is_left_out(tmp_path):
    foot = Frame(origin=np.zeros(3), unit_m=(0.3048,) * 3)
    names = written(tmp_path, similarity(), source_frame=foot, files=())
    assert names == {"json", "cloudcompare.txt"}


def test_cloudcompare_itself_moves_the_cloud(tmp_path, points):
    program = shutil.which("CloudCompare")
    if program is None:
        pytest.skip("CloudCompare is not installed")
    here, there, matrix = points
    np.savetxt(tmp_path / "in.xyz", here, fmt="%.4f")
    written(tmp_path, matrix)
    subprocess.run(
        [program, "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-PREC", "9",
         "-O", "-GLOBAL_SHIFT", "0", "0", "0", "in.xyz",
         "-APPLY_TRANS", "scan.cloudcompare.txt", "-SAVE_CLOUDS", "FILE", "out.xyz"],
        check=True, capture_output=True, timeout=120, cwd=tmp_path,
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )  # fmt: skip
    moved = np.loadtxt(tmp_path / "out.xyz")[:, :3] - global_shift(ends().target_frame)
    # It holds coordinates as float32: 0.06 mm at some hundred metres.
    np.testing.assert_allclose(moved, there, atol=2e-4)


def test_pdal_itself_moves_the_cloud(tmp_path, points):
    program = shutil.which("pdal")
    if program is None:
        pytest.skip("PDAL is not installed")
    here, there, matrix = points
    dougong.write(Cloud.from_points(here), tmp_path / "scan.laz")
    written(tmp_path, matrix)
    subprocess.run([program, "pipeline", "scan.pdal.json"], check=True, cwd=tmp_path, timeout=120)
    moved = dougong.read(tmp_path / "scan_moved.laz")
    np.testing.assert_allclose(moved.frame.to_file(moved.xyz), there, atol=1.1e-4)
