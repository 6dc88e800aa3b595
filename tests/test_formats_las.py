"""LAS and LAZ: bit for bit through reading and writing, against laspy as the second library."""

import struct
from dataclasses import replace

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlr import VLR
from numpy.lib.recfunctions import repack_fields

from dougong.cloud import Cloud, Frame
from dougong.errors import FormatError
from dougong.formats import check, describe, iterate, read, write, write_merged
from dougong.formats.las_header import LasHeader
from dougong.formats.units import as_wkt, units_of

EXTRAS = [
    laspy.ExtraBytesParams("amplitude", "f4", "of the echo"),
    laspy.ExtraBytesParams("deviation", "u2", scales=[0.01], offsets=[3.0]),
    laspy.ExtraBytesParams("direction", "3f8"),
]


def random_las(
    path,
    point_format,
    version,
    count=4000,
    seed=0,
    *,
    extras=True,
    offset=(0, 0, 0),
    one_channel=True,
):
    """Write a LAS file whose points are random bits and return its records."""
    rng = np.random.default_rng(seed)
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001, 0.0025, 0.01], offset
    header.system_identifier, header.file_source_id = "an old scanner", 42
    if extras:
        header.add_extra_dims(EXTRAS)
    header.vlrs.append(VLR("surveyor", 77, "field book", bytes(range(200))))
    las = laspy.LasData(header)
    dtype = las.point_format.dtype()
    raw = rng.integers(0, 256, count * dtype.itemsize, dtype=np.uint8)
    array = raw.view(dtype).copy()
    for axis in "XYZ":
        array[axis] = rng.integers(-200_000, 200_000, count)
    if point_format in (9, 10) and one_channel:
        array["classification_flags"] &= 0b11001111
    las.points = laspy.ScaleAwarePointRecord(array, las.point_format, header.scales, header.offsets)
    if version == "1.4":
        las.evlrs = laspy.vlrs.vlrlist.VLRList([VLR("surveyor", 78, "long book", bytes(70_000))])
    las.write(path)
    return array


def packed(cloud, names):
    """Return the bytes of some fields of the records, and of no others."""
    return repack_fields(cloud.records[names]).tobytes()


CASES = [(f, v) for v, top in (("1.2", 3), ("1.3", 5), ("1.4", 10)) for f in range(top + 1)]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("point_format", "version"), CASES)
def test_every_bit_survives(tmp_path, point_format, version, suffix):
    source, copy = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    array = random_las(source, point_format, version)
    cloud = read(source)
    assert cloud.records.tobytes() == array.tobytes()
    written = write(cloud, copy)
    assert written.points == len(array)
    assert written.notes == ()
    again, old = read(copy), cloud.header
    assert again.records.dtype == cloud.records.dtype
    assert again.records.tobytes() == array.tobytes()
    assert again.header.scale.tolist() == old.scale.tolist()
    assert again.header.offset.tolist() == old.offset.tolist()
    ours = [vlr for vlr in again.header.vlrs if vlr.key[0] != b"laszip encoded"]
    theirs = [vlr for vlr in old.vlrs if vlr.key[0] != b"laszip encoded"]
    assert ours == theirs
    assert again.header.evlrs == old.evlrs
    assert again.header.raw[4:90] == old.raw[4:90], "ids, version, system, software"
    second = laspy.read(copy)
    assert second.points.array.tobytes() == array.tobytes()
    assert second.header.system_identifier == "an old scanner"
    first = laspy.read(source)
    assert second.header.mins.tolist() == pytest.approx(first.header.mins.tolist(), abs=1e-9)
    assert (
        second.header.number_of_points_by_return.tolist()
        == first.header.number_of_points_by_return.tolist()
    )


@pytest.mark.parametrize(
    ("point_format", "version"), [(0, "1.2"), (3, "1.2"), (6, "1.4"), (8, "1.4")]
)
def test_packed_attributes_agree_with_laspy(tmp_path, point_format, version):
    path = tmp_path / "a.las"
    random_las(path, point_format, version)
    cloud, las = read(path), laspy.read(path)
    names = set(las.point_format.standard_dimension_names) - {"X", "Y", "Z"}
    assert names <= set(cloud.attributes)
    for name in names:
        assert np.array_equal(cloud.attribute(name), np.asarray(las[name]), equal_nan=True), name
    assert np.abs(cloud.frame.to_file(cloud.xyz) - las.xyz).max() < 1e-9


