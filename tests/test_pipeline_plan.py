"""`dougong plan` says what `dougong run` does."""

import json

import numpy as np
import pytest

from dougong.cli import call
from dougong.cloud import Cloud
from dougong.formats import write
from dougong.pipeline import memory


@pytest.fixture
def site(tmp_path):
    rng = np.random.default_rng(0)
    for name, count in (("scan", 30_000), ("drone", 8_000)):
        write(Cloud.from_points(rng.uniform(0, 20, (count, 3))), tmp_path / f"{name}.laz")
    return tmp_path


def planned(site, capsys, *options):
    files = ["--lidar", str(site / "scan.laz"), "--photogrammetry", str(site / "drone.laz")]
    code = call(["plan", *files, "--json", *options])
    return code, json.loads(capsys.readouterr().out)


def test_small_clouds_stay_in_memory(site, capsys):
    code, plan = planned(site, capsys)
    assert code == 0
    assert [(f["cloud"], f["points"], f["way"]) for f in plan["files"]] == [
        ("scan", 30_000, "in memory"),
        ("drone", 8_000, "in memory"),
    ]
    assert plan["reference"] == "drone"
    assert plan["refusal"] is None
    assert plan["memory_bytes"] == memory.estimated_bytes([30_000, 8_000])
    assert not list(site.glob("*.work"))


def test_a_scan_that_does_not_fit_goes_on_tiles(site, capsys, monkeypatch):
    monkeypatch.setattr(memory, "BASE_BYTES", 0)
    monkeypatch.setattr(memory, "LEAST_TILE_POINTS", 100)
    code, plan = planned(site, capsys, "--memory", "4MB")
    assert code == 0
    scan = plan["files"][0]
    assert scan["way"] == "on tiles"
    assert 100 <= scan["tile_points"] < 30_000
    assert plan["memory_bytes"] <= 4_000_000


def test_a_drone_cloud_that_does_not_fit_is_refused_by_plan_and_run_alike(site, capsys):
    code, plan = planned(site, capsys, "--memory", "200MB")
    assert code == 2
    assert "more than --memory" in plan["refusal"]
    files = ["--lidar", str(site / "scan.laz"), "--photogrammetry", str(site / "drone.laz")]
    assert call(["run", *files, "--out", str(site / "out"), "--memory", "200MB", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["message"] == plan["refusal"]
    assert not (site / "out").exists()


def test_people_read_a_table(site, capsys):
    assert call(["plan", "--lidar", str(site / "scan.laz")]) == 0
    said = capsys.readouterr().out
    for word in ("scan", "30,000", "in memory", "disk: at most", "time: about"):
        assert word in said


def test_no_cloud_is_one_sentence(capsys):
    assert call(["plan"]) == 2
    assert capsys.readouterr().err.startswith("error: ")
