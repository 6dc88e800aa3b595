"""How far the nearest others of a tile's points are, in all tiles: what no halo is safe for."""

import numpy as np
from numpy.typing import NDArray

from dougong.filters.clusters import distance_to
from dougong.filters.neighbourhood import Neighbourhood, build_index, knn
from dougong.filters.statistical import mean_and_largest, nearest_distances
from dougong.filters.surroundings import SLACK
from dougong.tiles.cloud import Arrays, Record, Tile
from dougong.tiles.parts import Job, asked_points, cloud_of, in_box, with_halo
from dougong.typing import Points, Values

_WIDEST = 0.25
"""A halo is at most this share of the tile's longest side: a tile of a few points high above a roof
does not read half a site for them."""
_FEW = 64
"""Of every so many points one is asked first how far it is worth to look."""


def nearest(job: Job) -> tuple[Arrays, Record]:
    """Mean and largest distance of a tile's points to the k nearest others; known: k.

    No halo is safe for a number of neighbours. A short one serves nearly all points; whose k-th
    lies beyond it asks the other tiles that can have nearer ones, one by one.
    """
    k = min(job.known, max(1, job.asked - 1))
    edge = max(high - low for low, high in zip(job.tile.low, job.tile.high, strict=True))
    halo = edge * min(2.0 * float(np.sqrt(k / job.tile.points)), _WIDEST)
    part = with_halo(job, halo)
    index = build_index(part.points)
    mean, largest = nearest_distances(index, k, part.own)
    own = part.points[: part.own]
    to_edge = np.minimum(own - job.tile.low, np.array(job.tile.high) - own).min(axis=1) + halo
    # A hair less, for the rounding of the border itself.
    unsure = np.flatnonzero(~(largest < to_edge * (1.0 - 1e-9)))
    if len(unsure) and part.own < job.asked:
        nearer = _nearest_of_all(job, index, own[unsure], halo, k)
        mean[unsure], largest[unsure] = mean_and_largest(nearer)
    return {"mean": mean, "largest": largest}, {"unsure": len(unsure)}


def _nearest_of_all(
    job: Job, read: Neighbourhood, queries: Points, halo_m: float, k: int
) -> NDArray[np.float64]:
    """Return the distances (m, k) of `queries`, which are in `read`, to the k nearest others."""
    # The nearest of itself is the point itself, or one at the same place.
    nearest_m = knn(read, queries, k + 1)[1][:, 1:]
    others = [tile for tile in cloud_of(job).tiles if tile != job.tile]
    gaps = [_gap(queries, tile) for tile in others]
    for number in np.argsort([gap.min() for gap in gaps], kind="stable"):
        rows = np.flatnonzero(gaps[number] <= nearest_m[:, -1])
        if not len(rows):
            continue
        points = asked_points(job, others[number])
        reach_m = _reach_of_few(job, points, queries[rows], halo_m, k)
        reach_m = np.minimum(reach_m, nearest_m[rows, -1])
        for some in _of_like_reach(reach_m):
            asked = rows[some]
            near = _within_reach(points, queries[asked], float(reach_m[some].max()))
            near = near[~in_box(near, job.tile, halo_m)]
            if len(near):
                more = knn(build_index(near), queries[asked], k)[1]
                both = np.concatenate([nearest_m[asked], more], axis=1)
                nearest_m[asked] = np.sort(both, axis=1)[:, :k]
    return nearest_m


def _of_like_reach(reach_m: Values) -> list[NDArray[np.int64]]:
    """Return the places of reaches (n,) that are alike within a factor of two, group by group.

    One stray that looks far then does not make all the others look at everything.
    """
    octave = np.frexp(reach_m)[1]
    octave[~np.isfinite(reach_m)] = np.iinfo(octave.dtype).max
    return [np.flatnonzero(octave == one) for one in np.unique(octave)]


def _reach_of_few(job: Job, points: Points, queries: Points, halo_m: float, k: int) -> Values:
    """Return how far the k-th nearest (m,) is among a few of the points outside the halo.

    Among all of them it is no farther, so a stray looks at little of a tile far below it.
    """
    few = points[::_FEW]
    few = few[~in_box(few, job.tile, halo_m)]
    reach_m: Values = knn(build_index(few), queries, k)[1][:, -1]
    return reach_m


def _within_reach(points: Points, queries: Points, reach_m: float) -> Points:
    """Return the points within `reach_m` of any query, of which there are far fewer."""
    limit = reach_m * SLACK
    gap_m = distance_to(build_index(queries), np.ones(len(queries), bool), points, limit)
    return points[gap_m < limit]


def _gap(points: Points, tile: Tile) -> Values:
    """Return no more than the distance (n,) from each point to the box of a tile."""
    outside = np.maximum(np.array(tile.low) - points, points - np.array(tile.high))
    gap: Values = np.sqrt((np.maximum(outside, 0.0) ** 2).sum(axis=1)) * (1.0 - 1e-9)
    return gap
