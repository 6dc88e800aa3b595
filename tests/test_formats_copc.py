"""COPC: read back by laspy, every point once, found by place and by level."""

import contextlib
import os
import platform
import struct
import subprocess
import sys

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds, CopcReader

from dougong.cloud import Cloud
from dougong.errors import FormatError, OutputError
from dougong.formats import describe, iterate, read, write
from dougong.formats.copc_nodes import LEAF_CAPACITY, priorities
from dougong.formats.las_header import LasHeader
from dougong.formats.model import Hold
from dougong.formats.unfinished import own_mark, remove_unfinished
from dougong.kernels.copc_levels import cube_codes, leaf_levels, pick_per_cell, priority
from dougong.threads import get_threads, set_threads
from reference.formats import cube_code
from test_formats_las import random_las


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """A wall with a far point: 150000 points, some of them at one place."""
    rng = np.random.default_rng(3)
    n = 150_000
    points = np.stack([rng.uniform(0, 40, n), rng.normal(0, 0.01, n), rng.uniform(0, 8, n)], axis=1)
    points[: n // 10] = points[0]
    points[-1] = [400.0, 300.0, 20.0]
    cloud = Cloud.from_points(
        points + [500_000, 4_000_000, 50],
        intensity=rng.integers(0, 65535, n).astype("u2"),
        red=rng.integers(0, 65535, n).astype("u2"),
        green=rng.integers(0, 65535, n).astype("u2"),
        blue=rng.integers(0, 65535, n).astype("u2"),
        gps_time=rng.uniform(0, 1e5, n),
        ident=np.arange(n, dtype="u4"),
        crs="EPSG:32650",
    )
    folder = tmp_path_factory.mktemp("copc")
    written = write(cloud, folder / "wall.copc.laz")
    write(cloud, folder / "wall.las")
    return folder / "wall.copc.laz", folder / "wall.las", written


def _xyz(points):
    return np.stack([points.x, points.y, points.z], axis=1)


def _sorted(array):
    return np.sort(np.ascontiguousarray(array).view(f"V{array.dtype.itemsize}").ravel())


def test_the_same_points_come_back(wall):
    path, plain, written = wall
    expected = read(plain)
    cloud = read(path)
    assert written.points == len(cloud) == 150_000
    assert cloud.header.is_copc
    assert np.array_equal(_sorted(cloud.records), _sorted(expected.records))
    assert cloud.frame.crs == expected.frame.crs is not None
    assert describe(path).format == "COPC"
    with CopcReader.open(path) as reader:
        points = reader.query()
        assert np.array_equal(_sorted(points.array), _sorted(expected.records))


def test_queries_by_place_find_all_and_only_what_is_there(wall):
    path, plain, _ = wall
    las = laspy.read(plain)
    low, high = np.array([500_010.0, 3_999_999.0, 51.0]), np.array([500_015.5, 4_000_001.0, 54.0])
    inside = ((las.xyz >= low) & (las.xyz <= high)).all(axis=1)
    with CopcReader.open(path) as reader:
        found = reader.query(Bounds(mins=low, maxs=high))
        assert sorted(found["ident"]) == sorted(las["ident"][inside])
        assert 0 < inside.sum() < len(inside)


def test_each_level_shows_one_point_per_cell_and_covers_the_cloud(wall):
    path, plain, _ = wall
    las = laspy.read(plain)
    seen = []
    with CopcReader.open(path) as reader:
        info = reader.copc_info
        assert info.halfsize * 2 == pytest.approx(400.0, abs=0.1)
        assert info.spacing == pytest.approx(info.halfsize * 2 / 128)
        corner = np.asarray(info.center) - info.halfsize
        assert corner == pytest.approx(reader.header.mins, abs=1e-9)
        assert info.gps_min == las.gps_time.min()
        assert info.gps_max == las.gps_time.max()
        for level in range(3):
            points = reader.query(level=level)
            seen.append(set(points["ident"].tolist()))
            if level == 0:
                cells = np.floor((_xyz(points) - corner) / info.spacing).astype(int)
                assert len(np.unique(cells, axis=0)) == len(points)
    assert not seen[0] & seen[1]
    root = las.xyz[np.isin(las["ident"], list(seen[0]))]
    shown = root[root[:, 0] < 500_100.0, 0]
    assert np.ptp(shown) > 40.0 - 2 * info.spacing, "the first level shows the whole wall"


def test_the_nodes_of_the_hierarchy_hold_their_points(wall):
    """Every chunk's points lie in its node's cube, and counts add up."""
    path, _, _ = wall
    with CopcReader.open(path) as reader:
        info = reader.copc_info
        total = 0
        corner = np.asarray(info.center) - info.halfsize
        for key, entry in reader.root_page.entries.items():
            total += entry.point_count
            points = reader.query(level=key.level)
            edge = 2 * info.halfsize / 2**key.level
            low = corner + edge * np.array([key.x, key.y, key.z])
            is_in = ((_xyz(points) >= low - 1e-6) & (_xyz(points) <= low + edge + 1e-6)).all(axis=1)
            assert is_in.sum() >= entry.point_count
            if key.level:
                parent = (key.level - 1, key.x >> 1, key.y >> 1, key.z >> 1)
                keys = {(k.level, k.x, k.y, k.z) for k in reader.root_page.entries}
                assert parent in keys, "no node hangs in the air"
        assert total == 150_000


def test_the_file_does_not_depend_on_the_thread_count(wall, tmp_path):
    _, plain, _ = wall
    before = get_threads()
    try:
        set_threads(1)
        write(read(plain), tmp_path / "one.copc.laz")
        set_threads(4)
        write(read(plain), tmp_path / "four.copc.laz")
    finally:
        set_threads(before)
    assert (tmp_path / "one.copc.laz").read_bytes() == (tmp_path / "four.copc.laz").read_bytes()


def test_chunks_of_a_copc_are_the_whole(wall):
    path, _, _ = wall
    whole = read(path)
    parts = list(iterate(path, 40_000))
    assert np.array_equal(np.concatenate([p.xyz for p in parts]), whole.xyz)
    assert b"".join(p.records.tobytes() for p in parts) == whole.records.tobytes()


@pytest.mark.parametrize(
    ("point_format", "version"), [(0, "1.2"), (3, "1.2"), (5, "1.3"), (8, "1.4"), (10, "1.4")]
)
def test_older_point_formats_are_upgraded(tmp_path, point_format, version):
    random_las(tmp_path / "a.las", point_format, version, count=3000)
    written = write(read(tmp_path / "a.las"), tmp_path / "b.copc.laz")
    assert any("waveform" in note for note in written.notes) == (point_format in (5, 10))
    old = read(tmp_path / "a.las")
    new = read(tmp_path / "b.copc.laz")
    assert isinstance(new.header, LasHeader)
    assert new.header.point_format in (6, 7, 8)
    key, other = (
        np.lexsort([c.records[n] for n in ("deviation", "intensity", "Z", "Y", "X")])
        for c in (old, new)
    )
    names = ["X", "Y", "Z", "intensity", "user_data", "point_source_id", "return_number",
             "number_of_returns", "withheld", "synthetic", "key_point", "edge_of_flight_line",
             "scan_direction_flag", "deviation", "direction"]  # fmt: skip
    names += [n for n in ("gps_time", "red", "nir") if n in old.attributes]
    for name in names:
        assert old.attribute(name)[key].tobytes() == new.attribute(name)[other].tobytes(), name
    was, now = old.attribute("classification")[key], new.attribute("classification")[other]
    if point_format < 6:
        assert (now == np.where(was == 12, 1, was)).all()
        assert (new.attribute("overlap")[other] == (was == 12)).all()
        angle = new.attribute("scan_angle")[other] * 0.006
        assert np.abs(angle - old.attribute("scan_angle_rank")[key]).max() <= 0.003 + 1e-9
    else:
        assert (was == now).all()
    assert laspy.read(tmp_path / "b.copc.laz").header.vlrs.get("surveyor") is not None


def error_of(path):
    """Return the one sentence that reading `path` ends with, None if it can be read."""
    try:
        read(path)
    except FormatError as error:
        return str(error)
    return None


def test_corrupt_chunks_give_one_sentence(wall, tmp_path):
    """Lazrs panics over some of these; that must not end the program."""
    raw = wall[0].read_bytes()
    for at in (5_000, len(raw) // 3, len(raw) // 2):
        bad = tmp_path / f"{at}.copc.laz"
        bad.write_bytes(raw[:at] + bytes(4000) + raw[at + 4000 :])
        found = error_of(bad)
        # LAZ has no checksum: some damage only changes points.
        assert found is None or "header says 150,000 points, file ends after about" in found
    cut = tmp_path / "cut.copc.laz"
    cut.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(FormatError, match="header says 150,000 points and records at byte"):
        read(cut)


def test_a_copc_without_chunk_table_cannot_be_read(wall, tmp_path):
    raw = bytearray(wall[0].read_bytes())
    struct.pack_into("<Q", raw, 235, 0)
    struct.pack_into("<I", raw, 243, 0)
    (start,) = struct.unpack_from("<I", raw, 96)
    (tmp_path / "a.copc.laz").write_bytes(raw[: start + 100_000])
    with pytest.raises(FormatError, match="header says 150,000 points, file ends after about 0"):
        read(tmp_path / "a.copc.laz")


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points_and_one_place(tmp_path, count):
    cloud = Cloud.from_points(np.full((count, 3), 7.25))
    write(cloud, tmp_path / "a.copc.laz")
    again = read(tmp_path / "a.copc.laz")
    assert again.frame.to_file(again.xyz).tolist() == [[7.25] * 3] * count
    with CopcReader.open(tmp_path / "a.copc.laz") as reader:
        assert len(reader.query()) == count


def test_codes_against_the_slow_twin():
    rng = np.random.default_rng(0)
    xyz = rng.integers(-(2**31), 2**31, (500, 3)).astype(np.int32)
    low = np.array([-(2**31)] * 3, dtype=np.int64)
    scale = np.array([2.0**21 / 2**32] * 3)
    out = np.empty(500, dtype=np.uint64)
    x, y, z = (np.ascontiguousarray(xyz[:, k]) for k in range(3))
    cube_codes(x, y, z, low, scale, 0, 500, out)
    expected = [cube_code(row, low.tolist(), scale.tolist()) for row in xyz.tolist()]
    assert out.tolist() == expected


def test_leaves_against_the_slow_twin():
    rng = np.random.default_rng(1)
    codes = np.sort(rng.integers(0, 2**63, 500).astype(np.uint64))
    codes = np.sort(np.concatenate([codes, np.full(40, codes[7])]))
    found = np.empty(len(codes), np.int8)
    for first, capacity, deepest in ((0, 9, 21), (0, 5000, 21), (0, 9, 2), (1, 900, 21)):
        leaf_levels(codes, first, capacity, deepest, found)
        held = np.empty((22, len(codes)), int)
        for level in range(22):
            nodes = codes >> np.uint64(63 - 3 * level)
            held[level] = (nodes[:, None] == nodes[None, :]).sum(axis=1)
        assert all(
            (held[level, place] <= capacity or level == deepest)
            and (held[first:level, place] > capacity).all()
            for place, level in enumerate(found.tolist())
        )


def test_cells_against_the_slow_twin():
    rng = np.random.default_rng(1)
    codes = np.sort(rng.integers(0, 2**12, 3000).astype(np.uint64))
    is_taken = np.zeros(len(codes), dtype=bool)
    pick_per_cell(codes, np.uint64(3), is_taken)
    cells = codes >> np.uint64(3)
    for cell in np.unique(cells):
        (chosen,) = codes[(cells == cell) & is_taken]
        assert chosen == min(codes[cells == cell], key=lambda code: int(priority(code)))
    wide = rng.integers(0, 2**63, 1000).astype(np.uint64)
    ours = np.array([priority(code) for code in wide])
    assert np.array_equal(ours, priorities(wide))
    assert abs(np.mean(ours / 2.0**64) - 0.5) < 0.03


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
def test_what_a_cancelled_or_killed_writer_held_on_disk_goes(tmp_path):
    out = tmp_path / "a.copc.laz"
    cloud = Cloud.from_points(np.random.default_rng(0).uniform(0, 10, (3 * LEAF_CAPACITY, 3)))
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    dead = tmp_path / f"copc-{out.name}-{platform.node()}-{process.pid}"
    dead.mkdir()
    (dead / "points").write_bytes(b"of a killed one")
    passes, seen = [], []

    def pieces():
        passes.append(1)
        for start in range(0, len(cloud), 50_000):
            yield cloud.select(np.arange(start, min(start + 50_000, len(cloud))))
        seen.append({path.name for path in tmp_path.glob("copc-*")})
        if len(passes) == 3:
            remove_unfinished()
            seen.append({path.name for path in tmp_path.glob("copc-*")})

    with contextlib.suppress(OutputError):  # of a process that would have ended by now
        write(pieces, out, hold=Hold(1, tmp_path))
    assert seen[-2] == {f"copc-{out.name}-{own_mark()}"}
    assert seen[-1] == set()
    assert not list(tmp_path.glob("copc-*"))


@pytest.mark.parametrize("far_m", [0.0, 3000.0])
def test_the_file_is_the_same_in_parts_on_disk(tmp_path, far_m):
    """Pieces, parts and the order of the points leave no trace, even where parts are tiny nodes."""
    rng = np.random.default_rng(5)
    count = 3 * LEAF_CAPACITY
    points = rng.uniform(0, 10, (count, 3)) * [1, 1, 0.02]
    points[:2000] = points[0]
    points[-1] = far_m
    cloud = Cloud.from_points(points, ident=np.arange(count, dtype="u4"))
    write(cloud, tmp_path / "whole.copc.laz")
    shuffled = cloud.select(rng.permutation(count))

    def pieces():
        for start in range(0, count, 50_000):
            yield shuffled.select(np.arange(start, min(start + 50_000, count)))

    work = tmp_path / "work"
    work.mkdir()
    write(pieces, tmp_path / "parts.copc.laz", hold=Hold(1, work))
    assert (tmp_path / "parts.copc.laz").read_bytes() == (tmp_path / "whole.copc.laz").read_bytes()
    assert list(work.iterdir()) == []
    with CopcReader.open(tmp_path / "parts.copc.laz") as reader:
        assert sorted(reader.query()["ident"]) == list(range(count))
