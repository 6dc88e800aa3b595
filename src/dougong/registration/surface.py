"""Normals, flatness and area of each point from its nearest neighbours."""

from dataclasses import dataclass

import numpy as np

from dougong.filters import neighbourhood
from dougong.typing import Points, Values

_AREA_NEIGHBOURS = 8
_LEAST_WIDTH = 0.03
"""(l2 - l3) / l1 from which neighbours span a plane: less is a line, its normal is chance."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """The local plane of every point."""

    normals: Points
    """(n, 3) unit; upward, the sign says nothing about the outside."""
    planarity: Values
    """(n,) 1 - 3 l3 / (l1 + l2 + l3): 1 is a plane, 0 a ball of points or a line of them."""
    area_m2: Values
    """(n,) area that each point stands for: pi r_k^2 / k to the 8th neighbour."""
    spacing_m: float
    """Median distance to the nearest neighbour."""


def surface(points: Points, neighbours: int) -> Surface:
    """Fit a plane to each of `points` (n, 3) and its `neighbours` nearest others."""
    index = neighbourhood.build_index(points)
    _, distance = neighbourhood.knn(index, None, _AREA_NEIGHBOURS)
    spacing = float(np.median(distance[:, 0]))
    # Where the cloud is thin, neighbours across a gap say nothing about the local plane.
    reach = max(12.0 * spacing, 1e-6)
    plane = neighbourhood.normals(index, neighbours, reach)
    is_plane = np.isfinite(plane.variation)
    # Far from the scanner its rings lie wider apart than the neighbours reach.
    width = np.clip(plane.planarity / _LEAST_WIDTH, 0.0, 1.0)
    flatness = np.clip(1.0 - 3.0 * plane.variation, 0.0, 1.0) * width
    return Surface(
        normals=np.where(is_plane[:, None], plane.normals, [0.0, 0.0, 1.0]),
        planarity=np.where(is_plane, flatness, 0.0),
        area_m2=np.pi * np.minimum(distance[:, -1], reach) ** 2 / _AREA_NEIGHBOURS,
        spacing_m=spacing,
    )
