"""Text: every common layout, odd lines counted, exact numbers."""

import weakref

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong.errors import FormatError
from dougong.formats import check, describe, iterate, read, text_rows


def save(tmp_path, text, name="a.xyz"):
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def coordinates(cloud):
    return cloud.frame.to_file(cloud.xyz)


ROWS = [[1.5, 2.25, 3.125], [-4.0, 5.5, 6.75], [7.0, 8.0, 9.0]]
LAYOUTS = {
    "blanks": "1.5 2.25 3.125\n-4 5.5 6.75\n7 8 9\n",
    "no last newline": "1.5 2.25 3.125\n-4 5.5 6.75\n7 8 9",
    "ragged blanks": "   1.5    2.25 3.125  \n  -4 5.5      6.75\n7 8 9   \n",
    "tabs": "1.5\t2.25\t3.125\n-4\t5.5\t6.75\n7\t8\t9\n",
    "windows lines": "1.5 2.25 3.125\r\n-4 5.5 6.75\r\n7 8 9\r\n",
    "commas": "1.5,2.25,3.125\n-4,5.5,6.75\n7,8,9\n",
    "commas and blanks": "1.5, 2.25, 3.125\n-4, 5.5, 6.75\n7, 8, 9\n",
    "semicolons": "1.5;2.25;3.125\n-4;5.5;6.75\n7;8;9\n",
    "decimal commas": "1,5;2,25;3,125\n-4;5,5;6,75\n7;8;9\n",
    "trailing delimiter": "1.5,2.25,3.125,\n-4,5.5,6.75,\n7,8,9,\n",
    "comments": "# by hand\n// twice\n1.5 2.25 3.125\n# between\n-4 5.5 6.75\n7 8 9\n",
    "blank lines": "\n\n1.5 2.25 3.125\n\n-4 5.5 6.75\n7 8 9\n\n",
    "byte order mark": "\ufeff1.5 2.25 3.125\n-4 5.5 6.75\n7 8 9\n",
    "trailing with a header": "x,y,z,\n1.5,2.25,3.125,\n-4,5.5,6.75,\n7,8,9,\n",
    "header": "X,Y,Z\n1.5,2.25,3.125\n-4,5.5,6.75\n7,8,9\n",
    "commented header": "//X Y Z\n1.5 2.25 3.125\n-4 5.5 6.75\n7 8 9\n",
    "quoted header": '"x","y","z"\n1.5,2.25,3.125\n-4,5.5,6.75\n7,8,9\n',
    "exponents": "1.5e0 2.25E+0 31.25e-1\n-4 5.5 6.75\n7 8 9\n",
    "count line": "3\n1.5 2.25 3.125\n-4 5.5 6.75\n7 8 9\n",
    "blanks and tabs": "1.5\t2.25  3.125\n-4 5.5\t6.75\n7\t8\t9\n",
    "two lines before": "Project: hall\nx,y,z\n1.5,2.25,3.125\n-4,5.5,6.75\n7,8,9\n",
    "units in the header": "x (m);y (m);z (m)\n1.5;2.25;3.125\n-4;5.5;6.75\n7;8;9\n",
    "old line ends": "1.5 2.25 3.125\r-4 5.5 6.75\r7 8 9\r",
    "two blocks": "2\n1.5 2.25 3.125\n-4 5.5 6.75\n1\n7 8 9\n",
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv", ".pts", ".asc"])
def test_layouts(tmp_path, layout, suffix):
    cloud = read(save(tmp_path, LAYOUTS[layout], f"a{suffix}"))
    assert coordinates(cloud).tolist() == ROWS
    assert cloud.attributes == ("x", "y", "z")


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("x,y,z", "xyz"),
        ("Easting;Northing;Elevation", "xyz"),
        ("z,x,y", "zxy"),
        ("id,X,Y,Z,extra", "_xyz_"),
        ("X[m] Y[m] Z[m]", "xyz"),
    ],
)
def test_headers_name_the_columns(tmp_path, header, order):
    delimiter = ";" if ";" in header else "," if "," in header else " "
    rows = [delimiter.join(str({"x": 1, "y": 2, "z": 3, "_": 9}[c]) for c in order)] * 2
    cloud = read(save(tmp_path, "\n".join([header, *rows, ""])))
    assert coordinates(cloud).tolist() == [[1, 2, 3]] * 2


