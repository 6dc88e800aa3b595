"""Morton codes of an octree cube, and which points show at which level of a COPC file."""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel

LEVELS = 21
"""Octree levels in one 63-bit code."""


@kernel
def spread_bits(value: np.uint64) -> np.uint64:
    """Put two zero bits between the low 21 bits of `value`."""
    v = value & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@kernel
def cube_codes(
    x: NDArray[np.int32],
    y: NDArray[np.int32],
    z: NDArray[np.int32],
    low: NDArray[np.int64],
    cells_per_step: NDArray[np.float64],
    start: int,
    stop: int,
    out: NDArray[np.uint64],
) -> None:
    """Fill `out` with the Morton code of each point in a cube of 2^21 cells along each axis.

    Parameters
    ----------
    x, y, z : ndarray, shape (n,)
        Integer coordinates of the file.
    low : ndarray, shape (3,)
        Integer coordinates of the cube's low corner.
    cells_per_step : ndarray, shape (3,)
        Cells per integer step along each axis.
    """
    last = np.float64(2**21 - 1)
    for i in range(start, stop):
        a = min((np.int64(x[i]) - low[0]) * cells_per_step[0], last)
        b = min((np.int64(y[i]) - low[1]) * cells_per_step[1], last)
        c = min((np.int64(z[i]) - low[2]) * cells_per_step[2], last)
        out[i] = (
            spread_bits(np.uint64(a))
            | (spread_bits(np.uint64(b)) << np.uint64(1))
            | (spread_bits(np.uint64(c)) << np.uint64(2))
        )


@kernel
def pick_level(
    codes: NDArray[np.uint64],
    node_shift: np.uint64,
    cell_shift: np.uint64,
    capacity: int,
    is_last: bool,
    is_taken: NDArray[np.bool_],
) -> None:
    """Mark the points that stay at one level: all of a small node, one per cell of a large one.

    Parameters
    ----------
    codes : ndarray, shape (n,)
        Sorted codes of the points no level above has taken.
    node_shift, cell_shift : uint64
        Bits below a node of this level, and below a cell of its grid.
    is_last : bool
        Nothing lies below: take everything.
    is_taken : ndarray, shape (n,)
        Filled.

    Notes
    -----
    Which point of a cell stays follows from a hash of the cell's code (Fibonacci hashing), so
    the same cloud gives the same file, and no corner of the cells is favoured.
    """
    n = len(codes)
    node_start = 0
    while node_start < n:
        node = codes[node_start] >> node_shift
        node_stop = node_start
        while node_stop < n and (codes[node_stop] >> node_shift) == node:
            node_stop += 1
        if is_last or node_stop - node_start <= capacity:
            for i in range(node_start, node_stop):
                is_taken[i] = True
        else:
            start = node_start
            while start < node_stop:
                cell = codes[start] >> cell_shift
                stop = start
                while stop < node_stop and (codes[stop] >> cell_shift) == cell:
                    is_taken[stop] = False
                    stop += 1
                scrambled = (cell * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(33)
                is_taken[start + np.int64(scrambled % np.uint64(stop - start))] = True
                start = stop
        node_start = node_stop
