"""A cloud for the registration: all of it, or its octree's deepest level of few enough nodes.

The rule depends on the points alone, never on the memory setting: a cloud of more than `most`
points is reduced to one point, that nearest to the centre, of every occupied node of its octree's
deepest level at which at most `most` nodes are occupied. What comes in pieces is passed over a few
times and gives the points that the whole gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dougong.cloud import Cloud, Pieces, joined, joined_pieces
from dougong.filters.occupied import DEEPEST, deepest_leaf_m
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid, root_cube_of
from dougong.pipeline.kept import batches

MOST_POINTS = 3_000_000
"""Of one cloud: five times what a registration thins it to."""
MOST_TOGETHER = 12_000_000
"""Of all clouds of a project: with many of them each has less, but never below `LEAST_POINTS`."""
LEAST_POINTS = 1_000_000
_BATCH = 3_000_000
"""Points that are sorted at once."""


def most_points(clouds: int) -> int:
    """Return how many points each of so many clouds may have in the registration."""
    return int(np.clip(MOST_TOGETHER // max(clouds, 1), LEAST_POINTS, MOST_POINTS))


@dataclass(frozen=True, slots=True, kw_only=True)
class Reduced:
    """What a cloud was reduced to."""

    cloud: Cloud
    points_in: int
    edge_m: float | None
    """Edge of the octree's nodes; None: every point is there."""


def reduced(pieces: Pieces, points: int, most: int) -> Reduced:
    """Reduce a cloud of `points` that comes in pieces of one frame and layout.

    The points are the same whatever the order and the pieces; they come in the order of the pieces.
    Memory: `most` points and a few pieces.
    """
    if points <= most:
        return Reduced(cloud=joined_pieces(pieces), points_in=points, edge_m=None)
    blocks = lambda: (joined(batch).xyz for batch in batches(pieces(), _BATCH))  # noqa: E731
    root = root_cube_of(blocks, points, OctreeVoxelGrid(depth=DEEPEST))
    leaf_m = deepest_leaf_m(blocks, root, most)
    params = OctreeVoxelGrid(voxel_m=leaf_m)
    root = root._replace(voxel_m=leaf_m)
    chosen: list[Cloud] = []
    for batch in batches(pieces(), _BATCH):
        both = joined([*chosen, *batch])
        kept = octree_voxel_grid(both.xyz, params, records=both.records, root=root).is_kept
        chosen = [both.select(kept)]
    return Reduced(cloud=chosen[0], points_in=points, edge_m=leaf_m)
