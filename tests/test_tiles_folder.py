"""Folders of whole files: on a disk, in memory, and on a real S3 server of this machine."""

import importlib
import json
import os
import platform
import subprocess
import sys

import numpy as np
import pytest

from dougong.cli import call
from dougong.errors import InputError, OutputError
from dougong.formats.unfinished import passing_folder, remove_unfinished
from dougong.tiles import engine as engines
from dougong.tiles.cloud import read_file, read_record, write_arrays
from dougong.tiles.folder import LocalFolder
from dougong.tiles.shared import SharedFolder, copies_in, folder_of
from s3_server import as_a_user
from tile_scans import KILLED, VOXEL, filtered_by, make_little_room, write_scan


@pytest.fixture
def scan(tmp_path):
    return write_scan(tmp_path / "scan.laz")


@pytest.fixture
def little_room(monkeypatch):
    make_little_room(monkeypatch)


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
def test_the_next_process_clears_what_a_killed_one_had_begun(tmp_path):
    killed = (
        "import os, sys; from pathlib import Path; from dougong.tiles.folder import LocalFolder\n"
        "LocalFolder(Path(sys.argv[1])).write('0_0.points.npz', lambda _: os._exit(9))"
    )
    subprocess.run([sys.executable, "-c", killed, str(tmp_path)], check=False)
    (left,) = tmp_path.iterdir()
    theirs = tmp_path / f"0_1.points.npz.part-{platform.node()}-{os.getppid()}"
    theirs.touch()
    folder = LocalFolder(tmp_path)
    for name in ("1_1.points.npz", "0_0.points.npz"):
        folder.write(name, lambda file: file.write(b"whole"))
        assert not left.exists()
    assert folder.names() == {"0_0.points.npz", "1_1.points.npz", theirs.name}


def test_a_cancelled_job_does_not_make_its_folder_again(tmp_path):
    """Its threads go on for a moment, and left tiles beside the output now and then."""
    with passing_folder(tmp_path / "tiles-o-") as beside:
        folder = LocalFolder(beside / "tiles")
        folder.write("0_0.points.npz", lambda file: file.write(b"whole"))
        remove_unfinished()
        with pytest.raises(OutputError, match="the job was cancelled"):
            folder.write("0_1.points.npz", lambda file: file.write(b"whole"))
        assert not beside.exists()
    with passing_folder(tmp_path / "tiles-o-"):
        folder.write("0_1.points.npz", lambda file: file.write(b"whole"))


@pytest.mark.parametrize("kind", ["disk", "memory", "s3"])
def test_a_file_is_there_whole_or_not_at_all(kind, tmp_path, bucket):
    places = {"disk": tmp_path, "memory": "memory://here", "s3": bucket[0]}
    folder = folder_of(places[kind]) / "tiles-1"
    assert_whole(folder)
    with copies_in(tmp_path / "copies"):
        assert_whole(folder)
    assert not (tmp_path / "copies").exists()


def assert_whole(folder):
    assert folder.names() == set()
    with pytest.raises(FileNotFoundError):
        folder.open("a.npz")
    assert read_record(folder, "a.npz") is None
    values = np.arange(30_000)
    write_arrays(folder, "a.npz", {"values": values, "few": values[:2]}, {"taken": 3})
    assert read_record(folder, "a.npz") == {"taken": 3}
    np.testing.assert_array_equal(read_file(folder, "a.npz")["values"], values)
    assert read_file(folder, "a.npz", "few").keys() == {"few"}
    stamp = folder.stamp("a.npz")
    assert folder.stamp("a.npz") == stamp

    def half(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        folder.write("a.npz", half)
    assert read_record(folder, "a.npz") == {"taken": 3}
    folder.write("a.npz", lambda file: file.write(b"other"))
    with folder.open("a.npz") as file:
        assert file.read() == b"other"
    assert folder.stamp("a.npz") != stamp
    assert folder.names() == {"a.npz"}
    folder.remove()
    folder.remove()
    assert folder.names() == set()


def test_a_path_is_a_folder_wherever_a_process_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert folder_of("work") == LocalFolder(tmp_path / "work")
    assert folder_of("s3/work").local == tmp_path / "s3" / "work"


def test_storage_is_tried_before_any_work_and_nothing_is_left(bucket):
    url, keys = bucket
    assert folder_of(f"{url}/a/b/") == SharedFolder(f"{url}/a/b")
    assert keys() == []


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("s3://", "names no bucket"),
        ("s3://bucket/w*rk", "holds none of"),
        ("ftp://host/work", "knows folders and s3://BUCKET/PREFIX, got"),
    ],
)
def test_a_url_that_cannot_be_is_a_mistake_of_usage(place, said):
    with pytest.raises(InputError, match=said):
        folder_of(place)


