"""Far points, isolated points and the noise of a raw cloud, by voxels alone."""

import itertools

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import Groups, grouped, sorted_places
from dougong.typing import Index, Mask, Points

_PATCH_POINTS = 16
"""Points per voxel that are aimed at: enough for a plane, few enough to be one."""


def far_points(points: Points) -> Mask:
    """Return which points (n,) lie far outside the box that holds nearly all others.

    The box is the 0.5-99.5 % range of each axis, widened by its own length (10 m at least) on
    either side: what a scan reaches thinly stays, a stray return kilometres away does not.
    """
    low, high = np.column_stack([np.quantile(axis, [0.005, 0.995]) for axis in points.T])
    margin = np.maximum(high - low, 10.0)
    is_far: Mask = ((points < low - margin) | (points > high + margin)).any(axis=1)
    return is_far


def isolated_points(points: Points, min_count: int = 4) -> Mask:
    """Return which points (n,) have too few others in the voxels around them.

    The voxel follows the density: on the typical surface it holds about 16 points, so its 27
    neighbours hold over 100. Points with less than `min_count` there (themselves included) are
    alone.
    """
    edge = patch_edge_m(points)
    keys, place, counts = _voxels(points, edge)
    total = np.zeros(len(keys), dtype=np.int64)
    stride = _strides(*extent(points), edge)
    for step in itertools.product((-1, 0, 1), repeat=3):
        wanted = keys + int(np.dot(step, stride))
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        total += np.where(keys[at] == wanted, counts[at], 0)
    return total[place] < min_count


def patch_edge_m(points: Points) -> float:
    """Return the voxel edge at which the typical point shares its voxel with 15 others.

    Judged on whole blocks of space, chosen by a hash of their place, so that the cost does not
    grow with the cloud and the order of the points plays no part.
    """
    edge = float(np.max(np.subtract(*extent(points)[::-1]))) / 64.0
    edge = max(edge, 1e-6)
    sample = points[in_some_blocks(points, edge)]
    for _ in range(4):
        _, place, counts = _voxels(sample, edge)
        typical = float(np.median(counts[place]))
        edge *= float(np.clip(np.sqrt(_PATCH_POINTS / typical), 0.05, 2.0))
    return edge


def sensor_noise(points: Points) -> float:
    """Return the noise of one point across its surface (standard deviation, metres).

    The residual of planes fitted to the points of each well-filled voxel, unbiased for the three
    fitted parameters, median over the flatter half of the voxels. Includes surface roughness
    finer than a voxel. 0.0 where no voxel holds enough points.
    """
    edge = patch_edge_m(points) * 1.5
    points = points[in_some_blocks(points, 8.0 * edge)]
    _, place, counts = _voxels(points, edge)
    order = sorted_places(place)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1]
    ordered = points[order]
    offset = ordered - np.repeat(ordered[starts], counts, axis=0)
    mean = np.add.reduceat(offset, starts, axis=0) / counts[:, None]
    offset -= np.repeat(mean, counts, axis=0)
    products = offset[:, [0, 0, 0, 1, 1, 2]] * offset[:, [0, 1, 2, 1, 2, 2]]
    second = np.add.reduceat(products, starts, axis=0)
    is_full = counts >= _PATCH_POINTS
    if is_full.sum() < 10:
        return 0.0
    matrix = second[is_full][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    values = np.linalg.eigvalsh(matrix)
    flatness = values[:, 0] / np.maximum(values[:, 1], 1e-300)
    is_flat = flatness <= np.median(flatness)
    variance = values[is_flat, 0] / (counts[is_full][is_flat] - 3)
    return float(np.sqrt(np.clip(np.median(variance), 0.0, None)))


def extent(points: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the low and high corner of `points`; by columns, ten times faster than by rows."""
    columns = range(points.shape[1])
    return (
        np.array([points[:, axis].min() for axis in columns]),
        np.array([points[:, axis].max() for axis in columns]),
    )


def in_some_blocks(points: Points, edge: float, wanted: int = 200_000) -> Mask:
    """Return which points lie in blocks of `edge` chosen by hash; about `wanted` points."""
    every = len(points) // wanted
    if every < 2:
        return np.ones(len(points), dtype=bool)
    cell = np.floor((points - extent(points)[0]) / edge).astype(np.uint64)
    mixed = cell @ np.array([73856093, 19349663, 83492791], dtype=np.uint64)
    mixed ^= mixed >> np.uint64(17)
    mixed *= np.uint64(0x9E3779B97F4A7C15)
    is_in: Mask = (mixed >> np.uint64(33)) % np.uint64(every) == 0
    return is_in


def _strides(low: NDArray[np.float64], high: NDArray[np.float64], edge: float) -> Index:
    """Return what one step along x, y, z adds to a voxel key (room for a step outside)."""
    size = np.floor((high - low) / edge).astype(np.int64) + 3
    return np.array([size[1] * size[2], size[2], 1], dtype=np.int64)


def _voxels(points: Points, edge: float) -> Groups:
    """Return the occupied voxels, the voxel of each point, points per voxel."""
    low, high = extent(points)
    cell = np.floor((points - low) / edge).astype(np.int64) + 1
    return grouped(cell @ _strides(low, high, edge))
