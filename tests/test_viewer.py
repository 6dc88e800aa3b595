"""The 3-D view: what it packs, what it serves, and that a browser shows it."""

import base64
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

import dougong.report.render as rendering
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.selection import Reason
from dougong.formats import read, write
from dougong.pipeline.marking import CLUTTER_CLASS, GROUND_CLASS, NOISE_CLASS
from dougong.pipeline.memory import Room
from dougong.pipeline.pairs import read_pairs
from dougong.report.figures import find_place
from dougong.report.layers import BLUE, COLOURS, Cores, Layer, Removed
from dougong.report.looks import look_at
from dougong.report.model import from_run
from dougong.report.payload import (
    NO_CLOUD,
    REACH_M,
    STEP_M,
    back_motion,
    distance_codes,
    distances,
    pack,
    shares,
    signed_distances,
    size_codes,
    sizes,
    thinned,
)  # fmt: skip
from dougong.report.picking import picking
from dougong.report.server import Served, ViewServer, byte_range
from dougong.report.streaming import Item, _streamable, items_of, prepare
from dougong.report.viewer import view_3d, why_missing
from test_report import building, registration, run_result
from tile_scans import make_little_room, write_scan

BEACONS = np.array([[3.0, -7.0, 7.0], [3.0, -4.0, 11.0]])
"""Two lone points above the building, 5 m apart."""


