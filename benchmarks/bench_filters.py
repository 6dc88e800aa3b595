"""Our filters and scipy's nearest equivalent on the same work.

    python benchmarks/bench_filters.py [POINTS] [THREADS]

Wall and CPU seconds of the second of two runs (compiled, allocated). Scenes: a site of ground and
walls with 1 % outliers, and the bracketed facade for what the filters find.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from dougong import filters, threads
from dougong.evaluation.facade import FEATURE, NOISE_LABELS, SURFACE, bracketed_facade
from dougong.filters import neighbourhood


def site(count: int, seed: int = 0) -> np.ndarray:
    """Return `count` points: rolling ground 80 x 80 m, two walls, 1 % outliers; random order."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 80, (count, 3))
    points[:, 2] = 0.5 * np.sin(points[:, 0]) + rng.normal(0, 0.01, count)
    on_wall = count // 3
    points[:on_wall, 0] = rng.choice([20.0, 60.0], on_wall)
    points[:on_wall, 2] = rng.uniform(0, 15, on_wall)
    stray = count // 100
    points[-stray:] = rng.uniform([0, 0, -5], [80, 80, 20], (stray, 3))
    return points[rng.permutation(count)]


def timed(name: str, work: Callable[[], object], per: int) -> tuple[float, float]:
    """Print and return wall and CPU seconds of the second call of `work` on `per` points."""
    work()
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{name:44s} {wall:8.3f} s wall {cpu:8.3f} s CPU {per / wall / 1e6:8.2f} M/s")
    return wall, cpu


def against(name: str, per: int, ours: Callable[[], object], theirs: Callable[[], object]) -> None:
    """Time both and print the ratios."""
    here = timed(f"{name}, dougong", ours, per)
    there = timed(f"{name}, scipy/numpy", theirs, per)
    wall, cpu = (b / a for a, b in zip(here, there, strict=True))
    print(f"{'':44s} {wall:8.1f} times as fast (wall), {cpu:.1f} (CPU)")


def voxels_by_numpy(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """Return the places of the points nearest the centres: lexsort and first of each run."""
    cells = (points - points.min(axis=0)) / voxel_m
    whole = np.floor(cells)
    rank = ((cells - whole - 0.5) ** 2).sum(axis=1)
    order = np.lexsort((rank, *whole.T.astype(np.int32)))
    ordered = whole[order]
    return order[np.concatenate(([True], (ordered[1:] != ordered[:-1]).any(axis=1)))]


def sor_by_scipy(points: np.ndarray, workers: int) -> np.ndarray:
    """Return the mask of SOR with 20 neighbours at 2 sigma."""
    distance, _ = cKDTree(points).query(points, 21, workers=workers)
    mean = distance[:, 1:].mean(axis=1)
    return mean <= mean.mean() + 2 * mean.std()


def bench_speed(count: int, workers: int) -> None:
    """Print the speeds."""
    points = site(count)
    rng = np.random.default_rng(1)
    queries = points[: count // 2] + rng.normal(0, 0.02, (count // 2, 3))
    index, tree = neighbourhood.build_index(points), cKDTree(points)
    against("index", count, lambda: neighbourhood.build_index(points), lambda: cKDTree(points))
    against(
        "nearest",
        len(queries),
        lambda: neighbourhood.nearest(index, queries),
        lambda: tree.query(queries, workers=workers),
    )
    against(
        "20 nearest of the points",
        count,
        lambda: neighbourhood.knn(index, None, 20),
        lambda: tree.query(points, 21, workers=workers),
    )
    against(
        "statistical, 20 neighbours",
        count,
        lambda: filters.statistical(points),
        lambda: sor_by_scipy(points, workers),
    )
    against(
        "radius 0.15 m",
        count,
        lambda: filters.radius(points, filters.Radius(radius_m=0.15)),
        lambda: tree.query_ball_point(points, 0.15, return_length=True, workers=workers),
    )
    against(
        "octree voxel grid 0.05 m",
        count,
        lambda: filters.octree_voxel_grid(points, filters.OctreeVoxelGrid(voxel_m=0.05)),
        lambda: voxels_by_numpy(points, 0.05),
    )
    timed("normals, 20 neighbours", lambda: neighbourhood.normals(points), count)
    timed("curvature weighted", lambda: filters.curvature_weighted(points), count)
    near = points[:100_000] * [0.05, 0.05, 0.2]
    timed(
        "curvature weighted, about 2000 per ball", lambda: filters.curvature_weighted(near), 100_000
    )


def bench_facade() -> None:
    """Print what each filter removes and keeps on the facade."""
    points, labels = bracketed_facade()
    rows = {"curvature weighted, paper": filters.curvature_weighted(points)}
    rows["curvature weighted, global"] = filters.curvature_weighted(
        points, filters.CurvatureWeighted(rule="global")
    )
    for size in ({"radius_m": 0.15}, {"neighbours": 20}):
        for multiplier in (0.5, 1.0, 2.0, 3.0):
            rows[f"statistical {size}, {multiplier} sigma"] = filters.statistical(
                points, filters.Statistical(multiplier=multiplier, **size)
            )
    print(f"\n{'facade, 300 points/m2, 2 % noise: per cent':44s} noise removed, feature, flat kept")
    for name, chosen in rows.items():
        shares = [
            (~chosen.is_kept[np.isin(labels, NOISE_LABELS)]).mean(),
            chosen.is_kept[labels == FEATURE].mean(),
            chosen.is_kept[labels == SURFACE].mean(),
        ]
        print(f"{name:44s}", *(f"{100 * share:8.1f}" for share in shares))


if __name__ == "__main__":
    numbers = [int(float(value)) for value in sys.argv[1:]]
    threads.set_threads(numbers[1] if len(numbers) > 1 else threads.get_threads())
    bench_speed(numbers[0] if numbers else 1_000_000, threads.get_threads())
    bench_facade()
