"""Clouds written as E57, read back by libe57 and pye57: E57 to E57, and from other formats."""

import resource
from dataclasses import replace

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.errors import FrameError, OutputError
from dougong.formats import read, read_stations, write, write_merged, write_stations
from e57_surveys import survey, turn
from reference.e57 import differing, pose, rotation_of, tree, world
from test_formats_e57 import cartesian, write_e57

GONE = ("/guid", "/originalGuids", "Bounds/", "/pointGroupingSchemes", "/associatedData3DGuid")


def motion(yaw=0.4, scale=1.0):
    about = np.array([500_000.0, 4_000_000.0, 20.0])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_of(*turn(yaw, 0.01, -0.015))
    matrix[:3, 3] = about + [12.5, -7.25, 3.0] - matrix[:3, :3] @ about
    return matrix


@pytest.mark.parametrize("kind", ["scaled", "double", "single", "integer", "spherical"])
def test_a_filtered_survey_keeps_all_but_what_was_taken(tmp_path, kind):
    source = survey(tmp_path / "a.e57", kind=kind)
    cloud = read(source)
    chosen = np.arange(len(cloud)) % 3 == 0
    written = write(cloud.select(chosen), tmp_path / "b.e57")
    assert written.points == chosen.sum()
    before, after = tree(source), tree(tmp_path / "b.e57")
    assert after["/data3D"] == before["/data3D"]
    state = "sphericalInvalidState" if kind == "spherical" else "cartesianInvalidState"
    first = 0
    for k in range(4):
        at = f"/data3D/{k}/points/"
        is_valid = before[at + state] == 0
        mine = chosen[first : first + is_valid.sum()]
        first += len(mine)
        for path in (p for p in before if p.startswith(at) and "/prototype" not in p):
            expected = before[path][is_valid][mine]
            if "nor:normal" in path:  # turned into the file's frame and back: float32 rounding
                assert np.abs(after[path] - expected).max() < 2e-7
            else:
                assert np.array_equal(after[path], expected), path
    changed = {
        path
        for path in differing(before, after)
        if not any(part in path for part in GONE) and not path.endswith("Guid")
    }
    changed = {p for p in changed if not ("/points" in p and "/prototype" not in p)}
    # A pose is written as its quaternion of length one.
    turned = {p for p in changed if "/pose" in p}
    for path in turned & before.keys():
        assert abs(after[path][1]) == pytest.approx(abs(before[path][1]), abs=1e-15)
    assert changed <= turned | {"/e57LibraryVersion"}


def test_what_a_survey_says_of_its_scans_is_carried_over(tmp_path):
    source = survey(tmp_path / "a.e57")
    written = write(read(source), tmp_path / "b.e57")
    after = tree(tmp_path / "b.e57")
    assert after["/data3D/1/sensorSerialNumber"][1] == "0815"
    assert after["/data3D/1/acquisitionStart/dateTimeValue"][1] == 1.3e9 + 1
    assert after["/acme:project"][1].endswith("太和殿")
    assert after["extension nor"].startswith("http://www.libe57.org")
    assert [after[f"/data3D/1/originalGuids/{k}"][1] for k in (0, 1)] == ["{ORIGINAL}", "{SCAN-1}"]
    assert after["/images2D/2/associatedData3DGuid"][1] == after["/data3D/2/guid"][1]
    assert after["/images2D/2/pinholeRepresentation/jpegImage"][1][:4] == b"\0\1\2\3"
    assert any("table of scan lines is left out" in note for note in written.notes)


@pytest.mark.data
def test_a_real_file_keeps_its_picture_and_bounds(data, tmp_path):
    """A photo that shows the object and stands nowhere belongs to the file."""
    write(read(data / "formats" / "pumpA.e57"), tmp_path / "b.e57")
    before, after = tree(data / "formats" / "pumpA.e57"), tree(tmp_path / "b.e57")
    name = "/images2D/0/visualReferenceRepresentation/jpegImage"
    assert after[name] == before[name]
    name = "/data3D/0/sphericalBounds/azimuthEnd"
    assert after[name] == before[name]
    lost = {path for path in before.keys() - after.keys() if "pointGroupingSchemes" not in path}
    assert lost == set()


