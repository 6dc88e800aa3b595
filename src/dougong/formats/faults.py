"""Faults of a cloud that are handled and must be said: counted, in words."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import are_within
from dougong._words import counted, of_all
from dougong.cloud import Cloud, Frame
from dougong.typing import Points

COARSE_M = 0.01
"""Coordinate steps from here on hide the detail of a building."""
FEW = 100
"""Fewer points prove nothing about how they were stored, and hold no site."""
SAMPLE = 200_000
"""Points that shape the wide box."""
NO_SYSTEM = "no coordinate reference system is named; its numbers are taken as metres."
_FAR_FACTOR = 10.0
_FAR_LEAST_M = 100.0
_HIGH_M = 1000.0
"""No site is as high as this: the highest cliff temples rise less than half of it."""
_DEGREES = np.array([180.0, 90.0])
_EARTH_M = (6.33e6, 6.40e6)
"""Distances from the earth's centre at which there are sites."""
_NO_HEIGHT_M = 20_000.0
"""No site lies as high, or as deep."""


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


def copies_in(xyz: Points) -> int:
    """Return how many of the points (n, 3) lie exactly on another one."""
    return copies_among(coordinate_hashes(xyz))


def _places(sample: Points) -> Points:
    """Return each place of a sample once.

    Missing returns that a scanner wrote at 0, 0, 0 are a heap that would pass for a part of the
    site.
    """
    _, first = np.unique(coordinate_hashes(sample), return_index=True)
    return sample if len(first) == len(sample) else sample[first]


def wide_box(sample: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the box of the middle 98 % grown on all sides by ten times its longest edge."""
    low, high = np.quantile(_places(sample), [0.01, 0.99], axis=0)
    margin = max(_FAR_LEAST_M, _FAR_FACTOR * float((high - low).max()))
    return low - margin, high + margin


def unit_suspicion(sample: Points, frame: Frame) -> str | None:
    """Return in words that coordinates without a reference system are hardly metres, or None.

    Parameters
    ----------
    sample : ndarray, shape (n, 3)
        Local metres.
    frame : Frame
        Of the cloud: says where on the map the local origin is.
    """
    if frame.crs is not None:
        return None
    low, high = np.quantile(_places(sample), [0.01, 0.99], axis=0)
    span = high - low
    first, last = frame.to_file(np.stack([low, high]))
    middle = (first + last) / 2
    is_place = (np.abs([first, last])[:, :2] <= _DEGREES).all()
    if is_place and 0 < span[:2].max() < 0.05 and span[2] > 20 * span[:2].max():
        return (
            f"it spans {span[0]:.3g} by {span[1]:.3g} in plan but {span[2]:.3g} in height: "
            "x and y may be degrees. Reproject it to metres."
        )
    is_deep = abs(middle[2]) > _NO_HEIGHT_M
    if is_deep and _EARTH_M[0] < float(np.linalg.norm(middle)) < _EARTH_M[1]:
        return (
            f"its heights would be about {middle[2]:,.0f} m, and its points lie an earth's radius "
            "from 0, 0, 0: they may be earth-centred coordinates, where z does not point up. "
            "Reproject it to a map projection."
        )
    if span[2] >= _HIGH_M:
        return (
            f"it would be {span[2]:,.0f} m high: its coordinates may be millimetres. "
            "Where they are, name their unit: crs = 'mm' in a project, --crs mm of filter, "
            "--source-crs mm or --target-crs mm of register."
        )
    return None


def faults_of(cloud: Cloud) -> tuple[str, ...]:
    """Return what is wrong with `cloud` and was handled: duplicates, far points, units, no CRS."""
    if not len(cloud):
        return ()
    sample = cloud.xyz[:: sample_step(len(cloud))]
    return faults_in_words(
        cloud.frame,
        points=len(cloud),
        copies=copies_in(cloud.xyz),
        far=points_beyond(cloud.xyz, *wide_box(sample)),
        sample=sample,
    )


def sample_step(points: int) -> int:
    """Return so that every so many-th point of a cloud is in its sample."""
    return max(1, points // SAMPLE)


def faults_in_words(
    frame: Frame, *, points: int, copies: int, far: int, sample: Points
) -> tuple[str, ...]:
    """Return the faults of a cloud of so many `points`, counted, in words.

    Parameters
    ----------
    frame : Frame
    copies, far : int
        Points that lie exactly on another one, and far from all others.
    sample : ndarray, shape (m, 3)
        Local metres.
    """
    found = []
    if frame.crs is None:
        found.append(NO_SYSTEM)
    if 0 < copies == points - 1:
        found.append(f"all {points:,} points lie at one place.")
    elif copies:
        found.append(f"{of_all(copies, points, 'lies', 'lie')} exactly on another one.")
    if far:
        found.append(f"{of_all(far, points, 'lies', 'lie')} far from all others.")
    if points < FEW:
        return (*found, f"only {counted(points)}: too few to filter or register.")
    said = unit_suspicion(sample, frame) or _coarseness(frame, sample)
    return (*found, said) if said else tuple(found)


def _coarseness(frame: Frame, sample: Points) -> str | None:
    """Return in words that coordinates lie on too coarse a lattice, or None.

    An axis along which nothing varies has no detail to lose.
    A step of just `COARSE_M`, as many programs choose unasked, is left to `check`.
    """
    if frame.step is None:
        return None
    steps = np.multiply(frame.step, frame.unit_m)
    coarsest = float(steps.max(initial=0.0, where=np.ptp(sample, axis=0) > 0))
    if coarsest <= COARSE_M * (1 + 1e-9):
        return None
    return (
        f"its coordinates are stored in steps of {coarsest:.3g} m: too coarse for a building. "
        "Export it with steps of 0.001 m or finer."
    )


def points_beyond(xyz: Points, low: Any, high: Any) -> int:
    """Return how many points lie outside a box."""
    return len(xyz) - int(np.count_nonzero(are_within(xyz, low, high)))
