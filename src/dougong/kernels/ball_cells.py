"""Sums over balls made of whole octree cells, exact in integers; one ball for all points of a cell.

Cells stand at whole numbers (as float64), each with sums of its points (`balls` says why sums of
int64 about the origin may wrap). Those of a node of the tree over the cells are added up once.
"""

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.ball_walk import (
    CHUNK,
    GROUP,
    SHARE,
    OpenLeaves,
    gather_band,
    load,
    look,
    make_open_leaves,
    make_walk,
    set_bands,
    sort_out,
)
from dougong.kernels.balls import (
    add_moved,
    add_point,
    add_rows,
    add_up_nodes,
    variation_of,
)
from dougong.kernels.boxtree import LEAF

_AT_ONCE = 320
"""Cells whose sums fit the fast cache."""
_APART = 8
"""Surplus of columns: rows whole pages apart would drive each other out of the cache."""


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
def spread(
    of_cells: Floats, places: Ints, starts: Ints, runs: Ints, first: int, last: int, out: Floats
) -> None:
    """Fill out (n,) at the points of cells first .. last - 1 with the values of_cells (m,)."""
    for c in range(first, last):
        for k in range(starts[runs[c]], starts[runs[c] + 1]):
            out[places[k]] = of_cells[c]


@kernel
def add_up(cells: Ints, nodes: Ints) -> None:
    """Fill nodes (2 leaves, w) with the sums over every node of those of its cells (m, w)."""
    m, leaves = cells.shape[0], nodes.shape[0] // 2
    nodes[:] = 0
    for leaf in range(leaves):
        for c in range(leaf * m // leaves, (leaf + 1) * m // leaves):
            for k in range(cells.shape[1]):
                nodes[leaves + leaf, k] += cells[c, k]
    add_up_nodes(nodes)


@kernel
def _gather_near(
    middles: Floats, cells: Ints, chunk: OpenLeaves, n_rim: int, near: Floats, given: Ints
) -> int:
    """Fill near (3, ..) and given (w, ..) with the cells of the leaves chunk.rim[:n_rim]; how many.

    Column by column, so that the sums over them are vectorised.
    """
    # Taken out of the tuple once: inside a loop each access counts a reference.
    listed, starts, stops = chunk.rim, chunk.starts, chunk.stops
    held = np.uint64(0)
    for r in range(np.uint64(n_rim)):
        k = listed[r]
        for c in range(np.uint64(starts[k]), np.uint64(stops[k])):
            for axis in range(3):
                near[axis, held] = middles[c, axis]
            for column in range(given.shape[0]):
                given[column, held] = cells[c, column]
            held += np.uint64(1)
    return int(held)


@kernel
def _pick(given: Ints, who: Ints, count: int, out: Ints) -> None:
    """Fill out[:, :count] with the columns of given (w, ..) that who[:count] lists."""
    for row in range(given.shape[0]):
        for k in range(np.uint64(count)):
            out[row, k] = given[row, np.uint64(who[k])]


@kernel
def _add_ten(
    near: Floats,
    given: Ints,
    start: int,
    stop: int,
    x: float,
    y: float,
    z: float,
    radius2: float,
    sums: Ints,
    row: int,
) -> None:
    """Add given (10, ..) of the cells start .. stop - 1 in the ball to a row of sums (.., 10)."""
    a = b = c = d = e = f = g = h = i = j = 0
    for k in range(np.uint64(start), np.uint64(stop)):
        dx, dy, dz = near[0, k] - x, near[1, k] - y, near[2, k] - z
        is_in = -1 if dx * dx + dy * dy + dz * dz <= radius2 else 0
        a += given[0, k] & is_in
        b += given[1, k] & is_in
        c += given[2, k] & is_in
        d += given[3, k] & is_in
        e += given[4, k] & is_in
        f += given[5, k] & is_in
        g += given[6, k] & is_in
        h += given[7, k] & is_in
        i += given[8, k] & is_in
        j += given[9, k] & is_in
    for column, total in enumerate((a, b, c, d, e, f, g, h, i, j)):
        sums[row, column] += total


@kernel
def _add_three(
    near: Floats,
    given: Ints,
    start: int,
    stop: int,
    x: float,
    y: float,
    z: float,
    radius2: float,
    sums: Ints,
    row: int,
) -> None:
    """Add given (3, ..) of the cells start .. stop - 1 in the ball to a row of sums (.., 3)."""
    a = b = c = 0
    for k in range(np.uint64(start), np.uint64(stop)):
        dx, dy, dz = near[0, k] - x, near[1, k] - y, near[2, k] - z
        is_in = -1 if dx * dx + dy * dy + dz * dz <= radius2 else 0
        a += given[0, k] & is_in
        b += given[1, k] & is_in
        c += given[2, k] & is_in
    for column, total in enumerate((a, b, c)):
        sums[row, column] += total


@kernel
def _add_rim(
    queries: Floats,
    first: int,
    last: int,
    near: Floats,
    given: Ints,
    held: int,
    radius2: float,
    sums: Ints,
    row: int,
) -> None:
    """Add what is `given` (w, ..) for `held` cells in the balls round queries first .. last - 1.

    To sums (.., w), from `row` on, w = 3 or 10. So many cells at once as fit the fast cache.
    """
    for start in range(0, held, _AT_ONCE):
        stop = min(start + _AT_ONCE, held)
        for q in range(first, last):
            x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
            if given.shape[0] == 3:
                _add_three(near, given, start, stop, x, y, z, radius2, sums, row + q - first)
            else:
                _add_ten(near, given, start, stop, x, y, z, radius2, sums, row + q - first)


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
    group, share = min(GROUP, leaves), min(SHARE, leaves)
    radius = np.sqrt(radius2)
    walk, chunk, room = make_walk(leaves), make_open_leaves(), CHUNK * LEAF + _APART
    near, near_sums = np.empty((3, room), np.float64), np.empty((width, room), np.int64)
    band, band_sums = np.empty((3, room), np.float64), np.empty((width, room), np.int64)
    flags, who = np.empty(room, np.int64), np.empty(room, np.int64)
    common = np.empty((group // share, width), np.int64)
    inner = np.empty((group, width), np.int64)
    centres, bands = np.empty((group, 3), np.float64), np.empty((group, 2), np.float64)
    offset = first_leaf * m // leaves
    held = 0
    for asked in range(first_leaf, last_leaf, group):
        n_whole, n_open = look(boxes, (leaves + asked) // group, radius2, walk)
        common[:] = 0
        add_rows(nodes, walk.whole, n_whole, common, 0)
        common[1:] = common[0]
        inner[:] = 0
        out[asked * m // leaves - offset : (asked + group) * m // leaves - offset] = 0
        set_bands(middles, boxes, asked, radius, centres, bands)
        for start in range(0, n_open, CHUNK):
            opened = walk.open[start : min(start + CHUNK, n_open)]
            load(boxes, m, opened, chunk)
            for k in range(group):
                if k % share == 0:
                    asking = (leaves + asked + k) // share
                    n_whole, n_rim = sort_out(chunk, opened, boxes, asking, radius2)
                    add_rows(nodes, chunk.whole, n_whole, common, k // share)
                    held = _gather_near(middles, cells, chunk, n_rim, near, near_sums)
                _add_rim(centres, k, k + 1, near, near_sums, held, bands[k, 0], inner, k)
                kept = gather_band(near, held, centres, bands, k, flags, who, band)
                _pick(near_sums, who, kept, band_sums)
                first, last = (asked + k) * m // leaves, (asked + k + 1) * m // leaves
                row = first - offset
                _add_rim(middles, first, last, band, band_sums, kept, radius2, out, row)
        for k in range(group):
            first, last = (asked + k) * m // leaves, (asked + k + 1) * m // leaves
            out[first - offset : last - offset] += common[k // share] + inner[k]


@kernel
def variations(sums: Ints, middles: Floats, edge: float, out: Floats) -> None:
    """Fill out (k,) with the surface variation of balls by their count and moments (k, 10).

    middles (k, 3): of the balls, in cells of `edge` steps, an even number.
    """
    a, v = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    about, centre = np.empty(10, np.int64), np.empty(3, np.int64)
    for q in range(sums.shape[0]):
        for axis in range(3):
            centre[axis] = np.int64((middles[q, axis] + 0.5) * edge)
        about[:] = 0
        add_moved(sums[q], centre[0], centre[1], centre[2], about)
        out[q] = variation_of(about, a, v)
