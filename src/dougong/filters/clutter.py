"""Clutter: what stands about and is no part of the building, by size and shape alone.

People, vehicles, poles and wires are *offered*: marked as a class, taken out only when asked for.
A statue the size of a person is told from one by its plinth, a column from a pole by its thickness;
what has neither cannot be told, so look before removing. docs/denoising.md says what was measured.
Kernels are imported when called.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from dougong._checks import as_points
from dougong.errors import InputError
from dougong.filters.clutter_kinds import Clutter, ClutterKind
from dougong.filters.selection import Selection

if TYPE_CHECKING:
    from dougong.filters.clutter_search import Whole

__all__ = ["KIND", "Clutter", "clutter", "clutter_notes", "halo_m"]

KIND: Literal["local", "two-pass", "global"] = "two-pass"


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
        `points` is not (n, 3) or not finite, or heights do not match them.

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
        many = "points" if clusters is None else f"{clusters:,} clusters, points"
        said.append(f"like a {kind.name.lower()}: {many} {points:,}")
    notes = [f"offered as clutter: {'; '.join(said)}"] if said else []
    if has_rows:
        notes.append(
            "wires were not looked for: many points lie on thin lines as it is, which are the "
            "scanner's rows"
        )
    return tuple(notes)
