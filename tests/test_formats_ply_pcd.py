"""PLY and PCD: every encoding, against plyfile and by hand-made bytes."""

import struct
from dataclasses import replace

import numpy as np
import plyfile
import pytest

from dougong.cloud import Cloud, Frame
from dougong.errors import FormatError
from dougong.formats import describe, iterate, read, reissue, write
from dougong.kernels.lzf import unpack_lzf
from reference.formats import unpack_lzf as slow_unpack_lzf

DTYPE = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
         ("scalar_Intensity", "f4"), ("label", "i4"), ("nx", "f4"), ("ny", "f4"),
         ("nz", "f4")]  # fmt: skip


def vertices(count=500, seed=0):
    rng = np.random.default_rng(seed)
    array = np.empty(count, dtype=DTYPE)
    for name, kind in DTYPE:
        low = 0 if kind[0] == "u" else -100
        array[name] = rng.uniform(low, 100, count)
    array["x"] += 500_000
    return array


def save(path, array, *, text=False, order="<", faces=0, comments=()):
    elements = [plyfile.PlyElement.describe(array, "vertex")]
    if faces:
        face = np.empty(faces, dtype=[("vertex_indices", "i4", (3,))])
        face["vertex_indices"] = 1
        elements.append(plyfile.PlyElement.describe(face, "face"))
    plyfile.PlyData(elements, text=text, byte_order=order, comments=list(comments)).write(str(path))
    return path


@pytest.mark.parametrize("faces", [0, 20])
@pytest.mark.parametrize(("text", "order"), [(False, "<"), (False, ">"), (True, "=")])
def test_every_encoding_is_read(tmp_path, text, order, faces):
    array = vertices()
    path = save(tmp_path / "a.ply", array, text=text, order=order, faces=faces)
    cloud = read(path)
    assert len(cloud) == 500
    for name, _ in DTYPE:
        if text:  # plyfile writes floats with fewer digits
            assert np.allclose(cloud.attribute(name), array[name], rtol=1e-6)
        else:
            assert np.array_equal(cloud.attribute(name), array[name]), name
    assert np.allclose(
        cloud.frame.to_file(cloud.xyz)[:, 0], cloud.attribute("x"), rtol=0, atol=1e-9
    )
    assert any("20 face" in note for note in cloud.notes) == bool(faces)


def test_names_that_blanks_told_apart_stay_apart(tmp_path):
    columns = {"a b": 1, "a_b": 2, "a  b": 3, " ": 4, "v": [5, 6], "v_0": 7}
    layout = [(name, "u1", (2,) if name == "v" else ()) for name in columns]
    cloud = Cloud.from_points(np.eye(3))
    records = np.zeros(3, dtype=[*cloud.records.dtype.descr, *layout])
    for name, value in columns.items():
        records[name] = value
    written = write(replace(cloud, records=records), tmp_path / "a.ply")
    found = read(tmp_path / "a.ply")
    names = ["a_b_2", "a_b", "a_b_3", "field", "v_0", "v_1", "v_0_2"]
    assert found.attributes[3:] == tuple(names)
    assert [found.attribute(name)[0] for name in names] == [1, 2, 3, 4, 5, 6, 7]
    assert any(note.startswith("'a b' is named a_b_2") for note in written.notes)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_vertices_survive_bit_for_bit(tmp_path, order):
    path = save(tmp_path / "a.ply", vertices(), order=order, comments=["by hand", "twice"])
    assert write(read(path), tmp_path / "b.ply").notes == ()
    assert (tmp_path / "b.ply").read_bytes() == path.read_bytes()


def test_added_and_selected(tmp_path):
    array = vertices()
    path = save(tmp_path / "a.ply", array, order=">", faces=5)
    cloud = read(path).with_attribute("dougong_reason", np.arange(500).astype("u1"))
    chosen = np.arange(500) % 7 == 0
    written = write(cloud.select(chosen), tmp_path / "b.ply")
    assert any("face" in note for note in written.notes)
    data = plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    for name, _ in DTYPE:
        assert np.array_equal(data[name], array[name][chosen])
    assert np.array_equal(data["dougong_reason"], np.arange(500).astype("u1")[chosen])


def test_a_moved_ply_has_new_coordinates_and_turned_normals(tmp_path):
    array = vertices()
    cloud = read(save(tmp_path / "a.ply", array))
    matrix = np.array([[0, -1, 0, 5.0], [1, 0, 0, 6.0], [0, 0, 1, 7.0], [0, 0, 0, 1]])
    write(cloud.moved(matrix), tmp_path / "b.ply")
    data = plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    assert np.allclose(data["x"], 5 - array["y"], atol=1e-8, rtol=0)
    assert np.allclose(data["y"], 6 + array["x"], atol=1e-8, rtol=0)
    assert np.allclose(data["nx"], -array["ny"], atol=1e-5)
    assert np.array_equal(data["label"], array["label"])