def test_whole_file_bytes_are_the_same_for_las(tmp_path):
    """Nothing but the header's own sums may differ; here they do not."""
    random_las(tmp_path / "a.las", 7, "1.4")
    write(read(tmp_path / "a.las"), tmp_path / "b.las")
    assert (tmp_path / "a.las").read_bytes() == (tmp_path / "b.las").read_bytes()


def test_undescribed_extra_bytes_survive_and_get_company(tmp_path):
    path = tmp_path / "a.las"
    array = random_las(path, 6, "1.4")
    raw = bytearray(path.read_bytes())
    at = raw.index(b"LASF_Spec\0")
    raw[at : at + 9] = b"someoneel"  # the description of the extra bytes is lost
    path.write_bytes(raw)
    cloud = read(path)
    assert cloud.records.tobytes() == array.tobytes()
    marked = cloud.with_attribute("dougong_reason", np.ones(len(cloud), "u1"))
    write(marked, tmp_path / "b.las")
    again = read(tmp_path / "b.las")
    assert again.attribute("dougong_reason").tolist() == [1] * len(cloud)
    names = list(cloud.records.dtype.names)
    assert packed(again, names) == packed(marked, names)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_added_attributes_become_extra_dimensions(tmp_path, suffix):
    random_las(tmp_path / "a.las", 3, "1.2")
    cloud = read(tmp_path / "a.las")
    n = len(cloud)
    added = {
        "dougong_reason": np.arange(n).astype("u1"),
        "classification_in": np.asarray(cloud.attribute("classification")),
        "curvature": np.linspace(0, 1, n),
        "height_above_ground": np.full(n, np.nan, "f4"),
        "is_ground": np.arange(n) % 2 == 0,
    }
    for name, values in added.items():
        cloud = cloud.with_attribute(name, values)
    cloud = cloud.with_attribute("classification", np.full(n, 7, "u1"))
    write(cloud, tmp_path / f"b{suffix}")
    las, again = laspy.read(tmp_path / f"b{suffix}"), read(tmp_path / f"b{suffix}")
    for name, values in added.items():
        assert np.array_equal(las[name], values, equal_nan=True), name
        assert np.array_equal(again.attribute(name), values, equal_nan=True), name
    assert (np.asarray(las.classification) == 7).all()
    assert np.array_equal(las["amplitude"], cloud.attribute("amplitude"), equal_nan=True)
    assert (np.asarray(las.withheld) == cloud.attribute("withheld")).all()


def test_a_selection_keeps_the_records_of_its_points(tmp_path):
    array = random_las(tmp_path / "a.laz", 7, "1.4")
    chosen = np.random.default_rng(5).random(len(array)) < 0.3
    write(read(tmp_path / "a.laz").select(chosen), tmp_path / "b.laz")
    assert read(tmp_path / "b.laz").records.tobytes() == array[chosen].tobytes()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("chunk", [1, 997, 4000, 10_000])
def test_chunks_are_the_whole(tmp_path, suffix, chunk):
    path = tmp_path / f"a{suffix}"
    random_las(path, 7, "1.4", count=4000 if chunk > 1 else 20)
    whole = read(path)
    chunks = list(iterate(path, chunk))
    assert max(map(len, chunks)) <= chunk
    assert all(part.frame is chunks[0].frame for part in chunks)
    assert np.array_equal(np.concatenate([part.xyz for part in chunks]), whole.xyz)
    assert b"".join(part.records.tobytes() for part in chunks) == whole.records.tobytes()
    assert np.array_equal(chunks[0].frame.origin, whole.frame.origin)


def test_local_coordinates_do_not_know_the_offset(tmp_path):
    random_las(tmp_path / "a.las", 6, "1.4", offset=(0, 0, 0))
    random_las(tmp_path / "b.las", 6, "1.4", offset=(500_000, 4_000_000, 0))
    near, far = read(tmp_path / "a.las"), read(tmp_path / "b.las")
    assert np.array_equal(near.xyz, far.xyz), "bit for bit"
    assert np.abs(far.frame.to_file(far.xyz) - laspy.read(tmp_path / "b.las").xyz).max() < 1e-9
    shifted = near.records.copy()
    shifted["X"] += 500_000_000
    write(replace(near, records=shifted), tmp_path / "c.las")
    assert np.array_equal(read(tmp_path / "c.las").xyz, near.xyz), "integers shifted"


