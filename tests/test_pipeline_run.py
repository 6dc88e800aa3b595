"""The main job around the registration: who moves, what is merged, exit codes, what is kept."""

import errno
import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import dougong
from dougong.cli import call
from dougong.cloud import Cloud
from dougong.filters.selection import Reason
from dougong.formats.atomic import replacing
from dougong.pipeline.exports import inverse
from dougong.pipeline.removed import removed_sample
from dougong.registration import Register
from dougong.registration.result import Hypothesis, Registration

SHIFT = np.array([3.0, -2.0, 0.5])


def cloud(seed, offset=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(0, 10, (4000, 2)), rng.normal(0, 0.003, 4000)])
    wall = np.column_stack([rng.uniform(3, 7, 2000), np.full(2000, 5.0), rng.uniform(0, 3, 2000)])
    return Cloud.from_points(np.vstack([floor, wall]) + offset)


def answer(status):
    """A registration that says `status` and shifts by SHIFT."""

    def register(source, target, params, *, source_kind, target_kind, control=None, **_):
        assert params.filtered
        matrix = np.eye(4)
        matrix[:3, 3] = SHIFT
        found = status[source.name] if isinstance(status, dict) else status
        return Registration(
            status=found,
            matrix=None if found == "failed" else matrix,
            reason="as the test says",
            probability=0.5,
            scale=1.0,
            dof=6,
            coarse_method="plan",
            hypotheses=(Hypothesis(T_target_source=matrix, score=0.7, method="plan"),),
            margin=0.0,
            fine=None,
        )

    return register


@pytest.fixture
def folder(tmp_path):
    dougong.write(cloud(0), tmp_path / "one.laz")
    dougong.write(cloud(1), tmp_path / "two.laz")
    dougong.write(cloud(2, SHIFT), tmp_path / "map.laz")
    return tmp_path


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch):
    """The pages keep their words; drawing has tests of its own."""
    monkeypatch.setattr("dougong.report.render.overview", lambda *_: [])
    monkeypatch.setattr("dougong.report.render.slices", lambda *_: [])


def run(capsys, *tokens):
    code = call(["run", *map(str, tokens), "--json", "--quiet"])
    return code, json.loads(capsys.readouterr().out)


def clouds(folder, *, registered="true", more=""):
    text = (
        f'[[cloud]]\nname="scans"\nkind="lidar"\nfiles=["one.laz","two.laz"]\n'
        f'registered={registered}\n[[cloud]]\nname="map"\nkind="photogrammetry"\n'
        f'files=["map.laz"]\n{more}'
    )
    path = folder / "project.toml"
    path.write_text(text)
    return path


