"""The object ladder: pairs as defined, symmetries found, counts as published."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong.evaluation.modelnet import (
    Ladder,
    Trial,
    make_pair,
    random_motion,
    run_ladder,
    summarise,
)
from dougong.evaluation.object_methods import METHODS
from dougong.evaluation.object_symmetry import describe_shape, is_symmetry, symmetric_error
from dougong.registration import FreeRotation
from object_shapes import bar, chair, moved


@pytest.fixture(scope="module")
def square():
    return describe_shape("bar", bar(0, 4000), rotations=800)


def test_symmetries_of_a_square_bar(square):
    assert len(square.symmetries) == 7
    for T in square.symmetries:
        assert np.abs(T[:3, :3] - np.round(T[:3, :3])).max() < 0.03
        assert np.linalg.norm(T[:3, 3]) < 0.05


def test_an_equal_pose_is_as_far_as_the_nearest_one_that_a_symmetry_makes_true(square):
    quarter, tilt = (Rotation.from_euler(a, d, degrees=True) for a, d in (("z", 90.0), ("x", 4.0)))
    truth, found = np.eye(4), np.eye(4)
    truth[:3, :3] = Rotation.from_euler("xyz", (10.0, 20.0, 30.0), degrees=True).as_matrix()
    truth[:3, 3] = 0.1, 0.2, 0.3
    found[:3, :3] = (tilt * quarter).as_matrix()
    angle, shift = symmetric_error(truth @ found, truth, square)
    assert angle == pytest.approx(4.0, abs=0.5)
    assert shift < 0.02


def test_a_lopsided_chair_has_none():
    assert len(describe_shape("chair", chair(0, 4000), rotations=800).symmetries) == 0


def test_a_symmetry_may_be_a_little_off_but_not_much(square):
    T = np.eye(4)
    for degrees, expected in ((90.0, True), (93.0, True), (110.0, False)):
        T[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        assert is_symmetry(T, square) is expected


def test_levels_are_what_they_say():
    points = chair(1, 4000)
    rng = np.random.default_rng(0)
    one, two, T = make_pair(points, "L0", "any", 1000, rng)
    gaps = np.linalg.norm(moved(one, T)[:, None] - two, axis=2)
    assert gaps.min(axis=1).max() < 1e-9
    one, two, T = make_pair(points, "L1", "yaw", 1000, rng)
    assert len(one) == len(two) == 1000
    assert np.linalg.norm(moved(one, T)[:, None] - two, axis=2).min() > 1e-6
    np.testing.assert_allclose(T[2, :3], [0, 0, 1], atol=1e-12)
    for level, count in (("L2", 700), ("L3", 500)):
        one, two, _ = make_pair(points, level, "45", 1000, rng)
        assert abs(len(one) - count) <= 1
        assert abs(len(two) - count) <= 1
    one, _, _ = make_pair(points, "L4", "any", 1000, rng)
    assert len(np.unique(one, axis=0)) == 1000


def test_motions_are_proper_and_within_their_limits():
    rng = np.random.default_rng(1)
    for motion, limit in (("45", 100.0), ("any", 180.0), ("yaw", 180.0)):
        for _ in range(20):
            T = random_motion(motion, rng)
            assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
            assert np.abs(T[:3, 3]).max() <= 0.5
            assert np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude()) <= limit


def test_counts_of_a_small_ladder():
    settings = FreeRotation(rotations=300, refined=12, features=None)
    ladder = Ladder(
        levels=("L1",), motions=("any",), methods=("ours", "pca"), poses=1, settings=settings
    )
    heard = []
    shapes = {"chair": chair(2, 4000), "bar": bar(3, 4000)}
    trials = run_ladder(shapes, ladder, heard.append)
    assert heard == trials
    by = {(t.shape, t.method): t for t in trials}
    assert by["chair", "ours"].is_correct
    assert by["chair", "ours"].status == "ok"
    assert by["bar", "ours"].status == "ambiguous"
    assert by["bar", "ours"].is_listed
    assert by["bar", "ours"].has_symmetry
    rows = {(r["method"], r["shapes"]): r for r in summarise(trials)}
    strict = rows["ours", "all"]
    assert (strict["pairs"], strict["ok"], strict["precision"], strict["recall"]) == (
        2,
        1,
        1.0,
        0.5,
    )
    assert strict["recall_symmetric"] == 1.0
    assert rows["ours", "no symmetry"]["recall"] == 1.0


def test_precision_and_recall_by_hand():
    def trial(status, correct, like, listed):
        return Trial(
            shape="s",
            level="L1",
            motion="any",
            method="ours",
            status=status,
            has_symmetry=True,
            rre_deg=1.0,
            rte=0.0,
            rre_symmetric_deg=1.0,
            rte_symmetric=0.0,
            seconds=1.0,
            is_correct=correct,
            is_correct_symmetric=like,
            is_listed=listed,
        )

    trials = [
        trial("ok", True, True, True),
        trial("ok", False, True, True),
        trial("ok", False, False, False),
        trial("ambiguous", False, False, True),
        trial("failed", True, True, True),
    ]
    (row,) = summarise(trials)
    assert row["precision"] == pytest.approx(1 / 3)
    assert row["recall"] == pytest.approx(1 / 5)
    assert row["precision_symmetric"] == pytest.approx(3 / 4)
    assert row["recall_symmetric"] == pytest.approx(3 / 5)


def test_every_method_runs_by_name():
    ladder = Ladder(
        levels=("L1",),
        motions=("45",),
        methods=tuple(m for m in METHODS if m != "ours"),
        poses=1,
        points=400,
    )
    trials = run_ladder({"chair": chair(4, 2000)}, ladder)
    found = {t.method: t.is_correct for t in trials}
    assert set(found) == set(METHODS) - {"ours"}
    assert found["sac-ia"]
    assert found["4pcs"]
