"""Mean and deviation that do not depend on order, threads or tiles: exact integer sums."""

from dataclasses import dataclass

import numpy as np

from dougong.typing import Index

_CHUNK = 1 << 16
_HALF = 21
LARGEST = (1 << (2 * _HALF)) - 1
"""Largest value that may be summed."""


@dataclass(frozen=True, slots=True)
class Totals:
    """Count, sum and sum of squares of integers; exact, so parts may be added in any order."""

    count: int = 0
    total: int = 0
    squares: int = 0

    @classmethod
    def of(cls, values: Index) -> "Totals":
        """Return the totals of `values` (n,) int64, 0 .. `LARGEST`."""
        total = squares = 0
        for start in range(0, len(values), _CHUNK):
            part = values[start : start + _CHUNK]
            high, low = part >> _HALF, part & ((1 << _HALF) - 1)
            total += int(part.sum())
            # High and low halves apart: each sum of 2**16 products stays below 2**58.
            squares += int((high * high).sum()) << (2 * _HALF)
            squares += int((high * low).sum()) << (_HALF + 1)
            squares += int((low * low).sum())
        return cls(len(values), total, squares)

    def __add__(self, other: "Totals") -> "Totals":
        return Totals(
            self.count + other.count, self.total + other.total, self.squares + other.squares
        )

    @property
    def mean(self) -> float:
        """Mean of the values; NaN without any."""
        return self.total / self.count if self.count else float("nan")

    @property
    def deviation(self) -> float:
        """Standard deviation (over n) of the values; NaN without any."""
        if not self.count:
            return float("nan")
        spread = self.count * self.squares - self.total * self.total
        return float(np.sqrt(spread / (self.count * self.count)))