def test_files_of_one_cloud_move_together(folder, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.links.register", answer("ok"))
    code, result = run(capsys, clouds(folder), "--out", folder / "out")
    assert code == 0
    assert [entry["name"] for entry in result["clouds"]] == ["scans", "map"]
    assert result["clouds"][0]["points_in"] == 12_000
    assert result["merged"]["source_ids"] == {"scans": 1, "map": 2}
    merged = dougong.read(folder / "out" / "merged.copc.laz")
    books = result["merged"]
    offered = sum(entry["points_out"] for entry in result["clouds"])
    assert len(merged) == books["points"] == offered - books["left_out"]
    source = merged.attribute("source_id")
    low = [merged.frame.to_file(merged.xyz[source == part]).min(axis=0) for part in (1, 2)]
    np.testing.assert_allclose(low[0], low[1], atol=0.1)
    both = dougong.read(folder / "out" / "clouds" / "scans.laz")
    assert len(both) == result["clouds"][0]["points_out"]


def test_the_option_brings_every_point_back(folder, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.links.register", answer("ok"))
    _, best = run(capsys, clouds(folder), "--out", folder / "best")
    _, every = run(capsys, clouds(folder), "--out", folder / "all", "--merge", "all")
    assert every["merged"]["left_out"] == 0 < best["merged"]["left_out"]
    assert every["merged"]["points"] == sum(entry["points_out"] for entry in every["clouds"])
    assert best["result_hash"] == every["result_hash"]
    more = '[merge]\nmode = "all"\n'
    _, by_file = run(capsys, clouds(folder, more=more), "--out", folder / "file")
    assert by_file["merged"]["points"] == every["merged"]["points"]
    page = (folder / "best" / "report.html").read_text()
    assert f"{best['merged']['sources']['map']['left_out']:,} of map" in page


def test_the_scanners_frame_can_be_the_reference(folder, capsys, monkeypatch):
    """The drone cloud comes from its map into ground metres; the way back is written too."""
    on_map = np.eye(4)
    on_map[:3, :3] *= 0.9996
    on_map[:3, 3] = (5e5, 4e6, 30.0)
    flown = cloud(2)
    high = flown.frame.to_file(flown.xyz) @ on_map[:3, :3].T + on_map[:3, 3]
    dougong.write(Cloud.from_points(high, crs="EPSG:32650"), folder / "map.laz", overwrite=True)
    found = replace(answer("ok")(flown, None, Register(filtered=True), source_kind=None,
                                 target_kind=None), matrix=inverse(on_map))  # fmt: skip
    monkeypatch.setattr("dougong.pipeline.links.register", lambda *_, **__: found)
    project = clouds(folder, more='[project]\nreference = "scans"\n[merge]\nmode = "all"\n')
    code, result = run(capsys, project, "--out", folder / "out")
    assert (code, result["reference"]) == (0, "scans")
    merged = dougong.read(folder / "out" / "merged.copc.laz")
    assert merged.frame.crs is None
    source = merged.attribute("source_id")
    for part in (1, 2):
        extent = np.ptp(merged.xyz[source == part], axis=0)
        np.testing.assert_allclose(extent, [10.0, 10.0, 3.0], atol=0.05)
    written = json.loads((folder / "out" / "registrations" / "map.json").read_text())
    np.testing.assert_allclose(written["matrix_inverse"], on_map, rtol=1e-12, atol=1e-8)
    names = {path.name for path in (folder / "out" / "registrations").iterdir()}
    assert names == {
        "map.json", "map.cloudcompare.txt", "map.pdal.json", "map.metashape.xml"
    }  # fmt: skip


def test_stations_that_are_not_registered_move_by_themselves(folder, capsys, monkeypatch):
    status = {"scans-1": "ok", "scans-2": "ambiguous"}
    monkeypatch.setattr("dougong.pipeline.links.register", answer(status))
    project = clouds(folder, registered="false")
    code, result = run(capsys, project, "--out", folder / "out")
    assert code == 3
    assert result["status"] == "ambiguous"
    assert result["merged"]["clouds"] == ["scans-1", "map"]
    assert {path.name for path in (folder / "out" / "registrations").iterdir()} == {
        "scans-1.json",
        "scans-1.cloudcompare.txt",
        "scans-1.pdal.json",
        "scans-1.metashape.xml",
        "scans-2.json",  # not sure: for no other program
    }
    own = dougong.read(folder / "out" / "clouds" / "scans-2.laz")
    assert own.frame.to_file(own.xyz).min(axis=0)[0] < 0.1, "left in its own coordinates"
    moved = dougong.read(folder / "out" / "clouds" / "scans-1.laz")
    assert moved.frame.to_file(moved.xyz).min(axis=0)[0] > 2.9
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert "1 of 2 clouds were registered" in page
    assert "holds only: scans-1, map" in page


def test_what_was_removed_is_kept_to_be_looked_at(folder, capsys, monkeypatch):
    """Thirty points in the air, and where the reference has them once the scan has moved."""
    strays = np.random.default_rng(7).uniform([0, 0, 5], [10, 10, 12], (30, 3))
    file = folder / "one.laz"
    dougong.write(Cloud.from_points(np.vstack([cloud(0).xyz, strays])), file, overwrite=True)
    monkeypatch.setattr("dougong.pipeline.links.register", answer("ok"))
    tokens = ("--lidar", folder / "one.laz", "--photogrammetry", folder / "map.laz")
    _, result = run(capsys, *tokens, "--out", folder / "out")
    one = result["clouds"][0]
    taken = {name: count for name, count in one["reasons"].items()
             if name not in ("kept", "decimated")}  # fmt: skip
    removed = dougong.read(folder / "out" / "removed" / "one.laz")
    assert len(removed) == one["removed_shown"] == sum(taken.values()) > 0
    assert one["removed_by_file"] == [{"removed": len(removed), "shown": len(removed)}]
    codes = removed.attribute("dougong_reason")
    assert {Reason(code).name.lower(): int((codes == code).sum()) for code in set(codes)} == taken
    shown = removed.frame.to_file(removed.xyz)
    near, _ = cKDTree(shown).query(strays + SHIFT)
    assert (near < 0.002).sum() >= 20


def test_the_removed_points_that_are_kept_do_not_depend_on_the_order():
    points = np.random.default_rng(8).uniform(0, 9, (500, 3))
    codes = np.random.default_rng(9).integers(0, 5, 500).astype(np.uint8)
    order = np.random.default_rng(10).permutation(500)
    one = removed_sample(Cloud.from_points(points), codes, 40)
    two = removed_sample(Cloud.from_points(points[order]), codes[order], 40)
    assert len(one) == len(two) == 40
    assert set(map(tuple, one.xyz)) == set(map(tuple, two.xyz))
    assert set(one.attribute("dougong_reason")) <= {2, 3, 4}


@pytest.mark.parametrize("status", ["ambiguous", "failed"])
def test_an_unsure_pose_is_not_merged_and_exits_3(folder, status, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.links.register", answer(status))
    tokens = ("--lidar", folder / "one.laz", "--photogrammetry", folder / "map.laz")
    code, result = run(capsys, *tokens, "--out", folder / "out")
    assert (code, result["status"], result["merged"]["clouds"]) == (3, status, ["map"])
    assert len(dougong.read(folder / "out" / "merged.copc.laz")) == result["merged"]["points"]
    document = json.loads((folder / "out" / "registrations" / "one.json").read_text())
    assert (document["matrix"] is None) == (status == "failed")


@pytest.mark.parametrize("status", ["ambiguous", "ok"])
def test_what_a_file_could_not_hold_is_said_of_merged_clouds_and_others(
    folder, status, capsys, monkeypatch
):
    monkeypatch.setattr("dougong.pipeline.links.register", answer(status))
    shiny = cloud(0).with_attribute("intensity", np.linspace(0, 1, 6000))
    dougong.write(shiny, folder / "one.ply")
    tokens = ("--lidar", folder / "one.ply", "--photogrammetry", folder / "map.laz")
    _, result = run(capsys, *tokens, "--out", folder / "out")
    said = [note for note in result["notes"] if "intensity is fractional" in note]
    start = "merged.copc.laz: one: " if status == "ok" else "clouds/one.laz: "
    assert [note.startswith(start) for note in said] == [True]


def test_a_filter_kept_from_an_earlier_run_speaks_of_the_file_as_it_is_called_now(folder, capsys):
    notes = []
    sparse = cloud(0).select(np.arange(0, 6000, 10))  # loses much, which is said
    dougong.write(sparse, folder / "one.laz", overwrite=True)
    tokens = ("--out", folder / "out", "--work", folder / "work", "--overwrite")
    for name in ("one", "renamed"):
        if name == "renamed":
            (folder / "one.laz").rename(folder / "renamed.laz")
        project = folder / "project.toml"
        project.write_text(
            f'[[cloud]]\nname="scan"\nkind="lidar"\nfiles=["{name}.laz"]\n'
            '[filter.lidar.curvature_weighted]\nrule="paper"\n'
        )
        notes.append(run(capsys, project, *tokens)[1]["notes"])
    assert any(note.startswith("one, curvature_weighted: took ") for note in notes[0])
    assert notes[1] == [note.replace("one", "renamed", 1) for note in notes[0]]


def test_the_best_pose_is_taken_when_the_project_says_so(folder, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.links.register", answer("ambiguous"))
    project = clouds(folder, more="[register]\naccept_best = true\n")
    code, result = run(capsys, project, "--out", folder / "out")
    assert (code, result["status"]) == (0, "ambiguous")
    assert result["merged"]["clouds"] == ["scans", "map"]


def test_one_cloud_alone_is_only_filtered(folder, capsys):
    code, result = run(capsys, "--lidar", folder / "one.laz", "--out", folder / "out")
    assert (code, result["status"], result["registrations"]) == (0, "ok", [])
    assert result["merged"]["clouds"] == ["one"]


def test_the_result_hash_forgets_time_paths_and_point_order(folder, capsys):
    first = run(capsys, "--lidar", folder / "one.laz", "--out", folder / "a")[1]
    shuffled = dougong.read(folder / "one.laz")
    order = np.random.default_rng(0).permutation(len(shuffled))
    dougong.write(shuffled.select(order), folder / "other.laz")
    second = run(capsys, "--lidar", folder / "other.laz", "--out", folder / "b")[1]
    assert second["result_hash"] == first["result_hash"]
    third = run(capsys, "--lidar", folder / "two.laz", "--out", folder / "c")[1]
    assert third["result_hash"] != first["result_hash"]


def test_a_copy_of_a_file_is_said(folder, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.links.register", answer("ok"))
    (folder / "two.laz").write_bytes((folder / "one.laz").read_bytes())
    one, two = ("--lidar", folder / "one.laz"), ("--lidar", folder / "two.laz")
    assert call([str(part) for part in ("run", *one, *two, "--out", folder / "out", "--json")]) == 0
    said = capsys.readouterr()
    notes = json.loads(said.out)["notes"]
    assert "two.laz is a copy of one.laz: the same points are given twice" in " ".join(notes)
    assert "filtered before, from its copy; not filtered again" in said.err


def test_registering_a_file_onto_its_copy_is_said(folder, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.registering_files.register", answer("ambiguous"))
    (folder / "two.laz").write_bytes((folder / "one.laz").read_bytes())
    for target, said in (("two.laz", True), ("map.laz", False)):
        tokens = ["register", "one.laz", target, "--out", "pose", "--filtered", "--overwrite"]
        monkeypatch.chdir(folder)
        assert call([*tokens, "--json", "--quiet"]) == 3
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert any("the same file, or copies of one" in note for note in notes) is said


def test_a_file_that_cannot_be_read_leaves_no_empty_folder(folder, capsys):
    damaged = (folder / "one.laz").read_bytes()[:3000]
    (folder / "one.laz").write_bytes(damaged)
    before = sorted(folder.iterdir())
    assert run(capsys, "--lidar", folder / "one.laz", "--out", folder / "out")[0] == 1
    assert sorted(folder.iterdir()) == before


def test_a_full_disk_says_what_stays_and_goes_on_from_there(folder, capsys, monkeypatch):
    tokens = ["--lidar", folder / "one.laz", "--out", folder / "out"]

    def full(linked, frame, merge, out, *_):
        with replacing(out / "merged.copc.laz", expected_bytes=2_000_000) as sink:
            sink.error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise sink.error

    with monkeypatch.context() as patched:
        patched.setattr("dougong.pipeline.run.write_clouds", full)
        code, answer = run(capsys, *tokens)
    said = answer["error"]["message"]
    assert code == 1
    assert re.search(r"disk is full: .*out/merged.copc.laz needs about .* MB, .* are free\. ", said)
    assert "The unfinished file was removed; free some space or write elsewhere." in said
    work = folder / "out.work"
    assert re.search(rf"filter steps stay in {work} \(\d+\.\d MB\): the same command", said)
    assert sorted(path.name.split(".")[-1] for path in work.iterdir()) == [
        "dougong-scratch", "json", "npz",
    ]  # fmt: skip
    assert run(capsys, *tokens)[0] == 0
    assert not work.exists()


def test_a_failing_job_leaves_nothing(folder, capsys, monkeypatch):
    def broken(*args, **kwargs):
        raise dougong.RegistrationError("no overlap at all.")

    monkeypatch.setattr("dougong.pipeline.links.register", broken)
    code, document = run(capsys, clouds(folder), "--out", folder / "out")
    assert (code, document["error"]["type"]) == (1, "RegistrationError")
    assert not (folder / "out").exists()
    assert [path for path in folder.iterdir() if "part" in path.name] == []


def test_a_setting_that_does_not_go_with_a_cloud_names_it(folder, capsys):
    points = np.random.default_rng(0).uniform(0, [20_000, 20_000, 5000], (5000, 3))
    dougong.write(Cloud.from_points(points), folder / "in_mm.laz")
    files = ("--lidar", folder / "one.laz", "--lidar", folder / "in_mm.laz")
    code, document = run(capsys, *files, "--out", folder / "out")
    assert code == 2
    assert document["error"]["message"].startswith("in_mm.laz: the cloth would have")


@pytest.mark.parametrize(
    ("tokens", "said"),
    [
        (("--lidar", "gone.laz"), "there is no file"),
        ((), "no cloud is named"),
        (("project.toml", "--lidar", "one.laz"), "Pass one or the other"),
        (("--lidar", "one.laz", "--photogrammetry", "one.laz"), "one.laz is one file, named twice"),
        (("--lidar", "one.laz", "--memory", "200MB"), "more than --memory"),
    ],
)
def test_a_job_that_cannot_be_meant_exits_2(folder, tokens, said, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    code, document = run(capsys, *tokens, "--out", "out")
    assert code == 2
    assert said in document["error"]["message"]
    assert not (folder / "out").exists()
