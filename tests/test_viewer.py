"""The 3-D view: what it packs, what it serves, and that a browser shows it."""

import base64
import http.client
import json
import os
import signal
import subprocess
import sys
import zlib
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np
import pytest

import dougong.report.render as rendering
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.formats import write
from dougong.report.layers import BLUE, COLOURS, Layer
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
    size_codes,
    sizes,
    thinned,
)  # fmt: skip
from dougong.report.server import Served, ViewServer, byte_range
from dougong.report.streaming import items_of
from dougong.report.viewer import why_missing
from test_report import building, registration, run_result

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
    found = rng.uniform(0, REACH_M, len(chosen))
    packed = pack(layer, chosen, found, 0)
    xyz, planes = unpacked(packed)
    order = np.lexsort(xyz.T)
    wanted = np.lexsort((np.round(points[chosen] / STEP_M) * STEP_M).T)
    assert np.abs(xyz[order] - points[chosen][wanted]).max() <= STEP_M / 2 + 1e-9
    assert (layer.colours[chosen][wanted] == planes[1:4, order].T).all()
    decoded = REACH_M * (planes[4, order] / 254) ** 2
    assert np.abs(decoded - found[wanted]).max() < 2 * REACH_M / 254
    assert (planes[5, order] == layer.classes[chosen][wanted]).all()


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
