"""What every filter returns: a choice over its input's points, never new points."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

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
