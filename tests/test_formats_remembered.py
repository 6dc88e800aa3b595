"""What a pass over a file found is not looked for again, unless the file has changed."""

import os

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import describe, iterate, read, write
from dougong.formats.remembered import Remembered
from tile_scans import VOXEL, filtered_by, make_little_room, write_scan

LONG_AGO = 1e9


@pytest.fixture
def passes(monkeypatch):
    """Count how often the points of an E57 scan are decoded."""
    from dougong.formats.e57 import E57Scan

    count, blocks = [0], E57Scan.blocks

    def counted(scan, rows):
        count[0] += 1
        return blocks(scan, rows)

    monkeypatch.setattr(E57Scan, "blocks", counted)
    return count


def e57(folder):
    path = folder / "scan.e57"
    write(read(write_scan(folder / "scan.laz")), path)
    os.utime(path, (LONG_AGO, LONG_AGO))
    return path


def test_a_large_e57_is_decoded_twice_by_filter(tmp_path, monkeypatch, passes):
    """It was decoded five times: to count points and scans, to find its frame, to read it."""
    make_little_room(monkeypatch)
    path = e57(tmp_path)
    filtered_by(path, tmp_path / "o.laz", "--kind", "lidar", "--memory", "190kB")
    assert passes == [2]


def test_a_large_e57_is_decoded_twice_by_run(tmp_path, monkeypatch, passes, capsys):
    from dougong.cli import call

    make_little_room(monkeypatch)
    monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
    monkeypatch.setattr("dougong.pipeline.memory.BYTES_PER_REDUCED_POINT", 1)
    project = tmp_path / "project.toml"
    field, value = VOXEL.rsplit("=")
    table, name = field.split(".")
    project.write_text(
        '[project]\nname = "a"\n[[cloud]]\nname = "a"\nkind = "lidar"\nfiles = ["scan.e57"]\n'
        f"[filter.lidar.{table}]\n{name} = {value}\n"
    )
    e57(tmp_path)
    assert call(["run", str(project), "--out", str(tmp_path / "out"), "--memory", "190kB"]) == 0
    assert "it is filtered on tiles" in capsys.readouterr().err
    assert passes == [2]


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_file_that_changed_is_asked_again(tmp_path, is_replaced):
    path, rng = tmp_path / "a.ply", np.random.default_rng(0)
    write(Cloud.from_points(rng.random((50, 3))), path)
    os.utime(path, (LONG_AGO, LONG_AGO))
    before = describe(path).extent_max
    other = tmp_path / "b.ply"
    write(Cloud.from_points(rng.random((50, 3)) + 7.0), other)
    if is_replaced:
        os.utime(other, (LONG_AGO, LONG_AGO))
        other.replace(path)
    else:
        path.write_bytes(other.read_bytes())
    after = describe(path).extent_max
    assert after[0] > 7.0 > before[0]
    assert next(iter(iterate(path))).frame.origin[0] >= 7.0


def test_a_file_written_a_moment_ago_is_not_trusted(tmp_path):
    """It may be written again within one tick of the disk's clock, as long as it was."""
    path, asked = tmp_path / "a", Remembered()
    path.write_text("1")
    assert asked.of(path, path.read_text) == "1"
    when = path.stat().st_mtime_ns
    path.write_text("2")
    os.utime(path, ns=(when, when))
    assert asked.of(path, path.read_text) == "2"


def test_what_a_pass_noted_at_its_end_is_said_on_every_chunk(tmp_path):
    path = tmp_path / "a.ply"
    write(Cloud.from_points(np.random.default_rng(0).random((50, 3))), path)
    with path.open("ab") as file:
        file.write(bytes(1000))
    os.utime(path, (LONG_AGO, LONG_AGO))
    said = [[chunk.notes for chunk in iterate(path, 20)] for _ in range(3)]
    assert said[0] == said[1] == said[2]
    assert "1,000 bytes" in said[0][0][0]
