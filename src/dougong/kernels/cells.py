"""Which cell of a cubic grid a point lies in: one rule for voxels, keys and tiles.

Coordinates are decimal and so are voxels: of points on whole millimetres every fifth layer lies on
a border of 5 mm voxels. Taking off the origin of a frame leaves dust (1e-9 m at map coordinates),
which would put such points now into one cell and now into the other. So what meets a border is
rounded, to steps of a half to one micrometre. A power of two of them make an edge: whole edges are
whole steps, the levels of an octree are nested, and distances from centres tie exactly.
"""

import math

import numpy as np

from dougong.kernels._arrays import Floats
from dougong.kernels._jit import kernel

_MOST_HALVINGS = 30
"""So that squared distances from a centre, in steps, fit 63 bits."""


@kernel
def steps_per_edge(edge_m: float) -> float:
    """Return how many steps make the edge of a cell: a power of two, 1 to 2**30."""
    _, exponent = math.frexp(edge_m * 1e6)
    return math.ldexp(1.0, min(max(exponent, 0), _MOST_HALVINGS))


@kernel
def steps_from(value: float, low: float, step_m: float) -> float:
    """Return how many whole steps `value` lies above `low`."""
    return float(np.rint((value - low) / step_m))


@kernel
def fill_cells(points: Floats, low: Floats, edge_m: float, out: Floats) -> None:
    """Fill out (n, 3) with the cell of each of points (n, 3): whole numbers, negative ones too.

    low (3,): where cell (0, 0, 0) begins.
    """
    steps = steps_per_edge(edge_m)
    for i in range(points.shape[0]):
        for axis in range(3):
            out[i, axis] = np.floor(steps_from(points[i, axis], low[axis], edge_m / steps) / steps)
