"""A run whose clouds do not fit in memory: the same files as one whose clouds do."""

import importlib
import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import dougong
from dougong.cli import call
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid, root_cube
from dougong.filters.protective import Taken
from dougong.filters.selection import DETAIL, Reason
from dougong.formats.model import Hold
from dougong.pipeline import books as books_module
from dougong.pipeline import memory, reduced
from dougong.pipeline.books import Binder, Books
from dougong.pipeline.result_hash import in_byte_order
from dougong.registration.result import Registration
from dougong.threads import get_threads, set_threads

SHIFT = np.array([3.0, -2.0, 0.5])
SMALL = {
    "BASE_BYTES": 0,
    "BYTES_PER_POINT": 30,
    "BYTES_PER_WAITING_POINT": 10,
    "BYTES_PER_REDUCED_POINT": 2,
    "LEAST_TILE_POINTS": 100,
    "_BYTES_PER_TILE_POINT": 40,
}
"""Estimates by which 15,000 points do not fit in 190 kB, and tiles of them do."""
ROOMS = {"whole": "4GB", "few": "500kB", "many": "190kB"}


def site(seed, offset, noise):
    """A yard of 20 m with three walls and something flying over it."""
    rng = np.random.default_rng(seed)
    yard = np.column_stack([rng.uniform(0, 20, (9000, 2)), rng.normal(0, noise, 9000)])
    walls = [
        rng.uniform((x, y, 0), (x + 6, y, 4), (2000, 3)) + rng.normal(0, noise, (2000, 3))
        for x, y in ((2, 4), (9, 9), (12, 15))
    ]
    birds = rng.uniform(3, 20, (60, 3))
    return np.round(np.vstack([yard, *walls, birds]) + offset, 4)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Two clouds, a registration that knows, and rooms that are small on purpose."""

    def register(source, target, params, **_):
        matrix = np.eye(4)
        matrix[:3, 3] = SHIFT
        return Registration(
            status="ok", matrix=matrix, reason=f"{len(source)} onto {len(target)}", probability=0.9,
            scale=1.0, dof=6, coarse_method="plan", hypotheses=(), margin=0.5, fine=None,
        )  # fmt: skip

    monkeypatch.setattr("dougong.pipeline.links.register", register)
    monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
    for name, value in SMALL.items():
        monkeypatch.setattr(memory, name, value)
    monkeypatch.setattr(reduced, "MOST_POINTS", 6000)
    monkeypatch.setattr(reduced, "LEAST_POINTS", 6000)
    monkeypatch.setattr(reduced, "_BATCH", 2000)
    monkeypatch.setattr("dougong.pipeline.tiled.CHUNK_POINTS", 2000)
    write(tmp_path)
    return tmp_path


def write(folder, order=None):
    for name, points in (("scan", site(0, 0.0, 0.002)), ("map", site(1, SHIFT, 0.01))):
        turn = np.arange(len(points)) if order is None else order.permutation(len(points))
        dougong.write(Cloud.from_points(points[turn]), folder / f"{name}.laz", overwrite=True)


def tokens_of(folder, name, room, *options, kinds=("lidar", "photogrammetry")):
    files = {"lidar": folder / "scan.laz", "photogrammetry": folder / "map.laz"}
    named = [text for kind in kinds for text in (f"--{kind}", str(files[kind]))]
    out = str(folder / name)
    return ["run", *named, "--out", out, "--memory", room, "--quiet", *options]


def run(folder, name, room, *options, **more):
    assert call(tokens_of(folder, name, room, *options, **more)) == 0
    return json.loads((folder / name / "result.json").read_text())


def comparable(result):
    """What must not depend on how a run was done."""
    for cloud in result["clouds"]:
        for stage in cloud["stages"]:
            del stage["seconds"]
    for document in result["registrations"]:
        del document["seconds"]
    names = ("clouds", "merged", "registrations", "result_hash", "notes")
    return {name: result[name] for name in names}


def bytes_of(out: Path):
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*.laz"))}


def test_every_file_is_the_same_on_tiles(folder):
    results = {name: run(folder, name, ROOMS[name]) for name in ("whole", "many")}
    files = {name: bytes_of(folder / name) for name in results}
    first = comparable(results["whole"])
    assert first["registrations"][0]["distances"] is not None
    assert 0 < first["merged"]["left_out"] < first["merged"]["points"]
    assert len(files["whole"]) == 6
    assert comparable(results["many"]) == first
    assert files["many"].keys() == files["whole"].keys()
    for path, content in files["many"].items():
        assert content == files["whole"][path], f"{path} differs on tiles"
    # Nothing is left lying about.
    assert {path.name for path in folder.iterdir()} == {*results, "scan.laz", "map.laz"}


def test_the_hash_knows_neither_order_nor_threads(folder):
    threads = get_threads()
    try:
        known = run(folder, "one", ROOMS["whole"], "--threads", "1")["result_hash"]
        write(folder, np.random.default_rng(2))
        assert run(folder, "two", ROOMS["few"], "--threads", "2")["result_hash"] == known
    finally:
        set_threads(threads)


@pytest.mark.parametrize("most", [500, 5000])
def test_a_reduced_cloud_is_the_octrees_level_whatever_the_pieces(most):
    points = site(3, 0.0, 0.01)
    cloud = Cloud.from_points(points, row=np.arange(len(points)))
    parts = np.array_split(np.random.default_rng(4).permutation(len(points)), 7)
    found = reduced.reduced(lambda: (cloud.select(part) for part in parts), len(cloud), most)
    root = root_cube(cloud.xyz, OctreeVoxelGrid(depth=20))
    kept = {}
    for level in range(1, 15):
        grid = OctreeVoxelGrid(depth=level)
        kept[level] = octree_voxel_grid(cloud.xyz, grid, records=cloud.records).is_kept
    deepest = max(level for level, mask in kept.items() if mask.sum() <= most)
    assert found.edge_m == pytest.approx(root.edge_m / 2**deepest)
    rows = np.sort(found.cloud.attribute("row"))
    np.testing.assert_array_equal(rows, np.flatnonzero(kept[deepest]))


def test_a_cloud_that_is_small_enough_is_not_reduced():
    cloud = Cloud.from_points(site(3, 0.0, 0.01))
    found = reduced.reduced(lambda: (cloud,), len(cloud), len(cloud))
    assert found.cloud is cloud
    assert found.edge_m is None


@pytest.mark.parametrize("most", [40, 10_000])
def test_records_in_parts_are_sorted_as_a_whole(tmp_path, most):
    rng = np.random.default_rng(5)
    records = np.zeros(3000, dtype=[("X", "<i4"), ("Y", "<i4"), ("c", "u1"), ("d", "<f8")])
    for name in ("X", "Y", "c"):
        records[name] = rng.integers(0, 9, 3000)
    records["d"] = rng.integers(-2, 2, 3000)
    hold = Hold(most, tmp_path / "sort")
    found = np.concatenate(list(in_byte_order(np.array_split(records, 4), 3000, hold)))
    whole = np.sort(records.view(f"V{records.dtype.itemsize}"))
    assert found.tobytes() == whole.tobytes()
    assert not list(tmp_path.rglob("sort-*"))


KILLED = """
import json, os, sys
from dougong import app
from dougong.cli import call
from dougong.pipeline import memory, spooling, writing

