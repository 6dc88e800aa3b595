"""How deep an octree may go with at most so many occupied nodes; the cloud comes in blocks."""

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import are_within
from dougong._sorting import distinct, once
from dougong.filters.octree_voxel_grid import Root
from dougong.threads import for_blocks
from dougong.typing import Blocks, Points

DEEPEST = 20
"""Levels below the root cube."""


def deepest_leaf_m(blocks: Blocks, root: Root, most: int) -> float:
    """Return the edge of the nodes of the deepest level at which at most `most` are occupied.

    Points outside the root cube, which are far from all others, are not counted. One pass; memory:
    16 bytes per node and 40 per point of a block. Deterministic, whatever the order and the blocks.
    """
    level = DEEPEST
    keys = np.empty(0, np.uint64)
    for block in blocks():
        keys = distinct(np.concatenate([keys, _keys(block, root, level)]))
        while len(keys) > most and level > 0:
            # A node's key without its last three bits is that of its parent.
            keys = once(keys >> np.uint64(3))
            level -= 1
    return root.edge_m / 2.0**level


def _keys(points: Points, root: Root, level: int) -> NDArray[np.uint64]:
    """Return the nodes that hold points, each once."""
    from dougong.kernels import order
    from dougong.kernels.raster import MICRON

    # The cube's edge is rounded to so much.
    is_inside = are_within(points, root.low - MICRON, root.low + root.edge_m + MICRON)
    inside = np.ascontiguousarray(points if is_inside.all() else points[is_inside])
    keys = np.empty(len(inside), np.uint64)
    cell_m = root.edge_m / 2.0**level
    for_blocks(
        len(inside),
        1 << 18,
        lambda start, stop: order.morton_keys(inside, root.low, cell_m, start, stop, keys),
    )
    return distinct(keys)
