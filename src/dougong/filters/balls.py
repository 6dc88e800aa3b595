"""Sums over the ball round every point: exact, or of cells where a slight blur will do.

Points are rounded to whole steps of a lattice and summed in integers, so a sum is the same for any
order, tile or thread count. Kernels are imported when called.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong._checks import as_points
from dougong._sorting import unsorted
from dougong.errors import InputError
from dougong.filters.octree_voxel_grid import robust_low, runs_of_cells
from dougong.threads import for_blocks
from dougong.typing import Index, Values

if TYPE_CHECKING:
    from dougong.filters.neighbourhood import Neighbourhood

_LEAVES = 1 << 9
"""Leaves per task; a power of two."""
_CELLS_AT_ONCE = 1 << 13
_POINTS_AT_ONCE = 1 << 16
_LATTICE_STEPS = 1 << 16
"""At least this many lattice steps in the largest radius: 8 micrometres for 0.3 m."""
_CELLS = 16
"""At least this many cells in a radius, and fewer than twice as many."""
BLUR = math.sqrt(3.0) / _CELLS
"""What a ball of cells may miss inside its radius or hold beyond it, at most, in radii."""


class Lattice(NamedTuple):
    """Points on whole numbers, sorted into a tree: balls are summed exactly on it."""

    points: NDArray[np.float64]
    """(n, 3) whole numbers, in steps."""
    order: Index
    """(n,) place in the caller's array of each sorted point."""
    boxes: NDArray[np.float64]
    """(2 leaves, 6)."""
    step_m: float
    """Metres per step; a power of two."""

    def unsorted(self, values: NDArray[np.float64]) -> Values:
        """Return per-point `values`, given in sorted order, in the caller's order."""
        return unsorted(values, self.order)


def build_lattice(
    points: ArrayLike, radius_m: float, low: NDArray[np.float64] | None = None
) -> Lattice:
    """Return `points` (n, 3), rounded to steps of at most radius_m / 2**16, as a tree.

    The steps count from `low` (3,), by default the points' `robust_low`, so that nothing depends
    on their frame. Parts of a cloud that are given the same are rounded alike.

    Raises
    ------
    InputError
        The points spread over more than 2**52 steps.
    """
    from dougong.filters.neighbourhood import sort_into_index

    xyz = as_points(points)
    low = robust_low(xyz) if low is None else low
    step_m = 2.0 ** math.floor(math.log2(radius_m / _LATTICE_STEPS))
    steps = np.empty_like(xyz)

    def task(start: int, stop: int) -> None:
        # To multiply by a power of two is to divide by one, and faster.
        np.rint((xyz[start:stop] - low) * (1.0 / step_m), out=steps[start:stop])

    for_blocks(len(xyz), _POINTS_AT_ONCE, task)
    lattice = Lattice(*sort_into_index(steps), step_m)
    if len(xyz) and np.abs(lattice.boxes[1]).max() > 2**52:
        msg = (
            f"points reach {np.abs(xyz - low).max():.3g} m from the others, too far for balls of "
            f"{radius_m} m (at most {2**52 * step_m:.3g} m). Drop far points."
        )
        raise InputError(msg)
    return lattice


class Balls(Protocol):
    """The balls of one radius round all points of a lattice, which themselves lie in them."""

    def variation(self) -> Values:
        """Return the surface variation (n,) of every ball, in sorted order (eq. 1 to 3)."""
        ...

    def statistics(self, steps: Index) -> tuple[Values, Values]:
        """Return mean and deviation (n,) of the `steps` (n,) >= 0 in every ball."""
        ...


class ExactBalls:
    """Balls that hold the points within the radius, inclusive, and no other.

    On a surface the cost of a ball grows with the square root of its points.
    """

    def __init__(self, lattice: Lattice, radius_m: float) -> None:
        self._lattice = lattice
        self._radius2 = (radius_m / lattice.step_m) ** 2

    def variation(self) -> Values:
        """See `Balls`."""
        from dougong.kernels import balls

        points, _, boxes, _ = self._lattice
        moments = np.empty((len(boxes), 10), np.int64)
        balls.node_moments(points, moments)
        found = np.empty(len(points))

        def keep(first: int, last: int, sums: Index) -> None:
            balls.variations(sums, found[first:last])

        self._sum_up(moments, np.zeros(0, np.int64), keep)
        return found

    def statistics(self, steps: Index) -> tuple[Values, Values]:
        """See `Balls`."""
        from dougong.kernels import balls

        nodes = np.empty((len(self._lattice.boxes), 3), np.int64)
        balls.node_sums(steps, nodes)
        mean, deviation = np.empty((2, len(self._lattice.points)))

        def keep(first: int, last: int, sums: Index) -> None:
            mean[first:last], deviation[first:last] = _mean_and_deviation(sums)

        self._sum_up(nodes, steps, keep)
        return mean, deviation

    def _sum_up(self, nodes: Index, values: Index, keep: Callable[[int, int, Index], None]) -> None:
        """Hand to `keep` the sums (.., w) over the balls of points first .. last - 1."""
        from dougong.kernels import balls

        points, _, boxes, _ = self._lattice
        n, leaves = len(points), len(boxes) // 2

        def task(first_leaf: int, last_leaf: int) -> None:
            first, last = first_leaf * n // leaves, last_leaf * n // leaves
            sums = np.empty((last - first, nodes.shape[1]), np.int64)
            balls.ball_sums(
                points, values, boxes, nodes, self._radius2, first_leaf, last_leaf, sums
            )
            keep(first, last, sums)

        if n:
            for_blocks(leaves, _LEAVES, task)


