"""Files issued again in another frame, chunk by chunk: the same as moving them whole."""

import resource
import struct

import laspy
import numpy as np
import pytest

from dougong.cloud import Cloud, Frame
from dougong.errors import InputError, OutputError
from dougong.formats import (
    can_reissue,
    is_same_crs,
    read,
    reissue,
    scans_in,
    units_of,
    write,
)
from e57_surveys import survey, turn
from reference.e57 import rotation_of, tree, world

TARGET = Frame(origin=np.array([500_000.0, 4_000_000.0, 0.0]), crs="EPSG:32650")


def motion(scale=1.0):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_of(*turn(0.4, 0.01, -0.02))
    matrix[:3, 3] = [500_100.0, 4_000_200.0, 30.0]
    return matrix


def scan(count=5000):
    rng = np.random.default_rng(1)
    return Cloud.from_points(
        np.rint(rng.uniform(-60, 60, (count, 3)) * 1e4) / 1e4,
        intensity=np.linspace(0, 4000, count).astype("f4"),  # whole in some chunks only
        red=rng.integers(0, 256, count).astype("u1"),
        green=rng.integers(0, 256, count).astype("u1"),
        blue=rng.integers(0, 256, count).astype("u1"),
        classification=np.arange(count).astype("i4") // 1000,
        quality=rng.uniform(0, 1, count),
        nx=np.ones(count, "f4"), ny=np.zeros(count, "f4"), nz=np.zeros(count, "f4"),
    )  # fmt: skip


def written_as(folder, suffix):
    cloud = scan()
    path = folder / f"scan{suffix}"
    if suffix == ".csv":
        names = ["x", "y", "z", "intensity", "classification"]
        columns = [cloud.attribute(name) for name in names]
        np.savetxt(path, np.stack(columns, axis=1), fmt="%.4f", delimiter=",",
                   header=",".join(names), comments="")  # fmt: skip
    else:
        write(cloud, path)
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz", ".ply", ".csv"])
def test_chunks_give_what_the_whole_gives(tmp_path, suffix):
    source = written_as(tmp_path, suffix)
    cloud = read(source)
    matrix = motion()
    reissue(source, tmp_path / "out.laz", [matrix], TARGET, chunk_points=700)
    found = read(tmp_path / "out.laz")
    write(cloud.moved(matrix, TARGET), tmp_path / "whole.laz")
    expected = read(tmp_path / "whole.laz")
    assert len(found) == len(cloud)
    step = np.array(found.frame.step)
    assert (step <= 1e-4 * (1 + 1e-9)).all()
    there = cloud.frame.to_file(cloud.xyz) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(found.frame.to_file(found.xyz) - there).max() <= step.max() / 2 + 1e-8
    assert set(found.attributes) == set(expected.attributes)
    for name in set(found.attributes) - {"X", "Y", "Z"}:
        assert np.array_equal(found.attribute(name), expected.attribute(name)), name
    assert is_same_crs(found.frame.crs, "EPSG:32650")


@pytest.mark.parametrize("suffix", [".laz", ".csv"])
def test_the_chunk_size_changes_no_byte(tmp_path, suffix):
    source = written_as(tmp_path, suffix)
    for name, size in (("a.laz", 100_000), ("b.laz", 999)):
        reissue(source, tmp_path / name, [motion()], TARGET, chunk_points=size)
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()


def test_laspy_reads_it_with_its_reference_system(tmp_path):
    source = written_as(tmp_path, ".ply")
    reissue(source, tmp_path / "out.laz", [motion()], TARGET, chunk_points=1000)
    file = laspy.read(tmp_path / "out.laz")
    assert file.header.global_encoding.wkt
    assert file.header.parse_crs().to_epsg() == 32650
    assert len(file.points) == 5000
    low, high = file.header.mins, file.header.maxs
    assert (np.abs(low - file.xyz.min(axis=0)) < 1e-9).all()
    assert (np.abs(high - file.xyz.max(axis=0)) < 1e-9).all()
    assert np.array_equal(np.asarray(file.quality), scan().attribute("quality"))