@pytest.mark.parametrize(
    ("header", "names", "said"),
    [
        ("height,x,y,z", ("height", "x", "y", "z"), None),
        ("Easting,Northing,x,y,z", ("Easting", "Northing", "x", "y", "z"), None),
        ("i,Intensity,X[m],Y[m],Z[m]", ("i", "intensity", "x", "y", "z"), None),
        (
            "East,North,h,alt,R",
            ("x", "y", "z", "alt", "red"),
            "columns were taken: East as x, North as y, h as z, R as red.",
        ),
        ("x,y,z,x,X_2", ("x", "y", "z", "x_2", "X_2"), None),
    ],
)
def test_a_name_counts_before_its_synonyms_and_synonyms_are_said(tmp_path, header, names, said):
    row = ",".join(map(str, range(1, len(names) + 1)))
    cloud = read(save(tmp_path, f"{header}\n{row}\n{row}\n"))
    assert cloud.records.dtype.names == names
    assert coordinates(cloud)[0].tolist() == [1.0 + names.index(axis) for axis in "xyz"]
    assert [note for note in cloud.notes if "taken" in note] == ([said] if said else [])


@pytest.mark.parametrize(
    ("rows", "names"),
    [
        (["1 2 3 0.5", "4 5 6 0.7"], ["intensity"]),
        (["1 2 3 255 0 7", "4 5 6 1 2 3"], ["red", "green", "blue"]),
        (["1 2 3 -1200 255 0 7", "4 5 6 2000 1 2 3"], ["intensity", "red", "green", "blue"]),
        (["1 2 3 255 0 7 0.5", "4 5 6 1 2 3 0.25"], ["red", "green", "blue", "intensity"]),
        (["1 2 3 0.6 0.8 0", "4 5 6 0 0 -1"], ["nx", "ny", "nz"]),
        (["1 2 3 9 8 7 0 0.6 0.8"] * 2, ["red", "green", "blue", "nx", "ny", "nz"]),
        (["1 2 3 0.1 900.5", "4 5 6 0.2 -7.5"], ["field_4", "intensity"]),
    ],
)
def test_meaning_of_columns_without_a_header_is_guessed_and_said(tmp_path, rows, names):
    cloud = read(save(tmp_path, "\n".join(rows)))
    assert list(cloud.attributes) == ["x", "y", "z", *names]
    assert cloud.notes[0].startswith("no header line: columns were taken as x y z")
    expected = np.array([row.split() for row in rows], dtype=float)
    for index, name in enumerate(cloud.attributes):
        assert cloud.attribute(name).tolist() == expected[:, index].tolist()


@pytest.mark.parametrize(
    ("rows", "is_said"),
    [
        ([f"{k} {k % 7}.5 {k % 5} 1.25" for k in range(1, 40)], True),
        ([f"{k} {k % 7}.5 {k % 5}" for k in range(1, 40)], False),  # a z is needed
        ([f"{k} 12.5 {k % 5} 1.25" for k in range(1, 40)], False),  # a line of a grid
        ([f"{k % 30} {k % 7}.5 {k % 5} 1.25" for k in range(1, 40)], False),
        ([f"{k} {k % 7}.5 {k % 5} 1.25" for k in range(1, 4)], False),
    ],
)
def test_a_first_column_that_numbers_the_points_is_said(tmp_path, rows, is_said):
    path = save(tmp_path, "\n".join(rows))
    notes = [note for note in read(path).notes if "wrongly read as x" in note]
    assert bool(notes) == is_said
    found = [f for f in check(path) if "goes up by one from row to row (1, 2, ...)" in f.text]
    assert [f.severity for f in found] == ["warning"] * is_said


