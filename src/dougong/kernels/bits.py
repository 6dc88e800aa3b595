"""Pack integers into fields of a few bits, as the records of E57 hold them (ASTM E2807-11, 9.7)."""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel


@kernel
def pack_bits(values: NDArray[np.uint64], bits: int, out: NDArray[np.uint8]) -> None:
    """Fill `out` with the low `bits` (1..64) of each value (n,), lowest bit of the first first.

    out: (ceil(n x bits / 8),). What is left of its last byte is zero.
    """
    held = np.uint64(0)  # bits that wait for a whole byte
    count = np.uint64(0)
    eight, full = np.uint64(8), np.uint64(64)
    width = np.uint64(bits)
    at = 0
    for i in range(len(values)):
        value = values[i]
        if width < full:
            value &= (np.uint64(1) << width) - np.uint64(1)
        held |= value << count
        over = np.uint64(0)
        if count + width > full:  # at most 7 wait, so only fields above 57 bits run over
            over = value >> (full - count)
        left = count + width
        while left >= eight:
            out[at] = held & np.uint64(0xFF)
            at += 1
            held >>= eight
            if over:
                held |= (over & np.uint64(0xFF)) << (full - eight)
                over >>= eight
            left -= eight
        count = left
    if count > np.uint64(0):
        out[at] = held & np.uint64(0xFF)
