"""Tiled work gives the points that whole work gives, whatever the tiles."""

import json
import os
import platform
import signal
import subprocess
import sys

import numpy as np
import pytest

from dougong.cli import call
from dougong.cloud import Cloud
from dougong.errors import OutputError
from dougong.filters.octree_voxel_grid import (
    OctreeVoxelGrid,
    cells_of,
    octree_voxel_grid,
    robust_box,
)
from dougong.formats import faults_of, read
from dougong.pipeline import memory
from dougong.threads import set_threads
from dougong.tiles.cloud import read_arrays
from dougong.tiles.engine import set_engine
from dougong.tiles.folder import LocalFolder
from dougong.tiles.grid import TileGrid, grid_for, leaves_of, part
from dougong.tiles.partition import partition
from dougong.tiles.spool import Spool
from dougong.tiles.store import RowFile, Rows
from e57_surveys import survey
from tile_scans import KILLED, VOXEL, filtered_by, make_little_room, site, write_scan


def pieces(cloud, size):
    return (
        cloud.select(np.arange(a, min(a + size, len(cloud)))) for a in range(0, len(cloud), size)
    )


@pytest.mark.parametrize("tile_points", [1500, 10**9])
@pytest.mark.parametrize("chunk", [4999, 10**9])
@pytest.mark.parametrize("params", [OctreeVoxelGrid(voxel_m=0.05), OctreeVoxelGrid(depth=9)])
def test_tiles_keep_what_the_whole_keeps(tmp_path, params, chunk, tile_points):
    cloud = site()
    whole = octree_voxel_grid(cloud.xyz, params, records=cloud.records)
    spool = Spool(pieces(cloud, chunk), tmp_path)
    tiled = partition(spool, params, LocalFolder(tmp_path), tile_points, tile_points)
    row, xyz, count = joined(tiled)
    np.testing.assert_array_equal(row, np.flatnonzero(whole.is_kept))
    np.testing.assert_array_equal(xyz, cloud.xyz[whole.is_kept])
    np.testing.assert_array_equal(count, whole.attributes["voxel_count"][whole.is_kept])
    assert tiled.facts["points_in"] == len(cloud)
    assert tuple(tiled.facts["faults"]) == faults_of(cloud)
    spool.remove()
    assert len(list(tmp_path.iterdir())) == len(tiled.tiles) + 1


def joined(tiled):
    """Return rows, coordinates and voxel counts of all tiles in the order of the cloud."""
    held = [read_arrays(tiled.folder, tile, "points") for tile in tiled.tiles]
    parts = [np.concatenate([h[name] for h in held]) for name in ("row", "xyz", "voxel_count")]
    order = np.argsort(parts[0])
    return [part[order] for part in parts]


def test_one_voxel_with_more_points_than_a_tile_may_hold_ends(tmp_path):
    cloud = Cloud.from_points(np.full((5000, 3), 3.25))
    spool = Spool(pieces(cloud, 1000), tmp_path)
    tiled = partition(spool, OctreeVoxelGrid(), LocalFolder(tmp_path), 100, 100)
    assert tiled.points == 1
    assert joined(tiled)[2].tolist() == [5000]


def test_a_voxel_lies_in_one_tile():
    points = site().xyz
    grid = TileGrid(robust_box(points)[0], 0.05, 3)
    parts = part(points, grid)
    tile = np.empty(len(points), np.int64)
    tile[parts.order] = np.repeat(np.arange(len(parts.tiles)), np.diff(parts.starts))
    voxel = np.unique(cells_of(points, grid.low, 0.05), axis=0, return_inverse=True)[1]
    assert len(np.unique(np.column_stack([voxel, tile]), axis=0)) == voxel.max() + 1
    for number in range(len(parts.tiles)):
        own = parts.order[parts.starts[number] : parts.starts[number + 1]]
        assert (np.diff(own) > 0).all()  # the cloud's order, so that ties are settled alike


def test_tiles_of_millimetres_at_map_coordinates_keep_what_the_whole_keeps(tmp_path):
    rng = np.random.default_rng(6)
    points = rng.integers(0, [700, 40, 700], (40_000, 3)) / 1000
    params = OctreeVoxelGrid(voxel_m=0.007)
    cloud = Cloud.from_points(points + [431_234.567, 4_001_234.123, 301.011])
    whole = octree_voxel_grid(points, params)
    tiled = partition(
        Spool(pieces(cloud, 9999), tmp_path), params, LocalFolder(tmp_path), 1500, 500
    )
    row, _, count = joined(tiled)
    assert len(tiled.tiles) > 20
    np.testing.assert_array_equal(points[row], points[whole.is_kept])
    np.testing.assert_array_equal(count, whole.attributes["voxel_count"][whole.is_kept])