def turned(points, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [30.0, -4.0, 2.0]


@pytest.fixture(scope="module")
def layers():
    first, second = np.vstack([building(0), BEACONS]), building(1)
    rng = np.random.default_rng(5)
    return [
        Layer(name="scan <b>1</b>", colour=COLOURS[0], after=first, before=turned(first, 70),
              is_reference=False, is_sure=True, origin=np.array([5e5, 4e6, 100.0]),
              colours=rng.integers(0, 255, (len(first), 3)).astype(np.uint8),
              classes=np.where(first[:, 2] < 0.1, 2, 1).astype(np.uint8)),
        Layer(name="drone", colour=BLUE, after=second, before=second, is_reference=True,
              is_sure=True, origin=np.array([5e5, 4e6, 100.0])),
    ]  # fmt: skip


def unpacked(packed):
    """Slow twin of the viewer's decoder."""
    raw = np.frombuffer(zlib.decompress(base64.b64decode(packed.data)), dtype=np.uint8)
    n = packed.head["points"]
    assert len(raw) % n == 0
    planes = raw.reshape(-1, n).astype(np.int64)
    blocks = np.repeat(
        [block[:3] for block in packed.head["blocks"]],
        [block[3] for block in packed.head["blocks"]],
        axis=0,
    )
    steps = [
        65536 * blocks[:, axis] + planes[2 * axis] + 256 * planes[2 * axis + 1] for axis in range(3)
    ]
    return np.column_stack(steps) * packed.head["step_m"], planes[6:]


@pytest.mark.parametrize("spread_m", [10.0, 700.0])
def test_packed_points_are_off_by_half_a_step_at_most(spread_m):
    rng = np.random.default_rng(0)
    points = rng.uniform(-spread_m, spread_m, (3000, 3))
    layer = Layer(name="a", colour=BLUE, after=points, before=points, is_reference=True,
                  is_sure=True, colours=rng.integers(0, 255, (3000, 3)).astype(np.uint8),
                  classes=(np.arange(3000) % 7).astype(np.uint8))  # fmt: skip
    chosen = np.arange(0, 3000, 2)
    found = rng.uniform(-REACH_M, REACH_M, len(chosen))
    reasons = (np.arange(len(chosen)) % 8).astype(np.uint8)
    packed = pack(points[chosen], source=0, element="e", colours=layer.colours[chosen],
                  found=found, classes=layer.classes[chosen], reasons=reasons)  # fmt: skip
    xyz, planes = unpacked(packed)
    order = np.lexsort(xyz.T)
    wanted = np.lexsort((np.round(points[chosen] / STEP_M) * STEP_M).T)
    assert np.abs(xyz[order] - points[chosen][wanted]).max() <= STEP_M / 2 + 1e-9
    assert (layer.colours[chosen][wanted] == planes[1:4, order].T).all()
    root = (planes[4, order] - 127) / 127
    decoded = REACH_M * np.sign(root) * root**2
    assert np.abs(decoded - found[wanted]).max() < 2 * REACH_M / 127
    assert (planes[5, order] == layer.classes[chosen][wanted]).all()
    assert (planes[6, order] == reasons[wanted]).all()


def test_thinning_is_even_and_keeps_small_clouds_whole():
    rng = np.random.default_rng(1)
    dense, sparse = rng.uniform(0, 1, (50_000, 2)), rng.uniform(0, 10, (5_000, 2))
    points = np.column_stack([np.vstack([dense, sparse]), np.zeros(55_000)])
    chosen = thinned(points, 5_000)
    assert 3_500 <= len(chosen) <= 5_000
    assert (np.diff(chosen) > 0).all()
    # The corner holds 91 % of the points on 1 % of the area.
    assert (chosen < 50_000).mean() < 0.2
    assert (thinned(points, 55_000) == np.arange(55_000)).all()


def test_shares_use_what_others_leave():
    assert shares([100, 1000, 1000], 1100) == [100, 500, 500]
    assert shares([5, 5], 400) == [5, 5]
    assert shares([900, 900], 1000) == [500, 500]


def test_distances_are_to_the_surface_not_to_its_points():
    grid = np.stack(np.meshgrid(np.arange(0, 3, 0.1), np.arange(0, 3, 0.1)), -1).reshape(-1, 2)
    plane = np.column_stack([grid, 0.2 * grid[:, 0]])
    normal = np.array([-0.2, 0, 1]) / np.hypot(0.2, 1)
    points = np.array([[1.53, 1.47, 0.2 * 1.53]]) + np.array([[0.0], [0.02], [0.1], [5.0]]) * normal
    found = distances(points, plane)
    assert found[:3] == pytest.approx([0.0, 0.02, 0.1], abs=1e-9)
    assert np.isnan(found[3])
    assert distance_codes(found)[3] == NO_CLOUD
    assert np.isnan(distances(points, plane[:4])).all()


def test_sizes_follow_the_spacing_and_lone_points_stay_small():
    grid = np.stack(np.meshgrid(np.arange(40), np.arange(40)), -1).reshape(-1, 2) * 0.05
    points = np.vstack([np.column_stack([grid, np.zeros(len(grid))]), [[30.0, 0, 0]]])
    found = sizes(points)
    assert np.median(found) == pytest.approx(0.0525)
    assert found[-1] == pytest.approx(0.0525)
    assert size_codes(np.array([0.002, 0.004, 1e9])).tolist() == [0, 4, 63]


def test_the_way_back_is_the_motion_between_the_two_arrays(layers):
    layer = layers[0]
    matrix = back_motion(layer)
    assert np.abs(layer.after @ matrix[:3, :3].T + matrix[:3, 3] - layer.before).max() < 1e-9
    scaled = replace(layer, before=2.5 * layer.before)
    assert np.cbrt(np.linalg.det(back_motion(scaled)[:3, :3])) == pytest.approx(2.5)


def test_a_report_without_the_viewer_says_so(layers, monkeypatch, tmp_path):
    said = "npm failed: no registry <here>"
    (tmp_path / "viewer.json").write_text(json.dumps({"is_built": False, "why": said}))
    assert why_missing(tmp_path) == said
    assert "pip" in why_missing(tmp_path / "none")
    monkeypatch.setattr(rendering, "why_missing", lambda: said)
    monkeypatch.setattr(rendering, "slices", lambda *_: [])
    text = rendering.render(from_run(run_result(registration()), None), layers)
    assert "Still pictures only" in text
    assert "no registry &lt;here&gt;" in text
    assert "<script" not in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [("bytes=0-9", (0, 9)), ("bytes=90-", (90, 99)), ("bytes=-10", (90, 99)),
     ("bytes=95-200", (95, 99)), ("bytes=100-", None), ("bytes=9-3", None), ("bytes=-", None),
     ("bytes=0-1,3-4", None), ("items=0-1", None), ("bytes=-500", (0, 99))],
)  # fmt: skip
def test_byte_ranges(text, expected):
    assert byte_range(text, 100) == expected


@pytest.fixture
def server(tmp_path):
    file = tmp_path / "cloud"
    file.write_bytes(bytes(range(200)))
    things = {"": Served(kind="text/html", body=b"page"), "cloud/0": Served(kind="x", body=file)}
    opened = ViewServer(things)
    yield opened
    opened.close()


