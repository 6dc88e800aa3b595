"""The maps of the report: colours for every eye, and that each picture shows what is there."""

import re

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.formats import write_merged
from dougong.report.coverage import coverage
from dougong.report.figures import find_place
from dougong.report.layers import BLUE, COLOURS, Layer
from dougong.report.maps import (
    UNTOLD,
    Sheet,
    amount_colours,
    axes_of,
    lay_sheet,
    medians,
    signed_colours,
    signed_scale,
    signs,
)
from dougong.report.poses import rival_poses, score_chart
from dougong.report.removal import removals, surface_m2

# Machado, Oliveira and Fernandes 2009, severity 1.0, linear RGB.
EYES = {
    "usual": np.eye(3),
    "protan": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                        [-0.003882, -0.048116, 1.051998]]),
    "deutan": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                        [-0.011820, 0.042940, 0.968881]]),
    "tritan": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                        [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip


def lab(colours, eye):
    """Return CIELAB (D65) of sRGB bytes as an eye sees them."""
    share = np.asarray(colours, float) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear @ EYES[eye].T, 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722],
                       [0.0193, 0.1192, 0.9505]])  # fmt: skip
    xyz = linear @ to_xyz.T / [0.95047, 1.0, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1
    )


@pytest.mark.parametrize("eye", EYES)
def test_both_sides_of_the_signed_map_are_told_apart_by_every_eye(eye):
    sizes = np.linspace(0.3, 1.0, 8)
    above, below = (lab(signed_colours(side * sizes, 1.0), eye) for side in (1.0, -1.0))
    grey = lab(np.array([UNTOLD]), eye)
    assert np.linalg.norm(above - below, axis=1).min() > 20
    assert np.linalg.norm(above - grey, axis=1).min() > 9
    assert np.linalg.norm(below - grey, axis=1).min() > 9
    for side in (above, below):
        assert (np.diff(side[:, 0]) < 0).all()


@pytest.mark.parametrize("eye", EYES)
def test_amounts_get_darker_for_every_eye(eye):
    assert (np.diff(lab(amount_colours(np.linspace(0, 1, 12), 1.0), eye)[:, 0]) < 0).all()


@pytest.mark.parametrize("eye", EYES)
def test_clouds_are_told_apart_by_every_eye(eye):
    first, second = lab(np.array([BLUE, COLOURS[0]]), eye)
    assert np.linalg.norm(first - second) > 30


def test_cells_hold_the_median_of_their_points_and_up_is_up():
    points = np.array([[0.1, 0.1, 0], [0.2, 0.2, 0], [0.3, 0.3, 0], [2.5, 3.5, 0]])
    sheet = Sheet(right=np.array([1.0, 0, 0]), up=np.array([0, 1.0, 0]), low=np.zeros(2),
                  cell_m=1.0, columns=4, rows=5)  # fmt: skip
    cells = sheet.cells(points)
    values = medians(cells, np.array([3.0, 1.0, 2.0, np.nan]), sheet.rows * sheet.columns)
    assert values[cells[0]] == 2.0
    assert np.isnan(values[cells[3]])
    assert cells[3] // sheet.columns < cells[0] // sheet.columns
    assert cells[3] % sheet.columns > cells[0] % sheet.columns
    assert sheet.cells(np.array([[99.0, 0, 0]])).tolist() == [-1]


def test_one_who_stands_south_of_a_facade_has_east_on_the_right():
    right, up = axes_of(np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(up, [0, 0, 1])


def test_signs_stand_where_cells_agree_and_nowhere_else():
    points = np.stack(np.meshgrid(np.arange(60.0), np.arange(60.0)), -1).reshape(-1, 2)
    points = np.column_stack([points, np.zeros(len(points))])
    sheet = lay_sheet(points, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 1.0)
    values = np.full(sheet.rows * sheet.columns, np.nan)
    values[sheet.cells(points)] = np.where(points[:, 0] < 30, 1.0, -1.0)
    svg = signs(sheet, values, np.isfinite(values))
    found = [(float(x), sign) for x, sign in re.findall(r'x="(\d+)"[^>]*>(.)<', svg)]
    middle = 31 * sheet.pixels
    assert len(found) > 100
    assert all(sign == "+" for x, sign in found if x < middle - 60)
    assert all(sign == "−" for x, sign in found if x > middle + 60)
    rng = np.random.default_rng(0)
    values[np.isfinite(values)] = rng.choice([-1.0, 1.0], np.isfinite(values).sum())
    assert signs(sheet, values, np.isfinite(values)).count("<text") < 5


def test_the_lines_of_the_key_lie_inside_it_and_apart_even_in_large_letters():
    svg = signed_scale(0.02, 0.005, "a", "b")
    height = float(re.search(r'viewBox="0 0 \d+ (\d+)"', svg)[1])
    lines = sorted({float(y) for y in re.findall(r'<text x="[^"]*" y="(\d+)"', svg)})
    letters = 21.0  # of a narrow page
    assert lines[0] >= 0.8 * letters
    assert lines[-1] + 0.3 * letters <= height
    assert min(np.diff(lines)) >= letters


def test_names_in_the_key_are_escaped():
    assert "<img" not in signed_scale(0.02, 0.005, "<img src=x> behind", "b")


def poses(*yaws_shifts):
    result = []
    for rank, (yaw, shift) in enumerate(yaws_shifts):
        turn, matrix = np.radians(yaw), np.eye(4)
        matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        matrix[0, 3] = shift
        result.append({"matrix": matrix.tolist(), "yaw_deg": float(yaw), "score": 0.8 - 0.1 * rank})
    return tuple(result)


def test_only_poses_that_differ_are_drawn():
    listed = poses((0, 0), (1, 0.1), (90, 0), (91, 0.2), (0, 3.0), (180, 0))
    assert rival_poses(listed, np.zeros((1, 3))) == [0, 2, 4]


def test_the_score_chart_has_a_mark_for_every_pose_at_its_yaw():
    svg = score_chart(poses((0, 0), (90, 0), (-180, 0)), 0.125)
    assert svg.count('class="rival"') == 2
    best = float(re.search(r'<circle class="best" cx="([\d.]+)"', svg)[1])
    stems = [float(x) for x in re.findall(r'class="stem rival" d="M([\d.]+)', svg)]
    assert max(stems) - best == pytest.approx((best - min(stems)) / 2, abs=0.5)
    assert "margin 0.12" in svg


def wall(x0, x1, y, seed, count):
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(x0, x1, count), np.full(count, y), rng.uniform(0, 4, count)]
    ) + rng.normal(0, 0.002, (count, 3))


