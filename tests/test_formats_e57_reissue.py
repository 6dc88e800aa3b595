"""E57 issued again with new poses: read back by libe57 and pye57, nothing ignored."""

import resource
from dataclasses import replace

import numpy as np
import pytest
from pye57 import libe57

from dougong.errors import FormatError, InputError, OutputError
from dougong.formats import is_same_crs, read, write
from dougong.formats.e57_container import Appender, Pages
from dougong.formats.e57_fields import FieldSpec
from dougong.formats.e57_pose import motion_of, quaternion_of
from dougong.formats.e57_reissue import reissue_e57
from dougong.formats.e57_section import write_section
from e57_surveys import POSES, survey, turn
from reference.e57 import differing, pose, rotation_of, tree, world

KINDS = ("scaled", "double", "single", "integer", "spherical")


def motion(yaw=0.4, scale=1.0, shift=(12.5, -7.25, 3.0), about=(500_000.0, 4_000_000.0, 20.0)):
    """Return a turn about a place on the map, a scale and a shift, as (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_of(*turn(yaw, 0.01, -0.015))
    matrix[:3, 3] = np.array(about) + shift - matrix[:3, :3] @ about
    return matrix


def is_of_the_frame(path):
    """Say whether a path of the tree may change: poses, the file's id, its reference system."""
    return "/pose" in path or path in ("/guid", "/coordinateMetadata")


@pytest.mark.parametrize("kind", KINDS)
def test_only_poses_change(tmp_path, kind):
    source = survey(tmp_path / "a.e57", kind=kind)
    matrices = [motion(0.1 * k, shift=(k, 2 * k, 0)) for k in range(len(POSES))]
    done = reissue_e57(source, tmp_path / "b.e57", matrices, crs="EPSG:32651")
    before, after = tree(source), tree(tmp_path / "b.e57")
    assert all(is_of_the_frame(path) for path in differing(before, after))
    assert is_same_crs(after["/coordinateMetadata"][1], "EPSG:32651")
    assert before["/guid"] != after["/guid"]
    assert done.points == 4 * 1200
    assert done.notes == ()


@pytest.mark.parametrize("kind", ["scaled", "double"])
def test_poses_are_composed_in_double_precision(tmp_path, kind):
    """Pose to 1e-6 m over the whole scan, on map coordinates: much better in fact."""
    source = survey(tmp_path / "a.e57", kind=kind)
    matrices = [motion(0.5 * k, shift=(3 * k, -k, k)) for k in range(len(POSES))]
    done = reissue_e57(source, tmp_path / "b.e57", matrices, crs=None)
    before, after = tree(source), tree(tmp_path / "b.e57")
    for k, matrix in enumerate(matrices):
        there, is_invalid = world(before, k)
        found, _ = world(after, k)
        centre = there[~is_invalid].mean(axis=0)
        expected = (there - centre) @ matrix[:3, :3].T + (matrix[:3, :3] @ centre + matrix[:3, 3])
        assert np.abs(found - expected)[~is_invalid].max() < 5e-9
        rotation, translation = pose(after, f"/data3D/{k}")
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-15
        said = done.stations[k]
        assert (said.index, said.name) == (k, f"station {k}")
        assert np.array_equal(said.translation, translation)
        assert np.array_equal(rotation_of(*said.quaternion), rotation)


def test_pye57_sees_the_same_points(tmp_path):
    import pye57

    source = survey(tmp_path / "a.e57", kind="scaled")
    matrix = motion(1.0)
    reissue_e57(source, tmp_path / "b.e57", [matrix] * 4, crs="EPSG:32650")
    one, other = pye57.E57(str(source)), pye57.E57(str(tmp_path / "b.e57"))
    options = {"intensity": True, "colors": True, "ignore_missing_fields": True}
    for k in range(4):
        old, new = one.read_scan(k, **options), other.read_scan(k, **options)
        for name in ("intensity", "colorRed", "colorGreen", "colorBlue"):
            assert np.array_equal(old[name], new[name])
        there, found = (
            np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for data in (old, new)
        )
        expected = there @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.abs(found - expected).max() < 1e-8
        assert other.get_header(k).point_count == 1200
    one.close()
    other.close()