def test_children_halve_a_tile():
    grid = grid_for(np.zeros(3), 100.0, 0.005, 10_000_000, 1_000_000)
    assert 2**grid.level * 0.005 < 100.0
    points = np.random.default_rng(0).uniform(0, 100, (1000, 3))
    fine = part(points, grid.children()).tiles
    coarse = part(points, grid).tiles
    assert {tuple(t) for t in (fine >> 1)} == {tuple(t) for t in coarse}


def halved(points, grid, most, rows, least):
    """Return the tiles of points, by name, as halving crowded ones down to a level gives them."""
    found = {}
    parts = part(points[rows], grid)
    for k, at in enumerate(parts.tiles.tolist()):
        mine = rows[parts.order[parts.starts[k] : parts.starts[k + 1]]]
        if len(mine) > most and grid.level > least:
            found |= halved(points, grid.children(), most, mine, least)
        else:
            found[(grid.level, *at)] = mine
    return found


@pytest.mark.parametrize("far", [0.0, 900.0, 1e7])
def test_a_cloud_is_cut_at_once_as_halving_crowded_tiles_would(far):
    rng = np.random.default_rng(1)
    points = np.vstack([rng.normal(0, 9.0, (3000, 3)), rng.normal(5, 0.3, (2000, 3))])
    points[:2] += far
    grid = TileGrid(np.full(3, -20.0), 0.05, 9)
    expected = halved(points, grid, 400, np.arange(len(points)), grid.level - 3)
    leaves = leaves_of([points[:1700], points[1700:1700], points[1700:]], grid, 400)
    assert list(leaves.names) == list(expected)
    assert leaves.counts.tolist() == [len(rows) for rows in expected.values()]
    some = np.arange(0, len(points), 3)
    parts = leaves.part(points[some])
    for k, leaf in enumerate(parts.tiles.tolist()):
        mine = some[parts.order[parts.starts[k] : parts.starts[k + 1]]]
        wanted = expected[leaves.names[leaf]]
        np.testing.assert_array_equal(mine, wanted[np.isin(wanted, some)])


@pytest.mark.parametrize("is_thinned", [True, False])
def test_rows_come_back_bit_for_bit(tmp_path, is_thinned):
    xyz = site(300).xyz
    counts = np.arange(len(xyz), dtype=np.int32) if is_thinned else None
    rows = Rows(np.arange(len(xyz)), xyz, counts)
    file = RowFile(tmp_path / "a.rows", is_thinned=is_thinned)
    for a, b in ((0, 100), (100, 101), (101, len(xyz))):
        file.append(rows.take(np.arange(a, b)))
    back = file.read()
    assert len(list(file.pieces())) == 3
    np.testing.assert_array_equal(np.concatenate(list(file.coordinates())), xyz)
    np.testing.assert_array_equal(back.row, rows.row)
    np.testing.assert_array_equal(back.xyz, xyz)
    np.testing.assert_array_equal(back.stands_for, counts)


def test_a_cloud_on_disk_comes_back_bit_for_bit(tmp_path):
    cloud = site(300)
    spool = Spool(pieces(cloud, 101), tmp_path)
    back = list(spool.pieces())
    assert [len(piece) for piece in back] == [len(piece) for piece in pieces(cloud, 101)]
    assert spool.points == len(cloud)
    np.testing.assert_array_equal(np.concatenate([piece.xyz for piece in back]), cloud.xyz)
    assert b"".join(piece.records.tobytes() for piece in back) == cloud.records.tobytes()
    some = np.array([7, 5, 250])
    assert spool.records_at(some).tobytes() == cloud.records[some].tobytes()


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path):
    xyz = site(100).xyz
    file = RowFile(tmp_path / "missing" / "a.rows", is_thinned=False)
    with pytest.raises(OutputError, match="could not be written"):
        file.append(Rows(np.arange(len(xyz)), xyz))


def test_a_file_that_was_cut_short_is_no_cloud(tmp_path):
    xyz = site(100).xyz
    file = RowFile(tmp_path / "a.rows", is_thinned=False)
    file.append(Rows(np.arange(len(xyz)), xyz))
    with file.path.open("r+b") as stored:
        stored.truncate(file.path.stat().st_size - 1)
    with pytest.raises(OutputError, match="cut short"):
        file.read()


@pytest.fixture
def scan(tmp_path):
    return write_scan(tmp_path / "scan.laz")


@pytest.fixture
def little_room(monkeypatch):
    make_little_room(monkeypatch)


