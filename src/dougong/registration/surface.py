"""Normals, flatness and area of each point from its nearest neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.filters import neighbourhood
from dougong.filters.neighbourhood import Neighbourhood
from dougong.kernels import moments, protective
from dougong.threads import for_blocks
from dougong.typing import Points, Values

_AREA_NEIGHBOURS = 8
_BLOCK = 1 << 13
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
    places, nearest, widest = _nearest(index, neighbours)
    spacing = float(np.median(nearest))
    # Where the cloud is thin, neighbours across a gap say nothing about the local plane.
    reach = max(12.0 * spacing, 1e-6)
    plane = _planes(index, places, reach)
    is_plane = np.isfinite(plane.variation)
    # Far from the scanner its rings lie wider apart than the neighbours reach.
    width = np.clip(plane.planarity / _LEAST_WIDTH, 0.0, 1.0)
    flatness = np.clip(1.0 - 3.0 * plane.variation, 0.0, 1.0) * width
    return Surface(
        normals=index.unsorted(np.where(is_plane[:, None], plane.normals, [0.0, 0.0, 1.0])),
        planarity=index.unsorted(np.where(is_plane, flatness, 0.0)),
        area_m2=index.unsorted(np.pi * np.minimum(widest, reach) ** 2 / _AREA_NEIGHBOURS),
        spacing_m=spacing,
    )


def _nearest(index: Neighbourhood, neighbours: int) -> tuple[NDArray[np.int32], Values, Values]:
    """Return every point's nearest (n, neighbours), and how far the first and the eighth are.

    One search for both; in sorted order.
    """
    n = len(index.points)
    places = np.empty((n, neighbours), np.int32)
    first, eighth = np.empty(n), np.empty(n)

    def task(first_leaf: int, last_leaf: int) -> None:
        start, found, distance2 = neighbourhood.self_knn_block(
            index, max(neighbours, _AREA_NEIGHBOURS), np.inf, first_leaf, last_leaf
        )
        rows = slice(start, start + len(found))
        places[rows] = found[:, :neighbours]
        first[rows] = np.sqrt(distance2[:, 0])
        eighth[rows] = np.sqrt(distance2[:, _AREA_NEIGHBOURS - 1])

    for_blocks(*neighbourhood.blocks_of_leaves(index), task)
    return places, first, eighth


def _planes(
    index: Neighbourhood, places: NDArray[np.int32], reach_m: float
) -> neighbourhood.Surface:
    """Return the plane of every point and those of its nearest within reach, in sorted order."""
    n = len(index.points)
    planes = neighbourhood.Surface(np.empty((n, 3)), np.empty(n), np.empty(n))

    def task(start: int, stop: int) -> None:
        protective.drop_far(index.points, places, reach_m**2, start, stop)
        moments.describe_neighbours(index.points, places[start:stop], start, *planes)

    for_blocks(n, _BLOCK, task)
    return planes
