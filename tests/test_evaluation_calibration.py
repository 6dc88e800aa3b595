"""The generator of cheap pairs, and the verdict's probability measured on them."""

import numpy as np
import pytest
from scipy import stats

import dougong
from dougong.evaluation import studies
from dougong.evaluation.calibration import (
    SETTINGS,
    area_under_roc,
    calibration_error,
    error_by_chance,
    fit,
    measure,
    reliability,
)
from dougong.evaluation.machine import code_hash
from dougong.evaluation.studies import Setting, measured
from dougong.evaluation.studies.probability import FIRST_SEED
from dougong.evaluation.trial_pairs import KINDS, TRAINED, make_pair
from dougong.pipeline.progress import Silent
from dougong.registration.probability import BELIEF, MOST_PROBABLE, Belief, Evidence


def evidence(**changes):
    usual = {"sharpness": 8.0, "explained": 0.8, "violation": 0.0, "spread_m": 0.02}
    usual["is_undecided"] = False
    return Evidence(**{**usual, "rivals": (1e-4, 1e-5), **changes})


def test_pairs_are_a_function_of_kind_and_seed_and_the_truth_lays_one_on_the_other():
    for kind in KINDS:
        one, two = make_pair(kind, 3), make_pair(kind, 3)
        np.testing.assert_array_equal(one.source, two.source)
        np.testing.assert_array_equal(one.target, two.target)
        if one.truth is not None:
            T, points = one.truth.T_best, one.truth.surface_points
            left = points @ T[:3, :3].T + T[:3, 3] - one.truth.surface_bent
            assert np.quantile(np.linalg.norm(left, axis=1), 0.95) < 0.05
    assert set(TRAINED) < set(KINDS)


def test_at_least_three_pairs_in_ten_have_no_single_answer():
    pairs = [make_pair(kind, seed) for kind in KINDS for seed in range(FIRST_SEED, FIRST_SEED + 30)]
    assert np.mean([pair.is_unique for pair in pairs]) <= 0.7
    assert any(pair.truth is None for pair in pairs)


def test_ends_that_are_alike_are_not_taken_for_one_another():
    # The scan shows one end of a plain hall, the drone the other: the pose that lays end on end
    # shares more than the true one, and was called ok.
    row = measure("rectangle", 37, SETTINGS)
    assert row["status"] != "ok"
    assert row["probability"] < 0.7


@pytest.mark.parametrize(
    "better",
    [
        {"sharpness": 12.0}, {"explained": 0.9}, {"spread_m": 0.01}, {"rivals": (1e-6, 1e-6)},
        {"rivals": (1e-4,)},
    ],
)  # fmt: skip
def test_more_evidence_never_makes_a_pose_less_probable(better):
    less, more = BELIEF.probability(evidence()), BELIEF.probability(evidence(**better))
    assert 0.0 <= less <= more <= MOST_PROBABLE
    assert BELIEF.probability(evidence(violation=0.07)) <= less
    assert BELIEF.probability(evidence(is_undecided=True)) <= less


def test_equal_rivals_share_the_belief():
    alone = BELIEF.probability(evidence(rivals=()))
    assert BELIEF.probability(evidence(rivals=(1.0, 1.0, 1.0))) == pytest.approx(
        alone / 4.0, rel=0.01
    )


def test_the_fit_finds_a_belief_that_is_known():
    # Rows drawn from known coefficients: the fit's probabilities come back, not just its shape.
    rng = np.random.default_rng(0)
    true = Belief(trust=(-3.0, 1.5, 1.0, 5.0, 0.5, 1.5), rival_power=0.4)
    rows = []
    for _ in range(3000):
        seen = Evidence(
            sharpness=float(rng.uniform(3, 20)),
            explained=float(rng.uniform(0.3, 1)),
            violation=float(rng.uniform(0, 0.08)),
            spread_m=float(np.exp(rng.uniform(-5, -2))),
            rivals=tuple(10.0 ** rng.uniform(-6, 0, rng.integers(0, 5))),
            is_undecided=bool(rng.random() < 0.4),
        )
        p = true.probability(seen)
        rows.append(
            {
                "is_correct": bool(rng.random() < p),
                "probability": p,
                "told": seen,
                **{name: getattr(seen, name) for name in seen.__slots__},
            }
        )
    found = fit(rows)
    off = [found.probability(row["told"]) - true.probability(row["told"]) for row in rows]
    assert np.abs(off).mean() < 0.03


