"""The command line: what is loaded, what is printed where, exit codes, options, docs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import dougong
from dougong.cli import call
from dougong.cli._common import Common
from dougong.cli._signals import Terminated
from dougong.cli._text import origin, table
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.pipeline import moving
from dougong.pipeline.provenance import sha256

ROOT = Path(__file__).parents[1]
COMMANDS = [
    "demo", "run", "plan", "init", "info", "check", "filter", "register", "transform",
    "report", "view", "evaluate", "bench",
]  # fmt: skip


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def room(tmp_path):
    """A floor with a wall, as a LAZ file."""
    rng = np.random.default_rng(0)
    floor = rng.uniform([0, 0, 0], [12, 9, 0.01], (6000, 3))
    wall = rng.uniform([2, 3, 0], [8, 3.02, 4], (6000, 3))
    cloud = Cloud.from_points(np.vstack([floor, wall]) + [500_000, 4_000_000, 30])
    path = tmp_path / "room.laz"
    dougong.write(cloud, path)
    return path


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import dougong", {"numba", "scipy", "laspy", "numpy", "pydantic"}),
        ("from dougong.cli import call; call(['--help'])", {"numba", "scipy", "laspy", "pydantic"}),
        ("from dougong.cli import call; call(['run', '--help'])", {"numba", "scipy", "laspy"}),
    ],
)
def test_importing_and_helping_load_nothing_heavy(code, heavy):
    result = python("-c", f"{code}\nimport sys; print(sorted(sys.modules))")
    loaded = set(re.findall(r"'([^'.]+)'", result.stdout.splitlines()[-1]))
    assert result.returncode == 0
    assert not heavy & loaded


def test_public_names_load_when_asked_for():
    for name in dougong.__all__:
        assert getattr(dougong, name) is not None
    assert set(dougong.__all__) <= set(dir(dougong))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = dougong.nothing


def test_python_m_is_the_command():
    result = python("-m", "dougong", "--version")
    assert (result.returncode, result.stdout.strip()) == (0, dougong.__version__)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_helps_with_an_example(command, capsys):
    assert call([command, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"Example: dougong {command}" in said
    assert "--json" in said


@pytest.mark.parametrize(
    ("tokens", "said"),
    [
        (["filtr"], "Did you mean"),
        (["info", "a.laz", "--thread", "3"], "Did you mean --threads"),
        (["demo", "--scene", "castle"], '"hall", "pagoda"'),
        (["run", "--lidar", "a.laz"], "--out"),
        (["info"], "no file is named"),
        (["info", "a.laz", "--engine", "spark"], "--engine knows local, dask and dask://HOST:PORT"),
        (["info", "a.laz", "--memory", "lots"], "--memory needs a size"),
        (["info", "a.laz", "--threads", "0"], "--threads must be 1 or more"),
        (["register", "a", "b", "--out", "c", "--dof", "8"], "--dof"),
        (
            ["--quiet", "transform", "a", "b", "c", "d", "--matrix", "m"],
            "'c' and 1 more: more than",
        ),
        (["register", "a", "b", "--out", "c", "--least-overlap", "15"], "--least-overlap"),
    ],
)
def test_usage_errors_are_one_line_and_exit_2(tokens, said, capsys):
    assert call(tokens) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    assert said in err


@pytest.mark.parametrize(
    ("tokens", "kind", "code"),
    [
        (["info", "missing.laz", "--json"], "FormatError", 1),
        (["info", "--json"], "InputError", 2),
        (["nonsense", "--json"], "InputError", 2),
        (["report", ".", "--json"], "InputError", 2),
    ],
)
def test_json_errors_are_one_document(tokens, kind, code, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call(tokens) == code
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {"error"}
    assert set(document["error"]) == {"type", "message", "exit_code"}
    assert (document["error"]["type"], document["error"]["exit_code"]) == (kind, code)


@pytest.mark.parametrize(
    ("text", "size"),
    [("4GB", 4 * 10**9), ("800 MB", 8 * 10**8), ("1.5GiB", 3 * 2**29), ("2g", 2 * 10**9)],
)
def test_memory_is_read_with_its_unit(text, size):
    assert Common(memory=text).memory_bytes() == size


@pytest.mark.parametrize("text", ["", "GB", "-1GB", "0GB", "4 apples", "4"])
def test_memory_that_is_no_size_is_refused(text):
    with pytest.raises(InputError, match="--memory needs a size"):
        Common(memory=text).memory_bytes()


def test_info_and_check_tell_about_a_file(room, capsys):
    assert call(["info", str(room), "--json", "--quiet"]) == 0
    file = json.loads(capsys.readouterr().out)["files"][0]
    assert file["points"] == 12_000
    assert call(["info", str(room), "--quiet"]) == 0
    assert "12,000" in capsys.readouterr().out
    assert call(["check", str(room), "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)["files"][0]["findings"]
    assert any("coordinate" in finding["text"] for finding in findings)


def test_info_tells_what_a_person_reads(room, capsys):
    assert call(["info", str(room), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"crs +none; the numbers are taken as metres", said)
    assert re.search(r"low corner +50000\d\S*  \S+  30", said)
    assert "<" not in said, "types of attributes are for --json"


def test_info_goes_on_after_an_unreadable_file_and_exits_1(room, capsys):
    gone = room.with_name("gone.laz")
    assert call(["info", str(gone), str(room), "--quiet"]) == 1
    said = capsys.readouterr().out
    assert "does not exist" in said
    assert "12,000" in said
    assert call(["info", str(gone), str(room), "--json"]) == 1
    files = json.loads(capsys.readouterr().out)["files"]
    assert (files[0]["path"], files[0]["error"]["type"]) == (str(gone), "FormatError")
    assert files[1]["points"] == 12_000


@pytest.mark.parametrize(
    ("crs", "said"),
    [("EPSG:4326", r"UTM zone 50N \(EPSG:32650\)"), ("EPSG:4978", "earth-centred")],
)
def test_degrees_and_earth_centred_clouds_are_refused_with_advice(crs, said, tmp_path, capsys):
    points = np.random.default_rng(0).uniform([116, 39, 0], [116.01, 39.01, 50], (500, 3))
    path, good = tmp_path / "bad.laz", tmp_path / "good.laz"
    dougong.write(Cloud.from_points(points, crs=crs), path)
    dougong.write(Cloud.from_points(points), good)
    out = tmp_path / "out"
    for tokens in (
        ["filter", path, tmp_path / "out.laz", "--kind", "lidar"],
        ["filter", path, tmp_path / "out.laz", "--only", "statistical"],
        ["register", path, good, "--out", out],
        ["register", good, path, "--out", out],
        ["run", "--lidar", path, "--photogrammetry", good, "--out", out],
    ):
        assert call([*map(str, tokens), "--quiet"]) == 1
        err = capsys.readouterr().err
        assert re.search(said, err), tokens
        assert err.count("\n") == 1
        assert not out.exists()


def applied(folder, crs, source, capsys):
    """Transform a cloud in `crs` by the matrix of a source with the frame `source`."""
    matrix, path = folder / "m.json", folder / "site.laz"
    document = {"status": "ok", "source": "scan", "matrix": np.eye(4).tolist()}
    matrix.write_text(json.dumps(document | source))
    points = np.random.default_rng(0).uniform([116, 39, 0], [116.01, 39.01, 50], (500, 3))
    dougong.write(Cloud.from_points(points, crs=crs), path, overwrite=True)
    moved = folder / "moved.laz"
    moved.unlink(missing_ok=True)
    tokens = ["transform", path, moved, "--matrix", matrix, "--overwrite"]
    code = call([*map(str, tokens), "--quiet", "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert moved.exists() == (code == 0)
    return answer["error"]["message"] if code else answer["notes"]


FRAMES = ("source_frame", "target_frame")
FEET = {"crs_wkt": "EPSG:2263", "unit_m": [1200 / 3937] * 3}


@pytest.mark.parametrize(
    ("crs", "source", "said"),
    [
        ("EPSG:4326", {}, "is in degrees"),
        ("EPSG:4978", {}, "earth-centred"),
        ("EPSG:2263", {}, r"in units of 0.30480061 m \(NAD83 .*of scan, in metres. Convert"),
        ("EPSG:2263", {"source_frame": {"crs_wkt": None, "unit_m": [1, 1, 1]}}, "in metres"),
        ("EPSG:32650", {"source_frame": FEET}, "is in metres .*in units of 0.30480061 m"),
    ],
)
def test_a_matrix_is_not_applied_to_other_units(crs, source, said, tmp_path, capsys):
    assert re.search(said, applied(tmp_path, crs, source, capsys))


def test_a_matrix_is_applied_to_the_units_it_is_for(tmp_path, capsys):
    assert "in scan's" not in str(applied(tmp_path, "EPSG:2263", {"source_frame": FEET}, capsys))
    assert "names no coordinate system: its numbers are taken for those of scan, in units" in str(
        applied(tmp_path, None, {"source_frame": FEET}, capsys)
    )
    without_unit = {"source_frame": {"crs_wkt": "EPSG:2263"}}
    assert "source_frame" not in str(applied(tmp_path, "EPSG:2263", without_unit, capsys))
    worded = {"source_frame": FEET | {"unit_m": [0.3048006096] * 3}}
    applied(tmp_path, "EPSG:2263", worded, capsys)
    searched = {"source_frame": FEET, "scale_search": {"side": "source"}}
    applied(tmp_path, "EPSG:32650", searched, capsys)
    elsewhere = {"source_frame": {"crs_wkt": "EPSG:32649", "unit_m": [1, 1, 1]}}
    assert "mean the same places" in str(applied(tmp_path, "EPSG:32650", elsewhere, capsys))


def test_a_frame_that_a_registration_does_not_name_is_metres_and_that_is_said(tmp_path, capsys):
    scan = {"source_frame": {"crs_wkt": None, "unit_m": [1, 1, 1]}}
    drone = {"target_frame": {"crs_wkt": None, "unit_m": [1, 1, 1]}}
    assert applied(tmp_path, None, scan | drone, capsys) == []
    (note,) = applied(tmp_path, None, drone, capsys)
    assert note == (
        "m.json names no source_frame: the coordinates that its matrix takes are taken for metres. "
        "Right only if scan was in metres"
    )
    (note,) = applied(tmp_path, None, scan, capsys)
    assert "no target_frame: the coordinates that its matrix gives are taken for metres" in note
    (note,) = applied(tmp_path, None, scan | {"target_frame": {"crs_wkt": None}}, capsys)
    assert "no unit_m in its target_frame" in note
    searched = drone | {"scale_search": {"side": "source"}}
    assert applied(tmp_path, None, searched, capsys) == []
    said = applied(tmp_path, "EPSG:2263", {}, capsys)
    assert "register it itself. m.json names no source_frame: metres are expected." in said


def test_a_matrix_that_was_changed_alone_is_said(tmp_path, capsys):
    frames = {name: {"crs_wkt": None, "unit_m": [1, 1, 1]} for name in FRAMES}
    inverse = np.eye(4)
    assert applied(tmp_path, None, frames | {"matrix_inverse": inverse.tolist()}, capsys) == []
    inverse[0, 3] = -10
    (note,) = applied(tmp_path, None, frames | {"matrix_inverse": inverse.tolist()}, capsys)
    assert "matrix and matrix_inverse of m.json are not of one pose (10 m apart" in note
    (note,) = applied(tmp_path, None, frames | {"matrix_inverse": [[1]]}, capsys)
    assert "matrix_inverse of m.json is no transform" in note


def test_a_registration_that_failed_is_never_applied(room, capsys):
    path = room.with_name("m.json")
    path.write_text(json.dumps({"status": "failed", "matrix": np.eye(4).tolist(), "reason": "No."}))
    tokens = ["transform", str(room), str(room.with_name("t.laz")), "--matrix", str(path)]
    assert call([*tokens, "--accept-best", "--quiet"]) == 1
    assert "the registration failed, there is no pose to apply: No." in capsys.readouterr().err
    assert not room.with_name("t.laz").exists()


def test_a_registration_that_an_editor_saved_with_its_mark_is_read(room):
    path = room.with_name("m.json")
    path.write_text(framed(), encoding="utf-8-sig")
    tokens = ["transform", str(room), str(room.with_name("t.laz")), "--matrix", str(path)]
    assert call([*tokens, "--quiet"]) == 0


@pytest.mark.parametrize(("name", "verb"), [("t.laz", "reissue"), ("t.ply", "read")])
def test_a_file_replaced_while_it_is_moved_leaves_no_output(name, verb, room, capsys, monkeypatch):
    path, moved = room.with_name("m.json"), room.with_name(name)
    path.write_text(framed())
    function = getattr(moving, verb)

    def replacing(*args, **more):
        found = function(*args, **more)
        dougong.write(Cloud.from_points(np.eye(3)), room, overwrite=True)
        return found

    monkeypatch.setattr(moving, verb, replacing)
    assert call(["transform", str(room), str(moved), "--matrix", str(path), "--quiet"]) == 1
    assert "room.laz was changed or replaced while it was worked on" in capsys.readouterr().err
    assert {file.name for file in room.parent.iterdir()} == {"room.laz", "m.json"}


def test_a_file_that_is_not_the_registered_one_is_said(room, capsys):
    path, moved = room.with_name("m.json"), room.with_name("t.laz")
    tokens = ["transform", str(room), str(moved), "--matrix", str(path), "--overwrite", "--json"]
    document = json.loads(framed())
    for digest, is_said in (("0" * 64, True), (sha256(room), False)):
        inputs = [{"path": f"scans/{room.name}", "sha256": digest, "points": 12_000}]
        path.write_text(json.dumps(document | {"inputs": inputs}))
        assert call([*tokens, "--quiet"]) == 0
        notes = str(json.loads(capsys.readouterr().out)["notes"])
        assert ("room.laz is not the file that was registered" in notes) == is_said
    inputs = [{"path": "scans/other.laz", "sha256": "0" * 64, "points": 12_000}, "junk"]
    path.write_text(json.dumps(document | {"inputs": inputs}))
    assert call([*tokens, "--quiet"]) == 0
    assert "not the file" not in capsys.readouterr().out


def test_check_of_a_broken_file_exits_1(tmp_path, capsys):
    path = tmp_path / "broken.laz"
    path.write_bytes(b"")
    assert call(["check", str(path), "--quiet"]) == 1
    assert "error: " in capsys.readouterr().out


def test_a_job_larger_than_the_memory_setting_is_refused_before_it_starts(room, capsys):
    out = room.with_name("out.laz")
    tokens = ["filter", str(room), str(out), "--only", "statistical", "--memory", "100MB"]
    assert call(tokens) == 2
    assert "more than --memory" in capsys.readouterr().err
    assert not out.exists()


def test_unexpected_errors_are_one_line_unless_debugged(room, capsys, monkeypatch):
    def broken(path):
        message = "boom"
        raise RuntimeError(message)

    monkeypatch.setattr("dougong.formats.describe", broken)
    assert call(["info", str(room), "--quiet"]) == 1
    err = capsys.readouterr().err
    assert err == "error: unexpected RuntimeError: boom. Run again with --debug and report it.\n"
    assert call(["info", str(room), "--quiet", "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_name_that_the_terminal_cannot_show_is_printed_all_the_same(tmp_path):
    path = tmp_path / "三.xyz"
    path.write_text("0 0 0\n1 1 1\n1 2 3\n")
    found = subprocess.run(
        [sys.executable, "-m", "dougong", "info", str(path), "--quiet"],
        env={**os.environ, "PYTHONIOENCODING": "ascii:strict"},
        capture_output=True,
        check=False,
    )
    assert (found.returncode, found.stderr) == (0, b"")
    assert b"\\u4e09.xyz" in found.stdout


def test_json_is_json_where_the_terminal_is_not_utf8(room):
    named = room.with_name("s\u00e4ule.laz")
    room.rename(named)
    told = subprocess.run(
        [sys.executable, "-m", "dougong", "info", str(named), "--json"],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        check=True,
    )
    assert json.loads(told.stdout)["files"][0]["path"] == str(named)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a POSIX pipe")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.ply")
    assert call(["info", str(tmp_path / "pipe.ply"), "--quiet"]) == 1
    assert "is a pipe or a device, expected a file on a disk" in capsys.readouterr().err


def test_commands_are_listed_in_the_order_of_a_survey(capsys):
    assert call(["--help"]) == 0
    said = capsys.readouterr().out
    at = [said.index(f"\u2502 {command} ") for command in COMMANDS]
    assert at == sorted(at)


def test_help_and_docs_name_the_commands_that_take_no_notice_of_memory(capsys):
    """`check --memory 1GB` was accepted, and held what it liked."""
    commands = ROOT / "src" / "dougong" / "cli"
    deaf = [
        name for name in COMMANDS
        if "memory_bytes()" not in (commands / f"{name}.py").read_text(encoding="utf-8")
    ]  # fmt: skip
    assert call(["info", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.replace("\u2502", " ").split())
    assert f"Without effect on {', '.join(deaf[:-1])} and {deaf[-1]}." in said
    quoted = [f"`{name}`" for name in deaf]
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert f"Without effect on {', '.join(quoted[:-1])} and {quoted[-1]} |" in text


def test_tables_set_figures_flush_right():
    text = table([["a", "1"], ["bb", "1,000"]], ["name", "points"])
    assert text.splitlines() == ["  name  points", "  a          1", "  bb     1,000"]


def test_the_screen_names_a_clouds_file_where_its_name_does_not():
    scan = {"name": "scan", "kind": "lidar", "files": ["a/scan.copc.laz"]}
    assert origin(scan) == "lidar"
    assert origin(scan | {"name": "stations-2"}) == "lidar, scan.copc.laz"
    assert origin(scan | {"files": ["a.laz", "b.laz"]}) == "lidar, 2 files"


def test_the_documented_commands_and_options_are_the_real_ones(capsys):
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## dougong (\w+)\n(.*?)(?=^## |\Z)", text, re.M | re.S))
    assert list(sections) == COMMANDS
    shared_text = re.search(r"^## Options of every command\n(.*?)^## ", text, re.M | re.S)
    shared = set(re.findall(r"^\| `(--[a-z-]+)", shared_text[1], re.M))
    for command, section in sections.items():
        call([command, "--help"])
        shown = capsys.readouterr().out
        real = set(re.findall(r"^│[ *]+(?:[A-Z]+ )?(--[a-z-]+)", shown, re.M)) - {"--help"}
        documented = set(re.findall(r"^\| `(--[a-z-]+)", section, re.M)) | shared
        assert documented == real, command


def test_what_is_no_readable_file_is_said_by_every_verb(tmp_path, capsys):
    (tmp_path / "folder.laz").mkdir()
    for name, said in (("folder.laz", "is a folder"), ("gone.laz", "does not exist")):
        tokens = ["filter", str(tmp_path / name), str(tmp_path / "o.laz"), "--kind", "lidar"]
        assert call([*tokens, "--quiet"]) == 1
        assert said in capsys.readouterr().err
        tokens = ["register", str(tmp_path / name), str(tmp_path / name), "--out"]
        assert call([*tokens, str(tmp_path / "out"), "--quiet"]) == 1
        assert said in capsys.readouterr().err


def test_outputs_that_cannot_be_meant_are_usage_errors(room, capsys):
    for output, said in (
        (room, "is the input itself"),
        (room.parent, "is a folder"),
        (room.with_name("a.xyz"), "clouds are written as"),
        (room.parent / "missing" / "a.laz", "is not a folder"),
    ):
        assert call(["filter", str(room), str(output), "--kind", "lidar", "--quiet"]) == 2
        assert said in capsys.readouterr().err


def framed(source=None, target=None):
    """Return a registration of no move, in words, with frames as given."""
    document = {"status": "ok", "source": "scan", "matrix": np.eye(4).tolist()}
    return json.dumps(document | {"source_frame": source, "target_frame": target})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"status": "ok", "matrix": [["x"]]}', "four rows of four numbers"),
        ('{"status": "ok", "matrix": [[1, 2], [3, 4]]}', "finite 4x4 matrix"),
        ("[1]", "holds a list"),
        ("\xff", "is no JSON file: it is no UTF-8 text"),
        ('{"status": "ok",\n "matrix": 1,}', "is no JSON file: line 2, column 14: "),
        ('{"status": "OK", "matrix": 1}', "has status 'OK'; expected ok, ambiguous or failed"),
        ('{"status": "ok"}', "has no matrix"),
        (framed(source="metres"), "source_frame of m.json must be an object, got 'metres'"),
        (framed(target=[1, 1, 1]), "target_frame of m.json must be an object, got [1, 1, 1]"),
        (framed(source={"unit_m": 1.0}), "source_frame.unit_m of m.json must be three positive"),
        (framed(source={"unit_m": [1, 1]}), "must be three positive numbers, metres per unit of"),
        (framed(target={"unit_m": [1, -1, 1]}), "target_frame.unit_m of m.json must be three"),
        (framed(target={"unit_m": ["m", "m", "m"]}), "must be three positive numbers"),
        (framed(target={"unit_m": [True, 1, 1]}), "must be three positive numbers"),
        (framed(target={"crs_wkt": 32650}), "target_frame.crs_wkt of m.json is no coordinate"),
        (framed(source={"crs_wkt": "UTM"}), "crs_wkt of m.json is no coordinate system: 'UTM'"),
        ('{"status": "ok", "matrix": 1, "scale_search": "none"}', "scale_search of m.json must"),
        (None, "cannot be read: Is a directory"),
    ],
)
def test_a_matrix_file_that_is_none_is_one_sentence(room, text, said, capsys):
    path = room.with_name("m.json")
    path.mkdir() if text is None else path.write_text(text, encoding="latin-1")
    tokens = ["transform", str(room), str(room.with_name("t.laz")), "--matrix", str(path)]
    assert call([*tokens, "--quiet"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "unexpected" not in err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[cloud]]\nname="a"\nkind="lidar"\nfiles="a.laz"\n', "number 1, files.*expected a list"),
        ('[[cloud]]\nname="a"\nkind="lidar"\nfiles=["a"]\n' * 2, r"cloud: two clouds are called"),
        ('[project]\nreference="b"\n[[cloud]]\nname="a"\nkind="lidar"\nfiles=["a"]\n',
         r"p\.toml: project\.reference names 'b', which is no cloud"),
        ('[[cloud]]\nname="a/b"\nkind="lidar"\nfiles=["a"]\n', "got 'a/b': expected text that"),
    ],
)  # fmt: skip
def test_a_wrong_project_is_told_in_words_and_without_its_contents(text, said, tmp_path, capsys):
    (tmp_path / "p.toml").write_text(text)
    tokens = ["run", str(tmp_path / "p.toml"), "--out", str(tmp_path / "out"), "--quiet"]
    assert call(tokens) == 2
    err = capsys.readouterr().err
    assert re.search(said, err)
    assert "{" not in err


@pytest.mark.parametrize("count", [1, 20])
def test_register_writes_its_document_where_a_cloud_is_too_small(room, tmp_path, capsys, count):
    few = tmp_path / "few.laz"
    dougong.write(Cloud.from_points(np.random.default_rng(0).uniform(0, 5, (count, 3))), few)
    out, control = tmp_path / "out", tmp_path / "control.csv"
    control.write_text(
        "name,cloud,source_x,source_y,source_z,target_x,target_y,target_z,sigma_m,role\n"
        "a,few,1,2,3,500001,4000002,33,0.01,check\n"
    )
    tokens = ["register", str(few), str(room), "--out", str(out), "--control", str(control)]
    assert call([*tokens, "--json"]) == 1
    document = json.loads((out / "registration.json").read_text())
    assert (document["status"], document["matrix"]) == ("failed", None)
    assert f"few has too few usable points ({count})" in document["reason"]
    assert document["parameters"]["coarse"] == "auto"
    assert (document["checks"]["check_points"], document["checks"]["check"]) == (1, None)
    assert json.loads(capsys.readouterr().out)["status"] == "failed"
    page = (out / "report.html").read_text()
    assert "too few usable points" in page
    assert "1 check point had no pose to be measured at" in " ".join(page.split())


def test_register_and_run_do_not_write_over_each_others_report(room, tmp_path, capsys):
    out = tmp_path / "result"
    out.mkdir()
    (out / "report.html").write_text("of another command")
    for tokens in (["register", str(room), str(room)], ["run", "--lidar", str(room)], ["demo"]):
        assert call([*tokens, "--out", str(out)]) == 2
        assert "report.html exists already" in capsys.readouterr().err
    assert (out / "report.html").read_text() == "of another command"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a Linux device")
@pytest.mark.parametrize(
    ("redirect", "code", "said"),
    [
        (">&-", 0, ""),
        ("2>&-", 0, ""),
        (">/dev/full", 1, "error: the answer could not be printed: No space left on device."),
        ("2>/dev/full", 0, ""),
    ],
)
def test_streams_that_take_nothing_are_no_accident(room, redirect, code, said):
    command = f"{sys.executable} -m dougong info {room} {redirect}"
    result = subprocess.run(
        ["sh", "-c", command], capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == code
    assert "Traceback" not in result.stderr
    assert said in result.stderr
    if redirect.startswith("2"):
        assert "12,000" in result.stdout


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["--json", "info", "a.laz"], ["info", "a.laz", "--json"]),
        (["--threads", "2", "--quiet", "run"], ["run", "--threads", "2", "--quiet"]),
        (["--threads=2", "check", "a"], ["check", "a", "--threads=2"]),
        (["--version"], ["--version"]),
        (["--seed"], ["--seed"]),
        ([], []),
    ],
)
def test_global_options_may_stand_before_the_command(given, expected):
    from dougong.cli._commands import command_first

    assert command_first(given) == expected


@pytest.mark.parametrize("flags", [[], ["--json"]])
@pytest.mark.parametrize(
    ("what", "exit_code"),
    [
        ("raise KeyboardInterrupt", 130),
        ("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", 143),
    ],
)
def test_being_ended_while_the_program_loads_is_heard(flags, what, exit_code):
    """It used to end in a traceback."""
    code = (
        "import sys\n"
        "class Interrupted:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'cyclopts':\n"
        f"            {what}\n"
        "sys.meta_path.insert(0, Interrupted())\n"
        f"sys.argv = ['dougong', 'info', 'a.laz', *{flags}]\n"
        "from dougong.cli import main\n"
        "main()\n"
    )
    result = python("-c", code)
    assert result.returncode == exit_code
    assert "Traceback" not in result.stderr
    if flags:
        assert json.loads(result.stdout)["error"]["exit_code"] == exit_code
    else:
        assert result.stderr == "cancelled.\n"


@pytest.mark.parametrize(
    ("verb", "tokens", "said"),
    [
        ("evaluate", ["growth"], "Rows measured so far are kept"),
        ("evaluate", ["denoise"], "Nothing was written"),
        ("filter_file", ["a.laz", "b.laz"], "Nothing was written"),
        ("filter_file", ["a.laz", "b.laz", "--work", "w"], "are kept in w"),
    ],
)
def test_a_cancelled_command_says_what_it_leaves(monkeypatch, capsys, verb, tokens, said):
    def cancelled(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"dougong.app.{verb}", cancelled)
    assert call([verb.removesuffix("_file"), *tokens]) == 130
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("how", "code"), [(KeyboardInterrupt, 0), (Terminated, 143)])
def test_a_viewer_is_closed_by_ctrl_c_and_ended_by_sigterm(monkeypatch, how, code):
    closed = []

    told = {"clouds": ["a"], "points": 1, "url": "u", "is_browser_open": True, "notes": []}
    viewing = SimpleNamespace(document=told, close=lambda: closed.append(how))

    class Waiting:
        def wait(self):
            raise how

    monkeypatch.setattr("dougong.app.view", lambda *_, **__: viewing)
    monkeypatch.setattr("dougong.cli.view.threading", SimpleNamespace(Event=Waiting))
    assert call(["view", "a.laz", "--quiet"]) == code
    assert closed == [how]


def test_a_folder_that_may_not_be_written_is_refused_before_the_work(room, capsys, monkeypatch):
    monkeypatch.setattr("dougong.pipeline.outputs.os.access", lambda *_: False)
    monkeypatch.setattr("dougong.pipeline.filtering.read", None)  # nothing is read
    tokens = ["filter", str(room), str(room.with_name("o.laz")), "--kind", "lidar", "--quiet"]
    assert call(tokens) == 1
    assert "may not be written by this user" in capsys.readouterr().err


def test_help_breaks_lines_where_the_terminal_ends_and_nowhere_else():
    from dougong.cli._commands import unwrapped

    text = """Do a thing.

    A sentence that was
    broken.

    Parameters
    ----------
    mark
        Keep every point, and the old class in
        classification_in.
    other
        Short.
    """
    assert unwrapped(text).splitlines() == [
        "Do a thing.",
        "",
        "A sentence that was broken.",
        "",
        "Parameters",
        "----------",
        "mark",
        "    Keep every point, and the old class in classification_in.",
        "other",
        "    Short.",
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("filter", "`dougong filter` needs INPUT, which is missing; see `dougong filter --help`."),
        ("register a.las", "`dougong register` needs TARGET, which is missing"),
        ("run", "`dougong run` needs --out, which is missing"),
        ("report", "`dougong report` needs FOLDER, which is missing"),
        ("filter a.las b.las --kind", "--kind is given without a value"),
    ],
)
def test_what_a_command_line_lacks_is_named_as_its_help_names_it(line, said, capsys):
    assert call(line.split()) == 2
    assert said in capsys.readouterr().err
