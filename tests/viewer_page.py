"""A viewer's page in a headless Chromium, for the tests of the 3-D view.

Needs Playwright (the extra `browser`) and a Chromium of the system (or DOUGONG_CHROMIUM).
"""

import os
import shutil

import cv2
import numpy as np
import pytest

from dougong.report.viewer import why_missing

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
NEEDED = [
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


def settled(page, seconds=20):
    """Wait until a page of `dougong view` has read all that its picture wants."""
    for _ in range(4 * seconds):
        # Drawn first: a picture that has changed since is asked for only when it is drawn.
        if page.tab.evaluate(
            "() => { dougongViewer.stage.draw(); return dougongViewer.streamer.isDone === true; }"
        ):
            return
        page.tab.wait_for_timeout(250)
    raise AssertionError("the streamer did not come to rest")
