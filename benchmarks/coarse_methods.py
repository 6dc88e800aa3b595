"""Compare the coarse methods on generated scenes: share of pairs whose pose is found.

    python benchmarks/coarse_methods.py --scenes hall,pagoda,tulou,wall,cave --seeds 10

A hypothesis is right when its yaw is within 2 degrees and its place in plan (at the middle of the
source) within 0.5 m of the true pose. Printed per method: pairs with a right pose first, pairs with
one among the first eight, the median errors of the right ones, and seconds without preparation.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from dougong.cloud import Cloud
from dougong.evaluation.scenes import make_scene
from dougong.registration.congruent_sets import four_pcs
from dougong.registration.plan_search import plan_search
from dougong.registration.prepare import Prepared, prepare
from dougong.registration.principal_axes import improved_pca, traditional_pca
from dougong.registration.result import Hypothesis
from dougong.registration.sample_consensus import sac_ia
from dougong.typing import Transform

METHODS: dict[str, Callable[[Prepared, Prepared], list[Hypothesis]]] = {
    "plan": plan_search,
    "improved-pca": improved_pca,
    "pca": traditional_pca,
    "sac-ia": sac_ia,
    "4pcs": four_pcs,
}


def local_truth(truth: Transform, source: Cloud, target: Cloud) -> Transform:
    """Return the true pose between the local frames of the two clouds."""
    local = np.array(truth)
    local[:3, 3] += truth[:3, :3] @ source.frame.origin - target.frame.origin
    return local


def errors(found: Transform, truth: Transform, centre: np.ndarray) -> tuple[float, float, float]:
    """Return the errors in yaw (deg), plan (m) and height (m) at `centre`."""
    turn = found[:3, :3] @ truth[:3, :3].T
    offset = (found[:3, :3] - truth[:3, :3]) @ centre + found[:3, 3] - truth[:3, 3]
    yaw = abs(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
    return float(yaw), float(np.hypot(*offset[:2])), abs(float(offset[2]))


def main() -> None:
    """Run the comparison and print one row per scene and method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", default="hall,pagoda,tulou,wall,cave")
    parser.add_argument("--seeds", type=int, default=10)
    arguments = parser.parse_args()
    print("| scene | method | first | among 8 | yaw deg | plan m | z m | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in arguments.scenes.split(","):
        rows: dict[str, list[tuple[int, tuple[float, ...], float]]] = {m: [] for m in METHODS}
        for seed in range(arguments.seeds):
            scene = make_scene(kind, seed)
            source = prepare(scene.lidar, "lidar")
            target = prepare(scene.photogrammetry, "photogrammetry")
            truth = local_truth(
                np.asarray(scene.truth.T_target_source), scene.lidar, scene.photogrammetry
            )
            centre = source.xyz.mean(axis=0)
            for name, method in METHODS.items():
                start = time.perf_counter()
                found = method(source, target)
                seconds = time.perf_counter() - start
                all_errors = [errors(h.T_target_source, truth, centre) for h in found]
                right = [i for i, (yaw, plan, _) in enumerate(all_errors) if yaw < 2 and plan < 0.5]
                rank = right[0] if right else 10**6
                at = all_errors[rank] if right else (np.nan, np.nan, np.nan)
                rows[name].append((rank, at, seconds))
        for name, results in rows.items():
            ranks = np.array([rank for rank, _, _ in results])
            good = np.array([at for rank, at, _ in results if rank < 8]).reshape(-1, 3)
            middle = np.median(good, axis=0) if len(good) else np.full(3, np.nan)
            seconds = float(np.median([s for _, _, s in results]))
            print(
                f"| {kind} | {name} | {(ranks == 0).sum()}/{len(ranks)} "
                f"| {(ranks < 8).sum()}/{len(ranks)} | {middle[0]:.2f} | {middle[1]:.2f} "
                f"| {middle[2]:.2f} | {seconds:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
