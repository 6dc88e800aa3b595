"""Which points others would hide, seen from a place: one nearest range per direction."""

import math

import numpy as np

from dougong.kernels._arrays import Floats
from dougong.kernels._jit import kernel


@kernel
def hidden_shares(
    points: Floats,
    places: Floats,
    rows: int,
    factor: float,
    extra: float,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Return the share of `points` (n, 3) that is hidden from places (k, 3), start .. stop - 1.

    Directions are rows x 2 rows cells of elevation and azimuth; a point is hidden that is farther
    than factor * r + extra, r the nearest range in its cell, and the nearest in the cell beside it
    towards the horizon: ground that runs away from the place has many ranges in one cell, but what
    hides a point stands up before it. out (k,).
    """
    n = points.shape[0]
    nearest = np.empty(2 * rows * rows)
    cells = np.empty(n, np.int64)
    ranges = np.empty(n)
    for k in range(start, stop):
        nearest[:] = np.inf
        for i in range(n):
            dx = points[i, 0] - places[k, 0]
            dy = points[i, 1] - places[k, 1]
            dz = points[i, 2] - places[k, 2]
            distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
            sine = min(max(dz / distance, -1.0), 1.0)
            row = int((math.asin(sine) / math.pi + 0.5) * rows)
            column = int((math.atan2(dy, dx) / math.pi + 1.0) * rows) % (2 * rows)
            cell = min(max(row, 0), rows - 1) * 2 * rows + column
            cells[i] = cell
            ranges[i] = distance
            nearest[cell] = min(nearest[cell], distance)
        hidden = 0
        for i in range(n):
            is_below = 2 * (cells[i] // (2 * rows)) < rows
            towards = 2 * rows if is_below else -2 * rows
            least = max(nearest[cells[i]], nearest[cells[i] + towards])
            hidden += ranges[i] > factor * least + extra
        out[k] = hidden / n
