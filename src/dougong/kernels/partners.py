"""Which points of two clouds meet under a pose, and how well: the loops of every fit and score.

A search, the two normals and the sides of roofs in one pass, so that nothing but the answer is
written. Poses are passed as (4, 4), targets as their box tree (see `boxtree`).
"""

from typing import NamedTuple

import numpy as np

from dougong.kernels._arrays import Flags, Floats, Ints
from dougong.kernels._jit import kernel
from dougong.kernels.neighbours import DEPTH, nearest_one


class Side(NamedTuple):
    """What a pair asks of one cloud's n points."""

    xyz: Floats
    """(n, 3) metres."""
    normals: Floats
    """(n, 3) unit."""
    is_oriented: Flags
    """(n,) the normal's sign is sure."""
    is_top: Flags
    """(n,) surely seen from above."""
    may_be_underside: Flags
    """(n,) of a roof of which nobody knows the side."""


class Tree(NamedTuple):
    """A box tree over a cloud."""

    points: Floats
    """(n, 3) in sorted order."""
    boxes: Floats
    """(2 leaves, 6)"""
    order: Ints
    """(n,) the place in the cloud of each sorted point."""


@kernel
def _moved(T: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@kernel
def _cosine(T: Floats, a: Floats, b: Floats) -> float:
    """Return the dot product of the turned `a` and `b`, both (3,)."""
    total = 0.0
    for i in range(3):
        total += (T[i, 0] * a[0] + T[i, 1] * a[1] + T[i, 2] * a[2]) * b[i]
    return total


@kernel
def find(
    source: Side,
    asked: Ints,
    target: Side,
    tree: Tree,
    T: Floats,
    limit2: float,
    least_cosine: float,
    start: int,
    stop: int,
    out: Ints,
) -> None:
    """Find the partner in the target of the asked (m,) points start .. stop - 1 under T.

    out (m,): its place; -1 where none is in reach, the normals disagree, or the pair may be the
    two sides of one roof (a top, and what may be an underside).
    """
    stack = np.empty(DEPTH, np.int64)
    bound = np.empty(DEPTH, np.float64)
    for k in range(start, stop):
        out[k] = -1
        i = asked[k]
        x, y, z = _moved(T, source.xyz[i, 0], source.xyz[i, 1], source.xyz[i, 2])
        place, _ = nearest_one(tree.points, tree.boxes, x, y, z, limit2, stack, bound)
        if place < 0:
            continue
        j = tree.order[place]
        if source.may_be_underside[i] and target.is_top[j]:
            continue
        if target.may_be_underside[j] and source.is_top[i]:
            continue
        cosine = _cosine(T, source.normals[i], target.normals[j])
        if not (source.is_oriented[i] and target.is_oriented[j]):
            cosine = abs(cosine)
        if cosine > least_cosine:
            out[k] = j


@kernel
def describe(
    source: Side,
    target: Side,
    T: Floats,
    s: Ints,
    t: Ints,
    weight_source: float,
    weight_target: float,
    points: Floats,
    normals: Floats,
    offsets: Floats,
    residuals: Floats,
) -> None:
    """Describe the pairs s, t (k,) under T: what a fit needs of them.

    points (k, 3): the source's, moved; offsets (k, 3): from the target's to them; normals (k, 3):
    the unit mean of both, weighted; residuals (k,): the offset along it.
    """
    mean = np.empty(3)
    for k in range(s.shape[0]):
        i, j = s[k], t[k]
        moved = _moved(T, source.xyz[i, 0], source.xyz[i, 1], source.xyz[i, 2])
        sign = -1.0 if _cosine(T, source.normals[i], target.normals[j]) < 0.0 else 1.0
        length2 = 0.0
        for axis in range(3):
            turned = (
                T[axis, 0] * source.normals[i, 0]
                + T[axis, 1] * source.normals[i, 1]
                + T[axis, 2] * source.normals[i, 2]
            )
            mean[axis] = weight_source * turned + weight_target * sign * target.normals[j, axis]
            length2 += mean[axis] * mean[axis]
        length = np.sqrt(length2)
        residual = 0.0
        for axis in range(3):
            points[k, axis] = moved[axis]
            offsets[k, axis] = moved[axis] - target.xyz[j, axis]
            normals[k, axis] = mean[axis] / length
            residual += normals[k, axis] * offsets[k, axis]
        residuals[k] = residual


@kernel
def closeness(
    points: Floats,
    normals: Floats,
    moves: Floats,
    tree: Tree,
    target_normals: Floats,
    reach: float,
    least_cosine: float,
    start: int,
    stop: int,
    out: Floats,
) -> None:
    """Score moves (m, 4, 4), start .. stop - 1: how near points come to like surfaces.

    out (m,): the mean over points (n, 3) of 1 - distance / reach, 0 beyond the reach and where the
    normals, whichever way they point, disagree.
    """
    stack = np.empty(DEPTH, np.int64)
    bound = np.empty(DEPTH, np.float64)
    for m in range(start, stop):
        move = moves[m]
        total = 0.0
        for i in range(points.shape[0]):
            x, y, z = _moved(move, points[i, 0], points[i, 1], points[i, 2])
            place, distance2 = nearest_one(
                tree.points, tree.boxes, x, y, z, reach * reach, stack, bound
            )
            if place < 0:
                continue
            cosine = _cosine(move, normals[i], target_normals[tree.order[place]])
            if abs(cosine) > least_cosine:
                total += 1.0 - np.sqrt(distance2) / reach
        out[m] = total / points.shape[0]
