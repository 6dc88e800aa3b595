"""The studies of the paper's tables and figures: that they measure what they say."""

import json
import os
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest

from dougong.cli import call
from dougong.evaluation import building_runs, coarse_trials, registration_peers
from dougong.evaluation.apart import apart
from dougong.evaluation.metrics import pose_errors
from dougong.evaluation.scenes import make_scene
from dougong.evaluation.studies import (
    Setting,
    buildings,
    coarse,
    filtering,
    growth,
    objects,
    peers,
    storage,
)
from dougong.evaluation.studies.coarse_figure import draw_coarse
from dougong.evaluation.studies.objects_figure import draw_objects
from dougong.evaluation.tabulate import as_text, spread


@pytest.mark.parametrize("pair", building_runs.PAIRS)
def test_pairs_are_drawn_by_seed_and_their_truth_lays_one_on_the_other(pair):
    made = building_runs.PAIRS[pair]("hall", 1, 5_000)
    errors = pose_errors(made.truth.T_best, made.truth)
    assert errors.tre95_m < 1e-6
    if made.is_scan:
        assert errors.bending_floor95_m < 1e-6
    else:
        assert 0.001 < errors.bending_floor95_m < 0.05
    again = building_runs.PAIRS[pair]("hall", 1, 5_000)
    np.testing.assert_array_equal(made.target.xyz, again.target.xyz)


def building_row(seed, **values):
    usual = {"pair": "two scanners", "building": "hall", "seed": seed, "status": "ok"}
    usual |= dict.fromkeys(buildings.FIGURES, 2.0)
    usual |= {
        f"{name}_points_{when}": 100
        for name in ("source", "target")
        for when in ("before", "after")
    }
    usual |= {"is_correct": True, "pose_level": "LOA40", "total_level": "LOA30"}
    return {**usual, "peak_memory_bytes": 5, **values}


def test_the_table_of_buildings_tells_spread_seeds_and_the_worst_level():
    rows = [
        building_row(0),
        building_row(1, pose95_mm=90.0, total95_mm=91.0, is_correct=False, total_level="LOA10"),
        building_row(2, status="ambiguous", is_correct=False),
    ]
    (line,) = buildings.summary(rows)
    assert (line["n"], line["ok"], line["wrong"], line["seeds"]) == (3, 2, 1, "0 1 2")
    assert (line["pose95_mm_min"], line["pose95_mm"], line["pose95_mm_max"]) == (2.0, 2.0, 90.0)
    assert line["total_level"] == "LOA10"


def test_a_study_writes_every_row_with_what_it_is_measured_against(tmp_path, monkeypatch):
    monkeypatch.setattr(buildings, "run_pair", lambda made, _: building_row(made[1]))
    fake = {"scanner and drone": lambda kind, seed, points: (kind, seed, points)}
    monkeypatch.setattr(buildings, "PAIRS", fake)
    job = ["evaluate", "buildings", "--quick", "--runs", "2", "--quiet", "--out", str(tmp_path)]
    assert call(job) == 0
    document = json.loads((tmp_path / "buildings.json").read_text())
    assert document["seeds"] == [0, 1]
    assert document["machine"]["cores"] >= 1
    assert document["software"]["dougong"] == document["version"]
    for row in document["rows"]:
        assert row["measured_against"] == buildings.AGAINST
        assert row["version"] == document["version"]
    assert (tmp_path / "buildings.png").stat().st_size > 5000
    assert "pose95_mm" in (tmp_path / "buildings.csv").read_text()


def test_spreads_leave_out_what_is_not_known():
    rows = [{"x": 1.0}, {"x": None}, {"x": 3.0}, {}]
    assert spread(rows, "x") == {"x": 2.0, "x_min": 1.0, "x_max": 3.0}
    assert spread([{}], "x") == {"x": None, "x_min": None, "x_max": None}
    assert as_text([{"x": None, "y": 12345}], {"x": "one", "y": "two"}).splitlines()[1] == (
        "-    12,345"
    )


@pytest.fixture(scope="module")
def scene():
    return make_scene("hall", 3, lidar_points=12_000, photogrammetry_points=4_000)


def test_deeper_octrees_take_less_and_cover_more(scene):
    surface = scene.truth.surface_points - scene.lidar.frame.origin
    before = filtering._gaps(scene.lidar.xyz, surface)
    found = [filtering._thinned(scene.lidar, depth, surface, before) for depth in (7, 9, 20)]
    for key, sign in (("reduction_percent", -1), ("completeness_percent", 1), ("gap95_mm", -1)):
        assert (sign * np.diff([row[key] for row in found]) > 0).all()
    assert found[-1]["completeness_percent"] == 100.0
    assert found[-1]["gap95_mm"] <= 1e3 * filtering.COVER_M


