"""Disjoint sets of points: parent (n,) holds a point of the same set, in a root its own place."""

from dougong.kernels._arrays import Ints
from dougong.kernels._jit import kernel


@kernel
def root_of(parent: Ints, i: int) -> int:
    """Return the root of the set of point i, and shorten the way to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def join(parent: Ints, i: int, j: int) -> None:
    """Make one set of those of points i and j; its root is the smaller one."""
    a, b = root_of(parent, i), root_of(parent, j)
    if a != b:
        parent[max(a, b)] = min(a, b)
