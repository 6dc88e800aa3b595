"""What the filters took out: counted by reason, and a sample to be looked at."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.filters.protective import Taken
from dougong.filters.selection import DETAIL, Reason
from dougong.formats.faults import coordinate_hashes
from dougong.pipeline.marking import with_own
from dougong.pipeline.steps import GROUND
from dougong.typing import Index, Points

MOST = 100_000
"""Removed points of one file (or station) that are kept for looking."""
_BLOCK = 1 << 22


def reason_counts(codes: NDArray[np.uint8]) -> list[int]:
    """Return how many points each `Reason` took (or kept), in their order."""
    return _counted(codes, len(Reason))


def _counted(codes: NDArray[np.uint8], kinds: int) -> list[int]:
    """Return how often each code below `kinds` is there, in blocks: counting widens them."""
    counts = np.zeros(kinds, np.int64)
    for start in range(0, len(codes), _BLOCK):
        counts += np.bincount(codes[start : start + _BLOCK], minlength=kinds)
    return counts.tolist()


def ground_kept(codes: NDArray[np.uint8], ground_class: NDArray[np.uint8]) -> int:
    """Return how many kept points are ground. Holds one mask."""
    is_ground = ground_class == GROUND
    is_ground &= codes == Reason.KEPT
    return int(np.count_nonzero(is_ground))


def detail_counts(codes: NDArray[np.uint8], details: Mapping[str, NDArray[Any]]) -> dict[str, int]:
    """Return, per name of a `Taken`, the points that it took.

    Empty where the curvature-weighted filter gave no details.
    """
    if DETAIL not in details:
        return {}
    chosen = details[DETAIL][codes == Reason.CURVATURE_WEIGHTED]
    counts = _counted(chosen, len(Taken))
    return {taken.name.lower(): counts[taken] for taken in Taken if taken != Taken.KEPT}


def removed_sample(
    cloud: Cloud,
    codes: NDArray[np.uint8],
    most: int = MOST,
    *,
    details: Mapping[str, NDArray[Any]] | None = None,
) -> Cloud:
    """Return at most `most` removed points of a raw cloud, with ``dougong_reason`` and `details`.

    Decimated points are left out: each lies in one voxel with a point that was kept. The choice
    is by a hash of the coordinates, so that it depends on no order.

    Parameters
    ----------
    cloud : Cloud
    codes : ndarray, shape (n,), uint8
        `Reason` of every point.
    most : int
    details : mapping of str to ndarray, shape (n,), optional
        What else is known of every point (`Filtered.details`).
    """
    chosen = np.flatnonzero((codes != Reason.KEPT) & (codes != Reason.DECIMATED))
    if len(chosen) > most:
        chosen = chosen[_smallest(cloud.xyz[chosen], most)]
    sample = with_own(cloud.select(chosen), "dougong_reason", codes[chosen])
    for name, values in (details or {}).items():
        sample = with_own(sample, name, values[chosen])
    return sample


def shortened(sample: Cloud, most: int = MOST) -> Cloud:
    """Return the sample of two samples, together in the order of the file."""
    return sample if len(sample) <= most else sample.select(_smallest(sample.xyz, most))


def _smallest(xyz: Points, most: int) -> Index:
    """Return the places, ascending, of the `most` points with the smallest hashes."""
    return np.sort(np.argsort(coordinate_hashes(xyz), kind="stable")[:most])
