"""Radius outlier removal: points with too few neighbours within a radius (METHOD.md 1.4)."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from dougong.filters.selection import Selection
from dougong.params import Parameters

KIND: Literal["local", "two-pass", "global"] = "local"


class Radius(Parameters):
    """Remove points with fewer than `min_neighbours` others within `radius_m`."""

    radius_m: Annotated[float, Field(gt=0)] = 0.10
    """Radius of the ball, metres; its surface counts."""
    min_neighbours: Annotated[int, Field(ge=1)] = 4
    """Other points needed; duplicates of a point count."""


def halo_m(params: Radius) -> float:
    """Return the radius: no neighbour lies further outside a tile."""
    return params.radius_m


def radius(points: ArrayLike, params: Radius | None = None) -> Selection:
    """Choose the points with enough neighbours.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Metres, local frame.
    params : Radius

    Returns
    -------
    Selection
        ``neighbour_count`` (n,) int64: other points within the radius; ``removal_margin`` (n,):
        those needed per one there is, above 1 for removed points.

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite.

    Notes
    -----
    O(n log n): whole nodes are counted, so the cost hardly grows with the neighbours.
    Tile class: local.
    """
    from dougong.filters.neighbourhood import build_index, count_within

    params = params or Radius()
    index = build_index(points)
    counts = count_within(index, None, params.radius_m) - 1
    with np.errstate(divide="ignore"):
        margin = params.min_neighbours / counts.astype(np.float64)
    return Selection(
        is_kept=counts >= params.min_neighbours,
        attributes={"neighbour_count": counts, "removal_margin": margin},
    )