for name, value in json.loads(sys.argv[1]).items():
    setattr(memory, name, value)
app._build_report = lambda *_: None


def run(module, name, calls):
    # A child that is killed when it calls a function for the nth time: nothing is tidied up.
    child = os.fork()
    if child == 0:
        known, left = getattr(module, name), [calls]

        def counted(*args, **more):
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), 9)
            return known(*args, **more)

        setattr(module, name, counted)
        os._exit(call(sys.argv[2:]))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


codes = [run(spooling, "removed_sample", 0), run(writing, "choose", 0), run(writing, "choose", 9)]
sys.exit(0 if codes == [-9, -9, 0] else f"ended with {codes}")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_killed_run_ends_as_one_left_alone(folder):
    run(folder, "calm", ROOMS["whole"], kinds=("lidar",))
    rooms = {name: getattr(memory, name) for name in SMALL}
    tokens = tokens_of(folder, "killed", ROOMS["many"], kinds=("lidar",))
    subprocess.run([sys.executable, "-c", KILLED, json.dumps(rooms), *tokens], check=True)
    assert bytes_of(folder / "killed") == bytes_of(folder / "calm")
    left = {path.name for path in folder.iterdir()}
    assert left == {"calm", "killed", "scan.laz", "map.laz"}


def test_books_are_bound_in_the_order_of_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(books_module, "PAGE_POINTS", 1000)
    rng, n = np.random.default_rng(0), 4321
    codes, ground = rng.integers(2, 9, n, np.uint8), rng.integers(0, 3, n, np.uint8)
    codes[rng.random(n) < 0.5] = Reason.KEPT
    detail, tile = rng.integers(0, 5, n, np.uint8), rng.integers(0, 9, n)
    # No tile has the points of two pages, nor those of tile 8: they were decimated.
    tile[1000:3000] = 8
    (tmp_path / "books").mkdir()
    (tmp_path / "books" / "0.rows").write_bytes(b"of a killed run")
    binder = Binder(tmp_path / "books", n)
    for number in range(8):
        row = np.flatnonzero(tile == number)
        columns = {"codes": codes, "ground_class": ground, DETAIL: detail}
        binder.add(row, {name: values[row] for name, values in columns.items()})
    is_gone = tile == 8
    codes[is_gone], ground[is_gone], detail[is_gone] = Reason.DECIMATED, 0, 0
    books = Books(points=n, page=binder.page, page_points=1000, stages=(), notes=(), noticed=())
    tally = books.tally()
    assert list(tally.reasons.values()) == np.bincount(codes, minlength=len(Reason)).tolist()
    assert tally.kept == int((codes == 0).sum())
    assert tally.ground == int(((codes == 0) & (ground == 2)).sum())
    assert tally.details["alone"] == int(((codes == 3) & (detail == Taken.ALONE)).sum())
    cloud = Cloud.from_points(rng.random((n, 3)))
    for ends in ([n], [1, 999, 1000, 2500, n]):
        chunks = [cloud.select(np.arange(a, b)) for a, b in zip([0, *ends], ends, strict=False)]
        parts = [part for _, part in books.along(chunks)]
        np.testing.assert_array_equal(np.concatenate([p.codes for p in parts]), codes)
        np.testing.assert_array_equal(np.concatenate([p.ground_class for p in parts]), ground)
        np.testing.assert_array_equal(np.concatenate([p.details[DETAIL] for p in parts]), detail)
        kept = np.concatenate([part.cloud.xyz for part in parts])
        np.testing.assert_array_equal(kept, cloud.xyz[codes == 0])
    for wrong in ([cloud.select(np.arange(n - 1))], [cloud, cloud.select(np.arange(1))]):
        with pytest.raises(InputError, match="is of 4,321 points, the cloud has"):
            list(books.along(wrong))


