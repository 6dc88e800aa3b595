"""Time the cloth and its guard beside the published filter: seconds and peak memory.

    python benchmarks/bench_cloth.py [--points 1e6 1e7] [--cloth 0.5]

The scene is a hall with trees and cars on 80 x 80 m of terrain, with 1.5 % outliers from 6 m below
the ground to 20 m above it. Each run has a process of its own; kernels are warm.
"""

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


def peak_mb():
    """Return the largest resident size of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def one(which, number, cloth):
    """Run one filter on one scene and print a line."""
    from dougong.filters.cloth_simulation import ClothSimulation, cloth_simulation
    from dougong.filters.low_outliers import low_outliers
    from reference.cloth import hall_site, published

    params = ClothSimulation(cloth_resolution_m=cloth, slope_smoothing=False)
    points, label = hall_site(number, outliers=0.015)
    if which == "published":
        found, seconds, peak = published(points, params, threads=2)
    else:
        cloth_simulation(points[:10_000], params)
        before, started, cpu = peak_mb(), time.perf_counter(), time.process_time()
        if which == "guard":
            found = low_outliers(points).is_kept
        else:
            guard = {"ours": params.guard, "ours, no guard": None}[which]
            found = cloth_simulation(points, params.model_copy(update={"guard": guard}))
            found = found.attributes["is_ground"] == 1
        seconds, cpu = time.perf_counter() - started, time.process_time() - cpu
        peak = peak_mb()
        which += f" (cpu {cpu:.2f} s, {peak - before:.0f} MB more than before)"
    print(
        f"{number:.0e} points, {cloth:g} m: {seconds:7.2f} s {peak:7.0f} MB  "
        f"recall {found[label == 2].mean():.4f}  false {found[label == 0].mean():.4f}  {which}",
        flush=True,
    )


def main():
    """Run every filter in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=float, nargs="*", default=[1e6, 1e7])
    parser.add_argument("--cloth", type=float, nargs="*", default=[0.5])
    arguments = parser.parse_args()
    for number in arguments.points:
        for cloth in arguments.cloth:
            for which in ("ours", "ours, no guard", "guard", "published"):
                code = f"import bench_cloth; bench_cloth.one({which!r}, {int(number)}, {cloth})"
                subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True)


if __name__ == "__main__":
    main()
