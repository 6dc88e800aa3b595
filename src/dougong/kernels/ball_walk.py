"""Which nodes of a box tree lie in the balls round the points of some leaves, and which on the rim.

Neighbouring leaves ask much the same, so the answer is narrowed in three steps. The tree is walked
once for `GROUP` leaves; the leaves that this leaves open are sorted out, in plain loops over
columns, for each `SHARE` of them; and of the points on that rim each single leaf keeps those in the
band that its own points disagree about (`set_bands`).
"""

from typing import NamedTuple

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel

GROUP = 32
"""Leaves that a walk is made for; a power of two, as is `SHARE`."""
SHARE = 4
"""Leaves whose points share a rim."""
CHUNK = 512
"""Open leaves that are held in columns at once."""
_DEPTH = 64
_SLACK = 1e-9
"""What rounding may do to a squared distance, and more."""


class Walk(NamedTuple):
    """The answer for `GROUP` leaves."""

    whole: Ints
    """(leaves,) nodes that lie in every ball."""
    open: Ints
    """(leaves,) leaf nodes that some ball may touch."""
    stack: Ints


class OpenLeaves(NamedTuple):
    """At most `CHUNK` open leaves of a walk, and where they lie for `SHARE` of those who ask."""

    boxes: Floats
    """(6, CHUNK) low, then high corners, column by column."""
    starts: Ints
    stops: Ints
    """(CHUNK,) the first of the sorted points of each, and the one behind its last."""
    state: Ints
    """(CHUNK,) 1: in every ball; 2: some ball may touch it; else 0."""
    whole: Ints
    """(CHUNK + 1,) nodes of those that lie in every ball, and one place to write to in vain."""
    rim: Ints
    """(CHUNK + 1,) which of them, in turn, some ball may touch, likewise."""


@kernel
def make_walk(leaves: int) -> Walk:
    """Return room for the answers of a tree of so many leaves."""
    return Walk(
        np.empty(leaves, np.int64), np.empty(leaves, np.int64), np.empty(leaves + _DEPTH, np.int64)
    )


@kernel
def make_open_leaves() -> OpenLeaves:
    """Return room for a chunk of open leaves."""
    return OpenLeaves(
        np.empty((6, CHUNK), np.float64),
        np.empty(CHUNK, np.int64),
        np.empty(CHUNK, np.int64),
        np.empty(CHUNK, np.int64),
        np.empty(CHUNK + 1, np.int64),
        np.empty(CHUNK + 1, np.int64),
    )


@kernel
def _reach2(boxes: Floats, a: int, b: int) -> tuple[float, float]:
    """Return the least and the largest squared distance between points of boxes a and b."""
    least = largest = 0.0
    for axis in range(3):
        ahead = boxes[b, axis] - boxes[a, 3 + axis]
        behind = boxes[a, axis] - boxes[b, 3 + axis]
        gap = max(ahead, behind, 0.0)
        span = max(boxes[b, 3 + axis] - boxes[a, axis], boxes[a, 3 + axis] - boxes[b, axis])
        least += gap * gap
        largest += span * span
    return least, largest


@kernel
def look(boxes: Floats, asked: int, radius2: float, walk: Walk) -> tuple[int, int]:
    """Fill walk.whole and walk.open for the balls round all points of node `asked`.

    Returns how many nodes there are in each.
    """
    leaves = boxes.shape[0] // 2
    whole, touched, stack = walk.whole, walk.open, walk.stack
    stack[0] = 1
    height = 1
    n_whole = n_open = 0
    while height > 0:
        height -= 1
        node = stack[height]
        least, largest = _reach2(boxes, asked, node)
        if least > radius2:
            continue
        if largest <= radius2:
            whole[n_whole] = node
            n_whole += 1
        elif node >= leaves:
            touched[n_open] = node
            n_open += 1
        else:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2
    return n_whole, n_open


@kernel
def load(boxes: Floats, n: int, nodes: Ints, chunk: OpenLeaves) -> None:
    """Fill chunk.boxes, starts and stops with those of the leaf `nodes`, at most `CHUNK`.

    boxes (2 leaves, 6): of a tree over n points.
    """
    held, starts, stops = chunk.boxes, chunk.starts, chunk.stops
    leaves = boxes.shape[0] // 2
    for k in range(np.uint64(nodes.shape[0])):
        node = nodes[k]
        for corner in range(6):
            held[corner, k] = boxes[node, corner]
        starts[k], stops[k] = (node - leaves) * n // leaves, (node - leaves + 1) * n // leaves