def test_pictures_move_with_their_scan(tmp_path):
    source = survey(tmp_path / "a.e57")
    matrices = [motion(0.1 * (k + 1)) for k in range(4)]
    reissue_e57(source, tmp_path / "b.e57", matrices, crs=None)
    before, after = tree(source), tree(tmp_path / "b.e57")
    for k, matrix in enumerate(matrices):
        rotation, translation = pose(before, f"/images2D/{k}")
        found = pose(after, f"/images2D/{k}")
        assert np.abs(found[0] - matrix[:3, :3] @ rotation).max() < 1e-14
        assert np.abs(found[1] - (matrix[:3, :3] @ translation + matrix[:3, 3])).max() < 1e-8


@pytest.mark.parametrize("kind", KINDS)
def test_a_scale_goes_into_the_points(tmp_path, kind):
    """The grid factor of a map, for one: a pose cannot hold it, so own coordinates are scaled."""
    source = survey(tmp_path / "a.e57", kind=kind, rows=150, columns=200)
    scale = 0.99962
    matrices = [motion(0.3 * k, scale) for k in range(4)]
    done = reissue_e57(source, tmp_path / "b.e57", matrices, crs=None)
    assert any("scale of 0.99962 and an E57 pose has none" in note for note in done.notes)
    before, after = tree(source), tree(tmp_path / "b.e57")
    changed = {p for p in differing(before, after) if not is_of_the_frame(p)}
    assert changed, "the scale is somewhere"
    floats = ("/sphericalRange",) if kind == "spherical" else tuple(f"/cartesian{a}" for a in "XYZ")
    assert all("Bounds" in path or path.endswith(floats) for path in changed)
    is_whole = kind in ("scaled", "integer")
    assert is_whole == all("prototype" in path or "Bounds" in path for path in changed), (
        "scaled integers keep their integers: only the factor in the header changes"
    )
    for k, matrix in enumerate(matrices):
        if kind == "spherical":
            name = f"/data3D/{k}/points/sphericalRange"
            np.testing.assert_allclose(after[name], before[name] * scale, rtol=1e-15)
            continue
        there, is_invalid = world(before, k)
        found, _ = world(after, k)
        expected = there @ matrix[:3, :3].T + matrix[:3, 3]
        most = 1e-5 if kind == "single" else 1e-8
        assert np.abs(found - expected)[~is_invalid].max() < most
        low = [after[f"/data3D/{k}/cartesianBounds/{a}Minimum"][1] for a in "xyz"]
        old = [before[f"/data3D/{k}/cartesianBounds/{a}Minimum"][1] for a in "xyz"]
        np.testing.assert_allclose(low, np.array(old) * scale, rtol=1e-15)


def test_floats_cut_by_packets_and_batches_are_scaled_once(tmp_path, monkeypatch):
    """Many packets, small batches: every cut through a number is met."""
    import dougong.formats.e57_floats as e57_floats

    source = survey(tmp_path / "a.e57", kind="double", scans=1, rows=300, columns=300)
    monkeypatch.setattr(e57_floats, "_BATCH_BYTES", 70_000)
    reissue_e57(source, tmp_path / "b.e57", [motion(0.0, 0.5)], crs=None)
    before, after = tree(source), tree(tmp_path / "b.e57")
    for axis in "XYZ":
        name = f"/data3D/0/points/cartesian{axis}"
        np.testing.assert_allclose(after[name], before[name] * 0.5, rtol=1e-15)


def test_scans_that_are_not_sure_are_left_out_with_their_pictures(tmp_path):
    source = survey(tmp_path / "a.e57")
    done = reissue_e57(
        source, tmp_path / "b.e57", [None, motion(), None, motion(0.9)], crs="EPSG:32650"
    )
    before, after = tree(source), tree(tmp_path / "b.e57")
    assert after["/data3D"][2] == 2
    assert after["/images2D"][2] == 2
    assert [after[f"/data3D/{k}/name"][1] for k in range(2)] == ["station 1", "station 3"]
    assert [station.index for station in done.stations] == [1, 3]
    assert any("2 pictures are left out" in note for note in done.notes)
    for new, old in ((0, 1), (1, 3)):
        for name in ("cartesianX", "intensity", "acme:temperature", "columnIndex"):
            one = before[f"/data3D/{old}/points/{name}"]
            assert np.array_equal(after[f"/data3D/{new}/points/{name}"], one)
        assert (
            after[f"/images2D/{new}/pinholeRepresentation/jpegImage"][1]
            == (before[f"/images2D/{old}/pinholeRepresentation/jpegImage"][1])
        )


