"""The 3-D view in a real browser: what it draws, what its controls change, what it asks for."""

from dataclasses import replace

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import write
from dougong.report.layers import Removed
from dougong.report.model import from_run
from dougong.report.render import render
from dougong.report.server import ViewServer
from dougong.report.streaming import prepare
from test_report import building, registration, run_result
from test_viewer import BEACONS, layers  # noqa: F401 - a fixture
from viewer_page import NEEDED, Page, browser, change, ink, settled  # noqa: F401 - a fixture

pytestmark = NEEDED


@pytest.fixture(scope="module")
def report(layers, tmp_path_factory):  # noqa: F811 - the fixture
    path = tmp_path_factory.mktemp("report") / "report.html"
    strays = np.random.default_rng(6).uniform([-4, -9, 6], [10, 0, 9], (3000, 3))
    removed = Removed(after=strays, reasons=np.full(3000, 4, np.uint8))
    shown = [replace(layers[0], removed=removed), layers[1]]
    path.write_text(render(from_run(run_result(registration()), None), shown), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def page(browser, report):  # noqa: F811 - the fixture
    opened = Page(browser, report)
    yield opened
    assert opened.errors == []
    assert [url for url in opened.requests if not url.startswith(("file:", "data:"))] == []
    opened.close()


def test_the_report_draws_and_every_colouring_looks_different(page):
    pictures = {}
    for name in ("Source", "Height", "Natural", "Distance", "Class", "Removed"):
        page.press("Colour", name)
        pictures[name] = page.picture()
        assert ink(pictures[name]) > 0.1, name
    names = list(pictures)
    for index, first in enumerate(names):
        for second in names[index + 1 :]:
            assert change(pictures[first], pictures[second]) > 0.03, (first, second)


def test_source_colours_are_those_of_the_legend(page):
    picture = page.picture()[:, :, ::-1]
    orange = (picture[:, :, 0] > picture[:, :, 2] + 60).mean()
    blue = (picture[:, :, 2] > picture[:, :, 0] + 60).mean()
    assert orange > 0.02
    assert blue > 0.02


def test_clouds_views_and_motion_change_the_picture(page):
    start = page.picture()
    page.tab.get_by_label("scan <b>1</b>").uncheck()
    without = page.picture()
    assert change(start, without) > 0.03
    page.tab.get_by_label("scan <b>1</b>").check()
    assert change(start, page.picture()) < 0.002
    page.press("Clouds are", "as delivered")
    assert page.state("s.stage.progress") == 0
    assert change(start, page.picture()) > 0.03
    page.press("Clouds are", "registered")
    assert change(start, page.picture()) < 0.002
    seen = [start]
    for view in ("Plan", "Front", "Right", "Left"):
        page.press("View", view)
        seen.append(page.picture())
        assert ink(seen[-1]) > 0.02
        assert all(change(seen[-1], other) > 0.02 for other in seen[:-1])


def test_a_slice_shows_what_lies_in_it_and_moves(page):
    page.press("Thin slice", "Level")
    assert page.state("s.view") == "plan"
    walls = page.picture()
    # Four walls cut at 1.5 m: lines on an empty ground.
    assert 0.0005 < ink(walls) < 0.08
    slider = page.tab.locator("#viewer .slice-position")
    slider.evaluate("(node) => { node.value = 0; node.dispatchEvent(new Event('input')); }")
    floor = page.picture()
    assert ink(floor) > 4 * ink(walls)
    page.canvas.focus()
    for _ in range(4):
        page.tab.keyboard.press("]")
    assert change(floor, page.picture()) > 0.05
    page.press("Thin slice", "Along")
    assert page.state("s.view") == "front"
    assert ink(page.picture()) > 0.0005


def test_measuring_two_points_gives_their_distance(page):
    page.press("View", "Plan")
    page.tab.get_by_role("button", name="Measure").click()
    for beacon in BEACONS:
        x, y = page.tab.evaluate("(p) => dougongViewer.project(...p)", beacon.tolist())
        page.tab.mouse.click(x, y)
    result = page.tab.evaluate("() => dougongViewer.measure.result")
    assert result["distance"] == pytest.approx(5.0, abs=1e-6)
    assert result["plan"] == pytest.approx(3.0, abs=1e-6)
    steps = [result[name] for name in ("dx", "dy", "dz")]
    assert steps == pytest.approx((BEACONS[1] - BEACONS[0]).tolist(), abs=1e-6)
    words = page.tab.locator("#viewer .readout").inner_text()
    assert words.startswith("5.000 m")
    assert "dx +0.000" in words
    assert "dz +4.000" in words
    assert "500003.000 3999993.000 107.000" in words
    assert "scan <b>1</b>" in words
    page.canvas.focus()
    page.tab.keyboard.press("Escape")
    assert page.tab.evaluate("() => dougongViewer.measure.result") is None


def test_keys_work_and_are_listed(page):
    page.canvas.focus()
    for key, asked, answer in (("2", "s.view", "plan"), ("c", "s.colour", "height"),
                               ("s", "s.slice", "level"), ("l", "s.stage.lighting", False),
                               ("x", "s.isBoxed", True), ("5", "s.view", "back"),
                               ("r", "s.slice", "off"),
                               ("o", "s.stage.isOrtho", True)):  # fmt: skip
        page.tab.keyboard.press(key)
        assert page.state(asked) == answer, key
    page.tab.keyboard.press("?")
    assert page.tab.get_by_role("dialog").is_visible()


def test_print_shows_the_stills_and_not_the_viewer(page):
    stills = page.tab.locator(".stills")
    assert stills.count() > 0
    assert not any(still.is_visible() for still in stills.all())
    page.tab.emulate_media(media="print")
    assert all(still.is_visible() for still in stills.all())
    assert not page.tab.locator("#viewer").is_visible()


@pytest.mark.parametrize(("width", "height", "scheme"), [(390, 844, "dark"), (2560, 1440, "light")])
def test_it_fits_a_phone_and_a_large_screen(browser, report, width, height, scheme):  # noqa: F811
    opened = Page(browser, report, viewport={"width": width, "height": height}, color_scheme=scheme)
    picture = opened.picture()
    assert ink(picture) > 0.1
    assert opened.tab.evaluate("() => document.documentElement.scrollWidth") <= width
    ground = picture[:4].mean()
    assert ground < 60 if scheme == "dark" else ground > 200
    assert opened.errors == []
    opened.close()


@pytest.fixture
def served(tmp_path):
    rng = np.random.default_rng(3)
    points = np.vstack([building(seed) for seed in range(4)]) + [5e5, 4e6, 100.0]
    colours = rng.integers(0, 65535, (3, len(points))).astype(np.uint16)
    cloud = Cloud.from_points(points, red=colours[0], green=colours[1], blue=colours[2])
    write(cloud, tmp_path / "big.copc.laz")
    write(Cloud.from_points(np.vstack([building(9), BEACONS]) + [5e5, 4e6, 100.0]),
          tmp_path / "small.ply")  # fmt: skip
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    scene = prepare([tmp_path / "big.copc.laz", tmp_path / "small.ply"], scratch, lambda _: None)
    server = ViewServer(scene.things)
    yield server, scene
    server.close()


def test_view_streams_clouds_from_this_computer_only(browser, served):  # noqa: F811
    server, scene = served
    opened = Page(browser, server.url)
    assert all(url.startswith(server.url) for url in opened.requests if url[:5] != "data:")
    settled(opened)
    opened.tab.evaluate("() => { dougongViewer.state.setView('plan'); }")
    first = opened.picture()
    assert ink(first) > 0.1
    assert "temporary COPC copy" in scene.notes[0]
    opened.tab.get_by_label("small.ply").uncheck()
    assert change(first, opened.picture()) > 0.01
    opened.tab.get_by_label("small.ply").check()
    settled(opened)
    origin = np.array(opened.state("s.scene.origin"))
    opened.tab.evaluate("() => { dougongViewer.tools.choose('measure'); }")
    for beacon in BEACONS:
        local = beacon + [5e5, 4e6, 100.0] - origin
        x, y = opened.tab.evaluate("(p) => dougongViewer.project(...p)", local.tolist())
        opened.tab.mouse.click(x, y)
    result = opened.tab.evaluate("() => dougongViewer.measure.result")
    assert result["distance"] == pytest.approx(5.0, abs=2e-4)
    assert opened.errors == []
    opened.close()


LEGENDS = {
    "Source": ("scan <b>1</b>", "drone"),
    "Height": ("height above the ground",),
    "Natural": ("scan <b>1</b>: colours of the file",),
    "Distance": ("distance to the other cloud", "none within 250 mm"),
    "Class": ("ground",),
    "Removed": ("kept", "statistical"),
}


def test_every_colouring_has_its_legend(page):
    for name, words in LEGENDS.items():
        page.press("Colour", name)
        legend = page.tab.locator("#viewer .viewer-legend").inner_text()
        assert all(word in legend for word in words), (name, legend)


def test_the_legend_of_sources_is_one_line(page):
    """The report's own styles do not reach into the viewer."""
    legend = page.tab.locator("#viewer .viewer-legend").bounding_box()
    assert legend["height"] < 45


def test_removed_points_are_shown_where_the_reason_is_asked_for_and_only_there(page):
    sky = [3.0, -7.0, 8.0]

    def picked():
        return page.tab.evaluate(
            "(p) => { const [x, y] = dougongViewer.stage.project(p);"
            " return dougongViewer.stage.pick(x, y, 40)?.point[2] ?? null; }", sky,
        )  # fmt: skip

    page.press("View", "Front")
    assert (picked() or 0) < 7.5
    page.press("Colour", "Removed")
    assert picked() > 5.9


def test_the_cut_box_cuts_the_picture_and_its_grips_are_dragged(page):
    start = page.picture()
    page.press("View", "Front")
    before = page.picture()
    page.tab.locator("#viewer .cut-box").click()
    low, high = page.state("[s.box.low[2], s.box.high[2]]")
    page.tab.add_style_tag(content=".viewer .stage > .overlay { visibility: visible !important; }")
    page.tab.evaluate("() => dougongViewer.stage.draw()")
    grip = page.tab.get_by_label("upper side of the box, height").bounding_box()
    x, y = grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2
    pixels = page.tab.evaluate(
        "() => dougongViewer.stage.canvas.clientHeight / (2 * dougongViewer.stage.halfHeight)"
    )
    page.tab.mouse.move(x, y)
    page.tab.mouse.down()
    page.tab.mouse.move(x, y + 20)
    page.tab.mouse.move(x, y + 50)
    page.tab.mouse.up()
    assert page.state("s.box.high[2]") == pytest.approx(high - 50 / pixels, abs=2 / pixels)
    page.state(f"s.setBoxSide(2, 'high', {(low + high) / 2})")
    half = page.picture()
    assert ink(half) < 0.8 * ink(before)
    page.tab.get_by_label("lower side of the box, along").focus()
    along = page.state("s.box.low[0]")
    page.tab.keyboard.press("ArrowUp")
    assert page.state("s.box.low[0]") == pytest.approx(along + 0.1)
    size = page.tab.locator("#viewer .row:has(.whole-box) .where").inner_text()
    assert size.startswith("box ")
    assert size.endswith(f"× {(high - low) / 2:.2f} m")
    page.tab.get_by_role("button", name="Reset").click()
    assert change(start, page.picture()) < 0.002


def test_an_upright_section_runs_through_two_clicked_places(page):
    page.press("Thin slice", "Drawn")
    assert page.state("s.view") == "plan"
    places = [[-2.0, -8.0, 0.0], [8.0, -2.0, 0.0]]
    for place in places:
        x, y = page.tab.evaluate("(p) => dougongViewer.project(...p)", place)
        page.tab.mouse.click(x, y)
    assert page.state("s.slice") == "drawn"
    a, b = page.state("[s.line.a, s.line.b]")
    # A click takes the point that is there, some centimetres from where it was aimed.
    assert np.hypot(*(np.array(a) - places[0])[:2]) < 1.5
    normal = page.state("s.slab.normal")
    assert abs(np.dot(normal[:2], np.subtract(b, a)[:2])) < 1e-9
    cut = page.picture()
    assert 0.0005 < ink(cut) < 0.1
    page.canvas.focus()
    where = page.state("s.positionMetres")
    page.tab.keyboard.press("]")
    assert page.state("s.positionMetres") == pytest.approx(where + page.state("s.thickness") / 2)
    box = page.canvas.bounding_box()
    page.tab.mouse.move(box["x"] + 200, box["y"] + 200)
    page.tab.keyboard.down("Shift")
    page.tab.mouse.wheel(0, 120)
    page.tab.keyboard.up("Shift")
    page.tab.wait_for_function(
        "(was) => Math.abs(dougongViewer.state.positionMetres - was) < 1e-9", arg=where
    )


def test_a_slice_is_dragged_by_its_grip(page):
    page.press("Thin slice", "Level")
    page.press("View", "Front")
    start = page.state("s.positionMetres")
    grip = page.tab.get_by_label("move the slice").bounding_box()
    x, y = grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2
    page.tab.mouse.move(x, y)
    page.tab.mouse.down()
    page.tab.mouse.move(x, y - 40, steps=4)
    page.tab.mouse.up()
    per_metre = page.tab.evaluate(
        "() => dougongViewer.stage.canvas.clientHeight / (2 * dougongViewer.stage.halfHeight)"
    )
    assert page.state("s.positionMetres") - start == pytest.approx(40 / per_metre, rel=0.15)


def test_fit_brings_everything_into_the_picture(page):
    page.press("View", "Front")
    page.tab.evaluate("() => { const st = dougongViewer.stage; st.orthographic.zoom = 30;"
                      " st.controls.target.z += 40; st.camera.position.z += 40;"
                      " st.controls.update(); }")  # fmt: skip
    assert ink(page.picture()) < 0.01
    page.tab.locator("#viewer .fit").click()
    assert ink(page.picture()) > 0.05
    ends = page.tab.evaluate(
        "() => { const st = dougongViewer.stage; let out = 0, all = 0;"
        " st.sample(4000, (x, y, z) => { const [u, v] = st.project([x, y, z]); all += 1;"
        " if (u < 0 || v < 0 || u > st.canvas.clientWidth || v > st.canvas.clientHeight) out += 1;"
        " }); return out / all; }"
    )
    assert ends < 0.02


def test_a_parallel_view_snaps_to_the_side_that_it_is_near(page):
    page.press("View", "Front")
    turn = (
        "(deg) => { const st = dougongViewer.stage, t = st.controls.target,"
        " p = st.camera.position, a = deg * Math.PI / 180, x = p.x - t.x, y = p.y - t.y;"
        " p.set(t.x + x * Math.cos(a) - y * Math.sin(a), t.y + x * Math.sin(a) + y * Math.cos(a),"
        " p.z); st.controls.update(); dougongViewer.state.view = ''; dougongViewer.state.snap(); }"
    )
    page.tab.evaluate(turn, 3)
    assert page.state("s.view") == "front"
    page.tab.evaluate(turn, 20)
    assert page.state("s.view") == ""


def test_fingers_turn_and_measure(browser, report):  # noqa: F811
    opened = Page(browser, report, viewport={"width": 390, "height": 700}, has_touch=True)
    touch = "() => getComputedStyle(dougongViewer.stage.canvas).touchAction"
    assert opened.tab.evaluate(touch) == "pan-y", (
        "a finger on an untouched picture scrolls the page"
    )
    opened.press("View", "Plan")
    opened.tab.get_by_role("button", name="Measure").click()
    opened.canvas.scroll_into_view_if_needed()
    for beacon in BEACONS:
        x, y = opened.tab.evaluate("(p) => dougongViewer.project(...p)", beacon.tolist())
        opened.tab.touchscreen.tap(x, y)
    distance = opened.tab.evaluate("() => dougongViewer.measure.result.distance")
    assert distance == pytest.approx(5.0, abs=1e-6)
    assert opened.tab.evaluate(touch) == "none"
    assert opened.errors == []
    opened.close()
