"""Manual rescue in a real browser: pairs picked in two clouds, their fit, and their file."""

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import write
from dougong.pipeline.pairs import read_pairs
from dougong.registration.picked_pairs import bad_pair, fit_rigid
from dougong.report.server import ViewServer
from dougong.report.streaming import prepare
from registration_sites import motion, moved
from test_report import building
from viewer_page import NEEDED, Page, browser  # noqa: F401 - a fixture

pytestmark = NEEDED

TRUTH = motion(70.0, shift=(5e5, 4e6, 100.0))
MARKS = np.array([[-5.0, -6, 7], [5, -6, 8], [5, 3, 7.5], [-5, 6, 9], [1, -2, 11]])
"""Lone points above the building, which a click finds."""


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rescue")
    points = np.vstack([building(0), MARKS])
    write(Cloud.from_points(points), folder / "scan.copc.laz")
    write(Cloud.from_points(moved(points, TRUTH)), folder / "drone.copc.laz")
    return folder / "scan.copc.laz", folder / "drone.copc.laz"


@pytest.fixture
def rescue(browser, clouds, tmp_path):  # noqa: F811 - the fixture
    """Two clouds side by side, nothing picked yet; the page, and the file for the pairs."""
    scene = prepare(clouds, tmp_path, lambda _: None, tmp_path / "pairs.csv")
    server = ViewServer(scene.things, takes=scene.takes)
    page = opened(browser, server)
    yield page, tmp_path / "pairs.csv", server
    assert page.errors == []
    assert [u for u in page.requests if not u.startswith((server.url, "data:", "blob:"))] == []
    page.close()
    server.close()


def opened(browser, server, **options):  # noqa: F811 - the fixture
    page = Page(browser, server.url, **{"viewport": {"width": 1500, "height": 700}} | options)
    page.tab.locator(".pick-pairs").click()
    ready = "s => dougongViewer.rescue.panes[s].streamer.isDone"
    page.tab.wait_for_function(
        f"() => dougongViewer.rescue && ['source', 'target'].every({ready})", timeout=60_000
    )
    page.press("View", "Plan")
    return page


def click(page, side, place):
    """Click a place (file coordinates) in one pane."""
    x, y = page.tab.evaluate(
        "([side, place]) => { const p = dougongViewer.rescue.panes[side];"
        " const b = p.stage.canvas.getBoundingClientRect();"
        " const [x, y] = p.stage.project(p.toLocal(place)); return [b.left + x, b.top + y]; }",
        [side, list(place)],
    )
    page.tab.mouse.click(x, y)


def pick(page, source, target):
    click(page, "source", MARKS[source])
    click(page, "target", moved(MARKS, TRUTH)[target])


def words(page):
    return page.tab.locator("#viewer .verdict").inner_text()


def test_pairs_are_picked_judged_removed_and_saved(rescue):
    page, file, _ = rescue
    save = page.tab.get_by_role("button", name="Save")
    assert save.is_disabled()
    assert "0 of at least 3 pairs" in words(page)
    for index in range(3):
        pick(page, index, index)
    assert "A fourth pair would show a bad one" in words(page)
    pick(page, 3, 3)
    pick(page, 4, 1)
    rows = page.tab.locator("#viewer .pairs li")
    assert rows.count() == 5
    assert "does not fit" in rows.nth(4).inner_text()
    assert "p5 does not fit the others" in words(page)
    fit = page.tab.evaluate(
        "() => { const f = dougongViewer.rescue.fit; return [f.residuals, f.bad]; }"
    )
    source, target = MARKS[[0, 1, 2, 3, 4]], moved(MARKS, TRUTH)[[0, 1, 2, 3, 1]]
    miss = np.linalg.norm(moved(source, fit_rigid(source, target)) - target, axis=1)
    assert fit[0] == pytest.approx(miss.tolist(), abs=2e-3)
    assert fit[1] == bad_pair(source, target) == 4
    page.tab.get_by_label("remove p5").click()
    assert rows.count() == 4
    assert "does not fit" not in words(page)
    save.click()
    page.tab.wait_for_function("() => dougongViewer.rescue.message")
    said = page.tab.locator("#viewer .message").inner_text()
    assert f"4 pairs saved in {file}" in said
    assert "dougong register" in said
    assert str(file) in said.splitlines()[1]
    found = read_pairs(file, "scan")
    assert found.names == ("p1", "p2", "p3", "p4")
    assert found.source == pytest.approx(MARKS[:4], abs=1e-3)
    assert found.target == pytest.approx(moved(MARKS, TRUTH)[:4], abs=1e-3)