@pytest.mark.parametrize("kind", ["scaled", "double"])
def test_what_is_left_out_leaves_no_bytes(tmp_path, kind):
    """Also of files that we wrote, whose index packets hold positions; and with a scale."""
    write(read(survey(tmp_path / "a.e57", kind=kind, rows=120)), tmp_path / "b.e57")
    for source in (tmp_path / "a.e57", tmp_path / "b.e57"):
        motions = [None, None, motion(0.2, 0.5), None]
        reissue_e57(source, tmp_path / "c.e57", motions, crs=None, overwrite=True)
        before, after = tree(source), tree(tmp_path / "c.e57")
        sizes = [path.stat().st_size for path in (tmp_path / "c.e57", source)]
        assert sizes[0] < 0.3 * sizes[1]
        there, is_invalid = world(before, 2)
        found, _ = world(after, 0)
        expected = there @ motion(0.2, 0.5)[:3, :3].T + motion(0.2, 0.5)[:3, 3]
        assert np.abs(found - expected)[~is_invalid].max() < 1e-8
        assert np.array_equal(
            after["/data3D/0/points/acme:temperature"], before["/data3D/2/points/acme:temperature"]
        )
        again = reissue_e57(
            tmp_path / "c.e57", tmp_path / "d.e57", [np.eye(4)], crs=None, overwrite=True
        )
        assert again.points == after["/data3D/0/points"][1]


def test_xml_before_the_points(tmp_path):
    """Where the XML lies is up to the writer: new XML then goes to the end."""
    spec = FieldSpec(kind="integer", low=0, high=1000)
    values = np.arange(500)
    fields = {f"cartesian{axis}": (spec, values) for axis in "XYZ"}
    prototype = "".join(f'<{n} type="Integer" minimum="0" maximum="1000"/>' for n in fields)

    def xml(place):
        return (
            (
                f'<e57Root type="Structure" xmlns="{libe57.E57_V1_0_URI}">'
                '<formatName type="String">ASTM E57 3D Imaging Data File</formatName>'
                '<guid type="String">{1}</guid><versionMajor type="Integer">1</versionMajor>'
                '<versionMinor type="Integer">0</versionMinor>'
                '<data3D type="Vector" allowHeterogeneousChildren="1">'
                '<vectorChild type="Structure">'
                f'<points type="CompressedVector" fileOffset="{place}" recordCount="500">'
                f'<prototype type="Structure">{prototype}</prototype>'
                '<codecs type="Vector" allowHeterogeneousChildren="1"/>'
                "</points></vectorChild></data3D>"
                "</e57Root>"
            )
            .encode()
            .ljust(2000)
        )

    with (tmp_path / "a.e57").open("w+b") as file:
        out = Appender(file)
        out.write(xml(0))
        place = write_section(out, fields, lambda _: None)
        layout = replace(out.finish(b" "), xml_start=48, xml_bytes=2000)
        pages = Pages(file, layout, "a.e57")
        pages.write(48, xml(place))
        pages.write(0, layout.packed())
    assert len(read(tmp_path / "a.e57")) == 500
    reissue_e57(tmp_path / "a.e57", tmp_path / "b.e57", [motion()], crs=None)
    before, after = tree(tmp_path / "a.e57"), tree(tmp_path / "b.e57")
    assert all(is_of_the_frame(path) for path in differing(before, after))
    expected = world(before, 0)[0] @ motion()[:3, :3].T + motion()[:3, 3]
    assert np.abs(world(after, 0)[0] - expected).max() < 1e-8


def test_the_same_input_gives_the_same_bytes(tmp_path):
    source = survey(tmp_path / "a.e57")
    for name in ("b.e57", "c.e57"):
        reissue_e57(source, tmp_path / name, [motion()] * 4, crs=None)
    assert (tmp_path / "b.e57").read_bytes() == (tmp_path / "c.e57").read_bytes()


def test_there_and_back(tmp_path):
    source = survey(tmp_path / "a.e57", kind="scaled")
    matrix = motion(2.2)
    reissue_e57(source, tmp_path / "b.e57", [matrix] * 4, crs=None)
    reissue_e57(tmp_path / "b.e57", tmp_path / "c.e57", [np.linalg.inv(matrix)] * 4, crs=None)
    before, after = tree(source), tree(tmp_path / "c.e57")
    assert all(is_of_the_frame(path) for path in differing(before, after))
    for k in range(4):
        assert np.abs(world(before, k)[0] - world(after, k)[0]).max() < 1e-8


