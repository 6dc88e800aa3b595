"""What every filter returns: a choice over its input's points, never new points."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.typing import Mask


class Reason(IntEnum):
    """Why a point was taken out: the uint8 extra dimension ``dougong_reason``."""

    KEPT = 0
    DECIMATED = 1
    LOW_OUTLIER = 2
    CURVATURE_WEIGHTED = 3
    STATISTICAL = 4
    RADIUS = 5
    PASS_THROUGH = 6
    CLOTH = 7
    CLUTTER = 8


NOISE = frozenset(
    {
        Reason.LOW_OUTLIER,
        Reason.CURVATURE_WEIGHTED,
        Reason.STATISTICAL,
        Reason.RADIUS,
    }
)
"""Reasons that make a point noise (LAS class 7). Decimated and cropped points keep their class."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """A choice over n points."""

    is_kept: Mask
    """(n,), True for points that stay."""
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """(n,) arrays that the filter worked out on the way (curvature, height_above_ground ...)."""
    notes: tuple[str, ...] = ()
    """What the user should know, in words and counted."""
    found: Mapping[str, int] = field(default_factory=dict)
    """What was found besides, counted under names (clutter: clusters and points per kind)."""


def spare(chosen: Selection, is_wanted: Mask) -> Selection:
    """Return the choice with the points (n,) that another rule keeps, whatever this one says."""
    is_spared = is_wanted & ~chosen.is_kept
    margin = chosen.attributes["removal_margin"]
    return replace(
        chosen,
        is_kept=chosen.is_kept | is_spared,
        attributes={**chosen.attributes, "removal_margin": np.where(is_spared, 1.0, margin)},
    )


DETAIL, MARGIN = "dougong_detail", "dougong_margin"
CLUTTER, CLUTTER_MARGIN = "dougong_clutter", "dougong_clutter_margin"
DETAILS = (DETAIL, MARGIN, CLUTTER, CLUTTER_MARGIN)
"""What is written of a point besides its reason, by the names of the attributes."""
MARGIN_MOST = 1e6
"""Margins are written as at most this: a point alone has an infinite one."""


def details_of(selection: Selection) -> dict[str, NDArray[Any]]:
    """Return what a selection says of its points besides its choice, as it is written."""
    details: dict[str, NDArray[Any]] = {}
    for given, name, dtype in (
        ("removal_reason", DETAIL, np.uint8),
        ("removal_margin", MARGIN, np.float32),
        ("clutter_kind", CLUTTER, np.uint8),
        ("clutter_margin", CLUTTER_MARGIN, np.float32),
    ):
        if given not in selection.attributes:
            continue
        values = np.minimum(selection.attributes[given], MARGIN_MOST).astype(dtype)
        if name == MARGIN:
            # In single precision too a removed point is above 1.
            values[~selection.is_kept & (values <= 1)] = np.nextafter(np.float32(1), dtype(2))
        details[name] = values
    return details
