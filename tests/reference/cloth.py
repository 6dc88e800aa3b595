"""Slow twins of the cloth and its raster, written from the definition, and the published filter.

`fall` and `rasterise` follow Zhang et al. (2016) particle by particle. `published` runs the PyPI
package cloth-simulation-filter in a process of its own: it prints, its threads race, and it
must not find the working directory.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

RING = [(-1, -1), (0, -1), (1, -1), (-1, 0), (-1, 1), (0, 1), (1, 0), (1, 1)]
NEIGHBOURS = RING + [(2 * row, 2 * column) for row, column in RING]


def rasterise(points, origin, cell, shape, rule):
    """Return the grid of heights above origin[2]; NaN where no point is nearest to a node."""
    out = np.full(shape, np.nan)
    local = np.rint((points - origin) * 1e6) * 1e-6
    nodes = np.floor(local[:, :2] / cell + 0.5).astype(int)
    for column, row in {tuple(node) for node in nodes.tolist()}:
        if not (0 <= row < shape[0] and 0 <= column < shape[1]):
            continue
        mine = local[(nodes == (column, row)).all(axis=1)]
        distance = np.rint(((mine[:, :2] - cell * np.array([column, row])) ** 2).sum(axis=1) * 1e8)
        if rule == "nearest":
            mine = mine[distance == distance.min()]
        out[row, column] = mine[:, 2].min()
    return out


def fill(heights):
    """Return `heights` with empty nodes filled: right, left, below, above; else NaN."""
    out = heights.copy()
    for row, column in np.argwhere(np.isnan(heights)):
        for line in (
            heights[row, column + 1 :],
            heights[row, :column][::-1],
            heights[:row, column][::-1],
            heights[row + 1 :, column],
        ):
            known = line[~np.isnan(line)]
            if len(known):
                out[row, column] = known[0]
                break
    return out


def fall(surface, start, drop, single, double, iterations, smallest_move):
    """Return (heights, is_landed, steps) of a cloth that falls on `surface`."""
    rows, columns = surface.shape
    height = np.full(surface.shape, start)
    before = height.copy()
    is_free = np.ones(surface.shape, bool)
    for step in range(1, iterations + 1):  # noqa: B007
        now = height.copy()
        height[is_free] += ((height - before) * 0.99 - drop)[is_free]
        before[is_free] = now[is_free]
        for row, column in np.ndindex(rows, columns):
            for down, right in NEIGHBOURS:
                r, c = row + down, column + right
                if not (0 <= r < rows and 0 <= c < columns):
                    continue
                gap = height[r, c] - height[row, column]
                if is_free[row, column] and is_free[r, c]:
                    height[row, column] += gap * double
                    height[r, c] -= gap * double
                elif is_free[row, column]:
                    height[row, column] += gap * single
                elif is_free[r, c]:
                    height[r, c] -= gap * single
        moves = np.abs(before - height)[is_free]
        lands = is_free & (height < surface)
        height[lands] = surface[lands]
        is_free &= ~lands
        if moves.max(initial=0.0) < smallest_move:
            break
    return height, ~is_free, step


def smooth(surface, smooth_threshold, height_threshold, smallest_patch, cloth, is_landed):
    """Return (cloth, is_landed) after slope smoothing, sweep after sweep until nothing changes."""
    from scipy.ndimage import label

    patches, _ = label(~is_landed)
    is_large = np.bincount(patches.ravel())[patches] > smallest_patch
    cloth, landed = cloth.copy(), is_landed.copy()
    changed = True
    while changed:
        changed = False
        for row, column in np.argwhere(is_large & ~is_landed & ~landed):
            for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                r, c = row + down, column + right
                if (
                    0 <= r < surface.shape[0]
                    and 0 <= c < surface.shape[1]
                    and landed[r, c]
                    and np.rint(abs(surface[r, c] - surface[row, column]) * 1e6)
                    <= np.rint(smooth_threshold * 1e6)
                    and cloth[row, column] - surface[row, column] < height_threshold
                ):
                    cloth[row, column] = surface[row, column]
                    landed[row, column] = changed = True
                    break
    return cloth, landed


PUBLISHED = """
import sys, time
import CSF
import numpy as np
points = np.load("points.npy")
csf = CSF.CSF()
csf.params.cloth_resolution = float(sys.argv[1])
csf.params.rigidness = int(sys.argv[2])
csf.params.class_threshold = float(sys.argv[3])
csf.params.bSloopSmooth = sys.argv[4] == "True"
csf.params.time_step = float(sys.argv[5])
csf.params.interations = int(sys.argv[6])
ground, rest = CSF.VecInt(), CSF.VecInt()
started = time.perf_counter()
csf.setPointCloud(points)
csf.do_filtering(ground, rest, False)
seconds = time.perf_counter() - started
is_ground = np.zeros(len(points), bool)
is_ground[np.array(ground, dtype=np.int64)] = True
np.save("is_ground.npy", is_ground)
import resource
np.save("cost.npy", [seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024])
"""


def published(points, params, threads=1):
    """Return (is_ground, seconds, peak MB) of cloth-simulation-filter at the same parameters."""
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "points.npy", np.ascontiguousarray(points))
        values = (
            params.cloth_resolution_m,
            params.rigidness,
            params.class_threshold_m,
            params.slope_smoothing,
            params.time_step,
            params.iterations,
        )
        subprocess.run(
            [sys.executable, "-c", PUBLISHED, *map(str, values)],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": str(threads)},
            check=True,
            capture_output=True,
            timeout=500,
        )
        seconds, peak_mb = np.load(Path(folder) / "cost.npy")
        return np.load(Path(folder) / "is_ground.npy"), float(seconds), float(peak_mb)


def terrain(x, y, slope=0.05):
    """Return the ground of `hall_site` at x, y (metres)."""
    return slope * x + 0.8 * np.sin(x / 15) * np.cos(y / 12)


def hall_site(number, seed=0, outliers=0.0, depth=6.0, slope=0.05, size=80.0):
    """Return (points, label) of a hall with trees and cars on 80 x 80 m of rolling terrain.

    label: 2 ground, 0 anything standing on it, 5 outliers: that share of all points, uniform
    from `depth` below the ground to 20 m above it. 1 cm noise on every surface.
    """
    rng = np.random.default_rng(seed)
    n = int(number / (1 + outliers))
    x, y = rng.random((2, int(n * 0.6))) * size
    ground = np.column_stack([x, y, terrain(x, y, slope)])
    ground = ground[~((abs(x - 40) < 15) & (abs(y - 40) < 10))]
    x, y = 25 + 30 * rng.random(int(n * 0.15)), 30 + 20 * rng.random(int(n * 0.15))
    base = terrain(40.0, 40.0, slope)
    roof = np.column_stack([x, y, base + 7 + 4 * (1 - abs(y - 40) / 10)])
    t = rng.random(int(n * 0.1)) * 100
    corners = np.array([0.0, 30, 50, 80, 100])
    x, y = np.interp(t, corners, [25, 55, 55, 25, 25]), np.interp(t, corners, [30, 30, 50, 50, 30])
    walls = np.column_stack([x, y, terrain(x, y, slope) + 7 * rng.random(len(t))])
    stems = np.column_stack([size * rng.random(12), np.where(rng.random(12) < 0.5, 10, 70)])
    stems = stems[rng.integers(0, 12, int(n * 0.13))]
    crown = rng.normal(size=(len(stems), 3))
    crown *= 2.5 * np.cbrt(rng.random((len(stems), 1))) / np.linalg.norm(crown, axis=1)[:, None]
    crown += np.column_stack([stems, terrain(*stems.T, slope) + 5])
    cars = np.column_stack([size * rng.random(10), 2 + 20 * rng.random(10)])
    cars = cars[rng.integers(0, 10, int(n * 0.02))]
    cars = np.column_stack([cars, terrain(*cars.T, slope)]) + rng.random((len(cars), 3)) * [
        4,
        1.8,
        1.5,
    ]
    parts = [ground, roof, walls, crown, cars]
    points = np.concatenate(parts)
    points += rng.normal(0, 0.01, points.shape)
    label = np.repeat([2, 0, 0, 0, 0], [len(part) for part in parts])
    x, y = rng.random((2, int(outliers * len(points)))) * size
    z = terrain(x, y, slope) - depth + (depth + 20) * rng.random(len(x))
    points = np.concatenate([points, np.column_stack([x, y, z])])
    label = np.concatenate([label, np.full(len(x), 5)])
    order = rng.permutation(len(points))
    return points[order], label[order]
