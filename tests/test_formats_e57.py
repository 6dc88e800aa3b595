"""E57: poses, invalid points, every kind of field, damage. Files made with libe57's bindings."""

import numpy as np
import pytest
from pye57 import libe57

from dougong.errors import FormatError
from dougong.formats import (
    check,
    describe,
    in_system,
    iterate,
    read,
    read_stations,
    units_of,
    write,
)


def quaternion(yaw, pitch=0.0):
    """Return (w, x, y, z) of a pitch about y after a yaw about z, and its matrix."""
    cz, sz, cy, sy = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    w, x, y, z = cz * cy, -sz * sy, cz * sy, sz * cy
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    about_y = np.array(
        [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    )
    return (w, x, y, z), about_z @ about_y


def _node(image, name, values):
    if name.startswith("cartesian") and values.dtype.kind == "f":
        return libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9)
    if values.dtype == np.float32:
        return libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1e9, 1e9)
    if values.dtype == np.float64:
        return libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9)
    low, high = int(values.min()), int(values.max())
    return libe57.IntegerNode(image, low, low, high)


def write_e57(path, scans, crs=""):
    """Write scans: dicts with `fields` (name to array), `rotation`, `translation`, `name`."""
    image = libe57.ImageFile(str(path), "w")
    root = image.root()
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, "{1}"))
    root.set("versionMajor", libe57.IntegerNode(image, 1))
    root.set("versionMinor", libe57.IntegerNode(image, 0))
    root.set("coordinateMetadata", libe57.StringNode(image, crs))
    data = libe57.VectorNode(image, True)
    root.set("data3D", data)
    root.set("images2D", libe57.VectorNode(image, True))
    for index, scan in enumerate(scans):
        node = libe57.StructureNode(image)
        data.append(node)
        node.set("guid", libe57.StringNode(image, f"{{{index + 2}}}"))
        if "name" in scan:
            node.set("name", libe57.StringNode(image, scan["name"]))
        if "rotation" in scan:
            _pose(image, node, scan)
        fields = {n: np.ascontiguousarray(v) for n, v in scan["fields"].items()}
        prototype = libe57.StructureNode(image)
        for name, values in fields.items():
            scaled = scan.get("scaled", {}).get(name)
            if scaled is None:
                prototype.set(name, _node(image, name, values))
            else:
                prototype.set(
                    name, libe57.ScaledIntegerNode(image, 0, -(2**31), 2**31 - 1, scaled, 0.0)
                )
        vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        node.set("points", vector)
        count = len(next(iter(fields.values())))
        buffers = libe57.VectorSourceDestBuffer()
        # 8-byte integer buffers have the wrong stride in pye57 0.4; doubles do.
        held = {n: v.astype("f8") if v.dtype == "i8" else v for n, v in fields.items()}
        for name, values in held.items():
            buffers.append(libe57.SourceDestBuffer(image, name, values, count, True, True))
        writer = vector.writer(buffers)
        writer.write(count)
        writer.close()
    image.close()
    return path


def _pose(image, node, scan):
    pose, turn, shift = (libe57.StructureNode(image) for _ in range(3))
    node.set("pose", pose)
    pose.set("rotation", turn)
    pose.set("translation", shift)
    for axis, value in zip("wxyz", scan["rotation"], strict=True):
        turn.set(axis, libe57.FloatNode(image, float(value)))
    for axis, value in zip("xyz", scan["translation"], strict=True):
        shift.set(axis, libe57.FloatNode(image, float(value)))


def cartesian(points):
    return dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T.copy(), strict=True))


