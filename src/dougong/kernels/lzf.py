"""Unpack LZF, the compression of PCD's binary_compressed (Lehmann, LibLZF)."""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel


@kernel
def unpack_lzf(packed: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Fill `out` from `packed`; return how many bytes came out, -1 where the data is damaged.

    Notes
    -----
    A control byte below 32 is followed by that many + 1 literal bytes. Otherwise its high three
    bits are a length - 2 (7: one more byte adds to it) and the rest with the next byte how far
    back the copy starts.
    """
    i, o = 0, 0
    size, room = len(packed), len(out)
    while i < size:
        control = np.int64(packed[i])
        i += 1
        if control < 32:
            count = control + 1
            if i + count > size or o + count > room:
                return -1
            for _ in range(count):
                out[o] = packed[i]
                o += 1
                i += 1
            continue
        count = control >> 5
        if count == 7:
            if i >= size:
                return -1
            count += np.int64(packed[i])
            i += 1
        if i >= size:
            return -1
        start = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
        i += 1
        count += 2
        if start < 0 or o + count > room:
            return -1
        for k in range(count):
            out[o] = out[start + k]
            o += 1
    return o
