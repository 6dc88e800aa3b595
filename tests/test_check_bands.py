"""The check of headline figures: what it lets through and what it does not."""

import importlib.util
import json
from pathlib import Path

import pytest

from dougong.evaluation.studies import STUDIES

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def bands():
    spec = importlib.util.spec_from_file_location("check_bands", BENCHMARKS / "check_bands.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_figures_in_and_out_of_their_bands(bands, tmp_path):
    table = [{"pair": "a", "error_mm": 4.0}, {"pair": "a", "error_mm": 6.0}]
    (tmp_path / "buildings.json").write_text(json.dumps({"table": table}))

    def broken(**band):
        asked = {"buildings": [{"where": {"pair": "a"}, "key": "error_mm", **band}]}
        return bands.judged(tmp_path, asked)[1]

    assert broken(most=6.0, least=4.0) == 0
    assert broken(most=5.0) == 1
    assert broken(least=5.0) == 1
    assert broken(most=6.0, where={"pair": "b"}) == 1
    assert broken(most=6.0, key="no_such") == 1
    assert bands.judged(tmp_path / "no", {"buildings": [{"where": {}, "key": "x"}]})[1] == 1


def test_every_study_has_a_band_and_ci_runs_it():
    text = (BENCHMARKS / "bands.toml").read_text()
    script = (BENCHMARKS.parent / ".ci" / "run").read_text()
    line = next(line for line in script.splitlines() if line.startswith("printf "))
    for study in STUDIES:
        assert f"[[{study}]]" in text
        assert study in line.replace(";", "").split()
