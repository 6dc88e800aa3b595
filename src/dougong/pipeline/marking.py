"""Removal that can be undone: every point kept, each with its class and its reason."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from dougong.cloud import Cloud
from dougong.filters.clutter import Clutter
from dougong.filters.selection import CLUTTER, CLUTTER_MARGIN, NOISE, Reason
from dougong.pipeline.steps import GROUND, Filtered, Step
from dougong.typing import Mask

GROUND_CLASS, NOISE_CLASS = 2, 7
CLUTTER_CLASS = 64
"""The first class that LAS 1.4 leaves to its users. Point formats 0 to 5 hold classes up to 31:
there the class stays, and ``dougong_clutter`` alone says what was offered."""


def marked(
    cloud: Cloud,
    codes: NDArray[np.uint8],
    ground_class: NDArray[np.uint8],
    details: Mapping[str, NDArray[Any]] | None = None,
) -> Cloud:
    """Return all points of `cloud` with classes and reasons.

    Ground becomes class 2, noise class 7 and clutter class 64; decimated and cropped points keep
    theirs. The old class is saved as ``classification_in``, the reason as ``dougong_reason``.

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
    is_clutter = clutter_of(details or {}, len(cloud)) & np.isin(
        codes, [int(Reason.KEPT), int(Reason.CLUTTER)]
    )
    result = with_classes(
        cloud,
        [(is_ground, GROUND_CLASS), (is_noise, NOISE_CLASS), (is_clutter, CLUTTER_CLASS)],
    )
    result = with_own(result, "dougong_reason", codes.astype(np.uint8))
    for name, values in (details or {}).items():
        result = with_own(result, name, values)
    return result


def marks_clutter(step: Step) -> bool:
    """Say whether a filter marks clutter on the points that stay."""
    return isinstance(step.params, Clutter) and step.params.action == "mark"


def with_clutter(filtered: Filtered) -> Cloud:
    """Return the kept points with what they were taken for, clutter in a class of its own."""
    is_kept = filtered.codes == Reason.KEPT
    kind = filtered.details[CLUTTER][is_kept]
    result = with_classes(filtered.cloud, [(kind > 0, CLUTTER_CLASS)])
    result = with_own(result, CLUTTER, kind)
    return with_own(result, CLUTTER_MARGIN, filtered.details[CLUTTER_MARGIN][is_kept])


def clutter_of(details: Mapping[str, NDArray[Any]], points: int) -> Mask:
    """Return which of so many points were offered as clutter."""
    offered: Mask = details.get(CLUTTER, np.zeros(points, np.uint8)) > 0
    return offered


def _holds(cloud: Cloud, value: int) -> bool:
    """Say whether the records of a cloud can hold a class."""
    bit = cloud.bits.get("classification")
    return bit is None or value <= bit.mask >> bit.shift


def with_classes(cloud: Cloud, classes: list[tuple[NDArray[np.bool_], int]]) -> Cloud:
    """Return `cloud` with some points' classes set and the old ones in ``classification_in``.

    What an earlier run put there stays: it is the scan's own.
    """
    stored = cloud.attribute("classification")
    if stored is not None and cloud.attribute("classification_in") is None:
        cloud = cloud.with_attribute("classification_in", stored)
    new = np.zeros(len(cloud), np.uint8) if stored is None else stored.copy()
    for chosen, value in classes:
        if not _holds(cloud, value):
            continue
        if new.dtype.type(value) != value:
            cloud, new = _recast(cloud, "classification", np.uint8), new.astype(np.uint8)
        new[chosen] = value
    return cloud.with_attribute("classification", new)


def with_own(cloud: Cloud, name: str, values: NDArray[Any]) -> Cloud:
    """Return `cloud` with an attribute of our own, whatever type an earlier run's came back in."""
    stored = cloud.attribute(name)
    if stored is not None and not np.can_cast(values.dtype, stored.dtype):
        cloud = _recast(cloud, name, values.dtype)
    return cloud.with_attribute(name, values)


def _recast(cloud: Cloud, name: str, kind: DTypeLike) -> Cloud:
    """Return `cloud` with room for values of another type in one field."""
    fields = [(field, cloud.records.dtype[field]) for field in cloud.records.dtype.names or ()]
    layout = [(field, np.dtype(kind) if field == name else old) for field, old in fields]
    return replace(cloud, records=cloud.records.astype(layout))