def test_a_header_that_lies_about_its_bounds(tmp_path):
    source = written_as(tmp_path, ".las")
    data = bytearray(source.read_bytes())
    struct.pack_into("<6d", data, 179, 1, 0, 1, 0, 1, 0)
    source.write_bytes(data)
    reissue(source, tmp_path / "out.laz", [motion()], TARGET)
    found, matrix = read(tmp_path / "out.laz"), motion()
    own = scan()
    there = own.frame.to_file(own.xyz) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(found.frame.to_file(found.xyz) - there).max() < 6e-5


def test_a_scale_and_feet(tmp_path):
    source = written_as(tmp_path, ".laz")
    feet = Frame(crs="EPSG:2277", unit_m=units_of("EPSG:2277").unit_m)
    matrix = motion(scale=1 / feet.unit_m[0])
    reissue(source, tmp_path / "out.laz", [matrix], feet)
    found, own = read(tmp_path / "out.laz"), scan()
    there = own.frame.to_file(own.xyz) @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(found.frame.to_file(found.xyz) - there).max() < 6e-4
    assert found.frame.unit_m == feet.unit_m


def test_e57_in_a_frame_of_feet_is_metres(tmp_path):
    source = survey(tmp_path / "a.e57")
    unit = units_of("EPSG:2277").unit_m
    matrix = motion(scale=1 / unit[0])
    reissue(source, tmp_path / "b.e57", [matrix] * 4, Frame(crs="EPSG:2277", unit_m=unit))
    before, after = tree(source), tree(tmp_path / "b.e57")
    there, is_invalid = world(before, 1)
    found, _ = world(after, 1)
    expected = (there @ matrix[:3, :3].T + matrix[:3, 3]) * unit
    assert np.abs(found - expected)[~is_invalid].max() < 1e-7
    assert "metre" in after["/coordinateMetadata"][1]


def test_scans_of_a_ptx_file_move_each_by_its_own_matrix(tmp_path):
    rng = np.random.default_rng(3)
    lines, own = [], []
    for k in range(3):
        points = np.round(rng.uniform(1, 20, (50, 3)), 4)
        own.append(points + [100 * k, 0, 0])
        lines += ["5", "10", f"{100 * k} 0 0", "1 0 0", "0 1 0", "0 0 1"]
        lines += ["1 0 0 0", "0 1 0 0", "0 0 1 0", f"{100 * k} 0 0 1"]
        lines += [f"{x:.4f} {y:.4f} {z:.4f} 0.5" for x, y, z in points]
    (tmp_path / "a.ptx").write_text("\n".join(lines) + "\n")
    assert scans_in(tmp_path / "a.ptx")[0] == 3
    turned = [motion(), None, motion(0.999)]
    reissue(tmp_path / "a.ptx", tmp_path / "out.laz", turned, TARGET, chunk_points=30)
    found = read(tmp_path / "out.laz")
    station = found.attribute("station")
    assert station.tolist() == [0] * 50 + [2] * 50
    for k in (0, 2):
        there = own[k] @ turned[k][:3, :3].T + turned[k][:3, 3]
        xyz = found.frame.to_file(found.xyz)[station == k]
        assert np.abs(xyz - there).max() < 6e-5
    with pytest.raises(InputError, match="keeps 3 scans apart, got a list of 1"):
        reissue(tmp_path / "a.ptx", tmp_path / "b.laz", [motion()], TARGET)


def test_a_full_disk_leaves_nothing(tmp_path):
    source = written_as(tmp_path, ".las")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, limits[1]))
    try:
        with pytest.raises(OutputError, match="limit was reached"):
            reissue(source, tmp_path / "out.las", [motion()], TARGET)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [p.name for p in tmp_path.iterdir()] == ["scan.las"]


def test_what_does_not_go_together_is_refused(tmp_path):
    source = written_as(tmp_path, ".laz")
    assert not can_reissue(source, tmp_path / "a.e57")
    with pytest.raises(InputError, match="cannot be made"):
        reissue(source, tmp_path / "a.e57", [motion()], TARGET)
    with pytest.raises(InputError, match="keeps 1 scans apart, got a list of 2"):
        reissue(source, tmp_path / "a.laz", [motion(), motion()], TARGET)