def test_reference_system_travels_in_a_comment(tmp_path):
    cloud = Cloud.from_points(np.zeros((2, 3)), crs="EPSG:32650")
    write(cloud, tmp_path / "a.ply")
    again = read(tmp_path / "a.ply")
    assert again.frame.crs.startswith("PROJCRS")
    write(again, tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes().count(b"comment crs") == 1
    feet = save(tmp_path / "c.ply", vertices(), comments=["georeferenced in EPSG:2225"])
    assert read(feet).frame.unit_m == pytest.approx((1200 / 3937,) * 3)


def test_a_reference_system_with_other_letters_leaves_the_header_ascii(tmp_path):
    """EPSG words its areas with degree signs; plyfile and others refuse them."""
    write(Cloud.from_points(np.ones((3, 3)), crs="EPSG:4549"), tmp_path / "a.ply")
    assert len(plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]) == 3
    assert 'ID["EPSG",4549]' in read(tmp_path / "a.ply").frame.crs


def test_not_finite_rows_are_dropped_and_counted(tmp_path):
    array = vertices()
    array["x"][3], array["y"][4], array["z"][5] = np.nan, np.inf, -np.inf
    path = save(tmp_path / "a.ply", array)
    cloud = read(path)
    assert len(cloud) == 497
    assert "3 of 500 rows had no finite coordinates and were dropped." in cloud.notes
    assert describe(path).points == 500
    parts = list(iterate(path, 100))
    assert sum(map(len, parts)) == 497
    assert np.array_equal(np.concatenate([p.xyz for p in parts]), cloud.xyz)
    assert [len(p.notes) for p in parts] == [1, 0, 0, 0, 0]


def test_vertices_behind_a_list_element(tmp_path):
    head = (
        "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
        "element vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "a.ply").write_text(head + "3 0 1 1\n1 2 3\n4 5 6\n")
    cloud = read(tmp_path / "a.ply")
    assert cloud.frame.to_file(cloud.xyz).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("text", [True, False])
def test_truncated_ply(tmp_path, text):
    path = save(tmp_path / "a.ply", vertices(), text=text)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FormatError, match=r"header says 500 points, file ends after 4\d\d"):
        read(path)


@pytest.mark.parametrize(("text", "faces"), [(True, 0), (True, 20), (False, 0)])
def test_more_than_a_ply_header_declares_is_said(tmp_path, text, faces):
    path = save(tmp_path / "a.ply", vertices(), text=text, faces=faces)
    whole = path.read_bytes()
    path.write_bytes(whole + b"\r\n")
    assert not [note for note in read(path).notes if "wrongly" in note]
    path.write_bytes(whole.replace(b"element vertex 500", b"element vertex 450"))
    size = np.dtype(DTYPE).itemsize
    said = "50 lines" if text else f"{50 * size:,} bytes (of {size} a point)"
    assert len(read(path)) == sum(map(len, iterate(path))) == 450
    for cloud in (read(path), *iterate(path)):
        (note,) = [note for note in cloud.notes if "wrongly" in note]
        assert note.startswith(f"its header declares 450 points, wrongly: {said} follow")
    assert note in describe(path).notes


def mesh(path, order="<", extra=b"", head="", lengths=(3,), rows=400):
    """Write three vertices, then faces of such lengths in turn; lists may stand in `head` too."""
    rng = np.random.default_rng(0)
    name = "little" if order == "<" else "big"
    text = f"ply\nformat binary_{name}_endian 1.0\n{head}element vertex 3\n"
    text += "property float x\nproperty float y\nproperty float z\n"
    text += f"element face {rows}\nproperty uchar flags\nproperty list uchar int vertex_indices\n"
    text += "property list ushort float texcoord\nend_header\n"
    body = np.arange(9, dtype=f"{order}f4").tobytes()
    for row in range(rows):
        count = lengths[row % len(lengths)]
        body += struct.pack(f"{order}BB{count}i", rng.integers(256), count, *range(count))
        body += struct.pack(f"{order}H{2 * count}f", 2 * count, *rng.random(2 * count))
    path.write_bytes(text.encode() + body + extra)
    return path


