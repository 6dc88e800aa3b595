"""Fit the coefficients of the verdict's probability on generated pairs.

    python benchmarks/fit_probability.py --seeds 0-179,100000-100126 --rows rows.jsonl

Pairs of the kinds in `trial_pairs.TRAINED`; rows are kept in the file and not made again. Prints
`BELIEF` for ``registration/probability.py`` and the fit on its own pairs. What it is worth on
others: ``dougong evaluate probability``. One pair takes about two CPU seconds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dougong.evaluation.calibration import (
    area_under_roc,
    calibration_error,
    fit,
    measure,
    probabilities,
)
from dougong.evaluation.studies import Setting, measured
from dougong.evaluation.trial_pairs import TRAINED
from dougong.pipeline.progress import Silent


def main() -> None:
    """Measure what is missing, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", default="0-59", help="first-last, several with commas")
    parser.add_argument("--rows", type=Path, required=True, help="JSON lines")
    asked = parser.parse_args()
    keys = [(kind, seed) for seed in seeds_of(asked.seeds) for kind in TRAINED]
    rows = measured(Setting(kept=asked.rows), keys, measure, Silent())
    belief = fit(rows)
    print(f"BELIEF = {belief}")
    p = probabilities(rows, belief)
    is_correct = np.array([bool(row["is_correct"]) for row in rows])
    print(
        f"{len(rows)} pairs: calibration error {calibration_error(p, is_correct):.3f}, "
        f"ROC area {area_under_roc(p, is_correct):.3f}"
    )


def seeds_of(text: str) -> list[int]:
    """Return the seeds that ``0-3,7-9`` names."""
    ends = ([int(end) for end in part.split("-")] for part in text.split(","))
    return [seed for first, *last in ends for seed in range(first, (last or [first])[0] + 1)]


if __name__ == "__main__":
    main()