class CellBalls:
    """Balls made of whole cells, one for all points of a cell.

    The cells are those of one octree, 16 to 32 to a radius r. The ball of a cell is the cells whose
    middles lie within r of its own, inclusive: it holds every point nearer than r (1 - `BLUR`) to
    the point asked about, and none farther than r (1 + `BLUR`). Sums over it are exact. The cost of
    a ball does not grow with its points.
    """

    def __init__(self, lattice: Lattice, radius_m: float) -> None:
        radius = radius_m / lattice.step_m
        self._edge = 2.0 ** math.floor(math.log2(radius / _CELLS))
        self._radius2 = (radius / self._edge) ** 2
        self._points = lattice.points
        self._cells, self._places, self._starts = _cells_of(lattice, self._edge)

    def variation(self) -> Values:
        """See `Balls`."""
        from dougong.kernels import ball_cells

        middles = self._cells.points
        found = np.empty(len(middles))

        def keep(first: int, last: int, sums: Index) -> None:
            ball_cells.variations(sums, middles[first:last], self._edge, found[first:last])

        self._sum_up(10, partial(ball_cells.cell_moments, self._points), keep)
        return self._of_points(found)

    def statistics(self, steps: Index) -> tuple[Values, Values]:
        """See `Balls`."""
        from dougong.kernels import ball_cells

        mean, deviation = np.empty((2, len(self._cells.points)))

        def keep(first: int, last: int, sums: Index) -> None:
            mean[first:last], deviation[first:last] = _mean_and_deviation(sums)

        self._sum_up(3, partial(ball_cells.cell_totals, steps), keep)
        return self._of_points(mean), self._of_points(deviation)

    def _sum_up(
        self,
        width: int,
        sum_cells: Callable[..., None],
        keep: Callable[[int, int, Index], None],
    ) -> None:
        """Hand to `keep` the sums (.., width) over the balls of cells first .. last - 1."""
        from dougong.kernels import ball_cells

        middles, runs, boxes = self._cells
        m, leaves = len(middles), len(boxes) // 2
        cells, nodes = np.empty((m, width), np.int64), np.empty((len(boxes), width), np.int64)
        for_blocks(
            m,
            _CELLS_AT_ONCE,
            lambda first, last: sum_cells(self._places, self._starts, runs, first, last, cells),
        )
        ball_cells.add_up(cells, nodes)

        def task(first_leaf: int, last_leaf: int) -> None:
            first, last = first_leaf * m // leaves, last_leaf * m // leaves
            sums = np.empty((last - first, width), np.int64)
            ball_cells.ball_sums(
                middles, boxes, cells, nodes, self._radius2, first_leaf, last_leaf, sums
            )
            keep(first, last, sums)

        if m:
            for_blocks(leaves, _LEAVES, task)

    def _of_points(self, of_cells: Values) -> Values:
        """Return the values (n,) of the points by those (m,) of the cells they lie in."""
        from dougong.kernels import ball_cells

        found = np.empty(len(self._points))

        def task(first: int, last: int) -> None:
            ball_cells.spread(
                of_cells, self._places, self._starts, self._cells.order, first, last, found
            )

        for_blocks(len(of_cells), _CELLS_AT_ONCE, task)
        return found


def _mean_and_deviation(totals: Index) -> tuple[Values, Values]:
    """Return mean and deviation (n,) of what has count, sum and sum of squares `totals` (n, 3)."""
    count = np.maximum(totals[:, 0], 1).astype(np.float64)
    mean = totals[:, 1] / count
    spread = totals[:, 2] / count - mean * mean
    return mean, np.sqrt(np.maximum(spread, 0.0))


def _cells_of(lattice: Lattice, edge: float) -> tuple[Neighbourhood, Index, Index]:
    """Return the cells of `edge` steps that hold points, as a tree, and whose points they are.

    The tree's points are whole numbers of cells. The points of the cell whose ``order`` is r are
    places[starts[r]:starts[r + 1]].
    """
    from dougong.filters.neighbourhood import build_index, sort_into_index

    points = lattice.points
    if not len(points):
        return build_index(points), np.zeros(0, np.int64), np.zeros(1, np.int64)
    low = np.floor(lattice.boxes[1, :3] / edge) * edge
    places, starts = runs_of_cells(points, low, edge)
    return sort_into_index(np.floor(points[places[starts[:-1]]] / edge)), places, starts