def test_a_missing_package_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(importlib.import_module("fsspec.registry")._registry, "s3", raising=False)
    with pytest.raises(InputError, match=r"needs s3fs, .* pip install 'dougong\[s3\]'"):
        folder_of("s3://bucket/work")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "The specified bucket does not exist"),
        ({"AWS_ACCESS_KEY_ID": None, "AWS_SECRET_ACCESS_KEY": None}, "credentials"),
        ({"AWS_ENDPOINT_URL": "nowhere"}, "Invalid endpoint: nowhere"),
    ],
)
def test_storage_that_cannot_be_used_is_one_sentence(
    settings, said, s3_endpoint, monkeypatch, scan, tmp_path, capsys
):
    more = {"AWS_EC2_METADATA_DISABLED": "true", **settings}
    as_a_user(monkeypatch, more.pop("AWS_ENDPOINT_URL", s3_endpoint), **more)
    tokens = ["filter", str(scan), str(tmp_path / "out.laz"), "--kind", "lidar", "--quiet"]
    assert call([*tokens, "--work", "s3://no-such-bucket/work"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: s3://no-such-bucket/work could not be written from ")
    assert said in error
    assert error.count("\n") == 1
    assert "AWS_ENDPOINT_URL" in error
    with pytest.raises(OutputError):
        folder_of("s3://no-such-bucket")


def test_a_filter_on_shared_tiles_is_the_same_and_goes_on(
    scan, tmp_path, little_room, bucket, monkeypatch
):
    url, keys = bucket
    whole, _ = filtered_by(scan, tmp_path / "whole.laz", "--kind", "lidar", "--memory", "4GB")
    options = ("--kind", "lidar", "--memory", "190kB", "--work", f"{url}/site")
    tiled, _ = filtered_by(scan, tmp_path / "tiled.laz", *options)
    np.testing.assert_array_equal(tiled.records, whole.records)
    there = keys()
    assert len(there) > 20
    assert all(key.startswith("site/tiles-") and key.endswith((".npz", ".json")) for key in there)
    assert {path.name.partition(".")[0] for path in tmp_path.iterdir()} == {
        "scan",
        "whole",
        "tiled",
    }

    def refuse(task):
        raise AssertionError(f"{task.tile} is done again")

    monkeypatch.setattr(engines, "perform", refuse)
    again, _ = filtered_by(scan, tmp_path / "again.laz", *options)
    np.testing.assert_array_equal(again.records, whole.records)
    assert keys() == there


def test_a_run_on_shared_storage_has_the_same_hash(
    scan, tmp_path, little_room, bucket, monkeypatch, capsys
):
    url, keys = bucket
    monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
    hashes = []
    project = tmp_path / "site.toml"
    project.write_text(
        '[[cloud]]\nname = "scan"\nkind = "lidar"\nfiles = ["scan.laz"]\n'
        "[filter.lidar.octree_voxel_grid]\nvoxel_m = 0.1\n"
    )
    for name, work in (("disk", tmp_path / "work"), ("shared", url), ("again", url)):
        tokens = ["run", str(project), "--out", str(tmp_path / name), "--memory", "190kB"]
        assert call([*tokens, "--work", str(work)]) == 0
        hashes.append(json.loads((tmp_path / name / "result.json").read_text())["result_hash"])
    assert len(set(hashes)) == 1
    assert capsys.readouterr().err.count("not filtered again") == 1
    on_disk = {path.relative_to(tmp_path / "work") for path in (tmp_path / "work").rglob("*.*")}
    assert {str(path) for path in on_disk} == set(keys())
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"scan.laz", "site.toml", "work", "disk", "shared", "again"}


def test_a_killed_run_goes_on_from_shared_storage(scan, tmp_path, little_room, bucket):
    whole, _ = filtered_by(scan, tmp_path / "whole.laz", "--kind", "lidar", "--memory", "4GB")
    tokens = ["filter", str(scan), str(tmp_path / "out.laz"), "--kind", "lidar", "--set", VOXEL]
    tokens += ["--memory", "190kB", "--work", bucket[0], "--quiet"]
    for tasks, code in ((7, -9), (1000, 0)):
        command = [sys.executable, "-c", KILLED, str(tasks), *tokens, "--overwrite"]
        assert subprocess.run(command, check=False).returncode == code
    found, _ = filtered_by(scan, tmp_path / "out.laz", "--kind", "lidar", "--overwrite")
    np.testing.assert_array_equal(found.records, whole.records)


def test_a_command_whose_files_are_on_a_disk_says_so(tmp_path, capsys):
    for command in (["view", "scan.laz"], ["bench", "--out", str(tmp_path / "bench")]):
        assert call([*command, "--work", "s3://bucket/work"]) == 2
        said = capsys.readouterr().err
        assert said == (
            "error: --work of this command is a folder on a disk, got 's3://bucket/work'. "
            "Name a folder.\n"
        )


def test_without_room_for_copies_files_are_fetched_again(bucket, tmp_path, monkeypatch):
    monkeypatch.setattr("dougong.tiles.shared._LEAST_FREE", 2.0)
    folder = folder_of(bucket[0])
    with copies_in(tmp_path / "copies"):
        write_arrays(folder, "a.npz", {"values": np.arange(9)}, {"taken": 3})
        assert read_record(folder, "a.npz") == {"taken": 3}
        np.testing.assert_array_equal(read_file(folder, "a.npz")["values"], np.arange(9))
        assert not list((tmp_path / "copies").rglob("*.npz"))