@pytest.fixture
def two_stations(tmp_path):
    """Two scans of the same random points, seen from two set-ups, one tilted."""
    world = np.random.default_rng(0).uniform(-10, 10, (3000, 3)) + [500_000, 4_000_000, 20]
    scans = []
    for index, (yaw, pitch) in enumerate(((0.7, 0.01), (-2.1, -0.005))):
        q, matrix = quaternion(yaw, pitch)
        shift = np.array([500_000.0 + index, 4_000_000.0, 21.5])
        own = (world - shift) @ matrix
        scans.append(
            {
                "name": f"station {index}",
                "rotation": q,
                "translation": shift,
                "fields": {
                    **cartesian(own),
                    "intensity": np.linspace(0, 1, 3000, dtype="f4"),
                    "colorRed": np.full(3000, 250, "u1"),
                    "colorGreen": np.arange(3000).astype("u1"),
                    "colorBlue": np.zeros(3000, "u1"),
                    "rowIndex": np.arange(3000, dtype="i8"),
                    "columnIndex": np.arange(3000, dtype="i8") * 30,
                },
            }
        )
    return world, write_e57(tmp_path / "two.e57", scans, "EPSG:32650"), scans


def test_every_station_is_posed_and_kept_apart(two_stations):
    world, path, scans = two_stations
    stations = read_stations(path)
    assert [cloud.name for cloud in stations] == ["station 0", "station 1"]
    assert stations[0].frame is stations[1].frame
    for index, cloud in enumerate(stations):
        assert np.abs(cloud.frame.to_file(cloud.xyz) - world).max() < 2e-9
        assert cloud.header.station == index
        raw = scans[index]["fields"]
        for name in ("cartesianX", "intensity"):
            assert np.array_equal(cloud.attribute(name), raw[name]), "records are the file's own"
        assert np.array_equal(cloud.attribute("green"), raw["colorGreen"])
        assert np.array_equal(cloud.attribute("row_index"), raw["rowIndex"])
        assert np.array_equal(cloud.attribute("column_index"), raw["columnIndex"]), "above 65535"


def test_read_merges_the_stations_and_says_whose_point_is_whose(two_stations):
    world, path, _ = two_stations
    cloud = read(path)
    assert len(cloud) == 6000
    assert cloud.attribute("station").dtype == np.uint16
    assert cloud.attribute("station").tolist() == [0] * 3000 + [1] * 3000
    assert np.abs(cloud.frame.to_file(cloud.xyz) - np.concatenate([world, world])).max() < 2e-9
    assert cloud.frame.crs.startswith('PROJCRS["WGS 84 / UTM zone 50N"')


def test_pose_agrees_with_pye57(two_stations):
    import pye57

    _, path, _ = two_stations
    file = pye57.E57(str(path))
    for index, cloud in enumerate(read_stations(path)):
        theirs = file.read_scan(index, ignore_missing_fields=True)
        expected = np.stack([theirs[f"cartesian{a}"] for a in "XYZ"], axis=1)
        assert np.abs(cloud.frame.to_file(cloud.xyz) - expected).max() < 2e-9
    file.close()


@pytest.mark.parametrize("chunk", [700, 3000, 100_000])
def test_chunks_are_the_whole(two_stations, chunk):
    _, path, _ = two_stations
    stations = read_stations(path)
    parts = list(iterate(path, chunk))
    assert max(map(len, parts)) <= chunk
    assert np.array_equal(
        np.concatenate([p.xyz for p in parts]), np.concatenate([s.xyz for s in stations])
    )
    assert {p.header.station for p in parts} == {0, 1}
    assert all(p.frame is parts[0].frame for p in parts)
    assert np.array_equal(parts[0].frame.origin, stations[0].frame.origin)


