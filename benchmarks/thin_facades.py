"""How much SOR leaves of a facade that a flight shows thinly, plain and with `spare_places`.

    python benchmarks/thin_facades.py [--seed 0]

Ground of 20 by 20 m, a facade of 20 by 10 m on it, its points `thinner` times as far apart, and
strays in the air. Percent that stays; numbers in docs/denoising.md.
"""

from __future__ import annotations

import argparse

import numpy as np

from dougong.filters.statistical import Statistical, statistical

DENSITIES = (10.0, 25.0, 100.0, 400.0)
"""Points per square metre of ground."""
THINNER = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


def main() -> None:
    """Print a line per density and thinness."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    print("points/m2  thinner  facade: SOR  sparing    strays: SOR  sparing")
    for density in DENSITIES:
        for thinner in THINNER:
            rng = np.random.default_rng(asked.seed)
            held, count = int(400 * density), int(200 * density / thinner**2)
            ground = np.column_stack([rng.uniform(0, 20, (held, 2)), rng.normal(0, 0.01, held)])
            across = 10 + rng.normal(0, 0.01, count)
            facade = np.column_stack([rng.uniform(0, 20, count), across, rng.uniform(0, 10, count)])
            strays = rng.uniform([0, 0, 0.6], [20, 20, 14], (max(20, int(density / 4)), 3))
            points = np.vstack([ground, facade, strays])
            plain = statistical(points).is_kept
            sparing = statistical(points, Statistical(spare_places=True)).is_kept
            of_facade, of_strays = slice(held, held + count), slice(held + count, None)
            print(
                f"{density:9.0f}{thinner:9.1f}{100 * plain[of_facade].mean():13.1f}"
                f"{100 * sparing[of_facade].mean():9.1f}{100 * plain[of_strays].mean():15.1f}"
                f"{100 * sparing[of_strays].mean():9.1f}"
            )


if __name__ == "__main__":
    main()
