"""Decimation: one original point per voxel of an octree level, the one nearest its centre.

METHOD.md 1.1. Kept points keep every attribute; which one is kept depends only on the points, never
on their order or the origin of their frame: less than a micrometre below a border counts as on it
(`kernels.cells`). Kernels are imported when called: the model loads without Numba.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from dougong._boxes import are_within, corners_of
from dougong._checks import as_points
from dougong.cloud import chosen_rows
from dougong.errors import InputError
from dougong.filters.selection import Selection
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Blocks, Index, Mask, Points

KIND: Literal["local", "two-pass", "global"] = "two-pass"

_TRIM = 0.005
"""Share of the points at each end of an axis that may be too far off to shape the root cube."""


class OctreeVoxelGrid(Parameters):
    """Keep, in every occupied leaf of an octree, the original point nearest the leaf's centre."""

    voxel_m: Annotated[float, Field(gt=0)] | None = 0.005
    """Edge of a leaf, metres. Left out when `depth` is given."""
    depth: Annotated[int, Field(ge=1, le=20)] | None = None
    """Levels below the root cube, instead of `voxel_m` (the paper: 14)."""

    @model_validator(mode="before")
    @classmethod
    def _depth_replaces_the_default(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("depth") is not None and "voxel_m" not in given:
            return {**given, "voxel_m": None}
        return given

    @model_validator(mode="after")
    def _one_of_both(self) -> "OctreeVoxelGrid":
        if (self.voxel_m is None) == (self.depth is None):
            msg = f"give voxel_m or depth, not both or none, got {self.voxel_m} and {self.depth}."
            raise ValueError(msg)
        return self


class Root(NamedTuple):
    """The root cube of an octree and its leaves: what tiles of one cloud must share."""

    low: NDArray[np.float64]
    """(3,) low corner, metres."""
    edge_m: float
    """Edge of the cube: the longest side of the box without isolated far points."""
    voxel_m: float
    """Edge of a leaf."""


def halo_m(params: OctreeVoxelGrid) -> float:
    """Return how far a point outside a tile can matter: one voxel; with `depth`, unknown here."""
    return params.voxel_m if params.voxel_m is not None else float("inf")


def robust_box(points: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return low and high corner of the box of `points` (n, 3) without isolated far points.

    Per axis the outer 0.5 % at each end are suspects; a suspect counts as far when it lies more
    than the longest side of the box of the others beyond that box. O(n), whatever the order.
    Below five points there are no suspects.
    """
    return robust_box_of(lambda: (points,), len(points))


def robust_low(points: Points) -> NDArray[np.float64]:
    """Return where cells begin that shall not depend on the frame: the `robust_box`'s low corner.

    (3,), zeros where there are no points.
    """
    return robust_box(points)[0] if len(points) else np.zeros(3)


def robust_box_of(blocks: Blocks, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the `robust_box` of a cloud that comes in blocks, passed over two to four times.

    Parameters
    ----------
    blocks : callable
        Returns the blocks (m, 3), metres, from the first one; called once per pass.
    count : int
        Points in all blocks, at least 1. Memory: 48 bytes per suspect, so 0.5 bytes per point.
    """
    suspects = max(1, int(count * _TRIM)) if count > 4 else 0
    low, high = _corners(blocks)
    if suspects == 0 or _has_full_ends(blocks, low, high, suspects):
        return low, high
    inner_low, inner_high = _inner_corners(blocks, suspects)
    reach = float((inner_high - inner_low).max())
    near_low, near_high = _corners(blocks, (inner_low - reach, inner_high + reach))
    return (near_low, near_high) if np.isfinite(near_low).all() else (low, high)


def _corners(
    blocks: Blocks, within: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box of all points, or of those `within` two corners (inclusive).

    Infinite where there are none.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for block in blocks():
        points = block
        if within is not None:
            points = block[are_within(block, *within)]
        if len(points):
            lowest, highest = corners_of(points)
            low, high = np.minimum(low, lowest), np.maximum(high, highest)
    return low, high


def _has_full_ends(
    blocks: Blocks, low: NDArray[np.float64], high: NDArray[np.float64], suspects: int
) -> bool:
    """Say whether counting alone proves that no point of the box is far.

    When more points than the suspects lie in the outer thirds (of the longest side) of every axis,
    the others' box is at least that third long and no suspect is further from it.
    """
    third = float((high - low).max()) / 3.0
    at_low, at_high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for block in blocks():
        for axis in range(3):
            at_low[axis] += np.count_nonzero(block[:, axis] <= low[axis] + third)
            at_high[axis] += np.count_nonzero(block[:, axis] >= high[axis] - third)
    return bool((at_low > suspects).all() and (at_high > suspects).all())


def _inner_corners(
    blocks: Blocks, suspects: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return, per axis, the coordinate behind the `suspects` lowest and before the highest."""
    lowest: list[NDArray[np.float64]] = [np.empty(0)] * 3
    highest: list[NDArray[np.float64]] = [np.empty(0)] * 3
    held = suspects + 1
    for block in blocks():
        for axis in range(3):
            values = block[:, axis]
            below = np.concatenate((lowest[axis], values))
            above = np.concatenate((highest[axis], values))
            lowest[axis] = np.partition(below, suspects)[:held] if len(below) > held else below
            highest[axis] = np.partition(above, -held)[-held:] if len(above) > held else above
    return np.array([v.max() for v in lowest]), np.array([v.min() for v in highest])


def root_cube(points: Points, params: OctreeVoxelGrid) -> Root:
    """Return the root cube of `points` (n, 3), n >= 1, and the edge of a leaf under `params`."""
    return root_cube_of(lambda: (points,), len(points), params)


def root_cube_of(blocks: Blocks, count: int, params: OctreeVoxelGrid) -> Root:
    """Return the `root_cube` of a cloud that comes in blocks (see `robust_box_of`)."""
    from dougong.kernels.raster import rounded

    low, high = robust_box_of(blocks, count)
    # Rounded like what it is compared with: leaves are the same in every frame.
    edge = max(rounded(high[axis], low[axis]) for axis in range(3))
    if params.voxel_m is not None:
        return Root(low, edge, params.voxel_m)
    assert params.depth is not None
    return Root(low, edge, edge / 2**params.depth if edge > 0 else 1.0)


def octree_voxel_grid(
    points: ArrayLike,
    params: OctreeVoxelGrid | None = None,
    *,
    records: NDArray[Any] | Callable[[Index], NDArray[Any]] | None = None,
    root: Root | None = None,
) -> Selection:
    """Choose the point nearest the centre of every occupied voxel.

    O(n) but for three to six passes of a radix sort; about 50 bytes per point.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Metres, local frame. Points outside the root cube fall into voxels of the same grid.
    params : OctreeVoxelGrid
    records : ndarray, shape (n,), or callable, optional
        Structured; tells points apart that share one place. A callable returns those at `places`.
    root : Root, optional
        Of the whole cloud, where `points` are a part of it.

    Returns
    -------
    Selection
        ``voxel_count`` (n,) int32: the points in the voxel of each point.

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite, or there is not one record per point.

    Notes
    -----
    Ties: smallest (x, y, z), then smallest record bytes. Tile class: two-pass (the box first).
    """
    params = params or OctreeVoxelGrid()
    xyz = as_points(points)
    n = len(xyz)
    if isinstance(records, np.ndarray) and len(records) != n:
        raise InputError(f"records must hold one record per point, got {len(records)} for {n}.")
    if n == 0:
        return Selection(
            is_kept=np.zeros(0, bool), attributes={"voxel_count": np.zeros(0, np.int32)}
        )
    records_at = partial(chosen_rows, records) if isinstance(records, np.ndarray) else records
    chosen, counts = _nearest_to_centres(xyz, root or root_cube(xyz, params), records_at)
    is_kept = np.zeros(n, bool)
    is_kept[chosen] = True
    return Selection(is_kept=is_kept, attributes={"voxel_count": counts.astype(np.int32)})


def _nearest_to_centres(
    xyz: Points, root: Root, records_at: Callable[[Index], NDArray[Any]] | None
) -> tuple[Index, Index]:
    """Return the place of the point chosen of each voxel, and how many (n,) are in each point's."""
    from dougong.kernels import octree

    low, _, voxel_m = root
    places, run_starts = runs_of_cells(xyz, low, voxel_m)
    runs = len(run_starts) - 1
    chosen, twins = np.empty(runs, np.int64), np.empty(runs, np.int64)
    counts = np.empty(len(xyz), np.int64)

    def task(first: int, last: int) -> None:
        octree.nearest_to_centres(
            xyz, places, run_starts, low, voxel_m, first, last, chosen, twins, counts
        )

    for_blocks(runs, 1 << 16, task)
    if records_at is not None and (twins > 1).any():
        _settle_twins(xyz, records_at, places, run_starts, twins > 1, chosen)
    return chosen, counts


def cells_of(points: Points, low: NDArray[np.float64], edge_m: float) -> Points:
    """Return the cell (n, 3) of each of `points` (n, 3), counted from `low` (3,): whole numbers.

    Rounded as `kernels.cells` says, so that a border is the same in every frame.
    """
    from dougong.kernels.cells import fill_cells

    found = np.empty_like(points, order="F")
    fill_cells(points, low, edge_m, found)
    return found


def runs_of_cells(xyz: Points, low: NDArray[np.float64], voxel_m: float) -> tuple[Index, Index]:
    """Return places that sort the points by voxel, and where each voxel's run starts (and ends)."""
    from dougong.kernels import order

    n = len(xyz)
    top = float(1 << order.KEY_BITS)
    first, last = cells_of(np.stack(corners_of(xyz)), low, voxel_m)
    is_inside: Mask = np.ones(n, bool)
    if last.max() >= top or first.min() < 0:
        cells = cells_of(xyz, low, voxel_m)
        is_inside = np.asarray(((cells >= 0) & (cells < top)).all(axis=1))
    places = np.flatnonzero(is_inside)
    inside = xyz if len(places) == n else xyz[places]
    keys = np.empty(len(places), np.uint64)
    keying: Callable[[int, int], None] = lambda start, stop: order.morton_keys(  # noqa: E731
        inside, low, voxel_m, start, stop, keys
    )
    for_blocks(len(places), 1 << 18, keying)
    bits = 3 * min(order.KEY_BITS, int(np.clip(last.max(), 0, top)).bit_length())
    order.radix_argsort(keys, bits, places, np.empty_like(places), np.empty_like(keys))
    starts = np.flatnonzero(np.concatenate(([len(keys) > 0], keys[1:] != keys[:-1])))
    if len(places) == n:
        return places, np.append(starts, n)
    # Outside the curve's cells only stray points lie: sorted by their cells as they are.
    outside = np.flatnonzero(~is_inside)
    cells = cells_of(xyz[outside], low, voxel_m)
    by_cell = np.lexsort(cells.T)
    cells = cells[by_cell]
    is_start = np.concatenate(([True], (cells[1:] != cells[:-1]).any(axis=1)))
    starts = np.concatenate((starts, len(places) + np.flatnonzero(is_start), [n]))
    return np.concatenate((places, outside[by_cell])), starts


def summed_cells(cells: Points, counts: NDArray[np.int64]) -> tuple[Points, NDArray[np.int64]]:
    """Return cells (n, 3), n >= 1, each once, and the sums of their counts (n,) or (n, k)."""
    places, starts = runs_of_cells(cells, cells.min(axis=0), 1.0)
    firsts = starts[:-1]
    return cells[places[firsts]], np.add.reduceat(counts[places], firsts, axis=0)


def _settle_twins(
    xyz: Points,
    records_at: Callable[[Index], NDArray[Any]],
    places: Index,
    run_starts: Index,
    has_twins: NDArray[np.bool_],
    chosen: Index,
) -> None:
    """Among points at the chosen one's very place, choose the smallest record bytes instead."""
    run_of = np.repeat(np.arange(len(chosen)), np.diff(run_starts))
    is_same = has_twins[run_of]
    run_of, candidates = run_of[is_same], places[is_same]
    is_same = (xyz[candidates] == xyz[chosen[run_of]]).all(axis=1)
    run_of, candidates = run_of[is_same], candidates[is_same]
    held = np.ascontiguousarray(records_at(candidates))
    as_bytes = held.view(np.uint8).reshape(len(held), -1).view(f"S{held.dtype.itemsize}")[:, 0]
    _, ranks = np.unique(as_bytes, return_inverse=True)
    first = np.lexsort((candidates, ranks, run_of))
    run_of, candidates = run_of[first], candidates[first]
    is_first = np.concatenate(([True], run_of[1:] != run_of[:-1]))
    chosen[run_of[is_first]] = candidates[is_first]