def test_a_matrix_of_few_digits_keeps_the_scan_in_its_place(tmp_path):
    """A rotation of seven digits would be off by a metre at the map's origin, not at the scan."""
    source = survey(tmp_path / "a.e57", kind="scaled")
    matrix = motion(0.4)
    matrix[:3, :3] = np.round(matrix[:3, :3], 7)
    matrix[:3, 3] = 0.0
    done = reissue_e57(source, tmp_path / "b.e57", [matrix] * 4, crs=None)
    before, after = tree(source), tree(tmp_path / "b.e57")
    for k in range(4):
        there, is_invalid = world(before, k)
        found, _ = world(after, k)
        expected = there @ matrix[:3, :3].T
        assert np.abs(found - expected)[~is_invalid].max() < 2e-5
    assert any("a rotation only to" in note for note in done.notes)


def test_a_damaged_page_is_found_and_nothing_is_left(tmp_path):
    source = survey(tmp_path / "a.e57")
    data = bytearray(source.read_bytes())
    data[5000] ^= 1
    source.write_bytes(data)
    with pytest.raises(FormatError, match="checksum of the 1024 bytes at 4,096"):
        reissue_e57(source, tmp_path / "b.e57", [motion()] * 4, crs=None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.e57"]


def test_a_truncated_input_is_refused(tmp_path):
    source = survey(tmp_path / "a.e57")
    source.write_bytes(source.read_bytes()[:-2000])
    with pytest.raises(FormatError, match="truncated"):
        reissue_e57(source, tmp_path / "b.e57", [motion()] * 4, crs=None)


def test_a_full_disk_leaves_nothing(tmp_path):
    source = survey(tmp_path / "a.e57", rows=100, columns=100)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(OutputError, match="limit was reached"):
            reissue_e57(source, tmp_path / "b.e57", [motion()] * 4, crs=None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.e57"]


def test_motions_must_be_one_per_scan(tmp_path):
    source = survey(tmp_path / "a.e57", scans=2)
    with pytest.raises(InputError, match="has 2 scans, got 1 motions"):
        reissue_e57(source, tmp_path / "b.e57", [motion()], crs=None)
    with pytest.raises(InputError, match="every scan is left out"):
        reissue_e57(source, tmp_path / "b.e57", [None, None], crs=None)


def test_a_mirror_is_no_pose(tmp_path):
    source = survey(tmp_path / "a.e57", scans=1)
    with pytest.raises(InputError, match="mirrors"):
        reissue_e57(source, tmp_path / "b.e57", [np.diag([1.0, 1, -1, 1])], crs=None)


@pytest.mark.parametrize("seed", range(20))
def test_quaternions_against_turned_axes(seed):
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    if seed % 3 == 0:
        quaternion[0] *= 1e-9  # near a half turn
    quaternion /= np.linalg.norm(quaternion) * np.sign(quaternion[0])
    assert np.abs(quaternion_of(rotation_of(*quaternion)) - quaternion).max() < 4e-16


def test_scales_next_to_one_are_one():
    assert motion_of(motion(0.3, 1 + 3e-16), np.zeros(3)).scale == 1.0
    assert motion_of(motion(0.3, 1 + 1e-6), np.zeros(3)).scale == pytest.approx(1 + 1e-6, abs=1e-15)


@pytest.mark.data
@pytest.mark.parametrize("name", ["ColouredCubeDouble.e57", "bunnyDouble.e57", "pumpA.e57"])
@pytest.mark.parametrize("scale", [1.0, 0.9996])
def test_real_files(data, tmp_path, name, scale):
    source = data / "formats" / name
    matrix = motion(0.7, scale, about=(0, 0, 0), shift=(500_000, 4_000_000, 20))
    reissue_e57(source, tmp_path / name, [matrix], crs="EPSG:32650")
    before, after = tree(source), tree(tmp_path / name)
    changed = [path for path in differing(before, after) if not is_of_the_frame(path)]
    assert scale != 1.0 or not changed
    assert all("cartesian" in path or "Bounds" in path for path in changed)
    there, is_invalid = world(before, 0)
    found, _ = world(after, 0)
    expected = there @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(found - expected)[~is_invalid].max() < 2e-9
