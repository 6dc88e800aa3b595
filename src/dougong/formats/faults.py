"""Faults of a cloud that are handled and must be said: counted, in words."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.typing import Points

SAMPLE = 200_000
"""Points that shape the robust box."""
_FAR_FACTOR = 10.0
_FAR_LEAST_M = 100.0
_HIGH_M = 1000.0
"""No site is as high as this: the highest cliff temples rise less than half of it."""


def coordinate_hashes(xyz: Points) -> NDArray[np.uint64]:
    """Return one 64-bit number per point (n, 3) that equal coordinates share."""
    bits = np.ascontiguousarray(xyz + 0.0).view(np.uint64)  # + 0.0 makes -0.0 equal to 0.0
    mixed = np.zeros(len(xyz), dtype=np.uint64)
    for axis in range(3):
        mixed ^= bits[:, axis]
        mixed *= np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
    return mixed


def copies_among(hashes: NDArray[np.uint64]) -> int:
    """Return how many points lie exactly on another one; sorts `hashes` in place."""
    hashes.sort()
    return int((hashes[1:] == hashes[:-1]).sum())


def robust_box(sample: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the box of the middle 98 % grown on all sides by ten times its longest edge."""
    low, high = np.quantile(sample, [0.01, 0.99], axis=0)
    margin = max(_FAR_LEAST_M, _FAR_FACTOR * float((high - low).max()))
    return low - margin, high + margin


def unit_suspicion(sample: Points, crs: str | None) -> str | None:
    """Return in words that coordinates without a reference system are hardly metres, or None.

    Parameters
    ----------
    sample : ndarray, shape (n, 3)
        Local metres.
    """
    if crs is not None:
        return None
    low, high = np.quantile(sample, [0.01, 0.99], axis=0)
    if high[2] - low[2] < _HIGH_M:
        return None
    return (
        f"it would be {high[2] - low[2]:,.0f} m high: its coordinates may be millimetres. "
        "Scale them to metres (by 0.001 where they are)."
    )


def faults_of(cloud: Cloud) -> tuple[str, ...]:
    """Return what is wrong with `cloud` and was handled: duplicates, far points, units, no CRS."""
    if not len(cloud):
        return ()
    found = []
    if cloud.frame.crs is None:
        found.append("no coordinate reference system is named; its numbers are taken as metres.")
    copies = copies_among(coordinate_hashes(cloud.xyz))
    if copies:
        found.append(f"{copies:,} of {len(cloud):,} points lie exactly on another one.")
    sample = cloud.xyz[:: max(1, len(cloud) // SAMPLE)]
    low, high = robust_box(sample)
    far = _beyond(cloud.xyz, low, high)
    if far:
        found.append(f"{far:,} of {len(cloud):,} points lie far from all others.")
    suspicion = unit_suspicion(sample, cloud.frame.crs)
    return (*found, suspicion) if suspicion else tuple(found)


def _beyond(xyz: Points, low: Any, high: Any) -> int:
    """Return how many points lie outside a box."""
    if (xyz.min(axis=0) >= low).all() and (xyz.max(axis=0) <= high).all():
        return 0
    return int(((xyz < low) | (xyz > high)).any(axis=1).sum())
