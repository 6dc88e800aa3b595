"""What we write, read by programs that share no code with us or with each other's libraries.

E57: the Rust reader `e57` (libe57 and pye57 read it in the other tests). COPC: copclib, where it
is installed. LAZ and COPC: PDAL, where it is installed.
"""

import json
import shutil
import subprocess

import numpy as np
import pytest

from dougong.formats import read, reissue, write
from dougong.formats.e57_reissue import reissue_e57
from e57_surveys import survey
from test_formats_e57_write import las_like, motion


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    path = tmp_path_factory.mktemp("las") / "a.laz"
    write(las_like(60_000), path)
    return read(path)


def as_rust_reads(path):
    rust = pytest.importorskip("e57", reason="the Rust reader of E57 is not installed")
    return np.asarray(rust.read_points(str(path)).points)


@pytest.mark.parametrize("kind", ["scaled", "double", "single", "spherical"])
@pytest.mark.parametrize("how", ["moved", "scaled", "filtered"])
def test_the_rust_reader_sees_our_e57(tmp_path, kind, how):
    source = survey(tmp_path / "a.e57", kind=kind)
    if how == "filtered":
        write(read(source), tmp_path / "b.e57")
    else:
        matrix = motion(0.7, 0.9996 if how == "scaled" else 1.0)
        reissue_e57(source, tmp_path / "b.e57", [matrix] * 4, crs="EPSG:32650")
    ours = read(tmp_path / "b.e57")
    theirs = as_rust_reads(tmp_path / "b.e57")
    assert theirs.shape == ours.xyz.shape
    assert np.abs(theirs - ours.frame.to_file(ours.xyz)).max() < 5e-9


def test_the_rust_reader_sees_a_foreign_cloud(tmp_path, cloud):
    write(cloud, tmp_path / "a.e57")
    theirs = as_rust_reads(tmp_path / "a.e57")
    assert np.abs(theirs - cloud.frame.to_file(cloud.xyz)).max() < 2e-9


def test_copclib_reads_our_copc(tmp_path, cloud):
    copclib = pytest.importorskip("copclib", reason="copclib is not installed")
    write(cloud, tmp_path / "a.copc.laz")
    reader = copclib.FileReader(str(tmp_path / "a.copc.laz"))
    found = np.array([p for node in reader.GetAllNodes() for p in reader.GetPoints(node).x])
    assert reader.ValidateSpatialBounds()
    assert np.array_equal(np.sort(found), np.sort(cloud.frame.to_file(cloud.xyz)[:, 0]))


def test_pdal_reads_a_reissued_station(tmp_path, cloud):
    if shutil.which("pdal") is None:
        pytest.skip("PDAL is not installed")
    write(cloud, tmp_path / "a.laz")
    reissue(tmp_path / "a.laz", tmp_path / "b.laz", [motion()], cloud.frame)
    answer = subprocess.run(
        ["pdal", "info", "--summary", str(tmp_path / "b.laz")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    summary = json.loads(answer.stdout)["summary"]
    ours = read(tmp_path / "b.laz")
    assert summary["num_points"] == len(ours)
    low = ours.frame.to_file(ours.xyz).min(axis=0)
    assert [summary["bounds"][f"min{a}"] for a in "xyz"] == pytest.approx(low.tolist(), abs=1e-6)
    assert "32650" in json.dumps(summary["srs"])
