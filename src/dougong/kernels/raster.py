"""Points into plan grids: heights for the cloth, and counts, lowest and highest per cell.

Grids are arrays of shape (rows, columns); row is along y, column along x. Every kernel gives the
same grid for any order of the points: a cell keeps an extreme or a count, and ties are broken by
content. The loops are serial, since threads would meet in the cells; 1e7 points take 0.1-0.3 s.
"""

import numpy as np

from dougong.kernels._arrays import Flags, Floats, Ints
from dougong.kernels._jit import kernel

MICRON = 1e-6
"""Plan coordinates and heights are rounded to this (metres) before they meet a cell or a tie."""


@kernel
def rounded(value: float, origin: float) -> float:
    """Return ``value - origin`` rounded to a micrometre.

    Subtracting a map-sized origin leaves 1e-9 m of dust, which would put a point that lies on the
    border of two cells now in one and now in the other.
    """
    return float(np.rint((value - origin) * 1e6) * MICRON)


@kernel
def nearest_heights(
    points: Floats,
    origin: Floats,
    cell: float,
    best: Floats,
    out: Floats,
) -> None:
    """Fill each node of a grid with the height of the point nearest to it in plan.

    points (n, 3); origin (3,): node (row, column) stands at origin + cell * (column, row).
    best, out (rows, columns): best holds squared plan distances (start it with infinity; a
    second call continues a stream), out the heights above origin[2] (start it with NaN).
    Points whose nearest node is outside the grid are skipped. Of points equally near (squared
    distances within 1e-8 m2) the lowest counts.
    """
    rows, columns = out.shape
    for i in range(points.shape[0]):
        x = rounded(points[i, 0], origin[0])
        y = rounded(points[i, 1], origin[1])
        column = int(np.floor(x / cell + 0.5))
        row = int(np.floor(y / cell + 0.5))
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        dx = x - column * cell
        dy = y - row * cell
        distance = np.rint((dx * dx + dy * dy) * 1e8)
        z = rounded(points[i, 2], origin[2])
        if distance < best[row, column] or (distance == best[row, column] and z < out[row, column]):
            best[row, column] = distance
            out[row, column] = z


@kernel
def lowest_heights(points: Floats, origin: Floats, cell: float, out: Floats) -> None:
    """Fill each node of a grid with the lowest height among the points nearest to it.

    As `nearest_heights`, but of all points whose nearest node it is, the lowest counts.
    out (rows, columns), metres above origin[2]; start it with NaN (a second call continues).
    """
    rows, columns = out.shape
    for i in range(points.shape[0]):
        column = int(np.floor(rounded(points[i, 0], origin[0]) / cell + 0.5))
        row = int(np.floor(rounded(points[i, 1], origin[1]) / cell + 0.5))
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        z = rounded(points[i, 2], origin[2])
        # Written so that NaN, the empty cell, is replaced.
        if not out[row, column] <= z:
            out[row, column] = z


@kernel
def cell_max(ix: Ints, iy: Ints, values: Floats, shape: tuple[int, int], out: Floats) -> None:
    """Raise out[iy, ix] to the largest value of the cell.

    ix, iy, values (n,); points outside `shape` (rows, columns) and NaN values are skipped.
    out (rows, columns): start it with NaN for "empty"; a second call continues a stream.
    """
    for i in range(values.shape[0]):
        if 0 <= ix[i] < shape[1] and 0 <= iy[i] < shape[0] and values[i] == values[i]:
            if not out[iy[i], ix[i]] >= values[i]:
                out[iy[i], ix[i]] = values[i]


@kernel
def cell_min(ix: Ints, iy: Ints, values: Floats, shape: tuple[int, int], out: Floats) -> None:
    """Lower out[iy, ix] to the smallest value of the cell.

    ix, iy, values (n,); points outside `shape` (rows, columns) and NaN values are skipped.
    out (rows, columns): start it with NaN for "empty"; a second call continues a stream.
    """
    for i in range(values.shape[0]):
        if 0 <= ix[i] < shape[1] and 0 <= iy[i] < shape[0] and values[i] == values[i]:
            if not out[iy[i], ix[i]] <= values[i]:
                out[iy[i], ix[i]] = values[i]


@kernel
def plan_count(points: Floats, low: Floats, high: Floats, cell: float, out: Ints) -> None:
    """Add the number of points of each cell of a plan box to out[row, column].

    points (n, 3); low, high (2,): the box, both ends included; points outside are skipped.
    cell: metres; out (rows, columns), large enough for the box.
    """
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        if low[0] <= x <= high[0] and low[1] <= y <= high[1]:
            out[int((y - low[1]) / cell), int((x - low[0]) / cell)] += 1


@kernel
def plan_bounds(points: Floats, low: Floats, high: Floats, out: Floats) -> None:
    """Widen out = (x low, y low, x high, y high, z low) to the points inside a plan box.

    points (n, 3); low, high (2,): the box, both ends included. out (5,): start it with
    (inf, inf, -inf, -inf, inf).
    """
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        if low[0] <= x <= high[0] and low[1] <= y <= high[1]:
            out[0] = min(out[0], x)
            out[1] = min(out[1], y)
            out[2] = max(out[2], x)
            out[3] = max(out[3], y)
            out[4] = min(out[4], points[i, 2])


@kernel
def blank_unsupported(
    points: Floats, origin: Floats, cell: float, is_supported: Flags, out: Floats
) -> None:
    """Set out[i] to NaN where the node nearest to point i is not supported or not in the grid.

    points (n, 3); origin, cell: as for `nearest_heights`; is_supported (rows, columns); out (n,).
    """
    rows, columns = is_supported.shape
    for i in range(points.shape[0]):
        column = int(np.floor(rounded(points[i, 0], origin[0]) / cell + 0.5))
        row = int(np.floor(rounded(points[i, 1], origin[1]) / cell + 0.5))
        is_inside = 0 <= column < columns and 0 <= row < rows
        if not is_inside or not is_supported[row, column]:
            out[i] = np.nan
