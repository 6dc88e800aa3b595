"""``run --full-resolution``: every station again, moved, nothing taken but what is not sure."""

import json
import re
import shutil
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

import dougong
from dougong.cli import call
from dougong.cloud import Cloud
from dougong.formats import read
from dougong.pipeline import full_resolution
from dougong.pipeline.full_resolution import output_names
from dougong.registration.result import Hypothesis, Registration
from e57_surveys import survey, turn
from reference.e57 import differing, rotation_of, tree, world


def motion():
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(*turn(0.3))
    matrix[:3, 3] = np.array([500_010, 4_000_005, 1.0]) - matrix[:3, :3] @ [500_000, 4_000_000, 0]
    return matrix


@pytest.fixture(autouse=True)
def short_cuts(monkeypatch):
    """No drawing, no search: this is about the files."""
    monkeypatch.setattr("dougong.report.render.overview", lambda *_: [])
    monkeypatch.setattr("dougong.report.render.slices", lambda *_: [])

    def register(source, target, params, **_):
        status = "ambiguous" if "2" in source.name else "ok"
        return Registration(
            status=status, matrix=motion(), reason="as the test says", probability=0.5, scale=1.0,
            dof=6, coarse_method="plan", margin=0.0, fine=None,
            hypotheses=(Hypothesis(T_target_source=motion(), score=0.7, method="plan"),),
        )  # fmt: skip

    monkeypatch.setattr("dougong.pipeline.links.register", register)


@pytest.fixture
def folder(tmp_path):
    survey(tmp_path / "stations.e57", scans=3, rows=60, columns=60)
    rng = np.random.default_rng(0)
    place = np.array([500_000.0, 4_000_000, 20])
    drone = Cloud.from_points(
        np.rint((place + rng.uniform(0, 10, (4000, 3))) * 1e3) / 1e3, crs="EPSG:32650"
    )
    dougong.write(drone, tmp_path / "drone.copc.laz")
    tower = Cloud.from_points(
        np.rint((place + rng.uniform(0, 10, (3000, 3))) * 1e4) / 1e4,
        intensity=rng.integers(0, 900, 3000).astype("u2"),
    )
    dougong.write(tower, tmp_path / "tower.laz")
    (tmp_path / "project.toml").write_text(
        '[[cloud]]\nname="scans"\nkind="lidar"\nfiles=["stations.e57"]\nregistered=false\n'
        '[[cloud]]\nname="tower"\nkind="lidar"\nfiles=["tower.laz"]\n'
        '[[cloud]]\nname="drone"\nkind="photogrammetry"\nfiles=["drone.copc.laz"]\n'
        # The survey is no building: keep the filters out of the way.
        "[filter.lidar.octree_voxel_grid]\nvoxel_m=0.001\n"
    )
    return tmp_path


def run(capsys, *tokens):
    code = call(["run", *map(str, tokens), "--json", "--quiet"])
    return code, json.loads(capsys.readouterr().out)


def test_every_station_is_issued_again(folder, capsys):
    code, result = run(
        capsys, folder / "project.toml", "--out", folder / "out", "--full-resolution"
    )
    assert code == 3, "one station is ambiguous"
    full = folder / "out" / "full"
    assert sorted(p.name for p in full.iterdir()) == [
        "drone.copc.laz", "drone.copc.laz.json", "stations.e57", "stations.e57.json",
        "tower.laz", "tower.laz.json",
    ]  # fmt: skip
    before, after = tree(folder / "stations.e57"), tree(full / "stations.e57")
    assert [after[f"/data3D/{k}/name"][1] for k in range(2)] == ["station 0", "station 2"]
    for new, old in enumerate((0, 2)):
        there, is_invalid = world(before, old)
        found, still_invalid = world(after, new)
        assert np.array_equal(is_invalid, still_invalid)
        expected = there @ motion()[:3, :3].T + motion()[:3, 3]
        assert np.abs(found - expected)[~is_invalid].max() < 1e-8
        for field in ("cartesianX", "intensity", "rowIndex", "acme:temperature"):
            one = before[f"/data3D/{old}/points/{field}"]
            assert np.array_equal(after[f"/data3D/{new}/points/{field}"], one)
    assert (full / "drone.copc.laz").read_bytes() == (folder / "drone.copc.laz").read_bytes()
    tower, was = read(full / "tower.laz"), read(folder / "tower.laz")
    assert len(tower) == 3000
    expected = was.frame.to_file(was.xyz) @ motion()[:3, :3].T + motion()[:3, 3]
    assert np.abs(tower.frame.to_file(tower.xyz) - expected).max() < 6e-5
    assert np.array_equal(tower.attribute("intensity"), was.attribute("intensity"))
    assert tower.frame.crs == read(folder / "drone.copc.laz").frame.crs
    books = json.loads((full / "stations.e57.json").read_text())
    assert [moved["station"] for moved in books["moved"]] == [0, 2]
    assert np.allclose(books["moved"][0]["matrix"], motion(), atol=0)
    assert len(books["stations"]) == 2
    assert books["input"]["sha256"] == result["inputs"][0]["sha256"]
    left = result["full_resolution"]["left_out"]
    assert [(entry["cloud"], entry["status"]) for entry in left] == [("scans-2", "ambiguous")]
    assert any("scans-2 is not written at full resolution" in note for note in result["notes"])


