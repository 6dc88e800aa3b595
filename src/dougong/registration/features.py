"""Points that describe their surroundings: FPFH (Rusu 2009) and the matching of features."""

from typing import Annotated

import numpy as np
from pydantic import Field

from dougong._checks import as_points
from dougong.errors import InputError
from dougong.filters import neighbourhood
from dougong.kernels import features as kernels
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Index, Points, Values

_BLOCK = 256
"""Queries per task: fixed, so results do not depend on the thread count."""


class Fpfh(Parameters):
    """What a feature looks at."""

    radius_spacings: Annotated[float, Field(gt=0)] = 8.0
    """Radius of the neighbourhood, in median point spacings."""
    max_neighbours: Annotated[int, Field(ge=4)] = 100
    """At most so many nearest neighbours within the radius."""


def fpfh(
    points: Points,
    normals: Points,
    radius_m: float,
    *,
    max_neighbours: int = 100,
    is_oriented: bool = False,
) -> Points:
    """Return the fast point feature histogram of every point.

    Parameters
    ----------
    points, normals : ndarray, shape (n, 3)
        Metres; unit normals.
    radius_m : float
        Neighbourhood; the nearest `max_neighbours` in it count.
    is_oriented : bool
        False: the signs of the normals mean nothing, and the feature does not see them.

    Returns
    -------
    ndarray, shape (n, 33)
        Three angles of 11 bins, each summing to 100; zeros where a point has no neighbours.

    Notes
    -----
    Rusu, Blodow, Beetz 2009, eq. 1 and 2, distances in radii. Unchanged by rigid motion, point
    order and thread count. O(n k), 600 bytes per point.
    """
    index = neighbourhood.build_index(as_points(points))
    if normals.shape != index.points.shape:
        msg = f"normals must have the shape of points {index.points.shape}, got {normals.shape}."
        raise InputError(msg)
    directions = np.ascontiguousarray(normals[index.order])
    n = len(index.points)
    simple, result = np.zeros((n, 3 * kernels.BINS)), np.zeros((n, 3 * kernels.BINS))

    def first_pass(first: int, last: int) -> None:
        start, places, _ = neighbourhood.self_knn_block(
            index, max_neighbours, radius_m**2, first, last
        )
        kernels.simple_histograms(index.points, directions, places, start, is_oriented, simple)

    def second_pass(first: int, last: int) -> None:
        start, places, d2 = neighbourhood.self_knn_block(
            index, max_neighbours, radius_m**2, first, last
        )
        kernels.weighted_histograms(places, d2, radius_m, start, simple, result)

    if n:
        for_blocks(*neighbourhood.blocks_of_leaves(index), first_pass)
        for_blocks(*neighbourhood.blocks_of_leaves(index), second_pass)
    return index.unsorted(result)


def nearest_features(queries: Points, features: Points, k: int) -> tuple[Index, Values]:
    """Return the k nearest of `features` (n, d) for each of `queries` (m, d).

    Returns places (m, k), nearest first, -1 where there are fewer, and distances (m, k). Exact;
    equal distances go to the smaller place. O(m n), most candidates given up after few columns.
    """
    if k < 1:
        raise InputError(f"k must be at least 1, got {k}.")
    places = np.full((len(queries), k), -1, np.int64)
    distance2 = np.full((len(queries), k), np.inf)
    if not len(features) or not len(queries):
        return places, distance2
    order = np.argsort(-features.var(axis=0), kind="stable")
    asked, known = np.ascontiguousarray(queries[:, order]), np.ascontiguousarray(features[:, order])

    def task(start: int, stop: int) -> None:
        rows = slice(start, stop)
        kernels.nearest_features(asked[rows], known, places[rows], distance2[rows])

    for_blocks(len(asked), _BLOCK, task)
    return places, np.sqrt(distance2)
