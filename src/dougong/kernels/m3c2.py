"""Normals of balls and distances in cylinders: the two steps of M3C2 (Lague 2013)."""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.boxtree import box_distance2
from dougong.kernels.moments import add_products, describe

_DEPTH = 64
_FIRST_ROOM = 256
_STEPS = 2.0**19
"""Lattice steps per ball radius: sums of their products over 3e7 points are exact in int64."""


@kernel
def _add_point(points: Floats, i: int, core: Floats, per_m: float, sums: Ints) -> None:
    """Add sorted point i, as whole lattice steps from the core point, to sums (10,)."""
    x = np.int64(np.floor((points[i, 0] - core[0]) * per_m + 0.5))
    y = np.int64(np.floor((points[i, 1] - core[1]) * per_m + 0.5))
    z = np.int64(np.floor((points[i, 2] - core[2]) * per_m + 0.5))
    sums[0] += 1
    add_products(x, y, z, sums[1:])


@kernel
def _covariance(sums: Ints, a: Floats) -> None:
    """Write the covariance (3, 3) of sums (10,), in squared lattice steps, into a."""
    m = float(sums[0])
    mx, my, mz = sums[1] / m, sums[2] / m, sums[3] / m
    a[0, 0] = sums[4] / m - mx * mx
    a[1, 1] = sums[5] / m - my * my
    a[2, 2] = sums[6] / m - mz * mz
    a[0, 1] = a[1, 0] = sums[7] / m - mx * my
    a[0, 2] = a[2, 0] = sums[8] / m - mx * mz
    a[1, 2] = a[2, 1] = sums[9] / m - my * mz


@kernel
def ball_normals(
    points: Floats,
    boxes: Floats,
    cores: Floats,
    radius: float,
    start: int,
    stop: int,
    counts: Ints,
    normals: Floats,
    variation: Floats,
    planarity: Floats,
) -> None:
    """Describe the sorted points within `radius`, inclusive, of core points start .. stop - 1.

    counts (m,), normals (m, 3), variation (m,) and planarity (m,) are filled; NaN with fewer than
    three points. Sums are of whole numbers, so they do not depend on the order of the points.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    radius2 = radius * radius
    stack = np.empty(_DEPTH, np.int64)
    sums = np.empty(10, np.int64)
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    for q in range(start, stop):
        x, y, z = cores[q, 0], cores[q, 1], cores[q, 2]
        sums[:] = 0
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            if box_distance2(boxes, node, x, y, z) > radius2:
                continue
            if node < leaves:
                stack[height] = 2 * node
                stack[height + 1] = 2 * node + 1
                height += 2
                continue
            leaf = node - leaves
            for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
                dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
                if dx * dx + dy * dy + dz * dz <= radius2:
                    _add_point(points, i, cores[q], _STEPS / radius, sums)
        counts[q] = sums[0]
        if sums[0] < 3:
            normals[q, :] = np.nan
            variation[q] = planarity[q] = np.nan
            continue
        _covariance(sums, a)
        describe(a, v, q, normals, variation, planarity)


@kernel
def _quantile(ordered: Floats, share: float) -> float:
    """Return the quantile of an ordered array, linear between its values."""
    place = share * (ordered.shape[0] - 1)
    below = int(np.floor(place))
    above = min(below + 1, ordered.shape[0] - 1)
    return float(ordered[below] + (place - below) * (ordered[above] - ordered[below]))


@kernel
def _grown(held: Floats) -> Floats:
    """Return an array with twice the room that begins with what is held."""
    wide = np.empty(2 * held.shape[0], np.float64)
    wide[: held.shape[0]] = held
    return wide


@kernel
def _is_apart(boxes: Floats, node: int, core: Floats, reach: Floats) -> bool:
    """Say whether the box of `node` lies outside the box of half sides `reach` round the core."""
    for axis in range(3):
        if boxes[node, axis] > core[axis] + reach[axis]:
            return True
        if boxes[node, 3 + axis] < core[axis] - reach[axis]:
            return True
    return False


@kernel
def _reach(normal: Floats, length: float, radius: float, reach: Floats) -> None:
    """Write the half sides of a cylinder's box into reach (3,)."""
    for axis in range(3):
        along = abs(normal[axis])
        # A hair more than the cylinder's box: rounding must not prune a point on its rim.
        reach[axis] = 1e-9 + length * along + radius * np.sqrt(max(1.0 - along * along, 0.0))


@kernel
def _summary(ordered: Floats, use_median: bool) -> tuple[float, float]:
    """Return middle and spread: median and IQR / 1.349, or mean and standard deviation."""
    n = ordered.shape[0]
    if use_median:
        spread = (_quantile(ordered, 0.75) - _quantile(ordered, 0.25)) / 1.3489795003921634
        return _quantile(ordered, 0.5), spread
    mean = 0.0
    for i in range(n):
        mean += ordered[i]
    mean /= n
    second = 0.0
    for i in range(n):
        second += (ordered[i] - mean) * (ordered[i] - mean)
    return mean, np.sqrt(second / (n - 1)) if n > 1 else 0.0


@kernel
def _along_axis(
    points: Floats,
    boxes: Floats,
    core: Floats,
    normal: Floats,
    radius: float,
    length: float,
    reach: Floats,
    stack: Ints,
    held: Floats,
) -> tuple[int, Floats]:
    """Return how many points lie in a cylinder, and an array that begins with their positions.

    Along its axis, from the core point. That array is `held` or, where it is too short, a new one.
    """
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    x, y, z = core[0], core[1], core[2]
    nx, ny, nz = normal[0], normal[1], normal[2]
    count = 0
    stack[0] = 1
    height = 1
    while height > 0:
        height -= 1
        node = stack[height]
        if _is_apart(boxes, node, core, reach):
            continue
        if node < leaves:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2
            continue
        leaf = node - leaves
        for i in range(leaf * n // leaves, (leaf + 1) * n // leaves):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            along = dx * nx + dy * ny + dz * nz
            dx -= along * nx
            dy -= along * ny
            dz -= along * nz
            if abs(along) > length or dx * dx + dy * dy + dz * dz > radius * radius:
                continue
            if count == held.shape[0]:
                held = _grown(held)
            held[count] = along
            count += 1
    return count, held


@kernel
def project(
    points: Floats,
    boxes: Floats,
    cores: Floats,
    normals: Floats,
    radius: float,
    length: float,
    use_median: bool,
    start: int,
    stop: int,
    counts: Ints,
    middles: Floats,
    spreads: Floats,
) -> None:
    """Summarise where the sorted points in a cylinder lie along its axis.

    The cylinders of core points start .. stop - 1 have the given radius, stand along their normals
    (m, 3) and reach `length` to either side, inclusive. counts (m,), middles (m,) and spreads (m,)
    are filled; NaN where the cylinder is empty. Positions are sorted first, so that the sums do
    not depend on the order of the points.
    """
    stack = np.empty(_DEPTH, np.int64)
    reach = np.empty(3, np.float64)
    held = np.empty(_FIRST_ROOM, np.float64)
    for q in range(start, stop):
        counts[q] = 0
        middles[q] = spreads[q] = np.nan
        if not (normals[q, 0] == normals[q, 0]):
            continue
        _reach(normals[q], length, radius, reach)
        count, held = _along_axis(
            points, boxes, cores[q], normals[q], radius, length, reach, stack, held
        )
        if count == 0:
            continue
        ordered = held[:count]
        ordered.sort()
        counts[q] = count
        middles[q], spreads[q] = _summary(ordered, use_median)