def about_the_end(path):
    return [note for note in read(path).notes if "wrongly" in note]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("lengths", [(3,), (3, 4), (3,) * 100 + (5, 0, 4)])
def test_what_follows_behind_lists_of_a_binary_ply_is_said(tmp_path, order, lengths, monkeypatch):
    monkeypatch.setattr("dougong.formats.ply_lists._RUN_ROWS", 70)
    path = tmp_path / "a.ply"
    assert not about_the_end(mesh(path, order, lengths=lengths))
    assert not about_the_end(mesh(path, order, b"\r\n", lengths=lengths))
    (note,) = about_the_end(mesh(path, order, b"junk" * 9, lengths=lengths))
    assert note.startswith("its header declares 3 points, wrongly: 36 bytes (of 12 a point) follow")
    assert note in describe(path).notes
    moved = reissue(path, tmp_path / "b.laz", [np.eye(4)], Frame(), overwrite=True)
    assert note in moved.notes
    mesh(path, order, lengths=lengths)
    path.write_bytes(path.read_bytes()[:-3])
    (note,) = about_the_end(path)
    assert note.startswith("it ends inside its face elements, or its header declares 3 points")


def test_lists_of_the_vertices_or_before_them_hide_nothing_behind(tmp_path):
    head = (
        "ply\nformat binary_little_endian 1.0\nelement patch 2\nproperty list uchar uchar part\n"
        "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "property list uchar int views\nend_header\n"
    )
    body = bytes([1, 7, 2, 8, 9])
    body += struct.pack("<3fB2i", 1, 2, 3, 2, 0, 1) + struct.pack("<3fB", 4, 5, 6, 0)
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + body)
    assert read(path).frame.to_file(read(path).xyz).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert not about_the_end(path)
    path.write_bytes(head.encode() + body + body)
    assert len(about_the_end(path)) == 1


@pytest.mark.parametrize("kind", ["float int", "octet int", "uchar octet"])
def test_lists_of_types_that_cannot_be_followed_say_nothing(tmp_path, kind):
    path = mesh(tmp_path / "a.ply")
    path.write_bytes(path.read_bytes().replace(b"uchar int vertex", f"{kind} vertex".encode()))
    assert len(read(path)) == 3
    assert not about_the_end(path)


def test_a_list_of_negative_length_is_where_a_ply_ends(tmp_path):
    path = mesh(tmp_path / "a.ply", lengths=(200,), rows=2)
    path.write_bytes(path.read_bytes().replace(b"uchar int vertex", b"char int vertex"))
    (note,) = about_the_end(path)
    assert "ends inside its face elements" in note


def test_lines_that_a_text_ply_lacks_are_said(tmp_path):
    path = save(tmp_path / "a.ply", vertices(), text=True, faces=20)
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-5]))
    (note,) = about_the_end(path)
    assert note.startswith("it ends inside its other elements")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ply\nformat ascii 1.0\nelement vertex 1\n", "ends inside its header"),
        ("ply\nformat octal 1.0\nelement vertex 1\nproperty float x\nend_header\n", "octal"),
        ("ply\nformat ascii 1.0\nelement face 1\nend_header\n", "no vertices"),
        ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no points"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "without x"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty bad x\nend_header\n1\n",
            "unknown type",
        ),
        ("ply\nnonsense\nend_header\n", "no meaning"),
        ("solid of another kind\n", "not a PLY file"),
    ],
)
def test_damaged_ply_headers(tmp_path, text, words):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(FormatError, match=words) as caught:
        read(tmp_path / "a.ply")
    assert "\n" not in str(caught.value)