@pytest.mark.parametrize(
    "what",
    [
        ("--kind", "lidar"),
        ("--kind", "lidar", "--mark"),
        ("--kind", "photogrammetry"),
        ("--only", "octree_voxel_grid"),
        ("--only", "cloth_simulation"),
        ("--only", "pass_through", "--set", "pass_through.height_m=[-1, 3]"),
    ],
)
def test_filter_is_the_same_on_tiles(scan, tmp_path, little_room, what):
    whole, said = filtered_by(scan, tmp_path / "whole.laz", *what, "--memory", "4GB")
    tiled, told = filtered_by(scan, tmp_path / "tiled.laz", *what, "--memory", "190kB")
    np.testing.assert_array_equal(tiled.records, whole.records)
    for volatile in ("seconds", "peak_memory_bytes", "output"):
        del said[volatile], told[volatile]
    for stage in (*said["stages"], *told["stages"]):
        del stage["seconds"]
    assert told == said
    assert not list(tmp_path.glob("tiles-*"))


def test_filter_of_a_survey_is_the_same_on_tiles(tmp_path, little_room):
    survey(tmp_path / "scans.e57", scans=2, rows=150, columns=150, kind="double")
    file, only = tmp_path / "scans.e57", ("--only", "pass_through")
    only += ("--set", "pass_through.z_m=[0, 40]")
    whole, said = filtered_by(file, tmp_path / "a.e57", *only, "--memory", "4GB")
    tiled, told = filtered_by(file, tmp_path / "b.e57", *only, "--memory", "190kB")
    assert [scan.station for scan in tiled.header.stations] == [0, 1]
    np.testing.assert_array_equal(tiled.xyz, whole.xyz)
    np.testing.assert_array_equal(tiled.records, whole.records)
    np.testing.assert_array_equal(tiled.viewpoints, whole.viewpoints)
    assert told["notes"] == said["notes"]
    assert told["reasons"] == said["reasons"]


@pytest.mark.parametrize("mark", [(), ("--mark",)])
def test_a_survey_that_is_too_large_to_be_written_is_refused(tmp_path, little_room, capsys, mark):
    file = survey(tmp_path / "scans.e57", scans=2, rows=150, columns=150, kind="double")
    tokens = ["filter", str(file), str(tmp_path / "a.e57"), "--only", "pass_through", *mark]
    tokens += ["--memory", "190kB", "--quiet"]
    assert call(tokens) == 2
    said = capsys.readouterr().err
    assert "a.e57 is held as a whole while it is written" in said
    assert "more than --memory 0.0 GB" in said
    assert list(tmp_path.iterdir()) == [file]


def test_run_is_the_same_on_tiles_and_goes_on_where_it_was(
    scan, tmp_path, little_room, capsys, monkeypatch
):
    monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
    results = []
    for name, room in (("whole", "4GB"), ("tiled", "190kB"), ("again", "190kB")):
        work = tmp_path / ("work" if name != "whole" else "other")
        tokens = ["run", "--lidar", str(scan), "--out", str(tmp_path / name), "--memory", room]
        assert call([*tokens, "--work", str(work)]) == 0
        results.append(json.loads((tmp_path / name / "result.json").read_text()))
    said = capsys.readouterr().err
    assert said.count("it is filtered on tiles") == 2
    assert said.count("not filtered again") == 1
    assert len({result["result_hash"] for result in results}) == 1
    assert results[0]["notes"] == results[1]["notes"] == results[2]["notes"]
    assert results[1]["inputs"] == results[0]["inputs"]


def test_tiles_of_another_unit_are_not_gone_on_with(tmp_path, little_room, monkeypatch):
    monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
    write_scan(tmp_path / "scan.laz", 17_000)

    def stages(crs, work):
        told = f'[[cloud]]\nname = "scan"\nkind = "lidar"\nfiles = ["scan.laz"]\ncrs = "{crs}"\n'
        (tmp_path / "p.toml").write_text(told)
        tokens = ["run", str(tmp_path / "p.toml"), "--out", str(tmp_path / "out"), "--overwrite"]
        tokens += ["--work", str(tmp_path / work), "--memory", "110kB", "--quiet"]
        assert call(tokens) == 0
        (cloud,) = json.loads((tmp_path / "out" / "result.json").read_text())["clouds"]
        return [(stage["name"], stage["points_out"]) for stage in cloud["stages"]]

    metres, feet = stages("EPSG:32650", "work"), stages("EPSG:2227", "work")
    assert metres != feet
    assert feet == stages("EPSG:2227", "other")


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
@pytest.mark.parametrize("command", ["filter", "run"])
def test_two_processes_do_not_cut_the_same_tiles(
    scan, tmp_path, little_room, monkeypatch, capsys, command
):
    tokens = ["--work", str(tmp_path / "work"), "--memory", "190kB", "--quiet", "--overwrite"]
    if command == "run":
        monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
        tokens = ["run", "--lidar", str(scan), "--out", str(tmp_path / "out"), *tokens]
    else:
        tokens = ["filter", str(scan), str(tmp_path / "out.laz"), "--kind", "lidar", *tokens]
    assert call(tokens) == 0
    (tiles,) = (tmp_path / "work").glob("tiles-*")
    before = sorted(tiles.iterdir())
    for books in (tmp_path / "work").glob("*.books.*"):
        books.unlink()
    other = tiles.with_name(f"{tiles.name}.user-{platform.node()}-{os.getppid()}")
    other.touch()
    assert call(tokens) == 1
    assert f"{tiles} is being worked in by another dougong" in capsys.readouterr().err
    assert sorted(tiles.iterdir()) == before
    other.unlink()
    assert call(tokens) == 0


