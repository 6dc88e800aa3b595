"""Which node of a COPC file's octree each point goes to, for a part of the cloud at a time.

Points are sorted along a Morton curve; each level of the octree shows one point per cell of a
128-cube of its node, nodes of few points are leaves and hold all that is left. A point's node
depends on the whole cloud only through the first few points of large cells, so a cloud of any size
is worked on in parts, each of them one node of the octree.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import sorted_places
from dougong.cloud import Records
from dougong.formats.las_header import LasHeader
from dougong.formats.las_write import Totals, as_bytes
from dougong.threads import for_blocks

GRID_BITS = 7
LEAF_CAPACITY = 65_536
DEEPEST = 21
"""A node of this level is one cell of the codes."""
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class Cube:
    """The root of the octree."""

    low: NDArray[np.int64]
    """(3,) integer coordinates of the low corner."""
    edge: float
    """File units."""


@dataclass(frozen=True, slots=True)
class Nodes:
    """Points in the order of their nodes."""

    order: NDArray[np.int64]
    """(n,) points, node after node."""
    starts: NDArray[np.int64]
    """(nodes + 1,) where each node begins in `order`."""
    level: NDArray[np.int8]
    key: NDArray[np.uint64]
    """(nodes,) Morton code at the node's level."""


def cube_of(totals: Totals, header: LasHeader) -> Cube:
    """Return the octree's cube, its low corner on the header's minimum as readers expect."""
    span = (totals.high - totals.low) * header.scale
    return Cube(low=totals.low, edge=max(float(span.max()), float(header.scale.max())))


def codes_of(records: Records, header: LasHeader, cube: Cube) -> NDArray[np.uint64]:
    """Return the Morton code (n,) of each point in the cube."""
    from dougong.kernels.copc_levels import LEVELS, cube_codes

    codes = np.empty(len(records), dtype=np.uint64)
    x, y, z = (np.ascontiguousarray(records[name]) for name in "XYZ")
    cells = header.scale * (2.0**LEVELS / cube.edge)
    for_blocks(len(codes), _BLOCK, lambda a, b: cube_codes(x, y, z, cube.low, cells, a, b, codes))
    return codes


def key_at(codes: NDArray[np.uint64], level: int) -> NDArray[np.uint64]:
    """Return the key (n,) of the node of `level` that each code lies in."""
    return codes >> np.uint64(3 * (DEEPEST - level))


def nodes_of(
    records: Records,
    codes: NDArray[np.uint64],
    *,
    part_level: int = 0,
    shown_above: Sequence[int] = (),
) -> Nodes:
    """Return the nodes of the points of one node of the octree, the part.

    Parameters
    ----------
    records, codes : ndarray, shape (n,)
        n > 0.
    part_level : int
        Level of the part; the nodes above it are no leaves.
    shown_above : sequence of int
        Levels whose cells are larger than the part, and that show its points of first priority.
    """
    from dougong.kernels.copc_levels import leaf_levels, pick_per_cell

    order = _sorted_places(records, codes)
    codes = codes[order]
    level = np.full(len(codes), -1, dtype=np.int8)
    leaf = np.empty(len(codes), dtype=np.int8)
    leaf_levels(codes, part_level, LEAF_CAPACITY, DEEPEST, leaf)
    if shown_above:
        first = np.argsort(priorities(codes), kind="stable")[: len(shown_above)]
        level[first] = list(shown_above)
    left = np.flatnonzero(level < 0)
    for depth in range(max(0, part_level - GRID_BITS), DEEPEST + 1):
        is_leaf = leaf[left] == depth
        level[left[is_leaf]] = depth
        left = left[~is_leaf]
        if not len(left):
            break
        is_taken = np.zeros(len(left), dtype=np.bool_)
        cell_level = min(depth + GRID_BITS, DEEPEST)
        pick_per_cell(codes[left], np.uint64(3 * (DEEPEST - cell_level)), is_taken)
        level[left[is_taken]] = depth
        left = left[~is_taken]
    key = codes >> (np.uint64(3) * (DEEPEST - level).astype(np.uint64))
    by_level = np.argsort(level, kind="stable")
    level, key = level[by_level], key[by_level]
    is_start = np.ones(len(level), dtype=bool)
    is_start[1:] = (level[1:] != level[:-1]) | (key[1:] != key[:-1])
    starts = np.flatnonzero(is_start)
    return Nodes(order[by_level], np.append(starts, len(level)), level[starts], key[starts])


def priorities(codes: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the priority (n,) of each code, as `kernels.copc_levels.priority`."""
    v = (codes ^ (codes >> np.uint64(31))) * np.uint64(0x7FB5D329728EA185)
    v = (v ^ (v >> np.uint64(27))) * np.uint64(0x81DADEF4BC2DD44D)
    found: NDArray[np.uint64] = v ^ (v >> np.uint64(33))
    return found


def _sorted_places(records: Records, codes: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return the places (n,) that sort the points by code, those of one code by their bytes."""
    order = sorted_places(codes)
    is_same = np.zeros(len(order), dtype=bool)
    is_same[1:] = codes[order[1:]] == codes[order[:-1]]
    if not is_same.any():
        return order
    is_tied = is_same.copy()
    is_tied[:-1] |= is_same[1:]
    tied = order[is_tied]
    held = as_bytes(records.take(tied)).reshape(len(tied), -1)
    ranks = np.unique(held.view(f"V{held.shape[1]}")[:, 0], return_inverse=True)[1]
    order[is_tied] = tied[np.lexsort((ranks, codes[tied]))]
    return order