@pytest.mark.parametrize("first", ["", "2\n"])
def test_the_fourth_of_seven_pts_columns_is_the_intensity(tmp_path, first):
    """Even where its values could be a colour's."""
    path = save(tmp_path, f"{first}1 2 3 100 10 20 30\n4 5 6 90 11 21 31\n", "a.pts")
    cloud = read(path)
    assert list(cloud.attributes) == ["x", "y", "z", "intensity", "red", "green", "blue"]
    assert cloud.attribute("intensity").tolist() == [100, 90]


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ((30,), ""),
        ((20, 10), ""),
        ((25,), "its count line says 25 points, wrongly: 30 rows follow, and all are read."),
        ((20, 5), "its count lines say 25 points, wrongly: 30 rows follow, and all are read."),
    ],
)
def test_more_rows_than_a_pts_file_counts_are_said(tmp_path, counts, said):
    rows = [f"{k} {k % 7} {k % 3} 5" for k in range(30)]
    for count in counts[1:]:
        rows.insert(20, str(count))
    path = save(tmp_path, "\n".join([str(counts[0]), *rows]) + "\n", "a.pts")
    for cloud in (read(path), *iterate(path)):
        assert len(cloud) == 30
        assert ([note for note in cloud.notes if "wrongly" in note] or [""]) == [said]
    found = [one.severity for one in check(path) if "wrongly" in one.text]
    assert found == (["warning"] if said else [])


@pytest.mark.parametrize(
    ("lines", "names"),
    [
        (["id,easting,northing,height,name"], ["id", "x", "y", "z"]),
        ([], ["x", "y", "z", "intensity"]),
    ],
)
def test_columns_of_words_are_passed_over_and_said(tmp_path, lines, names):
    rows = [f"{i},{i * 0.5},{i % 7},0.25,P{i} corner" for i in range(200)]
    cloud = read(save(tmp_path, "\n".join([*lines, *rows]), "a.csv"))
    assert list(cloud.attributes) == names
    assert len(cloud) == 200
    assert any("columns of words were not read" in note for note in cloud.notes)
    assert coordinates(cloud)[3].tolist() == ([1.5, 3, 0.25] if names[0] == "id" else [3, 1.5, 3])


def test_words_before_the_numbers(tmp_path):
    """Point, easting, northing, height, description: how surveyors list points."""
    rows = [f"P{i},{i}.5,2,3,corner {i}" for i in range(50)]
    cloud = read(save(tmp_path, "\n".join(rows), "points.csv"))
    assert coordinates(cloud)[4].tolist() == [4.5, 2, 3]
    assert cloud.attributes == ("x", "y", "z")


def test_most_rows_decide_how_many_columns_there_are(tmp_path):
    rows = [f"{i} 2 3" + " 7" * (i % 50 == 0) for i in range(1000)]
    cloud = read(save(tmp_path, "\n".join(rows)))
    assert len(cloud) == 980
    assert any("20 of 1000 rows" in note for note in cloud.notes)


def test_a_dropped_row_leaves_the_types_of_the_columns(tmp_path):
    rows = [f"{i} 2 3 {i % 256} 0 255" for i in range(300)]
    rows[7] = "spoilt"
    assert read(save(tmp_path, "\n".join(rows))).attribute("red").dtype == np.uint8


def test_pyarrow_has_let_go_of_all_it_was_handed(monkeypatch):
    """What its threads still hold when Python ends aborts the process (exit code 134)."""
    alive = weakref.WeakSet()

    class Counted(text_rows._WrongLengths):
        def __init__(self):
            super().__init__()
            alive.add(self)

    monkeypatch.setattr(text_rows, "_WrongLengths", Counted)
    data = b"1 2 3\n4 5 6\n7 8\n" * 2000
    for _ in range(50):
        assert len(text_rows.table_of(data, text_rows.RowFormat(3))) == 6000
        assert not alive