def test_a_click_beside_every_point_picks_nothing_and_undo_takes_back(rescue):
    page, _, _ = rescue
    page.tab.mouse.click(250, 4)
    assert "no point there" in page.tab.locator("#viewer .readout").nth(0).inner_text()
    assert page.state("dougongViewer.rescue.pending.source ?? null") is None
    click(page, "source", MARKS[0])
    prompts = page.tab.locator("#viewer .readout")
    assert "now the same place in drone.copc.laz" in prompts.nth(0).inner_text()
    assert "click the same place here" in prompts.nth(1).inner_text()
    page.tab.get_by_role("button", name="Undo").click()
    assert page.state("dougongViewer.rescue.pending.source ?? null") is None
    for index in range(3):
        pick(page, index, index)
    page.tab.get_by_role("button", name="Undo").click()
    assert page.tab.locator("#viewer .pairs li").count() == 2


@pytest.mark.parametrize("view", ["Corner", "Plan"])
def test_the_target_is_shown_as_the_source_is(rescue, view):
    page, _, _ = rescue
    for index in range(4):
        pick(page, index, index)
    page.press("View", view)
    page.state("dougongViewer.rescue.goTo(1)")
    page.tab.get_by_role("button", name="Same view").click()
    beside = MARKS[1] + [0.3, 0.2, -0.2]
    seen = page.tab.evaluate(
        "(places) => ['source', 'target'].map((side, k) => {"
        " const p = dougongViewer.rescue.panes[side];"
        " return p.stage.project(p.toLocal(places[k])).slice(0, 2); })",
        [beside.tolist(), moved(beside[None], TRUTH)[0].tolist()],
    )
    assert seen[0] == pytest.approx(seen[1], abs=2)


def test_back_asks_before_pairs_are_lost_and_the_viewer_returns(rescue):
    page, _, _ = rescue
    for index in range(3):
        pick(page, index, index)
    asked = []

    def answer(dialog):
        asked.append(dialog.message)
        dialog.accept()

    page.tab.on("dialog", answer)
    page.tab.get_by_role("button", name="Leave").click()
    page.tab.wait_for_function("() => !dougongViewer.rescue")
    assert "not saved" in asked[0]
    assert page.tab.locator(".pick-pairs").is_visible()


def test_without_a_file_the_pairs_are_a_download(browser, clouds, tmp_path):  # noqa: F811
    server = ViewServer(prepare(clouds, tmp_path, lambda _: None).things)
    page = opened(browser, server, accept_downloads=True)
    for index in range(3):
        pick(page, index, index)
    with page.tab.expect_download() as waited:
        page.tab.get_by_role("button", name="Save as CSV").click()
    path = tmp_path / "down.csv"
    waited.value.save_as(path)
    assert read_pairs(path, "scan").source == pytest.approx(MARKS[:3], abs=1e-3)
    assert path.read_text().startswith("name,cloud,source_x")
    assert page.errors == []
    page.close()
    server.close()


def test_on_a_phone_one_cloud_is_seen_at_a_time(browser, clouds, tmp_path):  # noqa: F811
    server = ViewServer(prepare(clouds, tmp_path, lambda _: None).things)
    page = opened(browser, server, viewport={"width": 390, "height": 844})
    canvases = page.tab.locator("#viewer .panes canvas")
    assert [canvases.nth(k).is_visible() for k in (0, 1)] == [True, False]
    click(page, "source", MARKS[0])
    page.tab.wait_for_timeout(200)
    assert [canvases.nth(k).is_visible() for k in (0, 1)] == [False, True]
    click(page, "target", moved(MARKS, TRUTH)[0])
    assert page.tab.locator("#viewer .pairs li").count() == 1
    assert [canvases.nth(k).is_visible() for k in (0, 1)] == [True, False]
    page.close()
    server.close()