def test_tiles_are_gone_on_with_whatever_is_free_at_the_moment(
    scan, tmp_path, little_room, monkeypatch
):
    cut = []
    known = Spool.__init__
    monkeypatch.setattr(Spool, "__init__", lambda *args: (cut.append(1), known(*args))[1])
    work = tmp_path / "work"

    def run(*options):
        filtered_by(scan, tmp_path / "out.laz", "--kind", "lidar", "--overwrite", *options,
                    "--work", str(work))  # fmt: skip
        return len(cut), len(list(work.glob("tiles-*")))

    for free in (200_000, 185_000, 210_000):
        monkeypatch.setattr(memory, "_free_bytes", lambda free=free: free)
        assert run() == (1, 1)
    assert run("--memory", "140kB") == (2, 1), "larger tiles than there is room for now"
    assert run("--memory", "190kB") == (2, 1)


@pytest.mark.filterwarnings("ignore")  # of the cluster's own
def test_a_dask_cluster_gives_the_same(scan, tmp_path, little_room):
    pytest.importorskip("distributed")
    whole, _ = filtered_by(scan, tmp_path / "whole.laz", "--kind", "lidar", "--memory", "4GB")
    options = ("--kind", "lidar", "--memory", "190kB", "--engine", "dask", "--threads", "2")
    try:
        tiled, _ = filtered_by(scan, tmp_path / "tiled.laz", *options)
    finally:
        set_engine("local")
        set_threads(2)
    np.testing.assert_array_equal(tiled.records, whole.records)


@pytest.mark.skipif(os.name != "posix", reason="signals are sent in another way")
def test_a_job_told_to_end_leaves_nothing_and_a_killed_one_until_the_next(
    scan, tmp_path, little_room
):
    """Tiles of hundreds of GB stayed beside the output for good."""
    tokens = ["filter", str(scan), str(tmp_path / "out.laz"), "--kind", "lidar", "--set", VOXEL]
    tokens += ["--memory", "190kB"]

    def ended_by(number):
        return subprocess.run(
            [sys.executable, "-c", KILLED, "7", *tokens],
            env={**os.environ, "SIGNAL": str(number)}, stderr=subprocess.PIPE, text=True,
            check=False,
        )  # fmt: skip

    told = ended_by(signal.SIGTERM)
    assert told.returncode == 143
    assert told.stderr.splitlines()[-1] == "cancelled. Nothing was written."
    assert "Traceback" not in told.stderr
    assert list(tmp_path.iterdir()) == [scan]
    assert ended_by(signal.SIGKILL).returncode == -9
    assert len(list(tmp_path.glob("tiles-out.laz-*"))) == 1
    assert call([*tokens, "--quiet"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {scan.name, "out.laz", "out.laz.json"}


def test_a_killed_run_goes_on_where_it_was(scan, tmp_path, little_room):
    whole, _ = filtered_by(scan, tmp_path / "whole.laz", "--kind", "lidar", "--memory", "4GB")
    tokens = ["filter", str(scan), str(tmp_path / "out.laz"), "--kind", "lidar", "--set", VOXEL]
    tokens += ["--memory", "190kB", "--work", str(tmp_path / "work"), "--quiet"]
    # At last no task is allowed: none is done again.
    for tasks, code in ((7, -9), (9, -9), (1000, 0), (0, 0)):
        command = [sys.executable, "-c", KILLED, str(tasks), *tokens, "--overwrite"]
        assert subprocess.run(command, check=False).returncode == code
    np.testing.assert_array_equal(read(tmp_path / "out.laz").records, whole.records)
