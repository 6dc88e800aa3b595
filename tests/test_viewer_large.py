"""Large clouds in the browser: how soon there is a picture, and what it took.

Seconds are of the processor, over all of the browser's processes: the clock on the wall also
measures what else the machine does. Software rendering may use two cores for the five seconds that
a reader is made to wait.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import write
from dougong.report.layers import BLUE, COLOURS, Layer
from dougong.report.model import from_run
from dougong.report.render import render
from dougong.report.server import ViewServer
from dougong.report.streaming import prepare
from test_report import registration, run_result
from viewer_page import NEEDED, Page, browser, change, ink, settled  # noqa: F401 - a fixture

pytestmark = NEEDED
READY_CPU_SECONDS = 10.0


def descendants_cpu():
    """Return the processor seconds of all processes that this one started, and theirs."""
    if not Path("/proc/self/stat").is_file():
        pytest.skip("this system tells no processor times of other processes")
    children, spent = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            numbers = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue  # it has just ended
        process = int(stat.parent.name)
        children.setdefault(int(numbers[1]), []).append(process)
        spent[process] = sum(map(int, numbers[11:15])) / os.sysconf("SC_CLK_TCK")
    total, todo = 0.0, [os.getpid()]
    while todo:
        for process in children.get(todo.pop(), []):
            total += spent[process]
            todo.append(process)
    return total


def village(rng, count):
    """Return points (count, 3) of sixteen houses on a field, 4 mm of noise."""
    houses = [(30.0 * (k % 4), 40.0 * (k // 4)) for k in range(16)]
    sides = [
        ((0, 0, 0), (20, 0, 0), (0, 0, 8)), ((0, 12, 0), (20, 0, 0), (0, 0, 8)),
        ((0, 0, 0), (0, 12, 0), (0, 0, 8)), ((20, 0, 0), (0, 12, 0), (0, 0, 8)),
        ((0, 0, 8), (20, 0, 0), (0, 6, 4)), ((0, 12, 8), (20, 0, 0), (0, -6, 4)),
    ]  # fmt: skip
    parts = [(np.array([-20.0, -20, 0]), np.array([150.0, 0, 0]), np.array([0, 190.0, 0]))]
    for x, y in houses:
        parts += [(np.add((x, y, 0), c), np.array(u, float), np.array(v, float))
                  for c, u, v in sides]  # fmt: skip
    each = np.full(len(parts), count // (len(parts) + 15))
    each[0] = count - each[1:].sum()
    points = np.empty((count, 3))
    at = 0
    for (corner, u, v), number in zip(parts, each, strict=True):
        share = rng.random((number, 2))
        points[at : at + number] = corner + share[:, :1] * u + share[:, 1:] * v
        at += number
    points += rng.normal(0, 0.004, points.shape)
    return points


def test_a_full_report_is_ready_in_time_and_small_enough(browser, tmp_path):  # noqa: F811
    rng = np.random.default_rng(1)
    layers = []
    for name, colour in (("scan", COLOURS[0]), ("drone", BLUE)):
        points = village(rng, 500_000)
        layers.append(
            Layer(name=name, colour=colour, after=points, before=points,
                  is_reference=name == "drone", is_sure=True,
                  colours=rng.integers(0, 255, points.shape).astype(np.uint8))
        )  # fmt: skip
    path = tmp_path / "report.html"
    path.write_text(render(from_run(run_result(registration()), None), layers), encoding="utf-8")
    assert path.stat().st_size < 15e6
    before = descendants_cpu()
    page = Page(browser, path.as_uri(), viewport={"width": 1280, "height": 800})
    assert page.tab.evaluate("() => dougongViewer.points") > 380_000
    picture = page.picture()
    spent = descendants_cpu() - before
    assert ink(picture) > 0.1
    assert spent < READY_CPU_SECONDS, f"{spent:.1f} s of the processor"
    assert page.errors == []
    page.close()


@pytest.mark.slow
def test_the_first_picture_of_ten_million_points_takes_a_twentieth_of_the_file(
    browser, tmp_path  # noqa: F811
):  # fmt: skip
    rng = np.random.default_rng(2)
    points = village(rng, 10_000_000) + [5e5, 4e6, 100.0]
    path = tmp_path / "big.copc.laz"
    write(Cloud.from_points(points), path)
    del points
    size = path.stat().st_size
    server = ViewServer(prepare([path], tmp_path, lambda _: None).things)
    page = Page(browser, server.url)
    first = page.tab.evaluate("() => dougongViewer.first")
    assert 0 < first["bytes"] < 0.05 * size
    coarse = page.picture()
    assert ink(coarse) > 0.2
    settled(page, 60)
    # What the page counts is what the server has sent.
    assert server.bytes_sent == page.tab.evaluate("() => dougongViewer.stats.bytes")
    assert server.bytes_sent < 0.25 * size
    assert 0 < page.tab.evaluate("() => dougongViewer.points") <= 500_000
    before = server.bytes_sent
    page.press("Thin slice", "Level")
    settled(page, 60)
    walls = page.picture()
    assert 0.0005 < ink(walls) < 0.1
    assert server.bytes_sent > before, "a slice shows finer points than the whole did"
    assert change(coarse, walls) > 0.1
    assert page.errors == []
    page.close()
    server.close()
