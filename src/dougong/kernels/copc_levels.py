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
def priority(code: np.uint64) -> np.uint64:
    """Return a number that orders codes as if by chance; no two codes share one."""
    v = (code ^ (code >> np.uint64(31))) * np.uint64(0x7FB5D329728EA185)
    v = (v ^ (v >> np.uint64(27))) * np.uint64(0x81DADEF4BC2DD44D)
    return v ^ (v >> np.uint64(33))


@kernel
def leaf_levels(
    codes: NDArray[np.uint64], first: int, capacity: int, deepest: int, out: NDArray[np.int8]
) -> None:
    """Fill `out` with the level at which each point's node is small enough to be a leaf.

    Parameters
    ----------
    codes : ndarray, shape (n,)
        Sorted; all points of one node of level `first`.
    first, deepest : int
        No node above `first` is a leaf; every node of level `deepest` is.
    capacity : int
        A node of at most so many points is a leaf.
    out : ndarray, shape (n,)
    """
    n = len(codes)
    out[:] = -1
    for level in range(first, deepest + 1):
        shift = np.uint64(3 * (LEVELS - level))
        start = 0
        is_done = True
        while start < n:
            if out[start] >= 0:
                start += 1
                continue
            node = codes[start] >> shift
            stop = start
            while stop < n and (codes[stop] >> shift) == node:
                stop += 1
            if stop - start <= capacity or level == deepest:
                out[start:stop] = level
            else:
                is_done = False
            start = stop
        if is_done:
            return


@kernel
def pick_per_cell(
    codes: NDArray[np.uint64], cell_shift: np.uint64, is_taken: NDArray[np.bool_]
) -> None:
    """Mark the first in `priority` of each cell's points: what one level shows of them.

    Parameters
    ----------
    codes : ndarray, shape (n,)
        Sorted codes of the points no level above has taken.
    cell_shift : uint64
        Bits below a cell of this level's grid.
    is_taken : ndarray, shape (n,)
        Filled. Of equal codes the first counts.

    Notes
    -----
    A least value of a set is the least of its parts' least: parts of a cloud can be worked on
    apart. Priorities are a hash, so no corner of the cells is favoured.
    """
    n = len(codes)
    start = 0
    while start < n:
        cell = codes[start] >> cell_shift
        best, least = start, priority(codes[start])
        stop = start
        while stop < n and (codes[stop] >> cell_shift) == cell:
            is_taken[stop] = False
            own = priority(codes[stop])
            if own < least:
                best, least = stop, own
            stop += 1
        is_taken[best] = True
        start = stop