def _crs_file(path, crs, point_format=6, version="1.4"):
    from pyproj import CRS

    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales = [0.01] * 3
    header.add_crs(CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = [0, 100_000], [0, 200_000], [0, 1000]
    las.write(path)
    return path


@pytest.mark.parametrize(
    ("crs", "unit_m"),
    [
        ("EPSG:32650", (1, 1, 1)),
        ("EPSG:2225", (1200 / 3937,) * 3),
        ("EPSG:2225+5703", (1200 / 3937, 1200 / 3937, 1.0)),
        ("EPSG:32650+6360", (1.0, 1.0, 1200 / 3937)),
        ("EPSG:2992", (0.3048,) * 3),
        ("EPSG:4326", (1, 1, 1)),
    ],
)
def test_feet_become_metres_per_axis(tmp_path, crs, unit_m):
    cloud = read(_crs_file(tmp_path / "a.las", crs))
    assert cloud.frame.unit_m == pytest.approx(unit_m, rel=1e-12)
    assert cloud.xyz[1] - cloud.xyz[0] == pytest.approx(np.multiply([1000, 2000, 10], unit_m))
    assert cloud.frame.to_file(cloud.xyz)[1] == pytest.approx([1000, 2000, 10])
    assert cloud.frame.crs == as_wkt(crs)
    write(cloud, tmp_path / "b.laz")
    assert read(tmp_path / "b.laz").frame.crs == cloud.frame.crs


def test_geotiff_keys_name_the_reference_system(tmp_path):
    path = _crs_file(tmp_path / "a.las", "EPSG:2225", point_format=1, version="1.2")
    cloud = read(path)
    assert cloud.frame.crs == as_wkt("EPSG:2225")
    assert "converted" in cloud.notes[0]
    write(cloud, tmp_path / "b.copc.laz")
    assert read(tmp_path / "b.copc.laz").frame.unit_m == cloud.frame.unit_m


@pytest.mark.parametrize("crs", ["EPSG:32650", "EPSG:2225", "EPSG:4326", "EPSG:2225+5703"])
def test_a_moved_old_file_names_its_new_system_as_laspy_reads_it(tmp_path, crs):
    """Point formats 0-5 name it by GeoTIFF keys, 6 and up by WKT."""
    from pyproj import CRS

    wkt = as_wkt(crs)
    for point_format, version in ((3, "1.2"), (1, "1.4"), (7, "1.4")):
        path = tmp_path / f"{point_format}.las"
        random_las(path, point_format, version, count=10)
        target = Frame(crs=wkt, unit_m=units_of(wkt).unit_m)
        copy = tmp_path / f"{point_format}b.las"
        write(read(path).moved(np.eye(4), target), copy)
        again = read(copy)
        assert again.frame.crs == wkt
        assert again.frame.unit_m == target.unit_m
        with laspy.open(copy) as reader:
            theirs = reader.header.parse_crs()
            assert theirs.equals(CRS(crs.split("+")[0] if point_format < 6 else crs), True)
            assert reader.header.global_encoding.wkt == (point_format >= 6)


def _own_system(path, *units):
    """Write a file in a user-defined projection on a geographic base (4269), with its unit keys."""
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = [0.01] * 3
    keys = [(1024, 0, 1, 1), (2048, 0, 1, 4269), (3072, 0, 1, 32767)]
    keys += [(key, 0, 1, unit) for key, unit in units]
    data = struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(struct.pack("<4H", *k) for k in keys)
    header.vlrs.append(VLR("LASF_Projection", 34735, "", data))
    las = laspy.LasData(header)
    las.X, las.Z = [0, 10_000], [0, 5000]
    las.write(path)
    return path


@pytest.mark.parametrize("suffix", [".las", ".copc.laz"])
@pytest.mark.parametrize("heights", [9001, 9002, 9003])
def test_units_without_a_named_system_stay_with_the_numbers(tmp_path, suffix, heights):
    feet = read(_own_system(tmp_path / "a.las", (3076, 9002), (4099, heights)))
    metres = Cloud.from_points([[0.0, 0, 0], [20, 0, 5]])
    to_metres = np.diag([0.3048, 0.3048, 0.3048, 1.0])
    out = tmp_path / f"b{suffix}"
    moves = [(feet, to_metres, metres), (metres, np.linalg.inv(to_metres), feet)]
    for source, matrix, target in moves:
        moved = source.moved(matrix, target.frame)
        write(moved, out, overwrite=True)
        assert read(out).frame.unit_m == pytest.approx(target.frame.unit_m, rel=1e-12)
        assert np.ptp(read(out).xyz, axis=0) == pytest.approx(np.ptp(moved.xyz, axis=0), abs=1e-3)
        write_merged([target, moved], out, source_ids=[1, 2], overwrite=True)
        assert read(out).frame.unit_m == pytest.approx(target.frame.unit_m, rel=1e-12)
    write(feet, out, overwrite=True)
    assert read(out).frame.unit_m == feet.frame.unit_m
    found = Cloud.from_points([[0.0, 0, 0], [20, 0, 5]])
    found = replace(found, frame=replace(found.frame, unit_m=(0.0123,) * 3))
    write(found, out, overwrite=True)
    assert read(out).frame.unit_m == found.frame.unit_m


def test_heights_in_another_unit_than_their_system_stay(tmp_path):
    wkt = as_wkt("EPSG:32650")
    frame = Frame(crs=wkt, unit_m=(1.0, 1.0, 0.3048))
    cloud = Cloud.from_points([[5e5, 4e6, 0], [5e5 + 20, 4e6, 5]])
    for suffix in (".las", ".copc.laz"):
        out = tmp_path / f"a{suffix}"
        write(cloud.moved(np.eye(4), frame), out)
        assert (read(out).frame.crs, read(out).frame.unit_m) == (wkt, frame.unit_m)


def test_user_defined_projection_in_feet_is_not_taken_for_degrees(tmp_path):
    """Its keys name a geographic base (4269); only the linear unit is to be used."""
    cloud = read(_own_system(tmp_path / "a.las", (3076, 9002)))
    assert cloud.frame.crs is None
    assert cloud.frame.unit_m == (0.3048,) * 3
    assert any("could not be understood" in note for note in cloud.notes)


def _moved(cloud, target=None):
    matrix = np.eye(4)
    matrix[:3, :3] = [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]
    matrix[:3, 3] = [500_000.123456, 4_000_000.7, 12.0]
    return matrix, cloud.moved(matrix, target)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz"])
def test_a_moved_cloud_gets_new_integers_and_keeps_the_rest(tmp_path, suffix):
    random_las(tmp_path / "a.las", 7, "1.4", extras=False)
    cloud = read(tmp_path / "a.las")
    frame = Frame(origin=np.array([500_000.0, 4_000_000.0, 0.0]), crs=as_wkt("EPSG:32650"))
    matrix, moved = _moved(cloud, frame)
    path = tmp_path / f"b{suffix}"
    write(moved, path)
    again = read(path)
    old = cloud.frame.to_file(cloud.xyz)
    expected = old @ matrix[:3, :3].T + matrix[:3, 3]
    found = again.frame.to_file(again.xyz)
    assert (again.header.scale <= [0.001, 0.001, 0.001]).all(), "never coarser than the input"
    assert again.frame.crs == frame.crs
    key, other = np.lexsort(expected.round(3).T), np.lexsort(found.round(3).T)
    if suffix != ".copc.laz":
        key = other = slice(None)
        rest = [name for name in cloud.records.dtype.names if name not in "XYZ"]
        assert packed(again, rest) == packed(cloud, rest)
    assert np.abs(found[other] - expected[key]).max() < 0.00051


def test_an_extent_that_int32_cannot_hold_is_refused(tmp_path):
    from dougong.cloud import Cloud
    from dougong.errors import OutputError

    cloud = Cloud.from_points(np.array([[0.12345678, 0, 0], [1e6 / 3, 0, 0], [1e6, 0, 0]]))
    with pytest.raises(OutputError, match="spans 1e\\+06"):
        write(cloud, tmp_path / "a.las")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("left", [0.9, 0.5, 0.2])
def test_truncated_files_say_how_many_points_there_are(tmp_path, suffix, left):
    path = tmp_path / f"a{suffix}"
    random_las(path, 6, "1.4", count=200_000, extras=False)
    raw = path.read_bytes()
    with laspy.open(path) as reader:
        header = reader.header
    # The file's long record at the end would be missed first; this is about the points.
    cut = raw[: header.offset_to_point_data + int(left * 200_000 * 20)]
    path.write_bytes(_without_evlrs(cut))
    words = r"header says 200,000 points, file ends after (about )?\d"
    for attempt in (read, lambda p: list(iterate(p, 50_000))):
        with pytest.raises(FormatError, match=words):
            attempt(path)
    assert [f.severity for f in check(path)] == ["error"]


def _without_evlrs(raw):
    raw = bytearray(raw)
    struct.pack_into("<QI", raw, 235, 0, 0)
    return bytes(raw)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_header_that_promises_more_than_memory_holds(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    random_las(path, 6, "1.4", count=100)
    raw = bytearray(path.read_bytes())
    struct.pack_into("<Q", raw, 247, 2**61)
    path.write_bytes(raw)
    with pytest.raises(FormatError, match=r"header says 2,305,843,009,213,693,952 points"):
        read(path)


def test_a_laz_without_its_chunk_table_is_still_read(tmp_path):
    path = tmp_path / "a.laz"
    array = random_las(path, 6, "1.4", count=60_000, extras=False)
    raw = _without_evlrs(path.read_bytes())
    with laspy.open(path) as reader:
        header = reader.header
    (table,) = struct.unpack_from("<q", raw, header.offset_to_point_data)
    path.write_bytes(raw[:table])
    assert read(path).records.tobytes() == array.tobytes()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_truncated_file_is_seen_without_reading_points(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    random_las(path, 6, "1.4", extras=False)
    raw = path.read_bytes()
    assert describe(path).notes == ()
    path.write_bytes(raw[:50_000])
    with pytest.raises(FormatError, match="header says 4,000 points and records at byte"):
        describe(path)
    path.write_bytes(_without_evlrs(raw[:50_000]))
    assert "truncated" in describe(path).notes[0]


def test_empty_file_with_a_header(tmp_path):
    laspy.LasData(laspy.LasHeader(point_format=6, version="1.4")).write(tmp_path / "a.las")
    with pytest.raises(FormatError, match="holds no points"):
        read(tmp_path / "a.las")
    assert describe(tmp_path / "a.las").points == 0


@pytest.mark.parametrize(("point_format", "version"), [(3, "1.2"), (1, "1.3"), (6, "1.4")])
def test_points_that_a_las_header_does_not_count_are_said(tmp_path, point_format, version):
    path = tmp_path / "a.las"
    random_las(path, point_format, version, count=100)
    for suffix in (".las", ".laz"):
        write(read(path), tmp_path / f"b{suffix}", overwrite=True)
        assert not [n for n in read(tmp_path / f"b{suffix}").notes if "wrongly" in n]
    raw = bytearray(path.read_bytes())
    size = struct.unpack_from("<H", raw, 105)[0]
    layout, place = ("<Q", 247) if version == "1.4" else ("<I", 107)
    struct.pack_into(layout, raw, place, 60)
    path.write_bytes(raw)
    (note,) = [note for note in read(path).notes if "wrongly" in note]
    said = f"its header declares 60 points, wrongly: {40 * size:,} bytes (of {size} a point) follow"
    assert note.startswith(said)
    assert note in describe(path).notes
    assert [f.severity for f in check(path) if "wrongly" in f.text] == ["warning"]
    struct.pack_into(layout, raw, place, 0)
    path.write_bytes(raw)
    with pytest.raises(FormatError, match=rf"no points by its header, but {100 * size:,} bytes"):
        read(path)
    assert "its writer may have been stopped" in check(path)[0].text


@pytest.mark.parametrize(("suffix", "said"), [(".laz", "20,001"), (".copc.laz", "90,000")])
def test_points_that_a_laz_header_does_not_count_are_said(tmp_path, suffix, said):
    """Chunks of one size are told by their number alone: the last may hold one point."""
    path = tmp_path / f"a{suffix}"
    points = np.random.default_rng(0).uniform(0, 9, (120_000, 3))
    write(Cloud.from_points(points), path)
    assert not [note for note in read(path).notes if "wrongly" in note]
    raw = bytearray(path.read_bytes())
    counted = 80_000 if suffix == ".laz" else 30_000
    struct.pack_into("<Q", raw, 247, counted)
    path.write_bytes(raw)
    (note,) = [note for note in read(path).notes if "wrongly" in note]
    assert f"declares {counted:,} points, wrongly: its chunks hold at least {said} more" in note
    assert {note} == {n for c in iterate(path, 20_000) for n in c.notes if "wrongly" in n}
    assert note in describe(path).notes
    assert [f.severity for f in check(path) if "chunks hold" in f.text] == ["warning"]
    struct.pack_into("<Q", raw, 247, 0)
    path.write_bytes(raw)
    with pytest.raises(FormatError, match="no points by its header, but its chunks hold at least"):
        read(path)


@pytest.mark.parametrize(
    ("offset", "value", "words"),
    [
        (25, b"\x09", "LAS 1.9"),
        (104, b"\x0b", "point format 11"),
        (105, b"\x05\x00", "bytes per point"),
        (94, b"\x10\x00", "damaged header"),
        (131, struct.pack("<d", 0.0), "scale"),
        (131, struct.pack("<d", float("nan")), "scale"),
        (96, struct.pack("<I", 400), "records run"),
        (100, struct.pack("<I", 4_000_000), "truncated"),
    ],
)
def test_damaged_headers_give_one_sentence(tmp_path, offset, value, words):
    path = tmp_path / "a.las"
    random_las(path, 6, "1.4", count=10)
    raw = bytearray(path.read_bytes())
    raw[offset : offset + len(value)] = value
    path.write_bytes(raw)
    with pytest.raises(FormatError, match=words) as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_compression_against_the_suffix_is_read_and_noted(tmp_path):
    array = random_las(tmp_path / "a.laz", 6, "1.4")
    (tmp_path / "a.laz").rename(tmp_path / "b.las")
    cloud = read(tmp_path / "b.las")
    assert cloud.records.tobytes() == array.tobytes()
    assert any("against its suffix" in note for note in cloud.notes)


def test_waveforms_that_laz_would_damage_are_left_out_and_said(tmp_path):
    """Lazrs changes the waveform fields of points of several channels; LAS keeps them."""
    array = random_las(tmp_path / "a.las", 9, "1.4", one_channel=False)
    cloud = read(tmp_path / "a.las")
    assert write(cloud, tmp_path / "b.las").notes == ()
    assert read(tmp_path / "b.las").records.tobytes() == array.tobytes()
    assert "waveform data is left out" in write(cloud, tmp_path / "b.laz").notes[0]
    again = read(tmp_path / "b.laz")
    assert again.header.point_format == 6
    shared = [n for n in again.records.dtype.names if n in array.dtype.names]
    assert {"gps_time", "amplitude", "direction", "scan_angle"} <= set(shared)
    assert packed(again, shared) == packed(cloud, shared)


def test_waveforms_inside_the_file_are_found_again(tmp_path):
    """The header's pointer to the waveform record must follow the record."""
    path = tmp_path / "a.las"
    random_las(path, 4, "1.4", count=100)
    cloud = read(path)
    wave = cloud.header.evlrs[0]
    wave = replace(wave, user_id=b"LASF_Spec".ljust(16, b"\0"), record_id=65535, data=b"w" * 500)
    header = replace(cloud.header, evlrs=(*cloud.header.evlrs, wave))
    assert isinstance(header, LasHeader)
    write(replace(cloud, header=header).select(np.arange(50)), tmp_path / "b.las")
    raw = (tmp_path / "b.las").read_bytes()
    (start,) = struct.unpack_from("<Q", raw, 227)
    assert raw[start + 2 : start + 11] == b"LASF_Spec"
    assert raw[start + 60 : start + 560] == b"w" * 500