@pytest.mark.parametrize("scale", [1.0, 0.9996])
@pytest.mark.parametrize("kind", ["scaled", "double"])
def test_a_moved_survey_has_new_poses_and_old_numbers(tmp_path, kind, scale):
    source = survey(tmp_path / "a.e57", kind=kind)
    cloud = read(source)
    moved = cloud.moved(motion(0.8, 1.0)).moved(motion(-0.3, scale))
    write(moved, tmp_path / "b.e57")
    before, after = tree(source), tree(tmp_path / "b.e57")
    whole = motion(-0.3, scale) @ motion(0.8)
    first = 0
    for k in range(4):
        there, is_invalid = world(before, k)
        expected = there[~is_invalid] @ whole[:3, :3].T + whole[:3, 3]
        found, _ = world(after, k)
        assert np.abs(found - expected).max() < 2e-8
        mine = slice(first, first + len(found))
        assert np.abs(found - moved.frame.to_file(moved.xyz[mine])).max() < 1e-8
        first += len(found)
        name = f"/data3D/{k}/points/cartesianX"
        if scale == 1.0 or kind == "scaled":
            assert np.array_equal(after[name], before[name][~is_invalid])


def test_a_survey_read_back_is_the_cloud(tmp_path):
    """Ours reads what ours wrote: points, attributes, stations."""
    cloud = read(survey(tmp_path / "a.e57"))
    write(cloud, tmp_path / "b.e57")
    again = read(tmp_path / "b.e57")
    assert np.abs(again.frame.to_file(again.xyz) - cloud.frame.to_file(cloud.xyz)).max() < 2e-9
    for name in cloud.attributes:
        one, other = cloud.attribute(name), again.attribute(name)
        if name in ("nx", "ny", "nz"):
            assert np.abs(one - other).max() < 3e-7
        else:
            assert np.array_equal(one, other), name


def las_like(count=5000, step=1e-3):
    rng = np.random.default_rng(4)
    xyz = np.rint(rng.uniform(0, 80, (count, 3)) / step) * step
    cloud = Cloud.from_points(
        xyz + [500_000, 4_000_000, 20], crs="EPSG:32650",
        intensity=rng.integers(0, 3000, count).astype("u2"),
        red=(rng.integers(0, 256, count) * 257).astype("u2"),
        green=(rng.integers(0, 256, count) * 257).astype("u2"),
        blue=(rng.integers(0, 256, count) * 257).astype("u2"),
        classification=rng.integers(0, 8, count).astype("u1"),
        gps_time=rng.uniform(0, 1e9, count),
        nx=rng.uniform(-1, 1, count).astype("f4"), ny=np.zeros(count, "f4"),
        nz=np.ones(count, "f4"),
        **{"odd name (m)": rng.uniform(0, 1, count), "large": np.arange(count) * 10**9},
    )  # fmt: skip
    return cloud


