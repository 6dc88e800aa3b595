"""One small demo through everything, and what can be done with its files afterwards."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import dougong
from dougong.cli import call

ROOT = Path(__file__).parents[1]


def run(capsys, *tokens):
    code = call([*map(str, tokens), "--quiet", "--json"])
    return code, json.loads(capsys.readouterr().out)


def crs_of(path):
    return dougong.describe(path).crs_name


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The folder and the answer of a small demo."""
    out = tmp_path_factory.mktemp("demo") / "hall"
    done = subprocess.run(
        [sys.executable, "-m", "dougong", "demo", "--size", "small", "--out", str(out), "--json"],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    return out, done


def test_the_demo_finds_the_pose_and_says_how_well(demo):
    out, done = demo
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["status"] == "ok"
    assert document["tre95_m"] <= 0.050
    assert document["rotation_error_deg"] <= 0.05
    assert 0 < document["bending_floor95_m"] < 0.1
    assert json.loads((out / "demo.json").read_text()) == document
    lines = done.stderr.splitlines()
    assert any("registering lidar onto drone" in line for line in lines)
    assert all(line.startswith(("[", "note: ")) for line in lines)


def test_the_result_has_the_files_of_the_contract(demo):
    out, _ = demo
    found = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert found == {
        "merged.copc.laz", "clouds/lidar.laz", "clouds/drone.laz", "registrations/lidar.json",
        "result.json", "report.html", "demo.json", "scene/lidar.laz", "scene/drone.laz",
        "scene/truth.json", "removed/lidar.laz", "removed/drone.laz", "distances/lidar.laz",
        "registrations/lidar.cloudcompare.txt", "registrations/lidar.pdal.json",
        "registrations/lidar.metashape.xml",
    }  # fmt: skip
    assert [path.name for path in out.parent.iterdir()] == ["hall"], "nothing is left beside it"


def test_result_json_tells_counts_parameters_and_provenance(demo):
    out, _ = demo
    result = json.loads((out / "result.json").read_text())
    for cloud in result["clouds"]:
        kept = dougong.describe(out / "clouds" / f"{cloud['name']}.laz").points
        assert kept == cloud["points_out"] == cloud["stages"][-1]["points_out"]
        assert sum(cloud["reasons"].values()) == cloud["points_in"]
    merged = result["merged"]
    offered = sum(cloud["points_out"] for cloud in result["clouds"])
    assert merged["points"] + merged["left_out"] == offered
    assert merged["sources"]["lidar"]["left_out"] < 0.01 * offered < merged["left_out"]
    assert result["merged"]["source_ids"] == {"lidar": 1, "drone": 2}
    assert {"read", "filter", "register", "write", "total"} <= set(result["seconds"])
    assert result["peak_memory_bytes"] > 10**8
    assert [len(entry["sha256"]) for entry in result["inputs"]] == [64, 64]
    assert result["inputs"][0]["path"] == str(out / "scene" / "lidar.laz")
    assert re.fullmatch("[0-9a-f]{64}", result["result_hash"])
    registration = json.loads((out / "registrations" / "lidar.json").read_text())
    assert registration == result["registrations"][0]


def test_no_result_names_the_folder_it_was_made_in(demo):
    out, _ = demo
    for path in (*out.glob("*.json"), *out.glob("*/*.json"), out / "report.html"):
        assert ".part-" not in path.read_text(encoding="utf-8"), path.name


def test_registration_json_keeps_the_contract(demo):
    out, _ = demo
    document = json.loads((out / "registrations" / "lidar.json").read_text())
    keys = {
        "status", "source", "target", "matrix", "scale", "dof", "coarse", "probability", "reason",
        "fine", "covariance", "covariance_about", "unobservable", "checks", "seconds", "dougong",
        "parameters", "inputs",
    }  # fmt: skip
    assert keys <= set(document)
    matrix = np.array(document["matrix"])
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    assert {"matrix", "score", "yaw_deg"} <= set(document["coarse"]["hypotheses"][0])
    scores = [entry["score"] for entry in document["coarse"]["hypotheses"]]
    assert 0 <= document["coarse"]["margin"] <= 1
    assert all(0 <= score <= 1 for score in scores)
    assert np.array(document["covariance"]).shape == (6, 6)


def test_the_merged_cloud_holds_both_in_one_frame(demo):
    out, _ = demo
    merged = dougong.read(out / "merged.copc.laz")
    source = merged.attribute("source_id")
    assert set(np.unique(source)) == {1, 2}
    assert crs_of(out / "merged.copc.laz") == crs_of(out / "scene" / "drone.laz")
    assert crs_of(out / "merged.copc.laz") is not None
    middles = [
        np.median(merged.frame.to_file(merged.xyz[source == part]), axis=0) for part in (1, 2)
    ]
    assert np.abs(middles[0] - middles[1]).max() < 30


def test_transform_repeats_what_the_run_did(demo, tmp_path, capsys):
    out, _ = demo
    moved = tmp_path / "moved.laz"
    registration = out / "registrations" / "lidar.json"
    code, document = run(
        capsys, "transform", out / "scene" / "lidar.laz", moved, "--matrix", registration
    )
    assert (code, document["status"]) == (0, "ok")
    cloud, before = dougong.read(moved), dougong.read(out / "scene" / "lidar.laz")
    matrix = np.array(document["matrix"])
    expected = before.frame.to_file(before.xyz) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(cloud.frame.to_file(cloud.xyz) - expected).max() < 2e-4
    np.testing.assert_array_equal(cloud.attribute("intensity"), before.attribute("intensity"))
    assert crs_of(moved) == crs_of(out / "scene" / "drone.laz")


def test_transform_refuses_the_cloud_that_stays(demo, tmp_path, capsys):
    """The drone cloud was moved by the matrix of the scan, with a hint that it may be so twice."""
    out, _ = demo
    tokens = ("transform", out / "scene" / "drone.laz", tmp_path / "moved.laz")
    code, answer = run(capsys, *tokens, "--matrix", out / "registrations" / "lidar.json")
    assert code == 2
    assert "is drone, onto which lidar was registered: it stays" in answer["error"]["message"]
    assert not (tmp_path / "moved.laz").exists()


@pytest.mark.parametrize("status", ["ambiguous", "failed"])
def test_transform_refuses_a_pose_that_is_not_sure(demo, status, tmp_path, capsys):
    out, _ = demo
    document = json.loads((out / "registrations" / "lidar.json").read_text())
    document |= {"status": status, "matrix": document["matrix"] if status != "failed" else None}
    registration = tmp_path / "registration.json"
    registration.write_text(json.dumps(document))
    tokens = (
        "transform",
        out / "scene" / "lidar.laz",
        tmp_path / "a.laz",
        "--matrix",
        registration,
    )
    code, answer = run(capsys, *tokens)
    assert code == (2 if status == "ambiguous" else 1)
    assert not (tmp_path / "a.laz").exists()
    code, answer = run(capsys, *tokens, "--accept-best")
    if status == "ambiguous":
        assert code == 0
        assert any("its best pose is applied" in note for note in answer["notes"])
    else:
        assert code == 1


def test_the_report_can_be_rebuilt_and_loads_nothing_from_elsewhere(demo, capsys):
    out, _ = demo
    page = (out / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"(src|href)=[\"'](?!data:)", page)
    assert not re.search(r"https?://(?!www\.w3\.org)", page)
    for said in ("Registered", "Pose error (TRE95)", "no accuracy grade is stated", "lidar", "mm"):
        assert said in page
    (out / "report.html").unlink()
    code, document = run(capsys, "report", out)
    assert (code, document["report"]) == (0, str(out / "report.html"))
    assert (out / "report.html").read_text(encoding="utf-8") == page


def test_a_finished_result_is_not_overwritten(demo, capsys):
    out, _ = demo
    tokens = ("run", "--lidar", out / "scene" / "lidar.laz", "--out", out)
    code, document = run(capsys, *tokens)
    assert code == 2
    assert "exists already" in document["error"]["message"]


def test_init_guesses_the_sensors_and_its_file_is_valid(demo, tmp_path, capsys):
    out, _ = demo
    for name in ("lidar.laz", "drone.laz"):
        (tmp_path / name).symlink_to(out / "scene" / name)
    code, document = run(capsys, "init", tmp_path)
    assert code == 0
    assert {cloud["name"]: cloud["kind"] for cloud in document["clouds"]} == {
        "lidar": "lidar",
        "drone": "photogrammetry",
    }
    from dougong.pipeline.project import read_project

    project = read_project(tmp_path / "project.toml")
    assert project.reference() == "drone"
    code, document = run(capsys, "init", tmp_path)
    assert (code, document["error"]["type"]) == (2, "InputError")


def test_the_readme_example_runs(demo, tmp_path, monkeypatch, capsys):
    out, _ = demo
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    example = re.search(r"```python\n(.*?)```", text, re.S)[1]
    assert len([line for line in example.splitlines() if line.strip()]) <= 7
    for name, file in (("scan", "lidar"), ("drone", "drone")):
        cloud = dougong.read(out / "clouds" / f"{file}.laz")
        dougong.write(cloud.select(np.arange(0, len(cloud), 4)), tmp_path / f"{name}.laz")
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    assert capsys.readouterr().out.startswith("ok ")
    assert len(dougong.read("scan_on_map.laz")) > 40_000


@pytest.mark.skipif(sys.platform == "win32", reason="signals are sent in another way")
def test_ctrl_c_ends_within_a_second_and_leaves_nothing_half_written(demo, tmp_path):
    out, _ = demo
    target = tmp_path / "result"
    command = [sys.executable, "-m", "dougong", "run", "--out", str(target)]
    command += ["--lidar", str(out / "scene" / "lidar.laz")]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        for line in process.stderr:
            if "curvature weighted" in line:
                break
        # Into the kernel, and well before the whole run is done.
        time.sleep(0.1)
        start = time.perf_counter()
        os.kill(process.pid, signal.SIGINT)
        rest = process.stderr.read()
        code = process.wait(timeout=20)
        # A second by contract; the machine may be busy with other tests.
        assert time.perf_counter() - start < 3.0
    assert code == 130
    assert "cancelled" in rest
    assert "Traceback" not in rest
    assert not target.exists()
    assert [path for path in tmp_path.iterdir() if "part" in path.name] == []


def test_a_run_goes_on_with_the_filter_steps_it_finished(demo, tmp_path, capsys):
    out, _ = demo
    tokens = ["run", "--lidar", out / "scene" / "lidar.laz", "--work", tmp_path / "work"]
    code, first = run(capsys, *tokens, "--out", tmp_path / "one")
    assert code == 0
    assert call([*map(str, tokens), "--out", str(tmp_path / "two"), "--json"]) == 0
    captured = capsys.readouterr()
    assert "not filtered again" in captured.err
    second = json.loads(captured.out)
    assert second["result_hash"] == first["result_hash"]
    assert second["clouds"] == [
        {**cloud, "files": second["clouds"][0]["files"]} for cloud in first["clouds"]
    ]
    page = (tmp_path / "two" / "report.html").read_text(encoding="utf-8")
    assert "nothing to register" in page