def test_a_higher_cloth_threshold_takes_ground_and_then_building(scene):
    low, high = (filtering._parted(scene.lidar, threshold) for threshold in (0.05, 0.5))
    assert low["ground_missed_percent"] > high["ground_missed_percent"]
    assert low["building_lost_percent"] < high["building_lost_percent"]
    assert low["points_before"] == low["points_after"] + round(
        low["reduction_percent"] * low["points_before"] / 100.0
    )


def test_bytes_are_those_of_files(scene, tmp_path):
    half = scene.photogrammetry.select(np.arange(0, len(scene.photogrammetry), 2))
    whole, part = storage._sizes(scene.photogrammetry), storage._sizes(half)
    assert set(whole) == set(storage.WRITABLE)
    assert all(0.4 < part[suffix] / whole[suffix] < 0.7 for suffix in whole)


def test_a_coarse_pose_is_right_by_yaw_and_place_and_goes_both_ways_between_frames(scene):
    truth, clouds = scene.truth.T_target_source, (scene.lidar, scene.photogrammetry)
    local = coarse_trials.local_pose(truth, *clouds)
    np.testing.assert_allclose(coarse_trials.file_pose(local, *clouds), truth, atol=1e-6)
    turned, shifted = local.copy(), local.copy()
    turned[:3, :3] = building_rotation(3.0) @ local[:3, :3]
    shifted[0, 3] += 0.6

    class Ready:
        source = scene.lidar

    Ready.scene = scene
    found = [coarse_trials.Hypothesis(T_target_source=T, score=1.0, method="x")
             for T in (turned, shifted, local)]  # fmt: skip
    errors = coarse_trials.coarse_errors(Ready, found)
    assert coarse_trials._right(errors) == [2]
    assert errors[0][0] == pytest.approx(3.0)
    assert errors[1][1] == pytest.approx(0.6)