def test_whole_numbers_become_integers_large_enough_for_all_rows(tmp_path):
    """The guess is from the first lines; the type from all: row 5000 needs 16 bits."""
    rows = [f"{i} 0 0 10 20 30" for i in range(6000)]
    rows[5000] = "5000 0 0 999 20 30"
    cloud = read(save(tmp_path, "\n".join(rows)))
    assert cloud.attribute("red").dtype == np.uint16
    assert cloud.attribute("red")[5000] == 999
    assert cloud.attribute("green").dtype == np.uint8
    assert cloud.attribute("x").dtype == np.float64


BAD_ROWS = ["4 5 nan", "4 five 6", "4 5", "4 5 6 7", "inf 5 6", "NULL NULL NULL", "- - -"]


@pytest.mark.parametrize("bad", BAD_ROWS)
@pytest.mark.parametrize("at", [1, 700, 1999])
def test_rows_that_cannot_be_read_are_dropped_and_counted(tmp_path, bad, at):
    rows = [f"{i} {i % 7} 0.5" for i in range(2000)]
    rows[at] = bad
    path = save(tmp_path, "\n".join(rows) + "\n")
    cloud = read(path)
    assert len(cloud) == 1999
    lacking = "no finite coordinates or another number of columns"
    assert f"1 of 2000 rows had {lacking} and were dropped." in cloud.notes
    kept = [i for i in range(2000) if i != at]
    assert sorted(cloud.attribute("x").tolist()) == kept
    assert describe(path).points == 2000
    assert any("1 of 2000" in finding.text for finding in check(path))
    assert sum(len(part) for part in iterate(path, 300)) == 1999


@pytest.mark.parametrize("chunk", [1, 100, 999, 5000])
def test_chunks_are_the_whole(tmp_path, chunk):
    rng = np.random.default_rng(0)
    count = 50 if chunk == 1 else 3000
    points = np.round(rng.uniform(-1e4, 1e6, (count, 3)), 3)
    path = save(
        tmp_path, "\n".join(f"{x:.3f} {y:.3f} {z:.3f} {i}" for i, (x, y, z) in enumerate(points))
    )
    whole = read(path)
    parts = list(iterate(path, chunk))
    assert max(map(len, parts)) <= chunk
    assert np.array_equal(np.concatenate([part.xyz for part in parts]), whole.xyz)
    assert b"".join(part.records.tobytes() for part in parts) == whole.records.tobytes()
    assert (
        np.array_equal(coordinates(whole), points)
        or np.abs(coordinates(whole) - points).max() < 2e-10
    )


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(*[st.floats(-1e7, 1e7, allow_nan=False, width=64)] * 3), min_size=1, max_size=40
    ),
    st.sampled_from([" ", ",", ";", "\t"]),
)
def test_any_numbers_come_back_exactly(tmp_path_factory, rows, delimiter):
    path = tmp_path_factory.mktemp("t") / "a.csv"
    path.write_text("".join(delimiter.join(map(repr, row)) + "\n" for row in rows))
    cloud = read(path)
    found = np.stack([cloud.attribute(axis) for axis in "xyz"], axis=1)
    assert found.tolist() == [list(row) for row in rows]
    size = max(1.0, float(np.abs(found).max()))
    assert np.abs(coordinates(cloud) - found).max() <= 8 * np.spacing(size)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(-(10**8), 10**8)] * 3), min_size=2, max_size=30),
    st.integers(0, 4),
    st.tuples(*[st.integers(-(10**6), 10**7)] * 3),
)
def test_a_shift_by_decimals_leaves_no_trace(tmp_path_factory, rows, decimals, shift):
    """The same decimals elsewhere on the map give the same local metres, bit for bit."""
    folder = tmp_path_factory.mktemp("t")
    scale = 10**decimals
    clouds = []
    for name, offset in (("near", (0, 0, 0)), ("far", shift)):
        lines = []
        for row in rows:
            whole = [v + o * scale for v, o in zip(row, offset, strict=True)]
            lines.append(" ".join(_decimal(v, decimals) for v in whole))
        path = folder / f"{name}.xyz"
        path.write_text("\n".join(lines))
        clouds.append(read(path))
    assert np.array_equal(clouds[0].xyz, clouds[1].xyz)


