"""`dougong bench`: what it measures, and that the same work is asked of everyone."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from dougong.cli import call
from dougong.evaluation.bench import ours, peers
from dougong.evaluation.bench.contenders import OPERATIONS
from dougong.evaluation.bench.scenes import SCENES
from dougong.evaluation.bench.table import as_markdown, fastest_peer

COUNT = 30_000


@pytest.mark.parametrize(
    ("operation", "peer"),
    [("knn", peers.knn_scipy), ("sor", peers.sor_scipy), ("ror", peers.ror_scipy)],
)
def test_ours_and_scipy_answer_the_same_question(operation, peer):
    work = OPERATIONS[operation]
    arrays = SCENES[work.scene](COUNT, 0)
    own = work.answer(work.contenders[0].run(arrays, 1), arrays)
    assert own == pytest.approx(work.answer(peer(arrays, 1), arrays), rel=1e-12)


def test_our_icp_finds_the_way_back():
    work = OPERATIONS["icp"]
    arrays = SCENES["pair"](COUNT, 0)
    assert work.answer(ours.icp(arrays, 1), arrays)["displacement_p95_mm"] < 50.0


def test_bench_writes_rows_and_keeps_them(tmp_path):
    asked = ["bench", "--only", "ror", "--points", f"{COUNT}", "--repeats", "1", "--quiet"]
    asked += ["--threads", "1", "--json", "--out", str(tmp_path)]
    assert call(asked) == 0
    document = json.loads((tmp_path / "bench.json").read_text())
    (group,) = document["groups"].values()
    rows = {row["name"]: row for row in group["rows"]}
    assert {"dougong", "scipy"} <= set(rows)
    assert rows["dougong"]["answer"] == rows["scipy"]["answer"]
    assert rows["dougong"]["cpu_s"] > 0.0
    assert "radius outlier removal" in as_markdown(document)
    before = (tmp_path / "bench.json").stat().st_mtime_ns
    assert call(asked) == 0
    assert (tmp_path / "bench.json").stat().st_mtime_ns == before
    assert call([*asked, "--seed", "3"]) == 0
    (group,) = json.loads((tmp_path / "bench.json").read_text())["groups"].values()
    assert group["seed"] == 3


@pytest.mark.parametrize(
    ("wrong", "words"),
    [(["--only", "sorr"], "no operation 'sorr'"), (["--points", "10"], "--points must be")],
)
def test_what_cannot_be_measured_is_refused(tmp_path, capsys, wrong, words):
    assert call(["bench", *wrong, "--out", str(tmp_path / "x")]) == 2
    assert words in capsys.readouterr().err


def test_scenes_are_the_same_for_a_seed():
    for make in SCENES.values():
        one, two = make(COUNT, 3), make(COUNT, 3)
        assert all(np.array_equal(one[key], two[key]) for key in one)


def test_who_ends_far_away_is_not_compared_by_seconds():
    def row(name, error_mm, cpu_s, *, is_ours=False):
        figures = {"cpu_s": cpu_s, "wall_s": cpu_s, "bytes": 1e6}
        about = {"name": name, "is_ours": is_ours, "is_equal": True, "failed": None}
        return {**about, **figures, "answer": {"displacement_p95_mm": error_mm}}

    rows = [row("ours", 0.8, 4.0, is_ours=True), row("hasty", 14.0, 0.9)]
    assert fastest_peer({"rows": rows}) is None
    rows.append(row("exact", 1.2, 9.0))
    assert fastest_peer({"rows": rows})["name"] == "exact"


def test_the_readme_shows_what_was_measured():
    root = Path(__file__).parent.parent
    spec = importlib.util.spec_from_file_location("keep_bench", root / "docs" / "keep_bench.py")
    keep_bench = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(keep_bench)
    section = (root / "README.md").read_text(encoding="utf-8").split(keep_bench.BEGIN)[1]
    assert section.split(keep_bench.END)[0].strip() == keep_bench.readme_table()
