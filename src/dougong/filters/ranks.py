"""Values at a rank in a stream too long to be held: exact, in four passes of counting."""

from collections.abc import Callable, Iterable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dougong.typing import Values

ValueBlocks: TypeAlias = Callable[[], Iterable[Values]]
"""Yields values block by block, the same at every call."""

_BITS = 16
_SIGN = np.uint64(1 << 63)


def count_finite(blocks: ValueBlocks) -> int:
    """Return how many values are finite."""
    return sum(int(np.isfinite(block).sum()) for block in blocks())


def at_rank(blocks: ValueBlocks, rank: int) -> float:
    """Return the finite value that would stand at `rank` (0: the smallest) if all were sorted."""
    prefix, shift = np.uint64(0), 64
    while shift > 0:
        shift -= _BITS
        held = np.zeros(1 << _BITS, np.int64)
        for block in blocks():
            keys = _keys(block[np.isfinite(block)])
            if shift + _BITS < 64:
                keys = keys[keys >> np.uint64(shift + _BITS) == prefix]
            digits = (keys >> np.uint64(shift)) & np.uint64((1 << _BITS) - 1)
            held += np.bincount(digits.astype(np.int64), minlength=1 << _BITS)
        before = np.cumsum(held)
        digit = int(np.searchsorted(before, rank, side="right"))
        rank -= int(before[digit] - held[digit])
        prefix = (prefix << np.uint64(_BITS)) | np.uint64(digit)
    return _value(prefix)


def median(blocks: ValueBlocks) -> float:
    """Return the median of the finite values: the mean of the two in the middle; NaN without."""
    count = count_finite(blocks)
    if not count:
        return float("nan")
    high = at_rank(blocks, count // 2)
    return high if count % 2 else (at_rank(blocks, count // 2 - 1) + high) / 2.0


def _keys(values: Values) -> NDArray[np.uint64]:
    """Return whole numbers in the order of `values`."""
    # + 0.0 makes one of both zeros.
    bits = (np.ascontiguousarray(values, np.float64) + 0.0).view(np.uint64)
    keys: NDArray[np.uint64] = np.where(bits & _SIGN, ~bits, bits | _SIGN)
    return keys


def _value(key: np.uint64) -> float:
    bits = key ^ _SIGN if key & _SIGN else ~key
    return float(np.array([bits], np.uint64).view(np.float64)[0])