def test_a_foreign_cloud_becomes_scaled_integers_about_its_origin(tmp_path):
    write(las_like(), tmp_path / "a.laz")
    cloud = read(tmp_path / "a.laz")
    written = write(cloud, tmp_path / "b.e57")
    after = tree(tmp_path / "b.e57")
    kind, _, low, high, scale, offset = after["/data3D/0/points/prototype/cartesianX"]
    assert (kind, scale, offset) == ("ScaledIntegerNode", 1e-4, 0.0)
    assert -2 <= low <= high < 1e6
    rotation, translation = pose(after, "/data3D/0")
    assert np.array_equal(rotation, np.eye(3))
    assert np.abs(translation - [500_000, 4_000_000, 20]).max() < 1
    found, _ = world(after, 0)
    assert np.abs(found - cloud.frame.to_file(cloud.xyz)).max() < 2e-9
    assert np.array_equal(after["/data3D/0/points/intensity"], cloud.attribute("intensity"))
    assert np.array_equal(after["/data3D/0/points/colorRed"], cloud.attribute("red") // 257)
    assert after["/data3D/0/colorLimits/colorRedMaximum"][1] == 255
    assert "EPSG" in after["/coordinateMetadata"][1]
    assert any("kept in an extension" in note for note in written.notes)
    again = read(tmp_path / "b.e57")
    for name in ("classification", "gps_time", "nx", "large", "return_number"):
        assert np.array_equal(again.attribute(name), cloud.attribute(name)), name
    assert np.array_equal(again.attribute("odd_name__m_"), cloud.attribute("odd name (m)"))
    assert again.frame.crs == cloud.frame.crs


def test_pye57_reads_a_foreign_cloud(tmp_path):
    import pye57

    write(las_like(), tmp_path / "a.laz")
    cloud = read(tmp_path / "a.laz")
    write(cloud, tmp_path / "b.e57")
    file = pye57.E57(str(tmp_path / "b.e57"))
    data = file.read_scan(0, intensity=True, colors=True, ignore_missing_fields=True)
    file.close()
    theirs = np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    assert np.abs(theirs - cloud.frame.to_file(cloud.xyz)).max() < 2e-9
    assert np.array_equal(data["intensity"], cloud.attribute("intensity"))
    assert np.array_equal(data["colorGreen"], cloud.attribute("green") // 257)


def test_finer_steps_and_true_doubles_are_kept(tmp_path):
    fine = Cloud.from_points(np.array([[1.00001, 2.00002, 3.00003], [4.0, 5.0, 6.0]]))
    fine = replace(fine, frame=replace(fine.frame, step=(1e-5, 1e-5, 1e-5)))
    write(fine, tmp_path / "fine.e57")
    assert tree(tmp_path / "fine.e57")["/data3D/0/points/prototype/cartesianX"][4] == 1e-5
    free = Cloud.from_points(np.random.default_rng(0).uniform(0, 1, (50, 3)) + 500_000)
    written = write(free, tmp_path / "free.e57")
    after = tree(tmp_path / "free.e57")
    assert after["/data3D/0/points/prototype/cartesianX"][0] == "FloatNode"
    found, _ = world(after, 0)
    assert np.array_equal(found, free.frame.to_file(free.xyz))
    assert any("as doubles" in note for note in written.notes)


def test_feet_become_metres(tmp_path):
    points = np.array([[944881.9, 3048006.1, 150.0], [944891.9, 3048016.1, 160.0]])
    write(Cloud.from_points(points, crs="EPSG:2277"), tmp_path / "a.laz")
    cloud = read(tmp_path / "a.laz")
    assert cloud.frame.unit_m[0] != 1.0
    written = write(cloud, tmp_path / "b.e57")
    again = read(tmp_path / "b.e57")
    assert again.frame.unit_m == (1.0, 1.0, 1.0)
    local = cloud.xyz + cloud.frame.origin
    assert np.abs(again.frame.to_file(again.xyz) - local).max() < 6e-5
    assert any("written in metres too" in note for note in written.notes)


def test_degrees_are_refused(tmp_path):
    cloud = Cloud.from_points(np.array([[116.4, 39.9, 40.0]]), crs="EPSG:4326")
    with pytest.raises(OutputError, match="E57 holds metres"):
        write(cloud, tmp_path / "a.e57")
    assert list(tmp_path.iterdir()) == []


def test_scans_of_a_ptx_file_keep_their_poses(tmp_path):
    points = np.round(np.random.default_rng(3).uniform(-20, 20, (50, 3)), 4)
    turned = rotation_of(*turn(0.5))
    lines = []
    for k in range(2):
        lines += ["5", "10", f"{100 * k} 7 2", "1 0 0", "0 1 0", "0 0 1"]
        lines += [" ".join(map(str, (*row, 0))) for row in turned.T] + [f"{100 * k} 7 2 1"]
        lines += [f"{x:.4f} {y:.4f} {z:.4f} 0.5 9 8 7" for x, y, z in points]
    (tmp_path / "a.ptx").write_text("\n".join(lines) + "\n")
    cloud = read(tmp_path / "a.ptx")
    write(cloud.moved(motion(0.3)), tmp_path / "b.e57")
    after = tree(tmp_path / "b.e57")
    assert [after[f"/data3D/{k}/name"][1] for k in (0, 1)] == ["a_1", "a_2"]
    for k in (0, 1):
        assert after[f"/data3D/{k}/points/prototype/cartesianX"][4] == 1e-4
        rotation, translation = pose(after, f"/data3D/{k}")
        assert np.abs(rotation - motion(0.3)[:3, :3] @ turned).max() < 1e-9
        there = motion(0.3) @ [100 * k, 7, 2, 1]
        assert np.abs(translation - there[:3]).max() < 1e-6
        own = np.stack([after[f"/data3D/{k}/points/cartesian{a}"] for a in "XYZ"], axis=1)
        assert np.array_equal(own, np.rint(points * 1e4))
        assert (after[f"/data3D/{k}/points/colorGreen"] == 8).all()


def mixed_survey(path):
    """A coloured scan beside one with intensities alone."""
    rng = np.random.default_rng(3)
    fields = [cartesian(rng.uniform(-5, 5, (50, 3))) for _ in range(2)]
    colours = {f"color{name}": rng.integers(1, 256, 50).astype("u1") for name in ("Red", "Green")}
    fields[0] |= {**colours, "colorBlue": np.zeros(50, "u1")}
    fields[1] |= {"intensity": rng.random(50).astype("f4")}
    return write_e57(path, [{"name": "AB"[k], "fields": f} for k, f in enumerate(fields)])


def test_a_scan_gets_no_channel_of_another(tmp_path):
    cloud = read(mixed_survey(tmp_path / "a.e57"))
    write(cloud, tmp_path / "b.e57")
    before, after = read_stations(tmp_path / "a.e57"), read_stations(tmp_path / "b.e57")
    for old, new in zip(before, after, strict=True):
        assert new.attributes == old.attributes
        assert new.records.tobytes() == old.records.tobytes()
    # What was set since is the scan's own, also under a name that another scan brought.
    write(cloud.with_attribute("intensity", np.full(100, 0.5, "f4")), tmp_path / "c.e57")
    first = read_stations(tmp_path / "c.e57")[0]
    assert (first.attribute("intensity") == 0.5).all()
    assert first.attribute("blue") is not None


def test_a_ptx_scan_without_colours_gets_none(tmp_path):
    head = ["2", "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    head += ["1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    lines = [*head, "1 2 3 0.5 9 8 7", "2 3 4 0.25 6 5 4", *head, "1 1 1 0.5", "2 2 2 0.25"]
    (tmp_path / "a.ptx").write_text("\n".join([*lines, ""]))
    write(read(tmp_path / "a.ptx"), tmp_path / "b.e57")
    first, second = read_stations(tmp_path / "b.e57")
    assert first.attribute("red").tolist() == [9, 6]
    assert second.attribute("red") is None
    assert second.attribute("intensity").tolist() == [0.5, 0.25]


def test_clouds_as_scans_of_one_file(tmp_path):
    stations = read_stations(survey(tmp_path / "a.e57"))
    foreign = las_like()
    written = write_stations([stations[1], stations[3]], tmp_path / "b.e57")
    assert written.points == len(stations[1]) + len(stations[3])
    again = read_stations(tmp_path / "b.e57")
    assert [cloud.name for cloud in again] == ["station 1", "station 3"]
    write_stations([stations[0], foreign], tmp_path / "c.e57")
    assert [len(c) for c in read_stations(tmp_path / "c.e57")] == [len(stations[0]), len(foreign)]
    with pytest.raises(FrameError):
        write_stations([stations[0], Cloud.from_points(np.zeros((2, 3)))], tmp_path / "d.e57")
    with pytest.raises(OutputError, match="E57 only"):
        write_stations([stations[0]], tmp_path / "d.laz")
    with pytest.raises(OutputError):
        write_merged([foreign], tmp_path / "d.e57", source_ids=[1])


def test_a_lost_source_is_said(tmp_path):
    source = survey(tmp_path / "a.e57")
    cloud = read(source)
    source.unlink()
    written = write(cloud, tmp_path / "b.e57")
    assert any("a.e57 is not there any more" in note for note in written.notes)
    again = read(tmp_path / "b.e57")
    assert np.array_equal(again.attribute("acme:temperature"), cloud.attribute("acme:temperature"))
    assert np.abs(again.frame.to_file(again.xyz) - cloud.frame.to_file(cloud.xyz)).max() < 2e-9


def test_a_number_beyond_its_field_is_said(tmp_path):
    cloud = read_stations(survey(tmp_path / "a.e57"))[0]
    cloud = cloud.with_attribute("row_index", np.full(len(cloud), 2**32 - 1))
    with pytest.raises(OutputError, match=r"rowIndex holds .* and its E57 field takes 0 to"):
        write(cloud, tmp_path / "b.e57")
    assert [p.name for p in tmp_path.iterdir()] == ["a.e57"]


def test_the_same_points_elsewhere_are_another_scan(tmp_path):
    """An id stands for one version of a scan, its pose included."""
    cloud = read_stations(survey(tmp_path / "a.e57"))[0]
    write(cloud, tmp_path / "b.e57")
    write(cloud.moved(motion()), tmp_path / "c.e57")
    one, other = tree(tmp_path / "b.e57"), tree(tmp_path / "c.e57")
    assert one["/data3D/0/guid"] != other["/data3D/0/guid"]


def test_one_cloud_is_one_file(tmp_path):
    cloud = read(survey(tmp_path / "a.e57"))
    for name in ("b.e57", "c.e57"):
        write(cloud, tmp_path / name)
    assert (tmp_path / "b.e57").read_bytes() == (tmp_path / "c.e57").read_bytes()


@pytest.mark.parametrize("limit", [2_000, 60_000, 200_000])
def test_a_full_disk_leaves_nothing(tmp_path, limit):
    cloud = read(survey(tmp_path / "a.e57", rows=100, columns=100))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    try:
        with pytest.raises(OutputError, match="limit was reached"):
            write(cloud, tmp_path / "b.e57")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.e57"]
