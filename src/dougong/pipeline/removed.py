"""A sample of what the filters took out, to be looked at: where, and why."""

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.filters.selection import Reason
from dougong.formats.faults import coordinate_hashes

MOST = 100_000
"""Removed points of one file (or station) that are kept for looking."""


def removed_sample(cloud: Cloud, codes: NDArray[np.uint8], most: int = MOST) -> Cloud:
    """Return at most `most` removed points of a raw cloud, with ``dougong_reason``.

    Decimated points are left out: each lies in one voxel with a point that was kept. The choice
    is by a hash of the coordinates, so that it depends on no order.

    Parameters
    ----------
    cloud : Cloud
    codes : ndarray, shape (n,), uint8
        `Reason` of every point.
    most : int
    """
    chosen = np.flatnonzero((codes != Reason.KEPT) & (codes != Reason.DECIMATED))
    if len(chosen) > most:
        hashes = coordinate_hashes(cloud.xyz[chosen])
        chosen = np.sort(chosen[np.argsort(hashes, kind="stable")[:most]])
    return cloud.select(chosen).with_attribute("dougong_reason", codes[chosen])