def _decimal(whole, decimals):
    digits = f"{abs(whole):0{decimals + 1}d}"
    text = f"{digits[: len(digits) - decimals]}.{digits[len(digits) - decimals :]}0"
    return f"-{text}" if whole < 0 else text


def test_local_coordinates_do_not_depend_on_the_order_of_points(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(5e5, 10, (500, 3))
    order = rng.permutation(500)
    clouds = []
    for name, rows in (("a.xyz", points), ("b.xyz", points[order])):
        clouds.append(
            read(save(tmp_path, "\n".join(" ".join(map(repr, map(float, r))) for r in rows), name))
        )
    assert np.array_equal(clouds[0].xyz[order], clouds[1].xyz)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "is empty"),
        (b"\n\n\n", "no rows of at least three numbers"),
        (b"# only words\n# here\n", "no rows of at least three numbers"),
        (b"1 2\n3 4\n", "no rows of at least three numbers"),
        (b"name,colour\nwall,red\nroof,blue\n", "no rows of at least three numbers"),
        (b"a,b,c\n1,2,3\n", "x, y and z were expected"),
        (b"nan nan nan\nnan nan nan\n", "none of its 2 points"),
        (b"1.5 " * 50_000, "no rows of at least three numbers; it starts with '1.5 1.5"),
        (b"1 2 3\0\0\0", "not text"),
        ("1 2 3\n".encode("utf-16"), "UTF-16.*Save it as UTF-8"),
        (
            b"x;y;z\n1.000,50;1.200,10;3.000,00\n",
            "after one line comes '1.000,50;1.200,10;3.000,00'",
        ),
        (b"5\n1 2 3\n4 5 6\n", "count line says 5 points, file ends after 2"),
        (b"1\n1 2 3\n2\n4 5 6\n", "count lines say 3 points, file ends after 2"),
    ],
)
def test_what_cannot_be_read_gives_one_sentence(tmp_path, text, words):
    path = save(tmp_path, text)
    with pytest.raises(FormatError, match=words) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert [finding.severity for finding in check(path)] == ["error"]


@pytest.mark.data
def test_real_scans(data):
    cloud = read(data / "lion_scans" / "lionscan1.xyz")
    expected = np.loadtxt(data / "lion_scans" / "lionscan1.xyz")
    assert np.abs(coordinates(cloud) - expected).max() < 1e-12
    assert cloud.frame.step == (0.001, 0.001, 0.001)


def test_bytes_that_are_not_utf8_make_no_noise(tmp_path, capfd):
    rows = [f"{i} 2 3".encode() for i in range(200)]
    rows[50:50] = [b"# Geb\xe4ude", b"\xff\xfe\xfa"]
    cloud = read(save(tmp_path, b"\n".join(rows)))
    assert len(cloud) == 200
    assert "1 of 201 rows" in cloud.notes[0]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("count", [60, 6000])
@pytest.mark.parametrize(
    ("cut", "is_said"),
    [(0, False), (1, False), (2, True), (4, True), (6, True), (11, False)],  # 11: another row
)
def test_a_file_that_ends_within_its_last_number_is_said(tmp_path, count, cut, is_said):
    points = np.random.default_rng(0).uniform(10, 99, (count, 3))
    text = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in points)
    cloud = read(save(tmp_path, text[: len(text) - cut]))
    assert any("may be cut within its last number" in note for note in cloud.notes) == is_said
    uneven = "".join(f"{x:.4f} {y:.4f} {round(z, 4)}\n" for x, y, z in points)
    notes = read(save(tmp_path, uneven[:-3], "b.xyz")).notes
    assert not any("may be cut" in note for note in notes)