@pytest.mark.parametrize("chunk", [700, 100_000])
def test_chunks_of_all_scans_as_one_cloud_are_those_of_the_whole(two_stations, tmp_path, chunk):
    world, path, scans = two_stations
    # Another layout, an unusable row, and a scan in between of which no point is left.
    own = {name: values[:900] for name, values in scans[1]["fields"].items() if name != "rowIndex"}
    state = np.zeros(900, "i1")
    state[40] = 2
    other = {**scans[1], "name": "other", "fields": {**own, "cartesianInvalidState": state}}
    nothing = {**cartesian(world[:50]), "cartesianInvalidState": np.full(50, 2, "i1")}
    mixed = write_e57(tmp_path / "mixed.e57", [scans[0], {"fields": nothing}, other])
    alone = write_e57(tmp_path / "alone.e57", [{"fields": nothing}, other])
    for file in (path, mixed, alone):
        whole, parts = read(file), list(iterate(file, chunk, as_one=True))
        for name in ("xyz", "records"):
            found = np.concatenate([getattr(part, name) for part in parts])
            np.testing.assert_array_equal(found, getattr(whole, name))
        for part in parts:
            assert (part.name, part.notes) == (whole.name, whole.notes)
            np.testing.assert_array_equal(part.viewpoints, whole.viewpoints)
            assert part.header.station == whole.header.station
            stations = [scan.station for scan in part.header.stations]
            assert stations == [scan.station for scan in whole.header.stations]


def test_where_the_scanner_stood_is_known(two_stations):
    _, path, scans = two_stations
    stood = [scan["translation"] for scan in scans]
    whole = read(path)
    assert np.abs(whole.viewpoints + whole.frame.origin - stood).max() < 1e-9
    for cloud, place in zip(read_stations(path), stood, strict=True):
        assert np.abs(cloud.viewpoints + cloud.frame.origin - place).max() < 1e-9
    (_, second) = whole.viewpoints + whole.frame.origin
    np.testing.assert_allclose(second, [500_001.0, 4_000_000.0, 21.5])


def test_describe_counts_stations(two_stations):
    world, path, _ = two_stations
    info = describe(path)
    assert (info.format, info.stations, info.points) == ("E57", 2, 6000)
    assert info.extent_min == pytest.approx(world.min(axis=0), abs=1e-8)
    assert info.attributes["intensity"] == "<f4"


def test_invalid_and_not_finite_points_are_dropped_and_counted(tmp_path):
    points = np.random.default_rng(1).uniform(-5, 5, (100, 3))
    points[7] = np.nan
    state = np.zeros(100, "i1")
    state[[3, 4, 5]] = [1, 2, 2]
    fields = {**cartesian(points), "cartesianInvalidState": state}
    path = write_e57(tmp_path / "a.e57", [{"fields": fields}])
    cloud = read(path)
    assert len(cloud) == 96
    assert np.abs(cloud.frame.to_file(cloud.xyz) - points[np.r_[0:3, 6, 8:100]]).max() < 1e-12
    assert cloud.name == "a"
    assert any("1 of 100 rows had no finite coordinates" in note for note in cloud.notes)
    assert any("3 of 100 points were marked invalid" in note for note in cloud.notes)
    assert "cartesianInvalidState" not in cloud.attributes
    assert any("3 of 100" in finding.text for finding in check(path))


def test_spherical_scans(tmp_path):
    points = np.random.default_rng(2).uniform(-5, 5, (200, 3))
    distance = np.linalg.norm(points, axis=1)
    state = np.zeros(200, "i1")
    state[0] = 2
    fields = {
        "sphericalRange": distance,
        "sphericalAzimuth": np.arctan2(points[:, 1], points[:, 0]),
        "sphericalElevation": np.arcsin(points[:, 2] / distance),
        "sphericalInvalidState": state,
    }
    q, matrix = quaternion(1.0)
    scan = {"fields": fields, "rotation": q, "translation": (1.0, 2.0, 3.0)}
    cloud = read(write_e57(tmp_path / "a.e57", [scan]))
    expected = points[1:] @ matrix.T + [1, 2, 3]
    assert np.abs(cloud.frame.to_file(cloud.xyz) - expected).max() < 1e-12


