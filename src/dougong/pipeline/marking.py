"""Removal that can be undone: every point kept, each with its class and its reason."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.filters.selection import NOISE, Reason
from dougong.pipeline.steps import GROUND

GROUND_CLASS, NOISE_CLASS = 2, 7


def marked(
    cloud: Cloud,
    codes: NDArray[np.uint8],
    ground_class: NDArray[np.uint8],
    details: Mapping[str, NDArray[Any]] | None = None,
) -> Cloud:
    """Return all points of `cloud` with classes and reasons.

    Ground becomes class 2 and noise class 7; decimated and cropped points keep theirs. The old
    class is saved as ``classification_in``, the reason as ``dougong_reason``.

    Parameters
    ----------
    cloud : Cloud
    codes : ndarray, shape (n,), uint8
        `Reason` of each point.
    ground_class : ndarray, shape (n,), uint8
        0 unknown, 1 not ground, 2 ground.
    details : mapping of str to ndarray, shape (n,), optional
        What else is written of each point (`Filtered.details`).
    """
    is_noise = np.isin(codes, [int(reason) for reason in NOISE])
    is_ground = (ground_class == GROUND) & (codes == Reason.KEPT)
    result = with_classes(cloud, [(is_ground, GROUND_CLASS), (is_noise, NOISE_CLASS)])
    result = result.with_attribute("dougong_reason", codes.astype(np.uint8))
    for name, values in (details or {}).items():
        result = result.with_attribute(name, values)
    return result


def with_classes(cloud: Cloud, classes: list[tuple[NDArray[np.bool_], int]]) -> Cloud:
    """Return `cloud` with some points' classes set and the old ones in ``classification_in``."""
    stored = cloud.attribute("classification")
    old = np.zeros(len(cloud), np.uint8) if stored is None else stored.astype(np.uint8)
    new = old.copy()
    for chosen, value in classes:
        new[chosen] = value
    if stored is not None:
        cloud = cloud.with_attribute("classification_in", old)
        new = new.astype(stored.dtype)
    return cloud.with_attribute("classification", new)
