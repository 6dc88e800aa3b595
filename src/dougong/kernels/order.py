"""Morton keys and sorting by them: the one order that everything spatial stands on.

A key interleaves 21 bits of each integer cell coordinate, x lowest, so points with near keys are
near in space and an octree node is a contiguous range of the sorted points.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints, Keys
from dougong.kernels._jit import kernel
from dougong.kernels.cells import steps_from, steps_per_edge

KEY_BITS = 21
"""Bits per axis: cells 0 .. 2**21 - 1."""
_DIGIT = 11
_BUCKETS = 1 << _DIGIT


@kernel
def spread(cell: np.uint64) -> np.uint64:
    """Return the 21 low bits of `cell` (uint64), two zero bits after each."""
    bits = cell & np.uint64(0x1FFFFF)
    bits = (bits | (bits << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    bits = (bits | (bits << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    bits = (bits | (bits << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    bits = (bits | (bits << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (bits | (bits << np.uint64(2))) & np.uint64(0x1249249249249249)


@kernel
def morton_keys(
    points: Floats, low: Floats, cell_m: float, start: int, stop: int, out: Keys
) -> None:
    """Fill out[start:stop] with the Morton key of the cell of each point.

    points (n, 3), low (3,) low corner, cell_m edge of a cell (see `cells`); out (n,) uint64. Cells
    outside 0 .. 2**21 - 1 are clamped to the border, so the caller must know what such a key means.
    """
    top = float((1 << KEY_BITS) - 1)
    steps = steps_per_edge(cell_m)
    step_m, per_step = cell_m / steps, 1.0 / steps
    for i in range(start, stop):
        key = np.uint64(0)
        for axis in range(3):
            cell = np.floor(steps_from(points[i, axis], low[axis], step_m) * per_step)
            cell = min(max(cell, 0.0), top)
            key |= spread(np.uint64(cell)) << np.uint64(axis)
        out[i] = key


@kernel
def radix_argsort(keys: Keys, bits: int, order: Ints, spare_order: Ints, spare_keys: Keys) -> None:
    """Sort `keys` (n,) uint64 in place by their low `bits` bits; order (n,) follows, stably.

    order holds the numbers to carry along (0 .. n-1 at first); spare_* are (n,) work space.
    Least significant digit first; a pass whose digit is the same everywhere is skipped.
    """
    n = keys.shape[0]
    if n == 0:
        return
    counts = np.empty(_BUCKETS, np.int64)
    mask = np.uint64(_BUCKETS - 1)
    for shift in range(0, bits, _DIGIT):
        by = np.uint64(shift)
        counts[:] = 0
        for i in range(n):
            counts[(keys[i] >> by) & mask] += 1
        if counts[(keys[0] >> by) & mask] == n:
            continue
        total = 0
        for bucket in range(_BUCKETS):
            held = counts[bucket]
            counts[bucket] = total
            total += held
        for i in range(n):
            bucket = (keys[i] >> by) & mask
            to = counts[bucket]
            counts[bucket] = to + 1
            spare_keys[to] = keys[i]
            spare_order[to] = order[i]
        for i in range(n):
            keys[i] = spare_keys[i]
            order[i] = spare_order[i]
