"""What the noise filters take from a bracketed facade: 300 points/m2, 2 % noise, several seeds.

    python benchmarks/denoise_facade.py [--seeds 5] [--density 300] [--noise 0.02] [--json FILE]
    python benchmarks/denoise_facade.py --study [--seeds 1] [--json FILE]

The second runs all test pieces (six shapes, three patterns of points) with 3 % noise of five kinds.

Shares in percent, mean and standard deviation over the seeds. Noise: a third uniform round the
facade, a third Gaussian (15 cm) about it, a third 5 to 50 cm off it. Separable noise is farther
from the true surface than max(3 sigma of the sensor, the local spacing). Features are the points
on brackets and rafters; worst patches are the 5 % of 0.25 m cells that lose most.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from dougong.evaluation.denoise import METHODS, facade_sample, rates, study, summary

COLUMNS = ("noise", "separable", "feature", "flat", "worst_patches", "vegetation")


def main() -> None:
    """Print the table, and write the rows as JSON when asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--density", type=float, default=300.0, help="points per square metre")
    parser.add_argument("--noise", type=float, default=0.02, help="share of noise, 0..0.5")
    parser.add_argument("--json", type=Path, help="write every run to this file; - for stdout")
    parser.add_argument("--study", action="store_true", help="all test pieces, with curves")
    arguments = parser.parse_args()
    rows = study(seeds=range(arguments.seeds)) if arguments.study else facade_rows(arguments)
    if arguments.json:
        text = json.dumps(rows, indent=1)
        if str(arguments.json) == "-":
            print(text)
            return
        arguments.json.write_text(text + "\n", encoding="utf-8")
    settings = [row for row in rows if "curve" not in row]
    # The facade has no vegetation.
    columns = [name for name in COLUMNS if any(not math.isnan(row[name]) for row in settings)]
    print(f"{'percent of':24s}" + "".join(f"{name.replace('_', ' '):>16s}" for name in columns))
    for name, cells in summary(settings, "filter", columns).items():
        print(f"{name:24s}" + "".join(f"{mean:9.1f} ±{spread:5.2f}" for mean, spread in cells))


def facade_rows(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rates of every filter on the facade, per seed."""
    rows: list[dict[str, Any]] = []
    for seed in range(arguments.seeds):
        sample = facade_sample(arguments.density, arguments.noise, seed)
        for method in METHODS:
            is_kept = method.is_kept(sample.points)
            rows.append({"filter": method.name, "seed": seed, **rates(is_kept, sample)})
    return rows


if __name__ == "__main__":
    sys.exit(main())