def test_scaled_integers_and_wide_integers(tmp_path):
    points = np.round(np.random.default_rng(3).uniform(-50, 50, (300, 3)), 4)
    fields = {
        **cartesian(points),
        "timeStamp": np.linspace(1e9, 1e9 + 1, 300),
        "rowIndex": np.arange(300, dtype="i8") * 10_000_000 - 5,
    }
    scaled = dict.fromkeys(("cartesianX", "cartesianY", "cartesianZ"), 1e-4)
    path = write_e57(tmp_path / "a.e57", [{"fields": fields, "scaled": scaled}])
    cloud = read(path)
    assert np.abs(cloud.frame.to_file(cloud.xyz) - points).max() < 1e-10
    assert cloud.frame.step == (1e-4, 1e-4, 1e-4)
    assert np.array_equal(cloud.attribute("row_index"), fields["rowIndex"])
    assert np.array_equal(cloud.attribute("time_stamp"), fields["timeStamp"])


def test_a_pose_that_is_none_is_refused(tmp_path):
    scan = {"name": "hall", "rotation": [0, 0, 0, 0], "translation": [1, 2, 3]}
    path = write_e57(tmp_path / "a.e57", [scan | {"fields": cartesian(np.eye(3))}])
    with pytest.raises(FormatError, match=r"a\.e57: scan 'hall' has a pose that is none"):
        read(path)


def test_scans_without_a_pose_beside_others_are_said(tmp_path):
    bare = [{"name": f"s{k}", "fields": cartesian(np.eye(3) + k)} for k in range(3)]
    posed = bare[0] | {"rotation": [1, 0, 0, 0], "translation": [5, 0, 0]}
    still = posed | {"translation": [0, 0, 0]}
    path = write_e57(tmp_path / "a.e57", bare)
    (note,) = read(path).notes
    assert note.startswith("s0: 3 of the 3 scans of a.e57 state no pose, or one that moves nothing")
    assert describe(path).notes == (note.removeprefix("s0: "),)
    assert [f.severity for f in check(path) if "state no pose" in f.text] == ["warning"]
    (note,) = read(write_e57(tmp_path / "b.e57", [posed, *bare[1:2]])).notes
    assert note.startswith("s1: 1 of the 2 scans of b.e57 states no pose, or")
    (note,) = read(write_e57(tmp_path / "c.e57", [posed, still, still])).notes
    assert note.startswith("s0: 2 of the 3 scans")
    for name, scans in (("d", [posed, posed]), ("e", [still, posed]), ("f", bare[:1])):
        assert not read(write_e57(tmp_path / f"{name}.e57", scans)).notes


def test_an_empty_scan_beside_a_full_one(tmp_path):
    points = np.random.default_rng(4).uniform(-5, 5, (50, 3))
    nothing = {**cartesian(points), "cartesianInvalidState": np.full(50, 2, "i1")}
    path = write_e57(tmp_path / "a.e57", [{"fields": nothing}, {"fields": cartesian(points)}])
    stations = read_stations(path)
    assert [cloud.header.station for cloud in stations] == [1]
    assert read(path).attribute("station").tolist() == [1] * 50
    only = write_e57(tmp_path / "b.e57", [{"fields": nothing}])
    with pytest.raises(FormatError, match="none of its 50 points"):
        read(only)


def test_normals_turn_with_the_pose(tmp_path):
    q, matrix = quaternion(np.pi / 2)
    normals = np.tile(np.array([[1.0, 0, 0]]), (10, 1))
    names = dict(zip(("nx", "ny", "nz"), normals.T.copy(), strict=True))
    fields = {**cartesian(np.arange(30.0).reshape(10, 3)), **names}
    path = write_e57(
        tmp_path / "a.e57", [{"fields": fields, "rotation": q, "translation": (0, 0, 0)}]
    )
    cloud = read(path)
    found = np.stack([cloud.attribute(a) for a in ("nx", "ny", "nz")], axis=1)
    assert np.abs(found - normals @ matrix.T).max() < 1e-6


