"""Columns of voxels: how many points stand by each voxel, and which voxels make one surface.

A voxel is `cell` wide in plan and `level` high. The voxels of a cloud are kept as one sorted
array of keys, ``(row * columns + column) * levels + level``: a column is a run of it.
"""

import numpy as np

from dougong.kernels._arrays import Flags, Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.disjoint import join, root_of
from dougong.kernels.raster import rounded


@kernel
def voxel_keys(
    points: Floats,
    origin: Floats,
    cell: float,
    level: float,
    shape: tuple[int, int, int],
    out: Ints,
) -> None:
    """Fill out[i] with the key of the voxel of point i; -1 beside or above all.

    points (n, 3); origin (3,): low corner of voxel 0; shape (rows, columns, levels); out (n,).
    What lies below all levels counts with the lowest.
    """
    rows, columns, levels = shape
    for i in range(points.shape[0]):
        column = np.floor(rounded(points[i, 0], origin[0]) / cell)
        row = np.floor(rounded(points[i, 1], origin[1]) / cell)
        k = max(np.floor(rounded(points[i, 2], origin[2]) / level), 0.0)
        # Compared as they are: a float beyond int64 has no integer.
        if 0 <= column < columns and 0 <= row < rows and k < levels:
            out[i] = (int(row) * columns + int(column)) * levels + int(k)
        else:
            out[i] = -1


@kernel
def runs(keys: Ints, unique: Ints, count: Ints) -> int:
    """Fill `unique` and `count` with the distinct values >= 0 of sorted `keys`; return how many.

    keys (n,) ascending; unique, count (n,) or longer.
    """
    m = 0
    for i in range(keys.shape[0]):
        if keys[i] < 0:
            continue
        if m > 0 and unique[m - 1] == keys[i]:
            count[m - 1] += 1
        else:
            unique[m] = keys[i]
            count[m] = 1
            m += 1
    return m


@kernel
def column_starts(unique: Ints, levels: int, out: Ints) -> None:
    """Fill out[c] with where the run of column c starts; out (rows * columns + 1,)."""
    c = 0
    for v in range(unique.shape[0]):
        while c <= unique[v] // levels:
            out[c] = v
            c += 1
    while c < out.shape[0]:
        out[c] = unique.shape[0]
        c += 1


@kernel
def first_at_or_above(unique: Ints, start: int, stop: int, key: int) -> int:
    """Return the first position in unique[start:stop] with a value >= key (stop if none)."""
    while start < stop:
        middle = (start + stop) // 2
        if unique[middle] < key:
            start = middle + 1
        else:
            stop = middle
    return start


@kernel
def count_support(
    unique: Ints,
    count: Ints,
    starts: Ints,
    shape: tuple[int, int, int],
    first: int,
    last: int,
    out: Ints,
) -> None:
    """Fill out[v] with the points in the 3 x 3 x 3 voxels round voxel v, for first <= v < last.

    unique, count, out (m,); starts (rows * columns + 1,); shape (rows, columns, levels).
    """
    rows, columns, levels = shape
    for v in range(first, last):
        column = unique[v] // levels
        k = unique[v] % levels
        row = column // columns
        column -= row * columns
        total = 0
        for r in range(max(0, row - 1), min(rows, row + 2)):
            for c in range(max(0, column - 1), min(columns, column + 2)):
                base = (r * columns + c) * levels
                stop = starts[r * columns + c + 1]
                u = first_at_or_above(unique, starts[r * columns + c], stop, base + max(0, k - 1))
                while u < stop and unique[u] <= base + min(k + 1, levels - 1):
                    total += count[u]
                    u += 1
        out[v] = total


@kernel
def mark_strong(
    support: Ints,
    starts: Ints,
    least: int,
    share: float,
    out: Flags,
) -> None:
    """Fill out[v]: enough points round voxel v for a surface.

    At least `least`, and at least `share` of the best supported voxel of the same column.
    support, out (m,); starts (rows * columns + 1,).
    """
    for c in range(starts.shape[0] - 1):
        best = 0
        for v in range(starts[c], starts[c + 1]):
            best = max(best, support[v])
        for v in range(starts[c], starts[c + 1]):
            out[v] = support[v] >= least and support[v] >= share * best


@kernel
def link_surfaces(
    unique: Ints,
    starts: Ints,
    is_strong: Flags,
    shape: tuple[int, int, int],
    reach: int,
    parent: Ints,
) -> None:
    """Fill `parent` with the surface of each strong voxel: the smallest position in it.

    Voxels of one column or of columns that touch (8 neighbours) belong together when their levels
    differ by at most `reach`. unique, is_strong, parent (m,); weak voxels keep themselves.
    """
    rows, columns, levels = shape
    for v in range(unique.shape[0]):
        parent[v] = v
    for v in range(unique.shape[0]):
        if not is_strong[v]:
            continue
        column = unique[v] // levels
        k = unique[v] % levels
        row = column // columns
        column -= row * columns
        # Only half of the neighbours: the other half meets this voxel from its own side.
        for m in range(5):
            r = row + (0 if m < 2 else 1)
            c = column + (m if m < 2 else m - 3)
            if r >= rows or c < 0 or c >= columns:
                continue
            base = (r * columns + c) * levels
            stop = starts[r * columns + c + 1]
            u = first_at_or_above(unique, starts[r * columns + c], stop, base + max(0, k - reach))
            while u < stop and unique[u] <= base + min(k + reach, levels - 1):
                if is_strong[u]:
                    join(parent, v, u)
                u += 1
    for v in range(unique.shape[0]):
        parent[v] = root_of(parent, v)


@kernel
def mark_levels(
    unique: Ints,
    levels: int,
    is_strong: Flags,
    parent: Ints,
    smallest: int,
    out: Flags,
) -> None:
    """Fill out[v]: voxel v belongs to a surface over at least `smallest` columns.

    unique, is_strong, parent, out (m,); parent as from `link_surfaces`.
    """
    area = np.zeros(unique.shape[0], np.int64)
    latest = np.full(unique.shape[0], -1, np.int64)
    for v in range(unique.shape[0]):
        column = unique[v] // levels
        if is_strong[v] and latest[parent[v]] != column:
            latest[parent[v]] = column
            area[parent[v]] += 1
    for v in range(unique.shape[0]):
        out[v] = is_strong[v] and area[parent[v]] >= smallest


@kernel
def mark_low(
    points: Floats,
    keys: Ints,
    unique: Ints,
    starts: Ints,
    levels: int,
    is_level: Flags,
    floor: Floats,
    out: Flags,
) -> None:
    """Fill out[i]: point i lies below the floor of its column and belongs to no level.

    points (n, 3), keys (n,) as from `voxel_keys` (-1: never low); floor (rows * columns,): z in
    the frame of the points, NaN where nothing is known; is_level (m,); out (n,).
    """
    for i in range(points.shape[0]):
        out[i] = False
        if keys[i] < 0:
            continue
        column = keys[i] // levels
        # Rounded, so that a point as high as the floor is not below it in some frame.
        if rounded(points[i, 2], floor[column]) < 0.0:
            v = first_at_or_above(unique, starts[column], starts[column + 1], keys[i])
            out[i] = not is_level[v]
