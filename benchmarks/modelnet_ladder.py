"""The ModelNet40 ladder: precision, recall and errors of five methods, L0 to L4.

    python benchmarks/modelnet_ladder.py modelnet40_half.npz --quick
    python benchmarks/modelnet_ladder.py modelnet40_half.npz --levels L2 --motions 45 --json a.json

The archive holds one (n, 3) array per shape, in the unit sphere. Definitions:
`dougong.evaluation.modelnet`.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np

import dougong
from dougong.evaluation.modelnet import LEVELS, MOTIONS, Ladder, run_ladder, summarise
from dougong.evaluation.object_methods import METHODS

COLUMNS = (
    *("level", "motion", "method", "shapes", "pairs", "ok", "ambiguous", "precision", "recall"),
    *("precision_symmetric", "recall_symmetric", "wrong", "wrong_symmetric"),
    *("rre_deg_mean", "rre_deg_median", "rre_symmetric_deg_mean", "rre_symmetric_deg_median"),
    *("rre_ok_mean_deg", "rte_median", "seconds_median"),
)


def main() -> None:
    """Run the ladder and print one row per level, motion, method and group of shapes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archive", type=Path)
    parser.add_argument("--levels", default=",".join(LEVELS))
    parser.add_argument("--motions", default=",".join(MOTIONS))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--every", type=int, default=1, help="take every so-many-th shape")
    parser.add_argument("--poses", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="every 13th shape, one pose")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    every, poses = (13, 1) if arguments.quick else (arguments.every, arguments.poses)
    with np.load(arguments.archive) as archive:
        shapes = {name: archive[name].astype(np.float64) for name in archive.files[::every]}
    ladder = Ladder(
        levels=tuple(arguments.levels.split(",")),
        motions=tuple(arguments.motions.split(",")),
        methods=tuple(arguments.methods.split(",")),
        poses=poses,
        seed=arguments.seed,
    )
    start = time.perf_counter()
    trials = run_ladder(shapes, ladder)
    rows = summarise(trials)
    print(f"{len(shapes)} shapes, {poses} poses, {time.perf_counter() - start:.0f} s")
    print("| " + " | ".join(COLUMNS) + " |")
    print("|" + "---|" * len(COLUMNS))
    for row in rows:
        cells = (f"{row[c]:.3f}" if isinstance(row[c], float) else str(row[c]) for c in COLUMNS)
        print("| " + " | ".join(cells) + " |")
    if arguments.json:
        document = {
            "dougong": dougong.__version__,
            "ladder": ladder.model_dump(mode="json"),
            "shapes": list(shapes),
            "rows": rows,
            "trials": [dataclasses.asdict(trial) for trial in trials],
        }
        arguments.json.write_text(json.dumps(document, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
