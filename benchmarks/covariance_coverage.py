"""How often a pose's 95 % ellipsoid holds the true pose, for errors that are correlated in space.

    python benchmarks/covariance_coverage.py --runs 200 --dof 6,7

Rigid data: a hall seen twice, each time with white noise and a smooth error field. Printed per
correlation length: runs, share covered (0.90 to 0.99 is honest), mean squared error in units of the
covariance (1 is exact, less is cautious).
"""

import argparse

import numpy as np

from dougong.evaluation.coverage import coverage


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--lengths", default="0.5,1.5,3.0", help="correlation lengths, metres")
    parser.add_argument("--dof", default="6,7", help="6: rigid; 7: with the scale")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.runs)
    print("| unknowns | correlation length | runs | covered | mean chi2 per dof | median |")
    print("|---|---|---|---|---|---|")
    for dof in (int(text) for text in options.dof.split(",")):
        for text in options.lengths.split(","):
            found = coverage(seeds, length_m=float(text), dof=dof)
            mean, median = float(np.mean(found.chi2_per_dof)), float(np.median(found.chi2_per_dof))
            print(
                f"| {dof} | {float(text):g} m | {found.runs} | {found.share:.3f} | {mean:.2f} "
                f"| {median:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
