"""The project file: strict, with errors that name the file and the key; paths and patterns."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from dougong.cli import call
from dougong.cloud import Cloud
from dougong.errors import FormatError, InputError
from dougong.formats import FileInfo, describe, write
from dougong.pipeline.guess import Guess, find_clouds, guess_kind, guess_kind_of, project_text
from dougong.pipeline.outputs import write_text
from dougong.pipeline.project import (
    Entry,
    Project,
    all_files,
    files_of,
    from_files,
    read_project,
    refuse_own_result,
)
from e57_surveys import survey

DOCS = Path(__file__).parents[1] / "docs" / "commands.md"
GOOD = """
[[cloud]]
name = "scan"
kind = "lidar"
files = ["scan.laz"]
[[cloud]]
name = "drone"
kind = "photogrammetry"
files = ["drone.laz"]
"""
UNSCALED = GOOD.rstrip() + "\nscale_known = false\n"


@pytest.fixture
def project(tmp_path):
    def write(text):
        path = tmp_path / "project.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_the_documented_project_is_valid(project):
    text = re.search(r"```toml\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.S)[1]
    found = read_project(project(text))
    assert found.reference() == "drone"
    assert found.cloud[0].registered is False
    assert found.filter.lidar.octree_voxel_grid.voxel_m == 0.005
    assert found.registration.coarse == "auto"


def test_the_reference_is_the_first_photogrammetry_cloud_else_the_first_lidar(project):
    assert read_project(project(GOOD)).reference() == "drone"
    only_scans = from_files([Path("b.laz"), Path("a.laz")], [])
    assert only_scans.reference() == "b"
    assert from_files([Path("a.laz")], [Path("x.copc.laz")]).reference() == "x"


def test_a_cloud_without_a_unit_is_no_reference(project):
    assert read_project(project(UNSCALED)).reference() == "scan"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "'cloud' is missing"),
        ("[[cloud]]\nname='a'", r"'\[\[cloud\]\] number 1, kind' is missing"),
        (GOOD + "colour = 1", r"unknown name '\[\[cloud\]\] number 2, colour'"),
        (
            GOOD.replace("photogrammetry", "drone"),
            r"number 2, kind, got 'drone': .*'lidar' or 'photogrammetry'\.$",
        ),
        (GOOD.replace('"drone"', '"scan"'), "two clouds are called 'scan'"),
        ('[project]\nreference = "dron"' + GOOD, "names 'dron'.*did you mean 'drone'"),
        (GOOD + "[registr]\ncoarse='auto'", "'registr', did you mean 'register'"),
        (GOOD + "[register]\ndof=3", r"register\.dof"),
        (GOOD + "hue = 1\n[register]\ndof=3", r"Also wrong: register\.dof\.$"),
        (GOOD + "[filter.lidar.octree_voxel_grid]\nvoxel=1", "did you mean 'voxel_m'"),
        (GOOD + "[register]\ndof=7", "every cloud's scale is known"),
        (GOOD.replace("kind", "scale_known = false\nkind"), "every cloud has scale_known = false"),
        (UNSCALED.replace("[[cloud]]", '[project]\nreference="drone"\n[[cloud]]', 1), "no unit"),
        (UNSCALED + 'crs = "EPSG:32650"', "and a crs"),
        (UNSCALED + "registered = false", "registered = false: one scale"),
        (GOOD + "[[", "no valid TOML"),
        (GOOD + 'crs = "UTM 50N?"', r"number 2, crs: 'UTM 50N\?' is no .*an EPSG code such as"),
    ],
)
def test_a_wrong_project_names_file_key_value_and_what_was_expected(project, text, said):
    path = project(text)
    with pytest.raises(InputError, match=said) as caught:
        read_project(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_project_that_an_editor_saved_with_its_mark_is_read(tmp_path):
    (tmp_path / "p.toml").write_text(GOOD, encoding="utf-8-sig")
    assert read_project(tmp_path / "p.toml").reference() == "drone"


def test_a_missing_project_says_how_to_get_one(tmp_path):
    with pytest.raises(InputError, match="dougong init"):
        read_project(tmp_path / "project.toml")
    with pytest.raises(InputError, match="is a folder"):
        read_project(tmp_path)


def test_patterns_are_relative_sorted_and_name_each_file_once(tmp_path):
    (tmp_path / "scans").mkdir()
    for name in ("b.laz", "a.laz", "c.txt"):
        (tmp_path / "scans" / name).touch()
    entry = Entry(name="s", kind="lidar", files=("scans/b.laz", "scans/*.laz"))
    assert [path.name for path in files_of(entry, tmp_path)] == ["b.laz", "a.laz"]
    absolute = Entry(name="s", kind="lidar", files=(str(tmp_path / "scans" / "*.laz"),))
    assert [path.name for path in files_of(absolute, Path("/"))] == ["a.laz", "b.laz"]
    with pytest.raises(InputError, match=r"cloud 's': no file matches 'scan/\*.laz'"):
        files_of(Entry(name="s", kind="lidar", files=("scan/*.laz",)), tmp_path)


@pytest.mark.parametrize("text", ["", "s**.laz"])
def test_what_is_no_pattern_is_a_wrong_project(tmp_path, text):
    with pytest.raises(InputError, match="cloud 's': "):
        files_of(Entry(name="s", kind="lidar", files=(text,)), tmp_path)


def test_a_link_to_a_file_without_a_suffix_is_a_cloud(tmp_path):
    """Caches of data versions keep files under their hash."""
    (tmp_path / "1f3a").write_bytes(b"LASF")
    (tmp_path / "scan.laz").symlink_to("1f3a")
    (found,) = all_files(from_files([tmp_path / "scan.laz"], []), Path())
    assert found == tmp_path / "scan.laz"


def test_one_file_under_two_names_is_refused(tmp_path):
    (tmp_path / "a.laz").write_bytes(b"LASF")
    (tmp_path / "b.laz").symlink_to("a.laz")
    twice = [{"name": n, "kind": "lidar", "files": [f"{n}.laz"]} for n in "ab"]
    pattern = [{"name": "a", "kind": "lidar", "files": ["*.laz"]}]
    for entries in (twice, pattern):
        with pytest.raises(InputError, match=r"a.laz and .*b.laz are one file, named twice"):
            all_files(Project.model_validate({"cloud": entries}), tmp_path)


def test_what_is_no_cloud_is_said_before_any_work(tmp_path):
    (tmp_path / "a.laz").write_bytes(b"LASF")
    (tmp_path / "site.jpg").write_bytes(b"no cloud")
    (tmp_path / "scans").mkdir()
    clouds = [{"name": n, "kind": "lidar", "files": [n]} for n in ("a.laz", "site.jpg")]
    with pytest.raises(FormatError, match=r"site.jpg has the suffix '.jpg'"):
        all_files(Project.model_validate({"cloud": clouds}), tmp_path)
    for text in ("scans", str(tmp_path / "scans")):
        with pytest.raises(InputError, match=r"scans is a folder. Name the files in it, or .*\*"):
            files_of(Entry(name="s", kind="lidar", files=(text,)), tmp_path)
    with pytest.raises(InputError, match=r"point cloud by its name.* --lidar a.laz or --photo"):
        read_project(tmp_path / "a.laz")


def test_an_earlier_result_is_no_input_of_the_next(tmp_path):
    files = [tmp_path / "a.laz", tmp_path / "out" / "clouds" / "a.laz"]
    refuse_own_result(files[:1], tmp_path / "out")
    refuse_own_result([tmp_path / "out" / "scene" / "a.laz"], tmp_path / "out")
    refuse_own_result(files, tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"clouds/a.laz is part of the result in .*another --out"):
        refuse_own_result(files, tmp_path / "out")


def test_a_result_named_as_an_input_is_no_accident(tmp_path, capsys):
    scan = tmp_path / "scan.laz"
    write(Cloud.from_points(np.eye(3)), scan)
    before = scan.read_bytes()
    assert call(["run", "--lidar", str(scan), "--out", str(scan), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "scan.laz is a file, and the result is a folder. Choose another --out." in said
    assert scan.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["scan.laz"]


def test_a_file_that_is_left_out_is_named_once(tmp_path):
    write(Cloud.from_points(np.eye(3)), tmp_path / "scan.laz")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "cut.ply").write_bytes(b"ply\n")
    assert find_clouds(tmp_path)[1] == [
        "old/cut.ply: the file ends inside its header. Copy it again."
    ]


def test_a_file_name_with_brackets_is_found_as_it_is(tmp_path):
    (tmp_path / "hall [1].laz").touch()
    entry = Entry(name="s", kind="lidar", files=("hall [1].laz",))
    assert files_of(entry, tmp_path) == [tmp_path / "hall [1].laz"]


def test_two_clouds_of_one_stem_are_refused():
    with pytest.raises(InputError, match=r"a.laz and b/a.e57 would both be the cloud 'a'.*Rename"):
        from_files([Path("a.laz"), Path("b/a.e57")], [])
    for other in ("a.laz", "b/../a.laz", str(Path("c.laz").resolve().with_name("a.laz"))):
        with pytest.raises(InputError, match=r"a.laz (is|are) one file, named twice"):
            from_files([Path("a.laz")], [Path(other)])
    with pytest.raises(InputError, match="no cloud is named"):
        from_files([], [])


@pytest.mark.parametrize("name", ["x-1", "x-03"])
def test_a_cloud_called_as_a_station_of_another_is_refused_before_the_work(name, tmp_path):
    survey(tmp_path / "x.e57", scans=3, rows=4, columns=4)
    write(Cloud.from_points(np.eye(3)), tmp_path / "y.laz")
    stations = Entry(name="x", kind="lidar", files=("x.e57",), registered=False)
    other = Entry(name=name, kind="lidar", files=("y.laz",))
    with pytest.raises(InputError, match=rf"cloud '{name}' is called as station .* of cloud 'x'"):
        all_files(Project(cloud=(stations, other)), tmp_path)
    for entries in (
        (stations.model_copy(update={"registered": True}), other),
        (stations, other.model_copy(update={"name": "x-4"})),
        (stations, other.model_copy(update={"name": "x-one"})),
    ):
        assert len(all_files(Project(cloud=entries), tmp_path)) == 2


def info(format_name="LAZ", attributes=(), low=(0.0, 0.0, 0.0), crs=None, stations=1):
    return FileInfo(
        path=Path("a"), format=format_name, version="", points=10, bytes=1, is_compressed=False,
        stations=stations, extent_min=low, extent_max=low, crs_wkt=crs,
        attributes=dict.fromkeys(attributes, "uint16"),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "kind"),
    [
        (info("E57", ("red", "green", "blue", "intensity")), "lidar"),
        (info(attributes=("red", "green", "blue"), low=(5e5, 4e6, 0)), "photogrammetry"),
        (info(attributes=("Red", "Green", "Blue", "intensity"), crs="PROJCS"), "photogrammetry"),
        (info(attributes=("intensity",), low=(5e5, 4e6, 0)), "lidar"),
        (info("PLY", ("red", "green", "blue")), "photogrammetry"),
        (info(attributes=("red", "green", "blue", "intensity")), "lidar"),
    ],
)
def test_sensors_are_guessed_from_what_files_hold(found, kind):
    guessed, why = guess_kind(found)
    assert guessed == kind
    assert why


@pytest.mark.parametrize("name", ["a.laz", "a.ply", "a.pts"])
@pytest.mark.parametrize(("last", "kind"), [(0, "photogrammetry"), (7, "lidar")])
def test_one_intensity_throughout_is_no_sign_of_a_scanner(name, last, kind, tmp_path):
    path, points = tmp_path / name, np.random.default_rng(0).uniform(0, 9, (300, 3))
    values = np.zeros(300, dtype="u2")
    values[-1] = last
    if name.endswith(".pts"):
        rows = (f"{x} {y} {z} {i} 9 8 7" for (x, y, z), i in zip(points, values, strict=True))
        path.write_text("300\n" + "\n".join(rows) + "\n")
    else:
        colours = dict.fromkeys(("red", "green", "blue"), np.full(300, 9, dtype="u2"))
        write(Cloud.from_points(points, intensity=values, **colours), path)
    guessed, why = guess_kind_of(path, describe(path))
    assert guessed == kind
    assert ("one intensity throughout" in why) == (last == 0)


def test_earlier_results_and_hidden_files_are_no_clouds_of_a_survey(tmp_path):
    for place in ("", "out/clouds/", ".out.part-1/clouds/", "pose/"):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        write(Cloud.from_points(np.eye(3)), tmp_path / place / "scan.laz")
    for file in ("out/result.json", "pose/registration.json", "pose/report.html"):
        (tmp_path / file).touch()
    guesses, skipped = find_clouds(tmp_path)
    assert [guess.file for guess in guesses] == [Path("scan.laz")]
    assert skipped == ["out: a result of dougong", "pose: a result of dougong"]


@pytest.mark.skipif(os.name != "posix", reason="names of other bytes than UTF-8 are POSIX's own")
def test_a_name_that_is_no_text_is_left_out_and_said(tmp_path):
    write(Cloud.from_points(np.eye(3)), tmp_path / "scan.laz")
    old = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.laz"))
    old.write_bytes((tmp_path / "scan.laz").read_bytes())
    guesses, skipped = find_clouds(tmp_path)
    assert [guess.file for guess in guesses] == [Path("scan.laz")]
    assert skipped == ["caf\udce9.laz: its name is no UTF-8 text. Rename it"]
    with pytest.raises(InputError, match=r"is no UTF-8 text\. Rename it"):
        from_files([old], [])
    write_text(tmp_path / "project.toml", project_text("site", guesses, skipped))
    assert len(read_project(tmp_path / "project.toml").cloud) == 1


NAMES = ['an "odd" name', "祈年殿", "two\nlines\x7f"]


def test_the_written_project_reads_back_whatever_the_names(project):
    guesses = [
        Guess(
            name=name, file=Path(name + ".laz"), kind="lidar", why="no colour", stations=3, points=5
        )
        for name in NAMES
    ]
    found = read_project(project(project_text('A "site"', guesses, ["b\n.laz: it is empty"])))
    assert [entry.name for entry in found.cloud] == NAMES
    assert found.cloud[0].files == ('an "odd" name.laz',)
    assert found.project.name == 'A "site"'