def test_a_stopped_study_goes_on_and_makes_no_row_twice(tmp_path):
    setting, asked = Setting(kept=tmp_path / "rows.jsonl"), []

    def row(kind, seed):
        asked.append((kind, seed))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return {"value": np.inf if seed else 1.5}

    keys = [("l", 0), ("l", 1), ("u", 0), ("u", 1)]
    with pytest.raises(KeyboardInterrupt):
        measured(setting, keys, row, Silent())
    with setting.kept.open("a") as file:
        file.write('{"key": ["u", 0], "softw')
        file.write("\n")
    rows = measured(setting, keys, row, Silent())
    assert asked == [("l", 0), ("l", 1), ("u", 0), ("u", 0), ("u", 1)]
    assert [line["value"] for line in rows] == [1.5, None, 1.5, None]


def test_kept_rows_of_other_source_are_made_again(tmp_path, monkeypatch):
    setting, asked = Setting(kept=tmp_path / "rows.jsonl"), []

    def row(kind):
        asked.append(kind)
        return {"value": len(asked)}

    for code in ("a", "a", "b", "b"):
        monkeypatch.setattr(studies, "_code", lambda code=code: code)
        (line,) = measured(setting, [("l",)], row, Silent())
    assert asked == ["l", "l"]
    assert line["value"] == 2


def test_kept_rows_of_another_setting_are_made_again(tmp_path, monkeypatch):
    """A quick look, stopped, became the first rows of the measurement."""
    asked = []

    def row(kind):
        asked.append(kind)
        return {"value": len(asked)}

    kept = tmp_path / "rows.jsonl"
    settings = [
        {"is_quick": True},
        {"is_quick": False},
        {"points": 20_000},
        {"data": tmp_path},
        {"runs": 3},
    ]
    for number, setting in enumerate(settings):
        measured(Setting(kept=kept, **setting), [("l",)], row, Silent())
        assert len(asked) == min(number + 1, 4), "more runs only ask for more rows"
    monkeypatch.setattr(studies, "get_threads", lambda: 77)
    measured(Setting(kept=kept), [("l",)], row, Silent())
    assert len(asked) == 5


def test_the_code_of_a_measurement_includes_what_lies_beside_the_rooms(tmp_path, monkeypatch):
    (tmp_path / "kernels").mkdir()
    for name in ("__init__.py", "threads.py", "kernels/order.py", "report.py"):
        (tmp_path / name).write_text(name)
    monkeypatch.setattr(dougong, "__file__", str(tmp_path / "__init__.py"))
    seen = {code_hash(["kernels"])}
    for name in ("threads.py", "kernels/order.py"):
        (tmp_path / name).write_text("changed")
        seen.add(code_hash(["kernels"]))
    assert len(seen) == 3


def test_measures_of_calibration_against_their_definitions():
    rng = np.random.default_rng(1)
    p = rng.random(20_000)
    is_correct = rng.random(20_000) < p
    assert calibration_error(p, is_correct) < 0.02
    # Few pairs show an error where there is none.
    assert error_by_chance(p[:100]) > 0.05 > error_by_chance(p) > 0.0
    # Declared 0.2 too high, where there is room for it.
    assert calibration_error(np.minimum(p + 0.2, 1.0), is_correct) == pytest.approx(0.18, abs=0.02)
    expected = stats.mannwhitneyu(p[is_correct], p[~is_correct]).statistic
    pairs = is_correct.sum() * (~is_correct).sum()
    assert area_under_roc(p, is_correct) == pytest.approx(expected / pairs)
    assert area_under_roc(np.full(9, 0.7), np.arange(9) < 6) == 0.5
    table = reliability(p, is_correct)
    assert sum(row["pairs"] for row in table) == 20_000
    assert all(row["low95"] <= row["observed"] <= row["high95"] for row in table)


def test_a_point_to_point_fit_that_leaves_the_surfaces_is_not_ok():
    # Thin clouds: one survey's points pull the other's towards themselves, 0.16 m off, and every
    # block agreed.
    plain = measure("l", 6, SETTINGS)
    pulled = measure("l", 6, SETTINGS.model_copy(update={"fine": "point-to-point"}))
    assert (plain["status"], plain["is_correct"]) == ("ok", True)
    assert pulled["status"] == "ambiguous"
    assert "point-to-plane" in pulled["reason"]


def test_a_true_pose_that_was_heard_beside_itself_is_no_beaten_rival():
    """A plain rectangle whose ground is cut alike at both ends: `ok`, turned by 180 degrees."""
    assert measure("rectangle", 100296)["status"] == "ambiguous"
