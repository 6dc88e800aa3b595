"""Names for the arrays that cross function borders."""

from collections.abc import Callable, Iterable
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Points: TypeAlias = NDArray[np.float64]
"""(n, 3), C-contiguous, metres, in a local frame."""

Blocks: TypeAlias = Callable[[], Iterable[Points]]
"""Yields a cloud block by block, from its beginning and in the same order at every call."""

Values: TypeAlias = NDArray[np.float64]
"""(n,), one number per point; the unit is in the name of the variable."""

Transform: TypeAlias = NDArray[np.float64]
"""(4, 4) rigid or similarity; named T_<to>_<from>, applied to column vectors."""

Index: TypeAlias = NDArray[np.int64]
"""(k,), positions of points in a cloud."""

Mask: TypeAlias = NDArray[np.bool_]
"""(n,), named by what True means: is_outlier, is_ground, is_kept."""

Kind: TypeAlias = Literal["lidar", "photogrammetry"]
"""The two kinds of sensor (METHOD.md): laser scanner, drone photogrammetry."""
