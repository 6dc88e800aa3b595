"""The rules by which a cluster counts as a person, a vehicle or a pole.

A rule is a list of measures, each with its limits; the margin is how far the tightest lies inside,
as a share of the limit. Sizes are parameters; the proportions that tell heritage apart are here.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Annotated, Literal

from pydantic import Field, model_validator

from dougong.filters.clutter_shapes import Shape
from dougong.params import Parameters

Limits = tuple[float, float]
Name = Literal["person", "vehicle", "pole", "wire"]


class Clutter(Parameters):
    """Which clusters are offered as clutter, and whether they are taken out."""

    action: Literal["off", "mark", "remove"] = "mark"
    """mark: every point stays and says what it was taken for. remove: the offered points go.
    off (in the recipes, unless set): nothing is looked for."""
    kinds: tuple[Name, ...] = ("person", "vehicle", "pole", "wire")
    """What is offered."""
    min_margin: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Offer only what lies at least this far within every limit, as a share of the limit."""
    foot_m: Annotated[float, Field(ge=0)] = 0.25
    """Points lower than this above the ground join nothing: grass and kerbs would tie all that
    stands together. They go with the cluster that they are nearest to, within `gap_least_m`."""
    gap_least_m: Annotated[float, Field(gt=0)] = 0.15
    """Points nearer to each other than this are one thing, metres."""
    gap_most_m: Annotated[float, Field(gt=0)] = 0.50
    """Points farther from each other are not. Between the two, five spacings of the sparser."""
    min_points: Annotated[int, Field(ge=8)] = 20
    """A cluster of fewer points has no shape."""
    person_height_m: Limits = (1.1, 2.1)
    """Top of a person above the ground."""
    person_length_m: Limits = (0.25, 1.0)
    """Longer side of a person's outline in plan."""
    vehicle_height_m: Limits = (1.2, 2.8)
    """Top of a car or van above the ground."""
    vehicle_length_m: Limits = (2.8, 6.0)
    """Longer side of its outline in plan."""
    vehicle_width_m: Limits = (1.3, 2.6)
    """Shorter side."""
    pole_height_m: Limits = (2.2, 8.0)
    """Top of a pole above the ground."""
    pole_radius_m: Annotated[float, Field(gt=0)] = 0.14
    """Half of a pole's layers stay within this radius: columns are thicker."""
    pole_clear_m: Annotated[float, Field(ge=0)] = 1.0
    """A pole is at least this far from everything longer than 3 m, or it may carry a roof."""
    wire_height_m: Annotated[float, Field(gt=0)] = 2.5
    """Wires hang at least this high above the ground."""
    wire_length_m: Annotated[float, Field(gt=0, le=2.0)] = 1.2
    """A wire goes on for so long to one side of each of its points."""

    @model_validator(mode="after")
    def _limits_ascend(self) -> Clutter:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if name.endswith("_m") and isinstance(value, tuple) and not 0 < value[0] < value[1]:
                raise ValueError(f"{name} must ascend from above 0, got {value}. Swap the two.")
        if self.gap_most_m < self.gap_least_m:
            raise ValueError("gap_most_m is below gap_least_m. Swap the two.")
        return self

    @property
    def largest_m(self) -> float:
        """The longest side that the box of a person, vehicle or pole can have."""
        long, wide = self.vehicle_length_m[1], self.vehicle_width_m[1]
        return max(math.hypot(long, wide), self.pole_height_m[1], self.person_length_m[1])


