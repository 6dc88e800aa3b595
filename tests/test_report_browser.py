"""Whole reports in a real browser: ready, quiet, within its width, a certificate on one page.

Needs Playwright (the extra `browser`) and a Chromium of the system (or DOUGONG_CHROMIUM). One scene
by default; DOUGONG_TEST_SCENES names others, of hall, pagoda, tulou, wall, cave, nuyda (a scanned
real mesh) and espacio (halves of a real flight), with spaces between, or `all`.
"""

import os

import numpy as np
import pytest

from dougong.app import run_project
from dougong.cloud import Cloud
from dougong.evaluation.mesh import load_mesh
from dougong.evaluation.scenes import make_scene, scan_mesh
from dougong.formats import read, write
from dougong.pipeline.progress import Silent
from viewer_page import NEEDED, Page, browser  # noqa: F401 - a fixture

pytestmark = NEEDED
ALL = "hall pagoda tulou wall cave nuyda espacio"
ASKED = os.environ.get("DOUGONG_TEST_SCENES", "hall")
SCENES = (ALL if ASKED == "all" else ASKED).split()
HOSTILE = "<img src=x onerror=alert(1)>"
A4_PX = (180 / 25.4 * 96, 269 / 25.4 * 96)
"""Width and height inside the margins of the print style sheet."""
MOST_BYTES = 15_000_000


def survey(name, data):
    """Return two clouds of a scene, small."""
    counts = {"lidar_points": 150_000, "photogrammetry_points": 100_000}
    if name == "nuyda":
        made = scan_mesh(*load_mesh(data / "nuyda_house" / "nuyda.ply"), name=name, **counts)
        return made.lidar, made.photogrammetry
    if name == "espacio":
        cloud = read(data / "espacio_escultorico" / "espacio_escultorico_uav_lod3.laz")
        cloud = cloud.select(np.arange(0, len(cloud), 3))
        along = cloud.xyz[:, 0] - np.median(cloud.xyz[:, 0])
        turn = np.radians(30.0)
        first = cloud.select(along < 60.0).xyz
        c, s = np.cos(turn), np.sin(turn)
        return Cloud.from_points(first @ [[c, s, 0], [-s, c, 0], [0, 0, 1]]), cloud.select(
            along > -60.0
        )
    made = make_scene(name, **counts)
    return made.lidar, made.photogrammetry


@pytest.fixture(scope="module", params=SCENES)
def result(request, tmp_path_factory):
    """The folder of a run on files with a hostile name."""
    data = request.getfixturevalue("data") if request.param in ("nuyda", "espacio") else None
    folder = tmp_path_factory.mktemp(request.param)
    source, target = survey(request.param, data)
    files = folder / f"{HOSTILE}.laz", folder / "drone & co.laz"
    for file, cloud in zip(files, (source, target), strict=True):
        write(cloud, file)
    kinds = {"lidar": [files[0]], "photogrammetry": [files[1]]}
    if request.param == "espacio":
        kinds = {"lidar": [], "photogrammetry": [files[1], files[0]]}
    run_project(
        None, folder / "out", **kinds, full_resolution=False, merge=None, overwrite=False,
        work=None, memory_bytes=None, progress=Silent(),
    )  # fmt: skip
    return folder / "out"


@pytest.fixture(scope="module")
def page(browser, result):  # noqa: F811 - the fixture
    opened = Page(browser, (result / "report.html").as_uri(), viewport={"width": 1440,
                                                                        "height": 900})  # fmt: skip
    yield opened
    assert opened.errors == []
    assert [url for url in opened.requests if not url.startswith(("file:", "data:"))] == []
    opened.close()


def test_the_page_is_small_whole_and_a_hostile_file_name_does_nothing(page, result):
    said = []
    page.tab.on("dialog", lambda dialog: (said.append(dialog.message), dialog.dismiss()))
    assert (result / "report.html").stat().st_size < MOST_BYTES
    assert page.tab.locator("img").count() == 0
    assert HOSTILE in page.tab.inner_text("body")
    for section in ("residuals", "coverage"):
        shown = page.tab.locator(f"section.{section}").count()
        assert shown == (0 if section == "coverage" and "espacio" in str(result) else 1), section
    assert page.tab.locator("section.residuals .plate svg").count() >= 1
    assert page.tab.locator("svg.scores").count() == 1
    assert page.tab.evaluate("() => [...document.querySelectorAll('svg[role=img]')].every("
                             "(svg) => svg.getAttribute('aria-label'))")  # fmt: skip
    assert said == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1440, 3840])
def test_nothing_is_wider_than_the_window_and_words_stand_out(page, width, scheme):
    page.tab.set_viewport_size({"width": width, "height": 900})
    page.tab.emulate_media(color_scheme=scheme)
    assert page.tab.evaluate("() => document.documentElement.scrollWidth - innerWidth") <= 0
    contrast = page.tab.evaluate(
        """() => {
        const light = (text) => {
          const [r, g, b] = text.match(/[\\d.]+/g).map((v) => {
            const s = v / 255; return s <= 0.03928 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4;
          });
          return 0.2126 * r + 0.7152 * g + 0.0722 * b;
        };
        const ground = (node) => {
          const own = getComputedStyle(node).backgroundColor;
          return own === 'rgba(0, 0, 0, 0)' && node.parentElement
            ? ground(node.parentElement) : own;
        };
        const nodes = document.querySelectorAll('body > :not(.three) :is(p, td, th, h2, h3, dd)');
        return Math.min(...[...nodes].filter((n) => n.innerText?.trim()).map((node) => {
          const a = light(getComputedStyle(node).color), b = light(ground(node));
          return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
        }));
      }"""
    )
    assert contrast > 4.5


def test_the_certificate_fills_one_page_and_the_annex_follows(page):
    width, height = A4_PX
    page.tab.set_viewport_size({"width": int(width), "height": int(height)})
    page.tab.emulate_media(media="print")
    end = page.tab.evaluate(
        "() => document.querySelector('.certificate').getBoundingClientRect().bottom + scrollY"
    )
    assert page.tab.locator(".first .plate").is_visible()
    assert not page.tab.locator("#viewer").is_visible()
    assert 0.5 * height < end <= height
    assert "Signature" in page.tab.inner_text(".certificate")
    after = page.tab.locator(".certificate").evaluate("(e) => getComputedStyle(e).breakAfter")
    assert after == "page"