def asked(server, path, **headers):
    address = urlsplit(server.url)
    link = http.client.HTTPConnection(address.hostname, address.port, timeout=5)
    link.request("GET", path, headers={"Host": address.netloc} | headers)
    answer = link.getresponse()
    found = answer.status, answer.read(), dict(answer.getheaders())
    link.close()
    return found


def test_the_server_answers_ranges_to_this_computer_only(server):
    root = urlsplit(server.url).path
    assert urlsplit(server.url).hostname == "127.0.0.1"
    assert asked(server, root)[:2] == (200, b"page")
    status, body, headers = asked(server, root + "cloud/0", Range="bytes=10-19")
    assert (status, body) == (206, bytes(range(10, 20)))
    assert headers["Content-Range"] == "bytes 10-19/200"
    assert asked(server, root + "cloud/0")[1] == bytes(range(200))
    assert asked(server, root + "cloud/0", Range="bytes=500-")[0] == 416
    assert asked(server, root + "cloud/1")[0] == 404
    assert asked(server, "/")[0] == 404
    assert asked(server, root + "../../etc/passwd")[0] == 404
    assert asked(server, root, Host="evil.example")[0] == 421


def test_view_refuses_what_it_cannot_show(tmp_path):
    with pytest.raises(InputError, match="nothing is named"):
        items_of([])
    with pytest.raises(InputError, match="does not exist"):
        items_of([tmp_path / "gone.laz"])
    with pytest.raises(InputError, match=r"no result\.json"):
        items_of([tmp_path])


@pytest.mark.parametrize("suffix", [".e57", ".laz", ".ply"])
def test_a_cloud_larger_than_memory_is_converted_in_pieces(tmp_path, monkeypatch, suffix):
    """`view --memory` took no notice, and the whole cloud was held."""
    path, notes = tmp_path / f"scan{suffix}", []
    write(read(write_scan(tmp_path / "first.laz")), path)
    item = Item(name="scan", path=path)
    whole = _streamable(item, tmp_path / "whole.copc.laz", Room.of(10**10), notes.append, notes)
    make_little_room(monkeypatch)
    monkeypatch.setattr("dougong.report.streaming.read", None)
    monkeypatch.setattr("dougong.pipeline.tiled.CHUNK_POINTS", 5000)
    (tmp_path / "work").mkdir()
    converted = tmp_path / "work" / "a.copc.laz"
    made = _streamable(item, converted, Room.of(190_000), notes.append, notes)
    assert read(made).records.tobytes() == read(whole).records.tobytes()
    assert list(converted.parent.iterdir()) == [converted]


