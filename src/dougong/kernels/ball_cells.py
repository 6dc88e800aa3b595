"""Sums over balls made of whole octree cells, exact in integers; one ball for all points of a cell.

Cells stand at whole numbers (as float64), each with sums of its points (`balls` says why sums of
int64 about the origin may wrap). Those of a node of the tree over the cells are added up once.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.ball_walk import SHARE, look, make_walk
from dougong.kernels.balls import add_moved, add_point, variation_of
from dougong.kernels.boxtree import LEAF

_CHUNK = 32
"""Leaves on the rim that are looked at together: their cells fit the fast cache."""


@kernel
def cell_moments(
    points: Floats, places: Ints, starts: Ints, runs: Ints, first: int, last: int, out: Ints
) -> None:
    """Fill out (m, 10) at cells first .. last - 1 with count and moments of their points.

    points (n, 3): whole numbers. The points of run r are those at places[starts[r]:starts[r + 1]];
    cell c is run runs[c].
    """
    out[first:last] = 0
    for c in range(first, last):
        for k in range(starts[runs[c]], starts[runs[c] + 1]):
            out[c, 0] += 1
            add_point(points, places[k], out[c, 1:])


@kernel
def cell_totals(
    values: Ints, places: Ints, starts: Ints, runs: Ints, first: int, last: int, out: Ints
) -> None:
    """Fill out (m, 3) at cells first .. last - 1: count, sum, sum of squares of values >= 0."""
    out[first:last] = 0
    for c in range(first, last):
        for k in range(starts[runs[c]], starts[runs[c] + 1]):
            value = values[places[k]]
            if value >= 0:
                out[c, 0] += 1
                out[c, 1] += value
                out[c, 2] += value * value


@kernel
def add_up(cells: Ints, nodes: Ints) -> None:
    """Fill nodes (2 leaves, w) with the sums over every node of those of its cells (m, w)."""
    m, leaves = cells.shape[0], nodes.shape[0] // 2
    nodes[:] = 0
    for leaf in range(leaves):
        for c in range(leaf * m // leaves, (leaf + 1) * m // leaves):
            for k in range(cells.shape[1]):
                nodes[leaves + leaf, k] += cells[c, k]
    for node in range(leaves - 1, 0, -1):
        for k in range(cells.shape[1]):
            nodes[node, k] = nodes[2 * node, k] + nodes[2 * node + 1, k]


@kernel
def _gather(
    middles: Floats,
    cells: Ints,
    leaves: int,
    rim: Ints,
    start: int,
    stop: int,
    near: Floats,
    given: Ints,
) -> int:
    """Fill near (3, ..) and given (w, ..) with the cells of leaf nodes rim[start:stop]; how many.

    Column by column, so that the sums over them are vectorised.
    """
    m = middles.shape[0]
    held = 0
    for r in range(start, stop):
        leaf = rim[r] - leaves
        for c in range(leaf * m // leaves, (leaf + 1) * m // leaves):
            for axis in range(3):
                near[axis, held] = middles[c, axis]
            for k in range(cells.shape[1]):
                given[k, held] = cells[c, k]
            held += 1
    return held


@kernel
def _flag(
    near: Floats, held: int, x: float, y: float, z: float, radius2: float, is_in: Ints
) -> None:
    """Fill is_in[:held] with -1 (all bits set) for cells in the ball, else 0."""
    for i in range(np.uint64(held)):
        dx, dy, dz = near[0, i] - x, near[1, i] - y, near[2, i] - z
        is_in[i] = -1 if dx * dx + dy * dy + dz * dz <= radius2 else 0


@kernel
def _sum_flagged(given: Ints, held: int, is_in: Ints) -> int:
    """Return the sum of given[:held] where flagged, modulo 2**64."""
    total = 0
    for i in range(np.uint64(held)):
        total += given[i] & is_in[i]
    return total


@kernel
def ball_sums(
    middles: Floats,
    boxes: Floats,
    cells: Ints,
    nodes: Ints,
    radius2: float,
    first_leaf: int,
    last_leaf: int,
    out: Ints,
) -> None:
    """Fill out (.., w) with the sums over the balls of the cells of first_leaf .. last_leaf - 1.

    middles (m, 3): whole numbers, in the order of a box tree. A ball holds the cells whose middles
    lie within the radius of its own, inclusive.
    """
    m, width, leaves = middles.shape[0], cells.shape[1], boxes.shape[0] // 2
    walk, share = make_walk(leaves), min(SHARE, leaves)
    common = np.empty(width, np.int64)
    near = np.empty((3, _CHUNK * LEAF), np.float64)
    given = np.empty((width, _CHUNK * LEAF), np.int64)
    is_in = np.empty(_CHUNK * LEAF, np.int64)
    offset = first_leaf * m // leaves
    for asked in range(first_leaf, last_leaf, share):
        n_whole, n_rim = look(boxes, asked, radius2, walk)
        common[:] = 0
        for w in range(n_whole):
            for k in range(width):
                common[k] += nodes[walk.whole[w], k]
        begin, end = asked * m // leaves, (asked + share) * m // leaves
        out[begin - offset : end - offset] = common
        for start in range(0, n_rim, _CHUNK):
            stop = min(start + _CHUNK, n_rim)
            held = _gather(middles, cells, leaves, walk.rim, start, stop, near, given)
            for q in range(begin, end):
                x, y, z = middles[q, 0], middles[q, 1], middles[q, 2]
                _flag(near, held, x, y, z, radius2, is_in)
                for k in range(width):
                    out[q - offset, k] += _sum_flagged(given[k], held, is_in)


@kernel
def variations(sums: Ints, middles: Floats, edge: float, out: Floats) -> None:
    """Fill out (k,) with the surface variation of balls by their count and moments (k, 10).

    middles (k, 3): of the balls, in cells of `edge` steps, an even number.
    """
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    about, centre = np.empty(10, np.float64), np.empty(3, np.float64)
    for q in range(sums.shape[0]):
        for axis in range(3):
            centre[axis] = (middles[q, axis] + 0.5) * edge
        about[:] = 0.0
        add_moved(sums[q], centre, about)
        out[q] = variation_of(about, a, v)
