"""`dougong plan` says what `dougong run` does."""

import inspect
import json
import shutil

import laspy
import numpy as np
import pytest

from dougong.cli import call, plan
from dougong.cli import run as run_command
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


def test_plan_takes_the_arguments_of_run(site, capsys):
    taken = inspect.signature(plan.command).parameters
    assert set(inspect.signature(run_command.command).parameters) <= set(taken)
    out = site / "result"
    code, document = planned(site, capsys, "--out", str(out), "--merge", "all")
    assert (code, document["refusal"]) == (0, None)
    out.mkdir()
    (out / "result.json").touch()
    code, document = planned(site, capsys, "--out", str(out))
    assert (code, len(document["files"])) == (2, 2)
    assert "result.json exists already" in document["refusal"]
    assert planned(site, capsys, "--out", str(out), "--overwrite")[0] == 0


def test_a_scan_that_does_not_fit_goes_on_tiles(site, capsys, monkeypatch):
    monkeypatch.setattr(memory, "BASE_BYTES", 0)
    monkeypatch.setattr(memory, "LEAST_TILE_POINTS", 100)
    monkeypatch.setattr(memory, "BYTES_PER_REDUCED_POINT", 50)
    code, plan = planned(site, capsys, "--memory", "4MB")
    assert code == 0
    stages = {stage["name"]: stage for stage in plan["stages"]}
    assert list(stages) == [
        "filter scan", "filter drone", "register", "distances", "merge", "write", "hash", "report",
    ]  # fmt: skip
    assert stages["filter scan"]["tiles"] >= 4
    assert stages["filter drone"]["tiles"] == 0
    assert plan["work_bytes"] == max(stage["work_bytes"] for stage in plan["stages"])
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


def test_a_registration_that_does_not_fit_is_refused(site, capsys, monkeypatch):
    monkeypatch.setattr(memory, "BASE_BYTES", 0)
    monkeypatch.setattr(memory, "LEAST_TILE_POINTS", 100)
    monkeypatch.setattr(memory, "BYTES_PER_REDUCED_POINT", 1000)
    code, plan = planned(site, capsys, "--memory", "4MB")
    assert code == 2
    assert "register" in plan["refusal"]


def test_a_full_disk_is_refused_before_anything_is_read(site, capsys, monkeypatch):
    _give_disk(monkeypatch, site, [1000])
    assert call(_run_of(site)) == 1
    assert "free, and the run needs about" in capsys.readouterr().err
    assert not list(site.glob("out*"))


def test_a_disk_that_only_the_upper_bound_does_not_fit_is_said_and_tried(site, capsys, monkeypatch):
    _give_disk(monkeypatch, site, [200_000])
    assert call(_run_of(site)) in (0, 3)
    assert "less where the filters take much" in capsys.readouterr().err


def test_a_disk_too_full_for_what_the_filters_left_is_refused_and_the_run_goes_on_later(
    site, capsys, monkeypatch
):
    _give_disk(monkeypatch, site, [10**12, 1000])
    assert call(_run_of(site)) == 1
    assert "free, and what the filters left need about" in capsys.readouterr().err
    assert not (site / "out").exists()
    monkeypatch.undo()
    assert call(_run_of(site)) in (0, 3)
    assert "filtered in an earlier run; not filtered again" in capsys.readouterr().err


def _run_of(site):
    files = ["--lidar", str(site / "scan.laz"), "--photogrammetry", str(site / "drone.laz")]
    return ["run", *files, "--out", str(site / "out"), "--memory", "4GB"]


def _give_disk(monkeypatch, folder, free):
    """Let the disk have so many bytes free, one number per time of asking, the last for good."""
    usage, asked = shutil.disk_usage(folder), iter(free)
    said = lambda _: usage._replace(free=next(asked, free[-1]))  # noqa: E731
    monkeypatch.setattr("dougong.pipeline.refusals.shutil.disk_usage", said)


def test_people_read_a_table(site, capsys):
    assert call(["plan", "--lidar", str(site / "scan.laz")]) == 0
    said = capsys.readouterr().out
    for word in ("scan", "30,000", "in memory", "disk: at most", "time: about"):
        assert word in said


def test_no_cloud_is_one_sentence(capsys):
    assert call(["plan"]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_a_cloud_without_points_is_refused_before_the_run(site, capsys):
    laspy.LasData(laspy.LasHeader(point_format=6, version="1.4")).write(site / "void.las")
    files = [*("--lidar", str(site / "scan.laz")), *("--lidar", str(site / "void.las"))]
    for command in (["plan"], ["run", "--out", str(site / "result")]):
        assert call([*command, *files, "--memory", "4GB"]) == 1
        shown = capsys.readouterr()
        assert "void.las holds no points" in shown.err
        assert "reading scan" not in shown.err