@pytest.mark.skipif(why_missing() is not None, reason=f"no viewer: {why_missing()}")
def test_the_command_serves_until_ctrl_c_and_cleans_up(tmp_path):
    file = tmp_path / "scan.ply"
    write(Cloud.from_points(building(0)), file)
    scratch = tmp_path / "work"
    process = subprocess.Popen(
        [sys.executable, "-m", "dougong", "view", str(file), "--no-browser", "--json", "--quiet",
         "--work", str(scratch)],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        text = ""
        while not text.endswith("}\n"):
            text += process.stdout.readline()
        document = json.loads(text)
        assert document["clouds"] == ["scan.ply"]
        assert document["points"] == len(building(0))
        assert "temporary COPC copy" in document["notes"][0]
        assert len(list(scratch.rglob("*.copc.laz"))) == 1
        address = urlsplit(document["url"])
        link = http.client.HTTPConnection(address.hostname, address.port, timeout=5)
        link.request("GET", address.path)
        assert link.getresponse().status == 200
        link.close()
    finally:
        process.send_signal(signal.SIGINT)
        code = process.wait(10)
        process.stdout.close()
    assert code == 0
    assert list(scratch.iterdir()) == []


POST = {"Content-Type": "application/json"}
PICKED = [
    {"name": f"p{n}", "source": [1.5 * n, 2.25, 3.0], "target": [5e5 + n, 4e6 + 0.1234, -7.5]}
    for n in range(1, 4)
]


@pytest.fixture
def taking(tmp_path):
    told, takes = picking(tmp_path / "scan.laz", tmp_path / "my drone.laz", tmp_path / "pairs.csv")
    opened = ViewServer({"": Served(kind="text/html", body=b"page")}, takes=takes)
    yield opened, told, tmp_path / "pairs.csv"
    opened.close()


def sent(server, body, path="pairs", **headers):
    address = urlsplit(server.url)
    link = http.client.HTTPConnection(address.hostname, address.port, timeout=5)
    own = {"Host": address.netloc, "Origin": f"http://{address.netloc}"} | POST
    link.request("POST", address.path + path, body=body, headers=own | headers)
    answer = link.getresponse()
    found = answer.status, answer.read()
    link.close()
    return found


def test_the_page_saves_its_pairs_in_the_named_file(taking):
    server, told, file = taking
    status, body = sent(server, json.dumps({"pairs": PICKED}))
    assert status == 200
    assert json.loads(body) == {"pairs": 3, "path": str(file)}
    assert file.read_text().splitlines()[0] == told["header"]
    back = read_pairs(file, "scan")
    assert back.names == ("p1", "p2", "p3")
    assert back.target.tolist() == [pair["target"] for pair in PICKED]
    assert "'" in told["command"], "a name with a blank is quoted"
    again, _ = picking(file.parent / "scan.laz", file.parent / "drone.laz", file)
    assert again["list"] == PICKED
    assert sent(server, json.dumps({"pairs": PICKED[:1]}))[0] == 200
    assert len(file.read_text().splitlines()) == 2, "the file is replaced"


def test_saving_pairs_keeps_the_rows_that_the_page_does_not_show(tmp_path):
    """Check points, those of other clouds and every sigma_m were deleted."""
    file = tmp_path / "control.csv"
    rows = [
        "name,cloud,source_x,source_y,source_z,target_x,target_y,target_z,sigma_m,role,seen",
        "T1,scan,1,2,3.00001,4,5,6,0.003,control,by A",
        ",,1,7,3,4,5,6,0.002,,",
        "T2,scan,1,2,9,4,5,6,0.003,check,",
        "T3,scan2,7,2,3,4,5,6,0.004,control,",
    ]
    file.write_text("\n".join(rows) + "\n")
    told, takes = picking(tmp_path / "scan.laz", tmp_path / "drone.laz", file)
    takes["pairs"]({"pairs": told["list"]})
    rows[2] = rows[2].replace(",,1", "2,,1", 1)
    assert file.read_text().splitlines() == rows
    moved = told["list"][0] | {"source": [1.0, 2.0, 3.1]}
    takes["pairs"]({"pairs": [moved]})
    added = "T1,scan,1.0000,2.0000,3.1000,4.0000,5.0000,6.0000,,control,"
    assert file.read_text().splitlines() == [rows[0], rows[3], rows[4], added]


@pytest.mark.parametrize(
    ("headers", "path", "status"),
    [
        ({"Origin": "http://evil.example"}, "pairs", 403),
        ({"Origin": ""}, "pairs", 403),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, "pairs", 403),
        ({"Content-Type": "text/plain"}, "pairs", 415),
        ({"Content-Length": "99999999"}, "pairs", 413),
        ({}, "../pairs", 404),
        ({}, "cloud/0", 404),
    ],
)
def test_no_other_page_can_write(taking, headers, path, status):
    server, _, file = taking
    assert sent(server, json.dumps({"pairs": PICKED}), path, **headers)[0] == status
    assert not file.exists()


@pytest.mark.parametrize(
    "body",
    ["", "[]", "{", '{"pairs": [{"name": "a"}]}', '{"pairs": [], "path": "/etc/passwd"}',
     '{"pairs": [{"name": "a", "source": [1, 2, NaN], "target": [1, 2, 3]}]}'],
)  # fmt: skip
def test_what_are_no_pairs_is_refused_in_words(taking, body):
    server, _, file = taking
    status, said = sent(server, body)
    assert status == 400
    assert len(json.loads(said)["error"]) > 10
    assert not file.exists()