def building_rotation(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def coarse_rows():
    about = {"on": "buildings", "building": "hall", "points": 9}
    for seed, status, is_right in ((0, "ok", True), (1, "ambiguous", False), (2, "ok", False)):
        row = {"is_first_right": is_right, "is_listed": True, "is_fitted": is_right}
        row |= {"is_correct": is_right, "fitted95_mm": 4.0, "coarse_s": 1.0, "status": status}
        yield {**about, "seed": seed, "part": "pairs", "method": "plan", **row}
        for most in (1, 10):
            step = {"most_iterations_per_level": most, "pose95_mm": 100.0 / most}
            yield {**about, "seed": seed, "part": "fine iterations", "method": "plan", **step}
        sample = {"samples": 100, "is_first_right": is_right, "is_listed": True}
        yield {**about, "seed": seed, "part": "samples", "method": "4pcs", **sample}


def test_precision_is_over_what_is_returned_and_recall_over_all(tmp_path):
    rows = list(coarse_rows())
    line = coarse.summary(rows)[0]
    assert (line["n"], line["returned"], line["wrong"]) == (3, 2, 1)
    assert line["precision_percent"] == 50.0
    assert line["recall_percent"] == pytest.approx(33.33)
    draw_coarse(rows, coarse.summary(rows), tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 5000


def object_rows():
    answers = (("a", False, "ok", 1.0, 1.0), ("b", True, "ok", 90.0, 2.0),
               ("c", False, "ambiguous", 180.0, 180.0))  # fmt: skip
    for shape, has_symmetry, status, rre, like in answers:
        row = {"level": "L1", "motion": "any", "method": "ours", "status": status}
        row |= {"has_symmetry": has_symmetry, "rre_deg": rre, "rre_symmetric_deg": like}
        row |= {"rte": 0.0, "rte_symmetric": 0.0, "is_correct": rre < 5.0}
        row |= {"is_correct_symmetric": like < 5.0, "is_listed": True, "seconds": 1.0}
        yield {"seed": 0, "part": "pairs", "shape": shape, **row}
        step = {"level": "L1", "method": "ours", "is_correct": rre < 5.0}
        for most in (1, 10):
            yield {"seed": 0, "part": "iterations", "most_iterations_per_level": most, **step}


def test_objects_count_with_and_without_their_symmetries(tmp_path):
    rows = list(object_rows())
    table = objects.object_lines([row for row in rows if row["part"] == "pairs"])
    whole, lopsided = table
    assert (whole["n"], whole["returned"], whole["ambiguous"], whole["wrong"]) == (3, 2, 1, 0)
    assert (whole["precision_percent"], whole["recall_percent"]) == (50.0, 33.33)
    assert whole["precision_symmetric_percent"] == whole["recall_symmetric_percent"] == 100.0
    assert (whole["rre_median_deg"], whole["rre_symmetric_median_deg"]) == (90.0, 2.0)
    assert (lopsided["shapes"], lopsided["n"], lopsided["rre_mean_deg"]) == ("no symmetry", 2, 90.5)
    draw_objects(rows, table, tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 5000


def test_objects_without_an_archive_are_generated_in_the_unit_sphere():
    shapes = objects.shapes_of(Setting())
    assert list(shapes) == ["stele", "lion", "burner"]
    for points in shapes.values():
        assert np.linalg.norm(points, axis=1).max() == pytest.approx(1.0)
        assert len(points) >= 2 * 1024


def test_sizes_go_up_to_the_largest_two_a_decade():
    assert growth.sizes(Setting(points=300_000)) == [30_000, 94_868, 300_000]
    assert growth.sizes(Setting(points=20_000)) == [20_000]
    assert growth.sizes(Setting(points=200_000))[-1] == 200_000


def test_the_check_error_of_growth_is_the_poses_own(scene, tmp_path):
    pose = scene.truth.T_best.copy()
    pose[2, 3] += 0.03
    assert growth.check_rmse_m(pose, scene.truth) == pytest.approx(0.03, rel=1e-6)
    about = {"coarse": "plan", "fine": "point-to-plane", "status": "ok", "points_aimed": 9}
    figures = dict.fromkeys(growth.FIGURES, 2.0)
    rows = [{**about, "seed": seed, "points": 10, **figures} for seed in (0, 1)]
    (line,) = growth.summary(rows)
    assert (line["n"], line["ok"], line["points"], line["check_rmse_mm"]) == (2, 2, 10, 2.0)
    growth.draw_growth([line], tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 5000


def test_peers_start_5_degrees_and_half_a_metre_off(scene):
    start = peers.start_of(scene.truth, 0)
    errors = pose_errors(start, scene.truth)
    assert errors.rotation_error_deg == pytest.approx(5.0, abs=1e-6)
    assert np.linalg.norm(errors.translation_at_centroid_m) == pytest.approx(0.5, abs=1e-4)


def test_an_answer_is_judged_by_the_truth_and_by_whether_it_is_doubted(scene, tmp_path):
    trial = peers.plain(peers.base_of(scene), np.random.default_rng(0))

    def fake(name, run):
        return registration_peers.Peer(
            name=name, package="numpy", task="find", settings="none", run=run
        )

    def broken(*_):
        raise RuntimeError("no way")

    best, start = trial.truth.T_best, peers.start_of(trial.truth, 0)
    asked = {
        "right": lambda *_: registration_peers.Answer(best, ""),
        "flipped": lambda *_: registration_peers.Answer(start, ""),
        "careful": lambda *_: registration_peers.Answer(start, "not valid"),
        "broken": broken,
    }
    rows = [
        {"task": "find", "program": name, "building": "hall", "seed": 0}
        | peers.asked(fake(name, run), trial, 0)
        for name, run in asked.items()
    ]
    table = {line["program"]: line for line in peers.summary(rows)}
    assert [table[name]["correct"] for name in asked] == [1, 0, 0, 0]
    assert [table[name]["said_wrongly"] for name in asked] == [0, 1, 0, 0]
    assert rows[-1]["failed"] == "RuntimeError: no way"
    assert set(peers._missing(fake("absent", broken))) == set(table["right"])
    peers.draw_peers(rows, tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 5000


def test_a_matrix_is_read_from_text():
    text = " ".join(f"{value:.3e}" for value in range(16)) + "\n"
    np.testing.assert_array_equal(registration_peers._matrix(text), np.arange(16.0).reshape(4, 4))
    with pytest.raises(registration_peers.PeerFailedError, match="no matrix"):
        registration_peers._matrix("1 2 3")


def test_a_measurement_apart_has_a_process_of_its_own():
    assert apart(os.getpid) != os.getpid()
    with pytest.raises(BrokenProcessPool):
        apart(os._exit, 3)