@pytest.mark.parametrize("left", [0.05, 0.5, 0.95])
def test_truncated_and_corrupt_files_give_one_sentence(two_stations, tmp_path, left):
    _, path, _ = two_stations
    raw = path.read_bytes()
    cut = tmp_path / "cut.e57"
    cut.write_bytes(raw[: int(left * len(raw))])
    broken = tmp_path / "broken.e57"
    at = int(left * len(raw))
    broken.write_bytes(raw[:at] + bytes(64) + raw[at + 64 :])
    for bad in (cut, broken):
        with pytest.raises(FormatError) as caught:
            read(bad)
        assert "\n" not in str(caught.value)
        assert bad.name in str(caught.value)
        assert [f.severity for f in check(bad)] == ["error"]


def test_conversion_to_las_uses_the_pose_and_keeps_the_fields(two_stations, tmp_path):
    world, path, scans = two_stations
    cloud = read_stations(path)[1]
    written = write(cloud, tmp_path / "b.laz")
    again = read(tmp_path / "b.laz")
    assert np.abs(again.frame.to_file(again.xyz) - world).max() < 5.1e-5
    assert np.array_equal(again.attribute("intensity_float"), scans[1]["fields"]["intensity"])
    assert (again.attribute("red") == 250 * 257).all()
    assert np.array_equal(again.attribute("column_index"), scans[1]["fields"]["columnIndex"])
    assert any("intensity is fractional" in note for note in written.notes)
    assert not any(name.startswith("cartesian") for name in again.attributes)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "points"),
    [("ColouredCubeDouble.e57", 7680), ("bunnyDouble.e57", 30571), ("pumpA.e57", 155201)],
)
def test_real_files(data, name, points):
    cloud = read(data / "formats" / name)
    assert len(cloud) == points
    assert describe(data / "formats" / name).points == points
    assert np.isfinite(cloud.xyz).all()


@pytest.mark.parametrize("crs", ["EPSG:2277", "EPSG:2277+6360"])
def test_coordinates_are_metres_even_where_the_system_is_in_feet(tmp_path, crs):
    """ASTM E2807-11, 8.4: metres by definition. The system is carried over in metres too."""
    points = np.array([[944881.9, 3048006.1, 150.0], [944891.9, 3048016.1, 160.0]])
    cloud = read(write_e57(tmp_path / "a.e57", [{"fields": cartesian(points)}], crs))
    assert cloud.frame.unit_m == (1.0, 1.0, 1.0)
    np.testing.assert_allclose(np.ptp(cloud.xyz, axis=0), 10.0, atol=1e-9)
    assert any("metres by definition: taken as metres" in note for note in cloud.notes)
    from pyproj import Transformer

    there = Transformer.from_crs(cloud.frame.crs, "EPSG:2277", always_xy=True)
    feet = there.transform(points[0, 0], points[0, 1])
    np.testing.assert_allclose(feet, points[0, :2] * 3937 / 1200, atol=1e-4)
    write(cloud, tmp_path / "a.laz")
    again = read(tmp_path / "a.laz")
    assert again.frame.unit_m == (1.0, 1.0, 1.0)
    np.testing.assert_allclose(again.frame.to_file(again.xyz), points, atol=1e-4)


@pytest.mark.parametrize("crs", ["EPSG:2277", "EPSG:2277+6360"])
@pytest.mark.parametrize("named", ["", "EPSG:2277"])
def test_coordinates_are_metres_even_where_a_system_in_feet_is_given(tmp_path, crs, named):
    points = np.random.default_rng(3).uniform(0, 50, (40, 3)) + [950_000, 3_050_000, 150]
    plain = read(write_e57(tmp_path / "a.e57", [{"fields": cartesian(points)}], named and crs))
    cloud = in_system(plain, crs)
    np.testing.assert_array_equal(cloud.xyz, plain.xyz)
    assert cloud.frame.unit_m == (1.0, 1.0, 1.0)
    assert units_of(cloud.frame.crs).unit_m == (1.0, 1.0, 1.0)
    assert any("metres by definition: taken as metres" in note for note in cloud.notes)
