"""Rows that say "no data" by a huge number: dropped, counted, and no other point loses a digit."""

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.errors import FormatError
from dougong.formats import check, describe, iterate, read, reissue, write
from test_formats_e57 import write_e57

WALL = np.round(np.random.default_rng(0).uniform([0, 0, 0], [20, 0.02, 10], (2000, 3)), 3)
AT = 700
NO_DATA = (np.float32(-3.4028235e38), 1e20, -1.7e308, 9.1e9)


def with_row(z):
    return np.insert(WALL, AT, [20.0, 0.0, z], axis=0)


def as_xyz(path, points):
    np.savetxt(path, points, fmt="%.17g")


def as_ply(path, points, kind="<f8"):
    records = points.astype(kind)
    name = {"<f8": "double", "<f4": "float"}[kind]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head = "\n".join([*lines, *(f"property {name} {axis}" for axis in "xyz"), "end_header", ""])
    path.write_bytes(head.encode() + records.tobytes())


def as_pcd(path, points):
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + points.tobytes())


def as_ptx(path, points):
    lines = [str(len(points)), "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    lines += ["1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    lines += [" ".join(f"{value:.17g}" for value in [*row, 0.5]) for row in points]
    path.write_text("\n".join([*lines, ""]))


def as_e57(path, points):
    fields = {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}
    write_e57(path, [{"name": "hall", "fields": fields}])


WRITERS = {".xyz": as_xyz, ".ply": as_ply, ".pcd": as_pcd, ".ptx": as_ptx, ".e57": as_e57}


@pytest.mark.parametrize("z", NO_DATA)
@pytest.mark.parametrize("suffix", WRITERS)
def test_a_row_without_data_costs_no_other_point_a_digit(tmp_path, suffix, z):
    for name, points in (("clean", WALL), ("spoilt", with_row(z))):
        WRITERS[suffix](tmp_path / f"{name}{suffix}", points)
    path = tmp_path / f"spoilt{suffix}"
    clean, spoilt = read(tmp_path / f"clean{suffix}"), read(path)
    assert np.array_equal(spoilt.xyz, clean.xyz)
    assert np.array_equal(spoilt.frame.origin, clean.frame.origin)
    (said,) = [note for note in spoilt.notes if "dropped" in note]
    assert said.startswith("1 of 2001 rows had a coordinate beyond 9e+09")
    pieces = list(iterate(path, 300))
    assert np.array_equal(np.concatenate([piece.xyz for piece in pieces]), clean.xyz)
    assert said in pieces[0].notes
    info = describe(path)
    assert said in info.notes
    assert info.extent_max == describe(tmp_path / f"clean{suffix}").extent_max
    assert any(said in found.text for found in check(path) if found.severity == "warning")


def test_no_data_in_single_precision_and_beside_rows_that_are_not_finite(tmp_path):
    points = with_row(-3.4028235e38)
    points[:3, 1] = np.nan
    as_ply(tmp_path / "a.ply", points, "<f4")
    cloud = read(tmp_path / "a.ply")
    assert len(cloud) == 1997
    assert cloud.notes[-2].startswith("3 of 2001 rows had no finite coordinates")
    assert cloud.notes[-1].startswith("1 of 2001 rows had a coordinate beyond 9e+09")


def test_the_numbers_of_a_row_without_data_do_not_widen_its_columns(tmp_path):
    rows = np.column_stack([with_row(1e20), np.arange(2001)])
    rows[AT, 3] = 1e20
    np.savetxt(tmp_path / "a.xyz", rows, fmt="%.17g")
    assert read(tmp_path / "a.xyz").records.dtype["intensity"] == np.dtype("u2")


def test_a_file_issued_again_leaves_the_row_out(tmp_path):
    as_xyz(tmp_path / "a.xyz", with_row(1e20))
    reissue(tmp_path / "a.xyz", tmp_path / "b.laz", [np.eye(4)], Cloud.from_points(WALL).frame)
    assert len(read(tmp_path / "b.laz")) == 2000


def test_a_map_in_millimetres_is_no_row_without_data(tmp_path):
    points = np.round(1000 * (WALL + [500_000, 5_500_000, 20]))
    write(Cloud.from_points(points), tmp_path / "a.ply")
    assert len(read(tmp_path / "a.ply")) == 2000


def test_nothing_but_rows_without_data_is_one_sentence(tmp_path):
    as_xyz(tmp_path / "a.xyz", np.full((4, 3), 1e20))
    with pytest.raises(FormatError, match=r"none of its 4 points .* 4 beyond 9e\+09"):
        read(tmp_path / "a.xyz")