def test_it_is_not_done_unasked(folder, capsys):
    _, result = run(capsys, folder / "project.toml", "--out", folder / "out")
    assert result["full_resolution"] is None
    assert not (folder / "out" / "full").exists()


def test_the_project_file_can_ask(folder, capsys):
    path = folder / "project.toml"
    path.write_text("[project]\nfull_resolution=true\n" + path.read_text())
    _, result = run(capsys, path, "--out", folder / "out")
    assert len(result["full_resolution"]["files"]) == 3
    assert (folder / "out" / "full" / "tower.laz").is_file()


def test_a_reference_gets_the_system_that_the_user_gave(folder, capsys):
    (folder / "project.toml").write_text(
        '[project]\nreference="tower"\nfull_resolution=true\n'
        '[[cloud]]\nname="tower"\nkind="lidar"\nfiles=["tower.laz"]\ncrs="EPSG:32650"\n'
        '[[cloud]]\nname="drone"\nkind="photogrammetry"\nfiles=["drone.copc.laz"]\n'
    )
    code, answer = run(capsys, folder / "project.toml", "--out", folder / "out")
    assert code == 0, answer
    given, was = read(folder / "out" / "full" / "tower.laz"), read(folder / "tower.laz")
    assert was.frame.crs is None
    assert "32650" in given.frame.crs
    assert np.abs(given.frame.to_file(given.xyz) - was.frame.to_file(was.xyz)).max() < 1e-8
    assert "32650" in read(folder / "out" / "full" / "drone.laz").frame.crs


def test_too_little_disk_is_said_before_any_work(folder, capsys, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 10, 1000))
    code, answer = run(
        capsys, folder / "project.toml", "--out", folder / "out", "--full-resolution"
    )
    assert code == 1
    assert "at full resolution need about" in answer["error"]["message"]
    assert not (folder / "out").exists()


def test_ctrl_c_while_writing_leaves_nothing_and_it_goes_again(folder, capsys, monkeypatch):
    tokens = [folder / "project.toml", "--out", folder / "out", "--full-resolution"]

    def stop(*_args, **_options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("dougong.formats.las_reissue.las_parts", stop)
        assert run(capsys, *tokens)[0] == 130
    assert not (folder / "out").exists()
    assert not list(folder.glob("*.part-*"))
    code, result = run(capsys, *tokens)
    assert code == 3
    assert len(result["full_resolution"]["files"]) == 3


@pytest.mark.parametrize("when", ["before", "meanwhile", "gone"])
def test_a_file_replaced_during_the_run_is_refused(folder, capsys, monkeypatch, when):
    """It got the matrix and the hash of the file that had been registered."""
    tower = folder / "tower.laz"
    done = full_resolution._write

    def replaced(file, *rest):
        written = done(file, *rest)
        if (file == tower) == (when == "meanwhile"):
            tower.unlink()
            if when != "gone":
                dougong.write(read(folder / "drone.copc.laz"), tower)
        return written

    monkeypatch.setattr(full_resolution, "_write", replaced)
    tokens = [folder / "project.toml", "--out", folder / "out", "--full-resolution"]
    code, answer = run(capsys, *tokens)
    said = answer["error"]["message"]
    assert code == 1
    assert str(tower) in said
    words = "cannot be read any more" if when == "gone" else r"was changed or .* bytes of .* now\."
    assert re.search(words, said)
    assert not (folder / "out").exists()


def test_names():
    files = [("a", Path("x/1.e57")), ("b", Path("y/1.laz")), ("b", Path("z/1.e57"))]
    assert output_names([*files, ("c", Path("z/two.copc.laz"))]) == ["a-1", "b-1", "b-1-2", "two"]


def test_transform_of_e57_keeps_every_record(folder, capsys):
    matrix = folder / "m.json"
    matrix.write_text(json.dumps({"status": "ok", "matrix": motion().tolist()}))
    code = call(
        ["transform", str(folder / "stations.e57"), str(folder / "moved.e57"), "--json",
         "--quiet", "--matrix", str(matrix)]
    )  # fmt: skip
    answer = json.loads(capsys.readouterr().out)
    assert (code, answer["points"]) == (0, 3 * 3600)
    before, after = tree(folder / "stations.e57"), tree(folder / "moved.e57")
    changed = differing(before, after)
    assert all("/pose" in p or p in ("/guid", "/coordinateMetadata") for p in changed)
