"""`check` finds each fault by name and stays silent about sound clouds; `describe` tells all."""

import re
import struct

import laspy
import numpy as np
import pytest

from dougong.cloud import Cloud, Frame
from dougong.errors import FormatError
from dougong.formats import SUFFIXES, check, describe, faults_of, iterate, read, reissue, write

CRS = "EPSG:32650"


def hall(count=20_000, seed=0):
    """Points of a 30 x 20 x 8 m box in map coordinates, millimetre steps."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, [30, 20, 8], (2 * count, 3))
    points[np.arange(2 * count), rng.integers(0, 3, 2 * count)] = 0
    points = np.unique(np.round(points, 3), axis=0)
    return np.round(rng.permutation(points)[:count] + [500_000, 4_000_000, 50], 3)


def saved(tmp_path, points, suffix=".las", crs=CRS):
    path = tmp_path / f"a{suffix}"
    write(Cloud.from_points(points, crs=crs), path)
    return path


def texts(path, severity=None):
    return [f.text for f in check(path) if severity in (None, f.severity)]


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz", ".ply"])
def test_a_sound_cloud_has_no_findings(tmp_path, suffix):
    assert check(saved(tmp_path, hall(), suffix)) == []


@pytest.mark.parametrize("suffix", [".las", ".ply"])
def test_duplicates_are_counted_exactly(tmp_path, suffix):
    points = hall()
    points[100:350] = points[7]
    points[-1] = points[0]
    (text,) = texts(saved(tmp_path, points, suffix), "warning")
    assert "251 of 20,000 points lie exactly on another one" in text


@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 0, -1], [-0.6, 0.8, 0]])
def test_one_far_point_is_found(tmp_path, direction):
    points = hall()
    points[1234] += 1e6 * np.array(direction)
    (text,) = texts(saved(tmp_path, points, ".ply"), "warning")
    assert "1 of 20,000 points lies far from all others" in text
    assert "e+0" in text or "99" in text


def test_a_long_wall_and_a_tower_are_not_far_points(tmp_path):
    rng = np.random.default_rng(1)
    wall = rng.uniform(0, [2000, 3, 10], (20_000, 3))
    tower = rng.uniform(0, [3, 3, 60], (50, 3)) + [1000, 50, 0]
    assert check(saved(tmp_path, np.round(np.concatenate([wall, tower]), 3))) == []


def test_a_missing_reference_system_is_said(tmp_path):
    (text,) = texts(saved(tmp_path, hall(), crs=None), "warning")
    assert "no coordinate reference system" in text


def test_degrees_are_an_error_with_the_zone_to_use(tmp_path):
    points = np.array([[116.39, 39.9, 44.0], [116.391, 39.901, 50.0]])
    (text,) = texts(saved(tmp_path, points, crs="EPSG:4326"), "error")
    assert "UTM zone 50N (EPSG:32650)" in text


def test_degrees_without_a_reference_system_are_suspected(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.uniform([116.39, 39.9, 40], [116.3905, 39.9004, 60], (500, 3))
    path = tmp_path / "a.xyz"
    np.savetxt(path, points, fmt="%.8f")
    assert any("may be degrees" in text for text in texts(path, "warning"))


@pytest.mark.parametrize(("crs", "unit"), [("EPSG:2225", "US survey foot"), ("EPSG:2992", "foot")])
def test_feet_are_said(tmp_path, crs, unit):
    found = texts(saved(tmp_path, hall(), crs=crs), "warning")
    assert len(found) == 1
    assert f"x in {unit}" in found[0]


def test_coarse_steps_are_said(tmp_path):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [0.01, 0.001, 0.001]
    header.offsets = [500_000, 4_000_000, 0]
    las = laspy.LasData(header)
    points = hall()
    las.x, las.y, las.z = points[:, 0], np.round(points[:, 1] * 2) / 2, points[:, 2]
    las.write(tmp_path / "a.las")
    found = texts(tmp_path / "a.las", "warning")
    assert any("stores x in steps of 0.01 m: too coarse" in text for text in found)
    assert any("every y is a multiple of 0.5 m" in text for text in found)
    assert not any("every z" in text or "z in steps" in text for text in found)


@pytest.mark.parametrize(("scale", "is_said"), [(0.001, False), (0.01, False), (0.05, True)])
def test_a_lattice_too_coarse_for_a_building_is_said_where_a_cloud_is_used(
    tmp_path, scale, is_said
):
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales, las.header.offsets = [scale] * 3, np.floor(hall().min(axis=0))
    las.x, las.y, las.z = hall().T
    las.write(tmp_path / "a.las")
    said = [note for note in faults_of(read(tmp_path / "a.las")) if "too coarse" in note]
    assert bool(said) == is_said
    assert all("in steps of 0.05 m: too coarse for a building" in note for note in said)


def test_phantom_points_at_zero_are_found(tmp_path):
    points = hall()
    points[5:25] = 0
    found = texts(saved(tmp_path, points, ".ply"), "warning")
    assert any("20 points exactly at 0, 0, 0" in text for text in found)


@pytest.mark.parametrize("step", [0.001, 0.25])
def test_phantom_points_are_found_whatever_the_offsets_of_a_file(tmp_path, step):
    points = hall() - [499_900, 3_999_900, 0]
    points[5:25] = 0
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales, las.header.offsets = [step] * 3, [100.1, 100.3, 7.7]
    las.x, las.y, las.z = points.T
    las.write(tmp_path / "a.las")
    found = texts(tmp_path / "a.las", "warning")
    assert any("20 points exactly at 0, 0, 0" in text for text in found)


def test_a_heap_of_phantoms_at_zero_does_not_shape_the_site(tmp_path):
    points = hall() + [0, 0, 2300]
    points[::20] = 0
    cloud = Cloud.from_points(points)
    assert "1,000 of 20,000 points lie far from all others." in faults_of(cloud)
    found = texts(saved(tmp_path, points, ".ply", None), "warning")
    assert any("1,000 of 20,000 points lie far from all others" in text for text in found)
    assert not any("millimetres" in text for text in [*found, *faults_of(cloud)])


def test_not_finite_rows_are_counted(tmp_path):
    path = saved(tmp_path, hall(), ".ply")
    raw = bytearray(path.read_bytes())
    start = raw.index(b"end_header\n") + 11
    for row in (3, 30, 300):
        struct.pack_into("<d", raw, start + 24 * row, float("nan"))
    path.write_bytes(raw)
    (text,) = texts(path, "warning")
    assert "3 of 20000 rows had no finite coordinates" in text


@pytest.mark.parametrize("box", [[np.nan] * 6, [1.0, 2.0, 9.0, 4.0, 6.0, 5.0]])
def test_a_header_without_a_usable_box_is_said_and_harms_nothing(tmp_path, box):
    path = saved(tmp_path, hall())
    raw = bytearray(path.read_bytes())
    struct.pack_into("<6d", raw, 179, *box)  # largest and smallest x, then y, then z
    path.write_bytes(raw)
    info = describe(path)
    assert (info.extent_min, info.extent_max) == (None, None)
    assert any("its header states no usable box" in note for note in info.notes)
    (text,) = texts(path, "warning")
    assert "its header states no usable box" in text
    moved = tmp_path / "moved.las"
    reissue(path, moved, [np.eye(4)], Frame())
    assert describe(moved).extent_min == pytest.approx(hall().min(axis=0), abs=1e-6)


@pytest.mark.parametrize(
    ("crs", "place", "said"),
    [
        ("EPSG:4326", [116.39, 39.9, 44.0], r"is in degrees \(WGS 84\).* UTM zone 50N"),
        ("EPSG:3857", [12_956_000.0, 4_852_000.0, 44.0], "lengths depend on their direction"),
    ],
)
def test_a_system_is_judged_by_the_points_whatever_the_header_states(tmp_path, crs, place, said):
    path = saved(tmp_path, place + np.random.default_rng(0).uniform(0, 1e-3, (500, 3)), crs=crs)
    raw = bytearray(path.read_bytes())
    for box in ([np.nan] * 6, [0.0] * 6):
        struct.pack_into("<6d", raw, 179, *box)
        path.write_bytes(raw)
        assert any(re.search(said, text) for text in texts(path, "error"))


def test_points_outside_the_box_of_the_header_are_said(tmp_path):
    path = saved(tmp_path, hall())
    raw = bytearray(path.read_bytes())
    struct.pack_into("<d", raw, 179, 500_010.0)  # the largest x, said to be 20 m less
    path.write_bytes(raw)
    (text,) = texts(path, "warning")
    assert "up to 20 m outside the box" in text


def test_dark_colours_are_said(tmp_path):
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [500_000, 4_000_000, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = hall().T
    las.red = np.arange(20_000) % 256
    las.write(tmp_path / "a.las")
    assert any("colours in 0..255" in text for text in texts(tmp_path / "a.las", "info"))


def test_unreadable_files_are_one_error_each(tmp_path):
    (tmp_path / "empty.las").write_bytes(b"")
    (tmp_path / "other.laz").write_bytes(b"not a cloud" * 50)
    (tmp_path / "unknown.xyzzy").write_bytes(b"1 2 3")
    for path in [*tmp_path.iterdir(), tmp_path / "missing.ply", tmp_path]:
        assert [finding.severity for finding in check(path)] == ["error"]
        assert "\n" not in check(path)[0].text


def test_findings_come_errors_first(tmp_path):
    points = np.array([[116.39, 39.9, 44.0]] * 3)
    severities = [finding.severity for finding in check(saved(tmp_path, points, crs="EPSG:4326"))]
    assert severities == ["error", "error", "warning"]  # degrees, one place; few points


def test_describe_tells_what_the_header_holds(tmp_path):
    points = hall()
    cloud = Cloud.from_points(
        points, crs=CRS, red=np.zeros(len(points), "u2"), ident=np.arange(20_000)
    )
    write(cloud, tmp_path / "a.laz")
    info = describe(tmp_path / "a.laz")
    assert (info.format, info.version, info.points, info.point_format) == ("LAZ", "1.4", 20_000, 6)
    assert info.is_compressed
    assert info.bytes == (tmp_path / "a.laz").stat().st_size
    assert info.crs_name == "WGS 84 / UTM zone 50N"
    assert info.unit_names == ("metre",) * 3
    assert info.extent_min == pytest.approx(points.min(axis=0))
    assert info.extent_max == pytest.approx(points.max(axis=0))
    assert info.scale == (1e-4,) * 3
    assert info.attributes["ident"] == "<i8"
    assert info.attributes["classification"] == "|u1"


def _clouds(data):
    skip = {"reference_T.txt", "T_target_source.txt", "LICENSE_monastery.txt"}
    return [
        path
        for path in sorted(data.rglob("*"))
        if path.suffix in SUFFIXES and path.name not in skip and "LICENSE" not in path.name
    ]


@pytest.mark.data
def test_every_real_cloud_is_described_checked_and_read_in_chunks(data):
    clouds = _clouds(data)
    assert len(clouds) >= 25
    for path in clouds:
        info = describe(path)
        assert info.points > 1000
        if info.points > 200_000:
            continue  # the rest takes long, and nothing differs
        assert not [f for f in check(path) if f.severity == "error"], path
        whole = read(path)
        count, low = 0, np.full(3, np.inf)
        for part in iterate(path, 100_000):
            count, low = count + len(part), np.minimum(low, part.xyz.min(axis=0))
        assert count == len(whole)
        assert low.tolist() == whole.xyz.min(axis=0).tolist()


@pytest.mark.data
@pytest.mark.parametrize("suffix", [".laz", ".copc.laz", ".ply"])
def test_real_clouds_round_trip(data, tmp_path, suffix):
    for name in (
        "isprs_filter/samp11-utm.laz",
        "formats/autzen_trim.laz",
        "street_pair/source.ply",
    ):
        cloud = read(data / name)
        path = tmp_path / f"{cloud.name}{suffix}"
        write(cloud, path)
        again = read(path)
        if path.suffix == (data / name).suffix and suffix != ".copc.laz":
            assert again.records.tobytes() == cloud.records.tobytes()
        there = np.sort(again.frame.to_file(again.xyz), axis=0)
        here = np.sort(cloud.frame.to_file(cloud.xyz), axis=0)
        assert np.abs(there - here).max() < 5.1e-5


@pytest.mark.data
def test_real_feet(data):
    info = describe(data / "formats" / "autzen_trim.laz")
    assert info.unit_m == pytest.approx((0.3048,) * 3)
    cloud = read(data / "formats" / "autzen_trim.laz")
    span = np.subtract(info.extent_max, info.extent_min) * 0.3048
    assert cloud.xyz.max(axis=0) - cloud.xyz.min(axis=0) == pytest.approx(span, abs=1e-6)


def test_errors_have_one_class(tmp_path):
    with pytest.raises(FormatError):
        describe(tmp_path / "missing.las")


def test_what_was_handled_is_counted_in_words():
    from dougong.formats import faults_of

    rng = np.random.default_rng(0)
    site = rng.uniform(0, 30, (5000, 3))
    clean = Cloud.from_points(site, crs="EPSG:32650")
    assert faults_of(clean) == ()
    bad = np.vstack([site, np.repeat(site[:1], 3000, axis=0), [[1e6, 0, 0]]])
    said = " ".join(faults_of(Cloud.from_points(bad)))
    assert "no coordinate reference system" in said
    assert "3,000 of 8,001 points lie exactly on another one" in said
    assert "1 of 8,001 points lies far from all others" in said
    assert "millimetres" not in said
    assert "may be millimetres" in " ".join(faults_of(Cloud.from_points(site * 1000)))


def test_degrees_and_earth_centred_coordinates_without_a_system_are_doubted(tmp_path):
    from pyproj import Transformer

    from dougong.formats import faults_of

    rng = np.random.default_rng(0)
    site = rng.uniform(0, 30, (500, 3)) + [480_700, 2_135_900, 2280]
    degrees = np.column_stack(
        Transformer.from_crs("EPSG:32614", "EPSG:4326", always_xy=True).transform(*site.T)
    )
    centred = np.column_stack(
        Transformer.from_crs("EPSG:32614", "EPSG:4978", always_xy=True).transform(*site.T)
    )
    north = site + [0, 4_223_000, 0]  # an earth's radius from 0, 0, 0, as a northing may be
    for name, points, words in (
        ("degrees", degrees, "may be degrees"),
        ("centred", centred, "may be earth-centred coordinates"),
    ):
        cloud = Cloud.from_points(points)
        assert words in " ".join(faults_of(cloud))
        write(cloud, tmp_path / f"{name}.ply")
        assert any(words in text for text in texts(tmp_path / f"{name}.ply", "warning"))
    for points in (site, north):
        assert "may be" not in " ".join(faults_of(Cloud.from_points(points)))


def test_a_name_without_or_with_another_suffix_gets_the_right_advice(tmp_path):
    path = saved(tmp_path, hall(200), ".laz")
    for name, advice in (("scan", "scan.laz"), ("a.b", "a.laz"), ("a.e57", "a.laz")):
        (tmp_path / name).write_bytes(path.read_bytes())
        (text,) = texts(tmp_path / name, "error")
        assert text.endswith(f"Rename it to {advice}.")
    (tmp_path / "notes").write_text("1 2 3")
    assert "has no suffix" in texts(tmp_path / "notes", "error")[0]


def test_an_offset_that_is_no_number_is_refused(tmp_path):
    path = saved(tmp_path, hall(200))
    raw = bytearray(path.read_bytes())
    struct.pack_into("<d", raw, 155, float("nan"))
    path.write_bytes(raw)
    (text,) = texts(path, "error")
    assert "has offset [nan" in text
    with pytest.raises(FormatError, match="must be finite"):
        describe(path)


def test_check_doubts_millimetres_and_does_not_judge_three_points(tmp_path):
    rng = np.random.default_rng(0)
    write(Cloud.from_points(rng.uniform(0, 30_000, (500, 3))), tmp_path / "mm.laz")
    assert any("may be millimetres" in finding.text for finding in check(tmp_path / "mm.laz"))
    write(Cloud.from_points(rng.uniform(0, 30, (3, 3))), tmp_path / "three.laz")
    said = " ".join(finding.text for finding in check(tmp_path / "three.laz"))
    assert "holds only 3 points" in said
    assert "multiple of" not in said


def test_a_cloud_at_one_place_is_an_error(tmp_path):
    path = saved(tmp_path, np.repeat([[500_000.0, 4_000_000.0, 50.0]], 5000, axis=0))
    (text,) = texts(path, "error")
    assert "all 5,000 points lie at one place (500000, 4000000, 50)" in text
    assert not any("on another one" in text for text in texts(path, "warning"))


def test_few_points_are_not_taken_for_degrees(tmp_path):
    path = saved(tmp_path, [[0.0, 0.0, 0.0], [0.0, 0.01, 1.0], [0.001, 0.04, 2.0]], ".ply", None)
    found = texts(path, "warning")
    assert any("holds only 3 points" in text for text in found)
    assert not any("degrees" in text for text in found)


def test_colours_that_are_all_black_are_no_dark_colours(tmp_path):
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [500_000, 4_000_000, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = hall().T
    las.write(tmp_path / "a.las")
    assert any("no colours: all are 0" in text for text in texts(tmp_path / "a.las", "info"))


def test_an_axis_along_which_nothing_varies_is_not_coarse(tmp_path):
    path = tmp_path / "line.xyz"
    path.write_text("".join(f"{0.001 * k:.3f} 0 0\n" for k in range(5000)))
    assert not [said for said in faults_of(read(path)) if "steps" in said]
    path.write_text("".join(f"{0.001 * k:.3f} {k % 7} 0\n" for k in range(5000)))
    assert [said for said in faults_of(read(path)) if "steps of 1 m" in said]
