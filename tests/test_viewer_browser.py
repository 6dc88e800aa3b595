"""The 3-D view in a real browser: what it draws, what its controls change, what it asks for.

Needs Playwright (the extra `browser`) and a Chromium of the system (or DOUGONG_CHROMIUM).
"""

import os
import shutil

import cv2
import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import write
from dougong.report.model import from_run
from dougong.report.render import render
from dougong.report.server import ViewServer
from dougong.report.streaming import prepare
from dougong.report.viewer import why_missing
from test_report import building, registration, run_result
from test_viewer import BEACONS, layers  # noqa: F401 - a fixture

CHROMIUM = os.environ.get("DOUGONG_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
# Software rendering: the same picture on every machine.
FLAGS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-gpu-sandbox", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
MISSING = why_missing()
pytestmark = [
    pytest.mark.skipif(MISSING is not None, reason=f"the viewer is not built: {MISSING}"),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium; install it or set DOUGONG_CHROMIUM"),
]


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="Playwright is missing: pip install 'dougong[browser]'"
    )
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


class Page:
    """A page with a viewer, and what went wrong or out while it was open."""

    def __init__(self, browser, url, **options):
        self.context = browser.new_context(
            **{"viewport": {"width": 900, "height": 600}, "reduced_motion": "reduce"} | options
        )
        self.tab = self.context.new_page()
        self.errors, self.requests = [], []
        self.tab.on("pageerror", lambda error: self.errors.append(str(error)))
        self.tab.on("console", lambda said: self.errors.append(said.text)
                    if said.type == "error" else None)  # fmt: skip
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(url)
        self.tab.wait_for_selector("html.viewer-ready", state="attached", timeout=60_000)
        self.canvas = self.tab.locator("#viewer canvas")
        self.canvas.scroll_into_view_if_needed()

    def state(self, words):
        return self.tab.evaluate(f"() => {{ const s = dougongViewer.state; return {words}; }}")

    def press(self, group, name):
        self.tab.get_by_role("group", name=group).get_by_role(
            "button", name=name, exact=True
        ).click()

    def picture(self):
        """Return the canvas alone as (h, w, 3), without what lies over it."""
        self.tab.add_style_tag(content=".viewer .stage > :not(canvas) { visibility: hidden; }")
        self.tab.evaluate("() => dougongViewer.stage.draw()")
        self.tab.evaluate("() => new Promise((done) => requestAnimationFrame(() => "
                          "requestAnimationFrame(done)))")  # fmt: skip
        data = np.frombuffer(self.canvas.screenshot(), dtype=np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_COLOR).astype(np.int64)

    def close(self):
        self.context.close()


def ink(picture):
    """Return the share of pixels that are not the ground's colour."""
    ground = np.median(picture[:8].reshape(-1, 3), axis=0)
    return float((np.abs(picture - ground).sum(axis=2) > 40).mean())


def change(first, second):
    return float((np.abs(first - second).sum(axis=2) > 40).mean())


@pytest.fixture(scope="module")
def report(layers, tmp_path_factory):  # noqa: F811 - the fixture
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render(from_run(run_result(registration()), None), layers), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def page(browser, report):
    opened = Page(browser, report)
    yield opened
    assert opened.errors == []
    assert [url for url in opened.requests if not url.startswith(("file:", "data:"))] == []
    opened.close()


def test_the_report_draws_and_every_colouring_looks_different(page):
    pictures = {}
    for name in ("Source", "Height", "Natural", "Distance", "Class"):
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
    for view in ("Plan", "Front", "Side"):
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
    assert result["rise"] == pytest.approx(4.0, abs=1e-6)
    words = page.tab.locator("#viewer .readout").inner_text()
    assert words.startswith("5.000 m")
    assert "500003.000 3999993.000 107.000" in words
    assert "scan <b>1</b>" in words
    page.canvas.focus()
    page.tab.keyboard.press("Escape")
    assert page.tab.evaluate("() => dougongViewer.measure.result") is None


def test_keys_work_and_are_listed(page):
    page.canvas.focus()
    for key, asked, answer in (("2", "s.view", "plan"), ("c", "s.colour", "height"),
                               ("s", "s.slice", "level"), ("l", "s.stage.lighting", False),
                               ("r", "s.slice", "off")):  # fmt: skip
        page.tab.keyboard.press(key)
        assert page.state(asked) == answer, key
    page.tab.keyboard.press("?")
    assert page.tab.get_by_role("dialog").is_visible()


def test_print_shows_the_stills_and_not_the_viewer(page):
    assert not page.tab.locator(".stills").is_visible()
    page.tab.emulate_media(media="print")
    assert page.tab.locator(".stills").is_visible()
    assert not page.tab.locator("#viewer").is_visible()


@pytest.mark.parametrize(("width", "height", "scheme"), [(390, 844, "dark"), (2560, 1440, "light")])
def test_it_fits_a_phone_and_a_large_screen(browser, report, width, height, scheme):
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


def test_view_streams_clouds_from_this_computer_only(browser, served):
    server, scene = served
    opened = Page(browser, server.url)
    assert all(url.startswith(server.url) for url in opened.requests if url[:5] != "data:")
    for _ in range(40):
        opened.tab.wait_for_timeout(250)
        if opened.tab.evaluate("() => dougongViewer.streamer.isDone === true"):
            break
    opened.tab.evaluate("() => { dougongViewer.state.setView('plan'); }")
    first = opened.picture()
    assert ink(first) > 0.1
    assert "temporary COPC copy" in scene.notes[0]
    opened.tab.get_by_label("small.ply").uncheck()
    assert change(first, opened.picture()) > 0.01
    opened.tab.get_by_label("small.ply").check()
    origin = np.array(opened.state("s.scene.origin"))
    opened.tab.evaluate("() => { dougongViewer.measure.setOn(true); }")
    for beacon in BEACONS:
        local = beacon + [5e5, 4e6, 100.0] - origin
        x, y = opened.tab.evaluate("(p) => dougongViewer.project(...p)", local.tolist())
        opened.tab.mouse.click(x, y)
    result = opened.tab.evaluate("() => dougongViewer.measure.result")
    assert result["distance"] == pytest.approx(5.0, abs=2e-4)
    assert opened.errors == []
    opened.close()