def test_a_wall_that_only_the_drone_saw_is_named_with_its_size_and_place():
    rng = np.random.default_rng(9)
    ground = np.column_stack([rng.uniform(-12, 12, (20_000, 2)), np.zeros(20_000)])
    scan = np.vstack([wall(-6, 0, 4.0, 0, 20_000), wall(-6, 6, -4.0, 1, 40_000)])
    drone = np.vstack([wall(-6, 6, 4.0, 2, 12_000), wall(-6, 6, -4.0, 3, 12_000), ground])
    origin = np.array([500_000.0, 4_000_000.0, 100.0])
    layers = [
        Layer(name=name, colour=COLOURS[0], after=xyz, before=xyz, is_reference=name == "drone",
              is_sure=True, origin=origin)
        for name, xyz in (("scan", scan), ("drone", drone))
    ]  # fmt: skip
    result = {
        "clouds": [
            {"name": "scan", "kind": "lidar", "points_out": len(scan)},
            {"name": "drone", "kind": "photogrammetry", "points_out": len(drone)},
        ]
    }
    found = coverage(layers, result, find_place(layers))
    size, x, y = map(float, re.match(r"(\d+) m² around x ([\d.]+), y ([\d.]+)",
                                     found.places[0]).groups())  # fmt: skip
    assert size == pytest.approx(24.0, abs=4.0)
    assert x == pytest.approx(500_003.0, abs=0.6)
    assert y == pytest.approx(4_000_004.0, abs=0.6)
    assert {row[0]: row[2] for row in found.scales}["1:20"] == "0 %"
    assert any("crosses" in figure.caption for figure in found.maps)
    result["clouds"][0]["kind"] = "photogrammetry"
    assert coverage(layers, result, find_place(layers)) is None


def test_surface_is_counted_in_square_metres():
    layer = Layer(name="a", colour=BLUE, after=wall(0, 10, 0.125, 0, 50_000), before=None,
                  is_reference=True, is_sure=True)  # fmt: skip
    assert surface_m2(layer) == pytest.approx(40.0, rel=0.12)


def test_the_map_of_removed_points_weighs_each_file_by_its_own_sample(tmp_path, monkeypatch):
    """Each file's sample ends at the same number of points, however many were taken out of it."""
    rng = np.random.default_rng(0)
    low, high = (rng.uniform([x, 1, 0], [x + 0.4, 1.4, 2], (100, 3)) for x in (1.0, 8.0))
    (tmp_path / "removed").mkdir()
    files = [Cloud.from_points(points) for points in (low, high)]
    write_merged(files, tmp_path / "removed" / "scan.laz", source_ids=[1, 1])
    layer = Layer(
        name="scan", colour=BLUE, after=rng.uniform([0, 0, 0], [10, 3, 0], (4000, 3)),
        before=np.zeros((0, 3)), is_reference=False, is_sure=True, origin=np.zeros(3),
    )  # fmt: skip
    drawn = []
    monkeypatch.setattr(
        "dougong.report.removal.amount_colours",
        lambda amount, limit: drawn.append(amount) or amount_colours(amount, limit),
    )
    taken = {"name": "scan", "reasons": {"kept": 4000, "statistical": 1200}, "points_in": 5200}
    by_file = [{"removed": 1000, "shown": 100}, {"removed": 0, "shown": 0},
               {"removed": 200, "shown": 100}]  # fmt: skip
    for cloud, ratio in ((taken | {"removed_by_file": by_file}, 5.0), (taken, 1.0)):
        removals(tmp_path, {"clouds": [cloud]}, [layer])
        sheet = lay_sheet(layer.after, np.eye(3)[0], np.eye(3)[1], 0.5, most=220)
        amount = np.array(drawn.pop()).reshape(sheet.rows, sheet.columns)
        half = sheet.columns // 2
        assert amount[:, :half].sum() / amount[:, half:].sum() == pytest.approx(ratio)
        assert amount.sum() * sheet.cell_m**2 == pytest.approx(1200)