@pytest.mark.skipif(why_missing() is not None, reason=f"no viewer: {why_missing()}")
def test_pairs_are_picked_in_two_clouds(tmp_path):
    for name in ("a", "b", "c"):
        write(Cloud.from_points(building(0)), tmp_path / f"{name}.copc.laz")
    clouds = [tmp_path / f"{name}.copc.laz" for name in "abc"]
    with pytest.raises(InputError, match=r"--pairs needs two clouds.* got 3"):
        prepare(clouds, tmp_path, print, tmp_path / "p.csv")
    with pytest.raises(InputError, match="is no folder"):
        prepare(clouds[:2], tmp_path, print, tmp_path / "none" / "p.csv")
    (tmp_path / "notes.csv").write_text("my notes\n")
    with pytest.raises(InputError, match="no column source_x"):
        prepare(clouds[:2], tmp_path, print, tmp_path / "notes.csv")
    assert (tmp_path / "notes.csv").read_text() == "my notes\n"
    scene = prepare(clouds[:2], tmp_path, print, tmp_path / "p.csv")
    assert list(scene.takes) == ["pairs"]
    assert prepare(clouds, tmp_path, print).takes == {}


def test_attributes_of_a_file_become_colourings(tmp_path):
    points = building(0)
    distance = np.full(len(points), np.nan, np.float32)
    distance[::2] = 0.03 * np.sign(points[::2, 0])
    cloud = Cloud.from_points(
        points, m3c2_distance=distance, dougong_reason=np.full(len(points), 4, np.uint8)
    )
    write(cloud, tmp_path / "a.copc.laz")
    look = look_at(tmp_path / "a.copc.laz")
    assert look.residual == "m3c2_distance"
    assert look.residual_shown_m == pytest.approx(0.05)
    assert look.reasons == {4}
    assert {"reason", "residual"} <= look.colours
    write(Cloud.from_points(points), tmp_path / "b.copc.laz")
    assert not look_at(tmp_path / "b.copc.laz").colours & {"reason", "residual"}


@pytest.mark.skipif(why_missing() is not None, reason=f"no viewer: {why_missing()}")
def test_removed_points_ride_with_their_cloud(layers):
    out = Removed(after=BEACONS, reasons=np.array([2, 4], np.uint8))
    shown = [replace(layers[0], removed=out), layers[1]]
    view = view_3d(shown, find_place(shown))
    assert view.scene["reasons"] == [0, 2, 4]
    assert view.scene["colours"][-1] == "reason"
    packed = view.clouds[1]
    assert packed.head["source"] == 0
    assert packed.head["has_reason"]
    assert np.abs(np.sort(unpacked(packed)[0], 0) - np.sort(BEACONS, 0)).max() <= STEP_M / 2 + 1e-9
    assert "2 points that the filters took out" in view.lead
    assert "reason" not in view_3d(layers, find_place(layers)).scene["colours"]


@pytest.mark.skipif(why_missing() is not None, reason=f"no viewer: {why_missing()}")
def test_measured_distances_are_shown_signed(layers):
    core = layers[0].after[::7]
    cores = Cores(after=core, distance_m=np.where(core[:, 2] > 1, 0.02, -0.01), reach_m=0.05)
    found = signed_distances(np.vstack([core[:50], [[90.0, 0, 0]]]), [cores])
    assert (found[:50] == cores.distance_m[:50]).all()
    assert np.isnan(found[50])
    scene = view_3d([replace(layers[0], cores=cores), layers[1]], find_place(layers)).scene
    assert scene["residual"]["is_signed"]
    assert scene["residual"]["shown_m"] == pytest.approx(0.02)
    assert not view_3d(layers, find_place(layers)).scene["residual"]["is_signed"]


def test_the_viewer_has_a_colour_for_every_reason_and_class_of_ours():
    source = Path(__file__).parent.parent / "viewer" / "src" / "colours.js"
    if not source.is_file():
        pytest.skip("the viewer's sources are not part of an installed package")
    classes, reasons = source.read_text(encoding="utf-8").split("export const REASONS")
    codes = [
        [int(code) for code in re.findall(r"\[(\d+), \"", part)] for part in (classes, reasons)
    ]
    assert {GROUND_CLASS, NOISE_CLASS, CLUTTER_CLASS} <= set(codes[0])
    assert codes[1] == [int(reason) for reason in Reason]
    # A byte holds both: sixteen places each, the last class for all that have none.
    assert len(codes[0]) < 16
    assert len(codes[1]) <= 16
