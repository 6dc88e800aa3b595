"""Which nodes of a box tree lie in the balls round the points of some leaves, and which on the rim.

Neighbouring leaves ask much the same, so the answer is found in two steps: the whole tree is looked
at once for `_GROUP` leaves, and what that leaves open once for `SHARE` of them.
"""

from typing import NamedTuple

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.boxtree import points_under

SHARE = 2
"""Leaves whose points share an answer; a power of two, as is `_GROUP`."""
_GROUP = 16
_DEPTH = 64


class Walk(NamedTuple):
    """The answer for `SHARE` leaves, and what it was found from."""

    whole: Ints
    """(leaves,) nodes that lie in every ball."""
    rim: Ints
    """(leaves,) leaf nodes that some ball may touch."""
    open: Ints
    """(leaves,) leaf nodes that are open for the group of leaves."""
    stack: Ints
    state: Ints
    """(3,) the group that was asked for last, its nodes in `whole`, its nodes in `open`."""


@kernel
def make_walk(leaves: int) -> Walk:
    """Return room for the answers of a tree of so many leaves."""
    state = np.zeros(3, np.int64)
    state[0] = -1
    return Walk(
        np.empty(leaves, np.int64),
        np.empty(leaves, np.int64),
        np.empty(leaves, np.int64),
        np.empty(leaves + _DEPTH, np.int64),
        state,
    )


@kernel
def size_of(node: int, n: int) -> int:
    """Return how many of n points lie under `node`."""
    first, last = points_under(node, n)
    return last - first


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
def _sort_out(
    boxes: Floats, asked: int, radius2: float, walk: Walk, height: int, n_whole: int, rim: Ints
) -> tuple[int, int]:
    """Sort out walk.stack[:height] for the balls round all points of node `asked`.

    Nodes that lie in every ball are added behind walk.whole[:n_whole], leaf nodes that some ball
    may touch are listed in `rim`; returns how many of each there are then.
    """
    leaves = boxes.shape[0] // 2
    stack = walk.stack
    n_rim = 0
    while height > 0:
        height -= 1
        node = stack[height]
        least, largest = _reach2(boxes, asked, node)
        if least > radius2:
            continue
        if largest <= radius2:
            walk.whole[n_whole] = node
            n_whole += 1
        elif node >= leaves:
            rim[n_rim] = node
            n_rim += 1
        else:
            stack[height] = 2 * node
            stack[height + 1] = 2 * node + 1
            height += 2
    return n_whole, n_rim


@kernel
def look(boxes: Floats, asked: int, radius2: float, walk: Walk) -> tuple[int, int]:
    """Fill walk.whole and walk.rim for the leaves from number `asked`, a multiple of `SHARE`, on.

    Returns how many nodes there are in each. In a tree of fewer leaves, for all of them.
    """
    leaves = boxes.shape[0] // 2
    state = walk.state
    group = min(_GROUP, leaves)
    if asked // group != state[0]:
        state[0] = asked // group
        walk.stack[0] = 1
        state[1], state[2] = _sort_out(
            boxes, (leaves + asked) // group, radius2, walk, 1, 0, walk.open
        )
    walk.stack[: state[2]] = walk.open[: state[2]]
    node = (leaves + asked) // min(SHARE, leaves)
    return _sort_out(boxes, node, radius2, walk, state[2], state[1], walk.rim)