LOWEST_M = 0.6
"""What stands on the ground begins below this: its feet may be hidden in grass."""
FILLED = 0.7
"""At least this share of its layers holds points: nothing hovers over a gap."""
HEAD_M = 0.15
"""A head is no wider to either side (root mean square)."""
SHOULDERS = 1.4
"""The widest layer of a person is at least so many times its head: steles and posts have none."""
PLINTH = 1.2
"""The foot of a person is at most so many times its upper body; a statue's plinth is more."""
WAIST = 0.87
"""Half of a person's layers are at most this share of its widest: posts are as wide all the way."""
CABIN_M = 0.4
"""The roof of a vehicle extends so far to either side of its middle (root mean square)."""
OBLONG = 1.3
"""A vehicle is at least so many times as long as wide."""
SLENDER = 10.0
"""A pole is at least so many times as tall as wide."""
POLE_FOOT = 1.5
"""The foot of a pole is at most so many times `pole_radius_m` wide to either side."""


PERSON_PITCH_M, VEHICLE_PITCH_M = 0.13, 0.20
"""Points farther apart than this show no shape: bushes and rocks have such sizes too."""

POLE_LAYER = 5.0
"""Points that a layer of a pole holds on average: by fewer no one can tell how thick it is."""


class ClutterKind(IntEnum):
    """What a point was taken for: attribute ``clutter_kind``, written as ``dougong_clutter``."""

    NONE = 0
    PERSON = 1
    VEHICLE = 2
    POLE = 3
    WIRE = 4


def at_least(value: float, limit: float) -> float:
    """Return how far `value` lies above `limit`, as a share of it; below 0: it does not."""
    return value / limit - 1.0 if limit > 0.0 else 0.0


def at_most(value: float, limit: float) -> float:
    """Return how far `value` lies below `limit`, as a share of it; below 0: it does not."""
    return 1.0 - value / limit if limit > 0.0 else -1.0


def between(value: float, limits: tuple[float, float]) -> float:
    """Return how far `value` lies within `limits`, as a share of the nearer; below 0: outside."""
    return min(at_least(value, limits[0]), at_most(value, limits[1]))


def kind_of(shape: Shape, p: Clutter) -> tuple[ClutterKind, float]:
    """Return what a cluster looks like most, and its margin; NONE and 0 where nothing fits.

    Whether a pole stands clear of large things is for the caller to see.
    """
    if at_most(shape.low_m, LOWEST_M) < 0 or shape.filled < FILLED:
        return ClutterKind.NONE, 0.0
    margins = {
        ClutterKind.PERSON: _person(shape, p),
        ClutterKind.VEHICLE: _vehicle(shape, p),
        ClutterKind.POLE: _pole(shape, p),
    }
    offered = {kind: m for kind, m in margins.items() if kind.name.lower() in p.kinds}
    best = max(offered, key=lambda kind: offered[kind], default=ClutterKind.NONE)
    if best == ClutterKind.NONE or offered[best] < max(p.min_margin, 0.0):
        return ClutterKind.NONE, 0.0
    return best, offered[best]


def _person(s: Shape, p: Clutter) -> float:
    return min(
        between(s.top_m, p.person_height_m),
        between(s.length_m, p.person_length_m),
        at_most(s.head_m, HEAD_M),
        at_least(s.body_m, SHOULDERS * s.head_m),
        at_most(s.foot_m, PLINTH * s.body_m),
        at_most(s.median_m, WAIST * s.body_m),
        at_most(s.pitch_m, PERSON_PITCH_M),
    )


def _vehicle(s: Shape, p: Clutter) -> float:
    return min(
        between(s.top_m, p.vehicle_height_m),
        between(s.length_m, p.vehicle_length_m),
        between(s.width_m, p.vehicle_width_m),
        at_least(s.head_m, CABIN_M),
        at_least(s.length_m, OBLONG * s.width_m),
        at_most(s.pitch_m, VEHICLE_PITCH_M),
    )


def _pole(s: Shape, p: Clutter) -> float:
    return min(
        between(s.top_m, p.pole_height_m),
        at_most(s.girth_m, p.pole_radius_m),
        at_most(s.foot_m, POLE_FOOT * p.pole_radius_m),
        at_least(s.top_m, 2.0 * SLENDER * s.girth_m),
        at_least(s.per_layer, POLE_LAYER),
    )
