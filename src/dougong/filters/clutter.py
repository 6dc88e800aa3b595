"""Clutter: what stands about and is no part of the building, by size and shape alone.

People, vehicles, poles and wires are *offered*: marked as a class, taken out only when asked for.
A statue the size of a person is told from one by its plinth, a column from a pole by its thickness;
what has neither cannot be told, so look before removing. docs/denoising.md says what was measured.
Kernels are imported when called.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from dougong._checks import as_points
from dougong.errors import InputError
from dougong.filters.clutter_kinds import ClutterKind
from dougong.filters.selection import Selection
from dougong.params import Parameters

if TYPE_CHECKING:
    from dougong.filters.clutter_search import Whole

KIND: Literal["local", "two-pass", "global"] = "two-pass"

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


def halo_m(params: Clutter) -> float:
    """Return how far the rule reaches: a cluster, what it stands clear of, and wires between."""
    from dougong.filters import clutter_search

    return clutter_search.halo_m(params)


def clutter(
    points: ArrayLike,
    params: Clutter | None = None,
    *,
    height_above_ground: ArrayLike,
    whole: Whole | None = None,
) -> Selection:
    """Find what stands about: people, vehicles, poles and wires.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Metres, z up; the points that are not ground.
    params : Clutter
    height_above_ground : array_like, shape (n,)
        Metres, from the cloth filter. A cluster with a point of unknown height (NaN) is never
        clutter.
    whole : Whole, optional
        Where the points are a part of a cloud: what must be known of it.

    Returns
    -------
    Selection
        ``clutter_kind`` (n,) uint8 (`ClutterKind`), 0 where nothing is offered;
        ``clutter_margin`` (n,): how far the tightest measure lies within its limit, as a share of
        it. All are kept unless ``action`` is ``remove``. ``found``: clusters and points per kind.

    Raises
    ------
    InputError
        Heights do not match the points.

    Notes
    -----
    Tile class: two-pass, halo of `halo_m`; the first pass counts how many points lie on thin lines.
    Where these are too many, they are the rows of the scanner and no wires are offered. Nothing
    depends on the order of the points.
    """
    from dougong.filters.clutter_search import nothing, search

    p = params or Clutter()
    xyz, height = as_points(points), np.asarray(height_above_ground, dtype=np.float64)
    if height.shape != (len(xyz),):
        msg = (
            f"height_above_ground must have shape ({len(xyz)},), got {height.shape}. "
            "Run cloth_simulation on the same points first."
        )
        raise InputError(msg)
    found = nothing(len(xyz))
    if p.action != "off" and len(xyz):
        found = search(xyz, height, p, whole)
    is_kept = np.ones(len(xyz), bool)
    if p.action == "remove":
        is_kept = found.kind == ClutterKind.NONE
    return Selection(
        is_kept=is_kept,
        attributes={"clutter_kind": found.kind, "clutter_margin": found.margin},
        notes=clutter_notes(found.counts, found.has_rows and "wire" in p.kinds),
        found=found.counts,
    )


def clutter_notes(found: Mapping[str, int], has_rows: bool) -> tuple[str, ...]:
    """Return what is to be said of the clusters and points found per kind."""
    said = []
    for kind in ClutterKind:
        points = found.get(f"{kind.name.lower()}_points", 0)
        if not points:
            continue
        clusters = found.get(f"{kind.name.lower()}_clusters")
        many = "points" if clusters is None else f"{clusters} clusters, points"
        said.append(f"like a {kind.name.lower()}: {many} {points}")
    notes = [f"offered as clutter: {'; '.join(said)}"] if said else []
    if has_rows:
        notes.append(
            "wires were not looked for: many points lie on thin lines as it is, which are the "
            "scanner's rows"
        )
    return tuple(notes)