def test_books_of_any_size_hold_a_page_at_a_time(tmp_path):
    rng, n = np.random.default_rng(0), 20_000_000
    binder = Binder(tmp_path, n)
    for start in range(0, n, 1_000_000):
        row = np.arange(start, start + 1_000_000)
        columns = {"codes": rng.integers(0, 9, 1_000_000, np.uint8)}
        columns |= dict.fromkeys(("ground_class", DETAIL), columns["codes"] % 3)
        binder.add(row, columns)
    books = Books(points=n, page=binder.page, stages=(), notes=(), noticed=())
    tracemalloc.start()
    tally = books.tally()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sum(tally.reasons.values()) == n
    assert peak < 60_000_000


def replaced_at(monkeypatch, place, path):
    """Have `path` written again, with other points, as soon as the function at `place` returns."""
    module, name = place.rsplit(".", 1)
    function = getattr(importlib.import_module(module), name)

    def replacing(*args, **more):
        found = function(*args, **more)
        dougong.write(Cloud.from_points(site(7, 0.0, 0.002)[1:]), path, overwrite=True)
        return found

    monkeypatch.setattr(place, replacing)


@pytest.mark.parametrize(
    ("room", "place"),
    [
        ("whole", "dougong.pipeline.filtering.read"),
        ("many", "dougong.pipeline.filtering.identified"),
    ],
)
def test_a_file_replaced_while_it_is_filtered_ends_the_filter(
    room, place, folder, monkeypatch, capsys
):
    scan, out = folder / "scan.laz", folder / "out.laz"
    replaced_at(monkeypatch, place, scan)
    tokens = ["filter", str(scan), str(out), "--kind", "lidar", "--memory", ROOMS[room], "--quiet"]
    assert call(tokens) == 1
    assert "scan.laz was changed or replaced while it was worked on" in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == {"scan.laz", "map.laz"}


def test_a_file_replaced_while_it_is_read_once_more_ends_the_run(folder, monkeypatch, capsys):
    work = ("--work", str(folder / "work"))
    run(folder, "out", ROOMS["many"], *work, kinds=("lidar",))
    replaced_at(monkeypatch, "dougong.pipeline.loading.identified", folder / "scan.laz")
    tokens = tokens_of(folder, "again", ROOMS["many"], *work, kinds=("lidar",))
    assert call(tokens) == 1
    assert "scan.laz was changed or replaced while it was worked on" in capsys.readouterr().err
    assert not (folder / "again").exists()


def test_a_file_replaced_while_it_is_registered_ends_the_registration(folder, monkeypatch, capsys):
    replaced_at(monkeypatch, "dougong.pipeline.registering_files.read", folder / "scan.laz")
    tokens = ["register", str(folder / "scan.laz"), str(folder / "map.laz")]
    assert call([*tokens, "--out", str(folder / "out"), "--quiet"]) == 1
    assert "scan.laz was changed or replaced while it was worked on" in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == {"scan.laz", "map.laz"}
