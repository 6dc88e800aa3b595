"""Writing: all or nothing, refusals, full disks, several clouds in one file, between families."""

import errno
import os
import re
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

from dougong.cloud import Cloud, Frame
from dougong.errors import FormatError, FrameError, InputError, OutputError
from dougong.formats import read, require_metric, units_of, write, write_merged
from dougong.formats.atomic import Sink, replacing
from test_formats_las import packed, random_las

SUFFIXES = [".las", ".laz", ".copc.laz", ".ply"]


def small(count=1000, seed=0, **attributes):
    points = np.random.default_rng(seed).uniform(0, 10, (count, 3)) + [500_000, 4_000_000, 0]
    return Cloud.from_points(points, **attributes)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_written_says_what_there_is(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    written = write(small(), path, notes=["kept from before"])
    assert written.path == path
    assert written.points == 1000
    assert written.bytes == path.stat().st_size > 0
    assert written.notes[0] == "kept from before"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_finished_outputs_are_not_overwritten_unless_asked(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write(small(10), path)
    before = path.read_bytes()
    with pytest.raises(OutputError, match="--overwrite"):
        write(small(20), path)
    assert path.read_bytes() == before
    write(small(20), path, overwrite=True)
    assert len(read(path)) == 20


def test_the_input_is_never_the_output(tmp_path):
    path = tmp_path / "a.laz"
    write(small(10), path)
    (tmp_path / "link.laz").symlink_to(path)
    for target in (path, tmp_path / "link.laz", tmp_path / ".." / tmp_path.name / "a.laz"):
        with pytest.raises(OutputError, match="is the input itself"):
            write(read(path), target, overwrite=True)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.pcd", "written as"),
        ("a.xyz", "written as"),
        ("a", "suffix 'none'"),
        ("nowhere/a.las", "not a folder"),
    ],
)
def test_bad_targets(tmp_path, name, words):
    with pytest.raises(OutputError, match=words):
        write(small(10), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_as_target(tmp_path):
    (tmp_path / "a.las").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        write(small(10), tmp_path / "a.las", overwrite=True)


def test_nothing_left_to_write(tmp_path):
    with pytest.raises(OutputError, match="no points left"):
        write(small(10).select(np.zeros(10, bool)), tmp_path / "a.las")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("has_old", [False, True])
def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch, suffix, has_old):
    path = tmp_path / f"a{suffix}"
    cloud = small(300_000)
    if has_old:
        write(small(10), path)
        before = path.read_bytes()
    room = [200_000]
    real = Sink.write

    def write_until_full(self, data):
        room[0] -= len(memoryview(data).cast("B"))
        if room[0] < 0:
            self.error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise self.error
        return real(self, data)

    monkeypatch.setattr(Sink, "write", write_until_full)
    with pytest.raises(OutputError, match=r"disk is full: .* needs about [\d.]+ .B, [\d.]+ .B are"):
        write(cloud, path, overwrite=True)
    assert list(tmp_path.iterdir()) == ([path] if has_old else [])
    if has_old:
        assert path.read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_device_is_said_whoever_meets_it(tmp_path, monkeypatch):
    """The system itself refuses, below the encoder, at a flush."""
    real = Path.open

    def open_full(self, mode="r", *args, **kwargs):
        return real(Path("/dev/full") if "w" in mode else self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", open_full)
    for suffix in (".las", ".ply"):
        with pytest.raises(OutputError, match="disk is full"):
            write(small(50_000), tmp_path / f"a{suffix}")


def test_the_file_size_limit_is_said(tmp_path):
    code = (
        "import signal, numpy as np; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "from dougong.cloud import Cloud\nfrom dougong.formats import write\n"
        "cloud = Cloud.from_points(np.random.default_rng(0).random((200000, 3)))\n"
        f"for s in ('.las', '.laz', '.copc.laz', '.ply'):\n"
        "    try:\n"
        f"        write(cloud, r'{tmp_path}/a' + s)\n"
        "    except Exception as error:\n"
        "        print(type(error).__name__, error)\n"
    )
    limit = 300_000
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "DOUGONG_NUMBA_CACHE": "0"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 4, done.stderr
    assert all(line.startswith("OutputError The file size limit was reached") for line in lines)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_leaves_nothing(tmp_path):
    def interrupted():
        with replacing(tmp_path / "a", expected_bytes=1) as sink:
            sink.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_attributes_travel_between_families(tmp_path, suffix):
    n = 500
    rng = np.random.default_rng(1)
    attributes = {
        "intensity": rng.integers(0, 65535, n).astype("u2"),
        "classification": rng.integers(0, 255, n).astype("u1"),
        "gps_time": rng.uniform(0, 1e6, n),
        "red": rng.integers(0, 256, n).astype("u1"),
        "green": rng.integers(0, 256, n).astype("u1"),
        "blue": rng.integers(0, 256, n).astype("u1"),
        "curvature": rng.uniform(0, 1, n),
        "is_ground": rng.random(n) < 0.5,
        "voxel_count": rng.integers(0, 9999, n).astype("i4"),
        "truth_label": rng.integers(-3, 3, n).astype("i1"),
        "row": rng.integers(0, 2**40, n),
        "a name that is longer than thirty-two bytes": np.arange(n).astype("u2"),
    }
    cloud = small(n, **attributes)
    first = write(cloud, tmp_path / f"a{suffix}")
    again = read(tmp_path / f"a{suffix}")
    names = [name for name in attributes if len(name) <= 32]
    key = np.argsort(again.attribute("gps_time"))
    other = np.argsort(attributes["gps_time"])
    for name in names:
        found, expected = again.attribute(name)[key], attributes[name][other]
        if name in ("red", "green", "blue") and suffix != ".ply":
            found = found // 257
        assert np.array_equal(found, expected), name
    step = 5.1e-5 if suffix != ".ply" else 1e-9
    there, here = again.frame.to_file(again.xyz)[key], cloud.frame.to_file(cloud.xyz)[other]
    assert np.abs(there - here).max() < step
    if suffix != ".ply":
        assert any("32 bytes" in note for note in first.notes)
        assert (again.attribute("return_number") == 1).all()
        assert again.header.minor == 4
        assert again.header.point_format == 7
        # From LAS to PLY and back: the 8-bit colours are 8-bit again.
        write(again, tmp_path / "c.ply")
        assert read(tmp_path / "c.ply").attribute("red").dtype == np.uint8


def test_long_names_are_cut_by_bytes_and_told_apart_by_numbers(tmp_path):
    same, ratio = "a" * 30, "平均曲率与粗糙度的比值"
    columns = {f"{same}_{end}": np.full(4, k) for k, end in enumerate(["one", "one_more", "ones"])}
    columns |= {ratio + end: np.full(4, k + 0.5) for k, end in enumerate("甲乙丙")}
    columns[same + "_vector"] = np.arange(12.0).reshape(4, 3)
    cloud = small(4)
    layout = [(name, column.dtype, column.shape[1:]) for name, column in columns.items()]
    records = np.zeros(4, dtype=[*cloud.records.dtype.descr, *layout])
    for name, column in columns.items():
        records[name] = column
    written = write(replace(cloud, records=records), tmp_path / "a.las")
    found = read(tmp_path / "a.las")
    names = [f"{same}_o", f"{same}_2", f"{same}_3"]
    names += [ratio[:10], f"{ratio[:10]}_2", f"{ratio[:10]}_3"]
    vector = [f"{same}_{k}" if k < 2 else f"{'a' * 28}_2_2" for k in range(3)]
    assert list(laspy.read(tmp_path / "a.las").point_format.extra_dimension_names) == names + vector
    for name, column in zip(names, columns.values(), strict=False):
        assert np.array_equal(found.attribute(name), column)
    held = np.stack([found.attribute(name) for name in vector], axis=1)
    assert np.array_equal(held, columns[same + "_vector"])
    said = f"{same}_one_more is named {same}_2: LAS names hold 32 bytes, each once."
    assert said in written.notes


def test_near_infrared_gives_point_format_8(tmp_path):
    cloud = small(5, nir=np.arange(5, dtype="u2"), red=np.zeros(5, "u2"))
    write(cloud, tmp_path / "a.las")
    again = read(tmp_path / "a.las")
    assert again.header.point_format == 8
    assert again.attribute("nir").tolist() == list(range(5))


@pytest.mark.parametrize(
    ("values", "stored"),
    [
        (np.array([0.0, 0.5, 1.0]), [0, 32768, 65535]),
        (np.array([0.0, 300.25, 2047.0]), [0, 300, 2047]),
        (np.array([-5.0, 0.0, 7.0]), [0, 0, 0]),
        (np.array([0.0, 1.0, np.nan]), [0, 0, 0]),
        (np.array([3.0, 4.0, 65535.0]), [3, 4, 65535]),
    ],
)
def test_float_intensities_lose_nothing(tmp_path, values, stored):
    written = write(small(3, intensity=values), tmp_path / "a.las")
    again = read(tmp_path / "a.las")
    assert again.attribute("intensity").tolist() == stored
    exact = again.attribute("intensity_float")
    if exact is None:
        assert values.tolist() == stored
    else:
        assert np.array_equal(exact, values, equal_nan=True)
        assert any("intensity" in note for note in written.notes)


def test_the_step_is_a_tenth_of_a_millimetre_or_the_inputs_own(tmp_path):
    rng = np.random.default_rng(0)
    for decimals, step in ((None, 1e-4), (2, 1e-4), (5, 1e-5), (6, 1e-6)):
        points = rng.uniform(0, 100, (50, 3))
        text = "\n".join(
            " ".join(repr(v) if decimals is None else f"{v:.{decimals}f}" for v in row)
            for row in points.tolist()
        )
        path = tmp_path / f"{decimals}.xyz"
        path.write_text(text)
        cloud = read(path)
        write(cloud, tmp_path / f"{decimals}.las")
        again = read(tmp_path / f"{decimals}.las")
        assert again.header.scale.tolist() == [step] * 3
        error = np.abs(again.frame.to_file(again.xyz) - cloud.frame.to_file(cloud.xyz)).max()
        assert error < (step / 2 * 1.01 if decimals is None else 1e-12)


def test_degrees_keep_their_digits_but_are_not_metric(tmp_path):
    points = np.array([[116.3912345, 39.9067891, 44.5], [116.3923456, 39.9078912, 50.0]])
    cloud = Cloud.from_points(points, crs="EPSG:4326")
    write(cloud, tmp_path / "a.las")
    again = read(tmp_path / "a.las")
    assert np.abs(again.frame.to_file(again.xyz) - points).max() < 6e-8
    assert units_of(again.frame.crs).is_geographic
    with pytest.raises(FrameError, match=r"UTM zone 50N \(EPSG:32650\)"):
        require_metric(again)
    require_metric(small(5))
    south = Cloud.from_points(np.array([[-70.5, -33.4, 500.0]]), crs="EPSG:4326")
    with pytest.raises(FrameError, match=r"UTM zone 19S \(EPSG:32719\)"):
        require_metric(south)
    chinese = Cloud.from_points(np.array([[113.13, 40.12, 1000.0]]), crs="EPSG:4490")
    with pytest.raises(FrameError, match=r"Gauss-Kruger CM 114E \(EPSG:4547\)"):
        require_metric(chinese)
    place = np.array([[-2_170_000.0, 4_380_000, 4_070_000]])
    with pytest.raises(FrameError, match=r"earth-centred.*UTM zone 50N \(EPSG:32650\)"):
        require_metric(Cloud.from_points(place, crs="EPSG:4978"))
    with pytest.raises(FrameError, match=r"earth-centred.*UTM zone of the site"):
        require_metric(Cloud.from_points(np.array([[1.0, 2.0, 3.0]]), crs="EPSG:4978"))


def test_the_gauss_kruger_zones_named_are_the_registered_ones():
    from pyproj import CRS

    from dougong.formats.units import metric_problem

    for longitude in (75.2, 90.0, 113.13, 121.4, 134.9):
        text = metric_problem("EPSG:4490", [longitude, 30, 0], [longitude, 30, 0])
        found = CRS.from_epsg(int(re.search(r"EPSG:(\d+)", text)[1]))
        assert found.name in text
        values = {p["name"]: p["value"] for p in found.to_json_dict()["conversion"]["parameters"]}
        assert abs(values["Longitude of natural origin"] - longitude) <= 1.5


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz"])
def test_merged_clouds_keep_every_attribute_and_know_whose_point_is_whose(tmp_path, suffix):
    random_las(tmp_path / "a.las", 3, "1.2", count=2000, seed=1)
    random_las(tmp_path / "b.las", 6, "1.4", count=1000, seed=2, extras=False)
    first, second = read(tmp_path / "a.las"), read(tmp_path / "b.las")
    second = second.with_attribute("curvature", np.arange(1000) / 7)
    written = write_merged([first, second], tmp_path / f"c{suffix}", source_ids=[3, 9])
    assert written.points == 3000
    merged = read(tmp_path / f"c{suffix}")
    assert merged.attribute("source_id").dtype == np.uint8
    for ident, cloud in ((3, first), (9, second)):
        part = merged.select(merged.attribute("source_id") == ident)
        assert len(part) == len(cloud)
        by = ("intensity", "Z", "Y", "X")
        key, other = (np.lexsort([c.records[name] for name in by]) for c in (cloud, part))
        names = ["X", "Y", "Z", "intensity", "user_data", "point_source_id", "gps_time"]
        names += [
            n for n in ("red", "amplitude", "direction", "curvature") if n in cloud.attributes
        ]
        for name in names:
            assert cloud.attribute(name)[key].tobytes() == part.attribute(name)[other].tobytes()
        missing = {"amplitude", "curvature", "red"} - set(cloud.attributes)
        for name in missing:
            assert not part.attribute(name).any()
    las = laspy.read(tmp_path / f"c{suffix}")
    assert las.header.point_count == 3000
    deviation = las.point_format.dimension_by_name("deviation")
    assert (deviation.scales[0], deviation.offsets[0]) == (0.01, 3.0), "still a scaled dimension"
    assert las.point_format.dimension_by_name("amplitude").description == "of the echo"
    again = write_merged([merged], tmp_path / f"d{suffix}", source_ids=[1])
    assert any("its own source_id is replaced" in note for note in again.notes)


def with_extras(path, **columns):
    """Read a LAS file of four points with these extra dimensions, laspy's name of type first."""
    las = laspy.create(point_format=6, file_version="1.4")
    las.x = las.y = las.z = np.arange(4.0)
    for name, (kind, values) in columns.items():
        las.add_extra_dim(laspy.ExtraBytesParams(name, kind))
        las[name] = np.broadcast_to(values, las[name].shape)
    las.write(path)
    return read(path)


def test_merging_leaves_out_what_does_not_go_together_and_no_other_name(tmp_path):
    clouds = [
        with_extras(tmp_path / "a.las", XY=("u2", [1, 2, 3, 4]), w=("u1", 1)),
        with_extras(tmp_path / "b.las", XY=("u2", 5), w=("3f4", 0.5)),
        with_extras(tmp_path / "c.las", YZ=("f8", 6.5), w=("u1", 2)),
    ]
    written = write_merged(clouds, tmp_path / "m.las", source_ids=range(3))
    merged = read(tmp_path / "m.las")
    assert merged.attribute("XY").tolist() == [1, 2, 3, 4, *[5] * 4, *[0] * 4]
    assert merged.attribute("YZ").tolist() == [0] * 8 + [6.5] * 4
    assert merged.attribute("w") is None
    assert written.notes == ("w has types that do not go together: left out.",)


def timed(folder, name, times, flag):
    """A LAS cloud with GPS times (n,) under a flag of the header: 1 standard, 0 of a week."""
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType(flag)
    las.x = las.y = las.z = np.arange(len(times), dtype=float)
    las.gps_time = times
    las.write(folder / f"{name}.las")
    return read(folder / f"{name}.las")


@pytest.mark.parametrize("is_first", [True, False])
def test_gps_times_of_two_kinds_do_not_stand_under_one_flag(tmp_path, is_first):
    week = timed(tmp_path, "week", np.full(5, 432_000.5), 0)
    clouds = [week, timed(tmp_path, "standard", np.full(5, 3.2e8), 1)]
    clouds += [timed(tmp_path, "none", np.zeros(5), 0), timed(tmp_path, "odd", np.full(5, 3e8), 0)]
    clouds = clouds if is_first else clouds[::-1]
    written = write_merged(clouds, tmp_path / "m.laz", source_ids=range(4))
    merged = laspy.read(tmp_path / "m.laz")
    assert merged.header.global_encoding.gps_time_type.value == 1
    assert sorted(set(merged.gps_time.tolist())) == [0.0, 3e8, 3.2e8]
    (note,) = [note for note in written.notes if "GPS" in note]
    assert note.startswith("week: its GPS times count the seconds of a week")
    alone = write_merged(
        [clouds[2 if is_first else 1], week], tmp_path / "w.laz", source_ids=[1, 2]
    )
    merged = laspy.read(tmp_path / "w.laz")
    assert merged.header.global_encoding.gps_time_type.value == 0
    assert merged.gps_time.max() == 432_000.5
    assert not alone.notes


def test_a_cloud_without_times_leaves_the_flag_to_those_with(tmp_path):
    week = timed(tmp_path, "week", np.full(5, 432_000.5), 0)
    write_merged([Cloud.from_points(np.eye(3)), week], tmp_path / "m.laz", source_ids=[1, 2])
    merged = laspy.read(tmp_path / "m.laz")
    assert merged.header.global_encoding.gps_time_type.value == 0
    assert merged.gps_time.max() == 432_000.5


def test_merged_clouds_get_the_finest_step_and_stay_where_they_are(tmp_path):
    frame = Frame(origin=np.array([500_000.0, 4_000_000.0, 0.0]))
    random_las(
        tmp_path / "a.las", 7, "1.4", count=500, extras=False, offset=(500_000, 4_000_000, 7)
    )
    cloud = read(tmp_path / "a.las")
    moved = small(400).moved(np.eye(4), frame)
    write_merged([cloud, moved], tmp_path / "c.laz", source_ids=[0, 300])
    merged = read(tmp_path / "c.laz")
    assert merged.attribute("source_id").dtype == np.uint16
    assert merged.header.scale.tolist() == [1e-4] * 3
    found = merged.frame.to_file(merged.xyz)
    assert np.abs(found[:500] - cloud.frame.to_file(cloud.xyz)).max() < 1e-9
    assert np.abs(found[500:] - moved.frame.to_file(moved.xyz)).max() < 5.1e-5
    rest = [n for n in cloud.records.dtype.names if n not in "XYZ"]
    assert packed(merged.select(np.arange(500)), rest) == packed(cloud, rest)


def test_merging_refuses_what_does_not_belong_together(tmp_path):
    here, there = small(10), replace(small(10), frame=Frame(crs="EPSG:2225"))
    with pytest.raises(FrameError, match="different reference systems"):
        write_merged([here, there], tmp_path / "a.las", source_ids=[0, 1])
    with pytest.raises(InputError, match="one source id per cloud"):
        write_merged([here], tmp_path / "a.las", source_ids=[0, 1])
    with pytest.raises(InputError, match=r"0\.\.65535"):
        write_merged([here], tmp_path / "a.las", source_ids=[70_000])
    with pytest.raises(OutputError, match=r"\.copc\.laz"):
        write_merged([here], tmp_path / "a.ply", source_ids=[0])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.las", b"", "is empty"),
        ("a.e57", b"", "is empty"),
        ("a.las", b"this is no point cloud at all", "not a LAS"),
        ("a.e57", b"this is no point cloud at all", "not an E57"),
        ("a.pcd", b"this is no point cloud at all", "not a PCD"),
        ("a.laz", b"ply\nformat ascii 1.0\n", "is a PLY file by its first bytes"),
        ("a.ply", b"LASF" + bytes(300), "Rename it to a.las"),
        ("a.csv", b"ASTM-E57" + bytes(300), "Rename it to a.e57"),
        ("a.obj", b"v 1 2 3", r"suffix '\.obj'"),
        ("a", b"1 2 3", "has no suffix"),
        ("a.las", b"LASF" + bytes(50), "ends inside its header"),
    ],
)
def test_files_that_are_not_what_they_seem(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=words) as caught:
        read(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_missing_files_folders_and_closed_doors(tmp_path):
    with pytest.raises(FormatError, match="does not exist"):
        read(tmp_path / "a.las")
    (tmp_path / "b.las").mkdir()
    with pytest.raises(FormatError, match="is a folder"):
        read(tmp_path / "b.las")
    closed = tmp_path / "c.las"
    closed.write_bytes(b"LASF")
    closed.chmod(0)
    if os.geteuid() != 0:  # root may read everything
        with pytest.raises(FormatError, match="may not be read"):
            read(closed)


def test_importing_the_room_is_quick_and_light():
    code = (
        "import sys, dougong.formats as f\n"
        "print([m for m in ('laspy', 'lazrs', 'pye57', 'pyarrow', 'pyproj', 'plyfile', 'numba')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
