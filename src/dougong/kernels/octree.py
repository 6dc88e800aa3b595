"""Voxels of an octree level as runs of points sorted by Morton key."""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.cells import steps_from, steps_per_edge


@kernel
def centre_rank(points: Floats, i: int, low: Floats, step_m: float, steps: float) -> int:
    """Return how far point i lies from the centre of its voxel of so many steps, squared.

    In whole steps (see `cells`), so points that mirror each other about a centre tie, whatever the
    rounding of the frame (common on quantised data).
    """
    total = 0
    for axis in range(3):
        up = steps_from(points[i, axis], low[axis], step_m)
        off = int(up - np.floor(up / steps) * steps - 0.5 * steps)
        total += off * off
    return total


@kernel
def nearest_to_centres(
    points: Floats,
    places: Ints,
    run_starts: Ints,
    low: Floats,
    voxel_m: float,
    first_run: int,
    last_run: int,
    chosen: Ints,
    twins: Ints,
    counts: Ints,
) -> None:
    """Choose the point of each run (voxel) that is nearest the voxel's centre.

    points (n, 3) in the caller's order; places (n,) sorts them; run_starts (runs + 1,). Ties: the
    smallest (x, y, z). Filled: chosen (runs,) a place in `points`; twins (runs,) how many points
    lie exactly where the chosen one does; counts (n,) the points of each point's voxel.
    """
    steps = steps_per_edge(voxel_m)
    step_m = voxel_m / steps
    for run in range(first_run, last_run):
        start, stop = run_starts[run], run_starts[run + 1]
        best = places[start]
        best_rank = centre_rank(points, best, low, step_m, steps)
        same = 1
        counts[best] = stop - start
        for at in range(start + 1, stop):
            i = places[at]
            counts[i] = stop - start
            rank = centre_rank(points, i, low, step_m, steps)
            if rank > best_rank:
                continue
            order = 0
            if rank == best_rank:
                for axis in range(3):
                    if points[i, axis] != points[best, axis]:
                        order = 1 if points[i, axis] > points[best, axis] else -1
                        break
                if order == 0:
                    same += 1
                    best = min(best, i)
                    continue
            if rank < best_rank or order < 0:
                best = i
                best_rank = rank
                same = 1
        chosen[run] = best
        twins[run] = same