PCD = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", (4,)), ("intensity", "<f4"),
     ("rgb", "<f4"), ("ring", "<u2"), ("histogram", "<f4", (3,))]
)  # fmt: skip
PCD_HEAD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ intensity rgb ring histogram
SIZE 4 4 4 1 4 4 2 4
TYPE F F F U F F U F
COUNT 1 1 1 4 1 1 1 3
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA {encoding}
"""


def lzf_literals(data):
    """Return LZF that packs nothing: literal runs only."""
    parts = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


def pcd(path, encoding, count=200):
    rng = np.random.default_rng(1)
    array = np.zeros(count, dtype=PCD)
    for name in ("x", "y", "z", "intensity"):
        array[name] = rng.uniform(-100, 100, count)
    array["x"][5] = np.nan
    array["histogram"] = rng.uniform(0, 1, (count, 3))
    array["ring"] = np.arange(count) % 64
    colour = rng.integers(0, 2**24, count).astype("<u4")
    array["rgb"] = colour.view("<f4")
    head = PCD_HEAD.format(n=count, encoding=encoding).encode()
    if encoding == "binary":
        body = array.tobytes()
    elif encoding == "ascii":
        rows = []
        for point, packed in zip(array, colour, strict=True):
            numbers = [point["x"], point["y"], point["z"], *point["_"], point["intensity"]]
            rows.append(
                " ".join(f"{float(v):.9g}" for v in numbers)
                + f" {packed.view('<f4'):.9g} {point['ring']} "
                + " ".join(f"{float(v):.9g}" for v in point["histogram"])
            )
        body = "\n".join(rows).encode() + b"\n"
    else:
        columns = b"".join(np.ascontiguousarray(array[name]).tobytes() for name in PCD.names)
        packed = lzf_literals(columns)
        body = struct.pack("<II", len(packed), len(columns)) + packed
    path.write_bytes(head + body)
    return array, colour


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_pcd_encoding(tmp_path, encoding):
    array, colour = pcd(tmp_path / "a.pcd", encoding)
    cloud = read(tmp_path / "a.pcd")
    good = np.delete(np.arange(200), 5)
    assert len(cloud) == 199
    assert any("1 of 200 rows" in note for note in cloud.notes)
    for name in ("x", "y", "z", "intensity", "ring", "histogram"):
        assert np.array_equal(cloud.attribute(name), array[name][good]), name
    assert np.array_equal(cloud.attribute("red"), (colour >> 16)[good])
    assert np.array_equal(cloud.attribute("blue"), (colour & 255)[good])
    assert not any(name.startswith("_") for name in cloud.attributes)
    parts = list(iterate(tmp_path / "a.pcd", 64))
    assert np.array_equal(np.concatenate([p.xyz for p in parts]), cloud.xyz)
    write(cloud, tmp_path / "b.las")
    again = read(tmp_path / "b.las")
    assert np.array_equal(again.attribute("green"), ((colour >> 8) & 255)[good] * 257)
    assert np.array_equal(again.attribute("histogram_1"), array["histogram"][good, 1])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_truncated_pcd(tmp_path, encoding):
    path = tmp_path / "a.pcd"
    pcd(path, encoding)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(FormatError, match="header says 200 points, file"):
        read(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("TYPE F F F U F F U F", "TYPE F F"), "damaged PCD header"),
        (("FIELDS x y z", "FIELDS a b c"), "without x, y and z"),
        (("DATA binary", "DATA morse"), "morse"),
        (("POINTS 200", "POINTS 0"), "no points"),
        (("# .PCD v0.7", "v0.7"), "not a PCD file"),
    ],
)
def test_damaged_pcd_headers(tmp_path, change, words):
    path = tmp_path / "a.pcd"
    pcd(path, "binary")
    path.write_bytes(path.read_bytes().replace(change[0].encode(), change[1].encode(), 1))
    with pytest.raises(FormatError, match=words):
        read(path)


def test_lzf_against_the_slow_twin():
    """Copies that overlap themselves, long copies, far copies, literals."""
    packed = b"\x04hello" + bytes([(3 << 5) | 0, 4]) + bytes([(7 << 5), 200, 0]) + b"\x00!"
    packed += lzf_literals(bytes(range(256)) * 3) + bytes([(5 << 5) | 2, 30])
    expected = slow_unpack_lzf(packed)
    out = np.zeros(len(expected), np.uint8)
    assert unpack_lzf(np.frombuffer(packed, np.uint8), out) == len(expected)
    assert out.tobytes() == expected
    for bad in (packed[:-1], b"\x05hi", b"\x20\x09", b"\xe0", b"\x20"):
        room = np.zeros(len(expected), np.uint8)
        assert unpack_lzf(np.frombuffer(bad, np.uint8), room) == -1
    assert unpack_lzf(np.frombuffer(packed, np.uint8), out[:10]) == -1, "no room"


def test_colours_with_alpha_are_told_apart(tmp_path):
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgba\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        "WIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary\n"
    )
    rows = np.zeros(2, dtype=[*((axis, "<f4") for axis in "xyz"), ("rgba", "<u4")])
    rows["rgba"] = 0xFF010203, 0x80FF0000
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.tobytes())
    cloud = read(tmp_path / "a.pcd")
    colours = [cloud.attribute(name).tolist() for name in ("red", "green", "blue", "alpha")]
    assert colours == [[1, 255], [2, 0], [3, 0], [255, 128]]
    write(cloud, tmp_path / "a.laz")
    assert (read(tmp_path / "a.laz").attribute("red") // 257).tolist() == [1, 255]