@kernel
def _set_states(
    held: Floats, count: int, boxes: Floats, asked: int, radius2: float, state: Ints
) -> None:
    """Fill state[:count] with where the boxes held (6, ..) lie for the balls round node `asked`.

    `_reach2` without a branch, so that it is vectorised.
    """
    x0, y0, z0 = boxes[asked, 0], boxes[asked, 1], boxes[asked, 2]
    x1, y1, z1 = boxes[asked, 3], boxes[asked, 4], boxes[asked, 5]
    for k in range(np.uint64(count)):
        gap_x = max(held[0, k] - x1, x0 - held[3, k], 0.0)
        gap_y = max(held[1, k] - y1, y0 - held[4, k], 0.0)
        gap_z = max(held[2, k] - z1, z0 - held[5, k], 0.0)
        span_x = max(held[3, k] - x0, x1 - held[0, k])
        span_y = max(held[4, k] - y0, y1 - held[1, k])
        span_z = max(held[5, k] - z0, z1 - held[2, k])
        is_near = gap_x * gap_x + gap_y * gap_y + gap_z * gap_z <= radius2
        is_whole = span_x * span_x + span_y * span_y + span_z * span_z <= radius2
        state[k] = 1 if is_whole else (2 if is_near else 0)


@kernel
def sort_out(
    chunk: OpenLeaves, nodes: Ints, boxes: Floats, asked: int, radius2: float
) -> tuple[int, int]:
    """Fill chunk.whole and chunk.rim for the balls round all points of node `asked`.

    nodes: those that were loaded. Returns how many there are in each.
    """
    count = nodes.shape[0]
    state, whole, rim = chunk.state, chunk.whole, chunk.rim
    _set_states(chunk.boxes, count, boxes, asked, radius2, state)
    n_whole = n_rim = 0
    for k in range(np.uint64(count)):
        # Written in any case and counted where it holds: a branch would be guessed wrongly.
        whole[n_whole] = nodes[k]
        rim[n_rim] = k
        n_whole += state[k] & 1
        n_rim += state[k] >> 1
    return n_whole, n_rim


@kernel
def set_bands(
    points: Floats, boxes: Floats, asked: int, radius: float, centres: Floats, bands: Floats
) -> None:
    """Fill row k of centres (m, 3) and bands (m, 2) for the balls of the points of leaf asked + k.

    centres: whole numbers. What lies within sqrt(bands[k, 0]) of one lies in all of the balls, and
    in none of them what lies farther than sqrt(bands[k, 1]).
    """
    n, leaves = points.shape[0], boxes.shape[0] // 2
    for k in range(centres.shape[0]):
        for axis in range(3):
            low, high = boxes[leaves + asked + k, axis], boxes[leaves + asked + k, 3 + axis]
            centres[k, axis] = np.rint(0.5 * (low + high))
        most2 = 0.0
        for q in range((asked + k) * n // leaves, (asked + k + 1) * n // leaves):
            dx = points[q, 0] - centres[k, 0]
            dy = points[q, 1] - centres[k, 1]
            dz = points[q, 2] - centres[k, 2]
            most2 = max(most2, dx * dx + dy * dy + dz * dz)
        off = np.sqrt(most2) * (1.0 + _SLACK)
        inner, outer = radius - off, radius + off
        bands[k, 0] = inner * inner * (1.0 - _SLACK) if inner > 0.0 else -1.0
        bands[k, 1] = outer * outer * (1.0 + _SLACK)


@kernel
def _flag_between(
    near: Floats, held: int, x: float, y: float, z: float, low2: float, high2: float, flags: Ints
) -> None:
    """Fill flags[:held] with 1 for columns of `near` between two distances to (x, y, z), else 0."""
    for i in range(np.uint64(held)):
        dx, dy, dz = near[0, i] - x, near[1, i] - y, near[2, i] - z
        d2 = dx * dx + dy * dy + dz * dz
        flags[i] = 1 if (d2 > low2) & (d2 <= high2) else 0


@kernel
def gather_band(
    near: Floats,
    held: int,
    centres: Floats,
    bands: Floats,
    k: int,
    flags: Ints,
    who: Ints,
    band: Floats,
) -> int:
    """Fill `band` with those of the first `held` columns of `near` that lie in band k; how many.

    near and band (3 or more, ..): x, y, z, more. who (..) receives which they are; flags (..) is
    work space.
    """
    x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
    _flag_between(near, held, x, y, z, bands[k, 0], bands[k, 1], flags)
    kept = np.uint64(0)
    for i in range(np.uint64(held)):
        # Written in any case and counted where it is flagged: no branch to guess.
        who[kept] = i
        kept += np.uint64(flags[i])
    for row in range(near.shape[0]):
        for at in range(kept):
            band[row, at] = near[row, np.uint64(who[at])]
    return int(kept)
