"""Points below the ground: the guard before the cloth, which rests on the lowest points.

Single stray points and small clusters (multipath under floors and water) lie below a surface that
neighbouring cells agree on; courtyards, moats, ditches and terraces are surfaces of their own.
"""

from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import maximum_filter, minimum_filter

from dougong._checks import as_points
from dougong._words import of_all
from dougong.errors import InputError
from dougong.filters.extent import plan_box_of
from dougong.filters.ranks import median
from dougong.filters.selection import Selection
from dougong.kernels import low_outliers as kernels
from dougong.kernels import raster
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Blocks, Index, Mask, Points, Values

KIND: Literal["local", "two-pass", "global"] = "two-pass"

_BLOCK = 1 << 18
_MAX_CELLS = 20_000_000
_MAX_LEVELS = 1 << 36
"""A stray may lie anywhere: with this many levels keys fit int64, and heights keep a micrometre."""
_SMALLEST_CELL_M = 0.25
_LARGEST_CELL_M = 16.0
_POINTS_PER_CELL = 4
_LINK_SLOPE = 0.5


class LowOutliers(Parameters):
    """What counts as a level of the ground, and what lies impossibly below it."""

    min_depth_m: Annotated[float, Field(gt=0)] = 0.3
    """Points less than this below the ground are left to the cloth's own threshold, metres."""
    smallest_level_m2: Annotated[float, Field(gt=0)] = 4.0
    """A connected surface that shows at least this area in plan, or from the side as walls do, is
    real, however deep it lies. Pits that are smaller and joined to nothing (a manhole seen from
    above) are taken for multipath."""
    min_points: Annotated[int, Field(ge=1)] = 3
    """A surface has at least this many points in the 3 x 3 x 3 voxels round each of its points."""
    min_share: Annotated[float, Field(ge=0, lt=1)] = 0.02
    """... and at least this share of the densest surface above or below it: the outliers under a
    dense cloud are many, but never as dense as it."""
    ground_window_m: Annotated[float, Field(gt=0)] = 20.0
    """Canopies and roofs narrower than this are never taken for the ground, metres."""
    cell_m: Annotated[float, Field(gt=0)] | None = None
    """Plan size of a voxel, metres. None: the smallest of 0.25, 0.35, 0.5 ... 16 m at
    which half of the occupied cells hold 4 points or more."""


class _Columns(NamedTuple):
    """The voxels of a cloud, column by column (see kernels.low_outliers)."""

    unique: Index
    """(m,) occupied voxels, ascending."""
    counts: Index
    """(m,) points in each."""
    starts: Index
    """(rows * columns + 1,) where the run of each column begins in `unique`."""
    shape: tuple[int, int, int]
    cell: float
    level: float
    origin: Values
    """(3,) low corner of voxel 0."""


class Levels(NamedTuple):
    """What the whole cloud says about its ground: enough to judge any part of it."""

    unique: Index
    """(m,) occupied voxels, ascending."""
    starts: Index
    """(rows * columns + 1,) where the run of each column begins in `unique`."""
    is_level: NDArray[np.bool_]
    """(m,) over the voxels: True in a surface large enough to be real."""
    floor: Values
    """(rows * columns,) z below which a point of no level is low; NaN: unknown."""
    shape: Index
    """(3,) rows, columns, levels."""
    cell: float
    level: float
    origin: Values
    """(3,) low corner of voxel 0."""


def halo_m(params: LowOutliers) -> float:
    """Return the ground window: the level of the ground is looked for inside it."""
    return params.ground_window_m


def low_outliers(points: Points, params: LowOutliers | None = None) -> Selection:
    """Find the points below the ground that no surface explains.

    The cloud is counted in voxels. A voxel with enough points round it is part of a surface;
    surfaces large enough are levels. The ground is the lowest level of each column, opened
    (minimum, then maximum over `ground_window_m`) so that canopies and roofs do not count while
    slopes and pits stay. A point of no level, `min_depth_m` or more below the ground of its own
    and the eight columns round it, is a low outlier. Cost: one sort of the points.

    Parameters
    ----------
    points
        (n, 3), metres, z up, in a local frame.
    params
        See `LowOutliers`.

    Returns
    -------
    Selection
        ``is_kept`` is False for low outliers. Points far outside in plan are never low outliers.

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite, or the cloud would need too many cells of `cell_m`.
    """
    params = params or LowOutliers()
    points = as_points(points)
    is_low = np.zeros(len(points), np.bool_)
    if len(points):
        is_low = is_low_outlier(points, find_levels(lambda: (points,), len(points), params))
    return Selection(is_kept=~is_low, notes=low_notes(int(is_low.sum()), len(points)))


def low_notes(low: int, points: int) -> tuple[str, ...]:
    """Return what is to be said where `low` of all `points` are low outliers."""
    return (f"{of_all(low, points, 'lies', 'lie')} below the ground",) if low else ()


def find_levels(blocks: Blocks, points: int, params: LowOutliers) -> Levels:
    """Return the levels of a cloud of so many `points` (>= 1) that comes in blocks.

    Some passes over the blocks; about 40 bytes per occupied voxel.
    """
    columns = _columns(blocks, points, params)
    is_level = _levels(columns, params)
    return Levels(
        unique=columns.unique,
        starts=columns.starts,
        is_level=is_level,
        floor=_ground(columns, is_level, params) - params.min_depth_m,
        shape=np.array(columns.shape),
        cell=columns.cell,
        level=columns.level,
        origin=columns.origin,
    )


def is_low_outlier(points: Points, levels: Levels) -> Mask:
    """Say which of some `points` (n, 3) of the cloud are low outliers."""
    rows, columns, heights = levels.shape.tolist()
    is_low = np.zeros(len(points), np.bool_)

    def block(start: int, stop: int) -> None:
        keys = np.empty(stop - start, np.int64)
        part = points[start:stop]
        shape = (rows, columns, heights)
        kernels.voxel_keys(part, levels.origin, levels.cell, levels.level, shape, keys)
        kernels.mark_low(
            part,
            keys,
            levels.unique,
            levels.starts,
            heights,
            levels.is_level,
            levels.floor,
            is_low[start:stop],
        )

    for_blocks(len(points), _BLOCK, block)
    return is_low


def _columns(blocks: Blocks, points: int, params: LowOutliers) -> _Columns:
    low, high, lowest = plan_box_of(blocks, points)
    cell = params.cell_m or _cell_for(blocks, low, high)
    level = max(params.min_depth_m / 2, cell / 4)
    rows, columns = _plan_shape(low, high, cell)
    highest = max(float(block[:, 2].max()) for block in blocks() if len(block))
    if highest - lowest > _MAX_LEVELS * level:
        # Half of the levels below the middle: what lies lower is in the lowest.
        middle = median(lambda: (block[:, 2] for block in blocks()))
        lowest = max(lowest, middle - _MAX_LEVELS / 2 * level)
    levels = int(min((highest - lowest) / level, _MAX_LEVELS)) + 2
    shape = (rows, columns, levels)
    origin = np.append(low, lowest)
    unique, counts = np.empty(0, np.int64), np.empty(0, np.int64)
    for block in blocks():
        found = _occupied(block, origin, cell, level, shape)
        unique, counts = _added(unique, counts, *found) if len(unique) else found
    starts = np.empty(rows * columns + 1, np.int64)
    kernels.column_starts(unique, levels, starts)
    return _Columns(unique, counts, starts, shape, cell, level, origin)


def _occupied(
    points: Points, origin: Values, cell: float, level: float, shape: tuple[int, int, int]
) -> tuple[Index, Index]:
    """Return the voxels, ascending, in which `points` lie, and how many in each."""
    keys = np.empty(len(points), np.int64)

    def block(start: int, stop: int) -> None:
        kernels.voxel_keys(points[start:stop], origin, cell, level, shape, keys[start:stop])

    for_blocks(len(points), _BLOCK, block)
    unique, count = np.empty((2, len(points)), np.int64)
    number = kernels.runs(np.sort(keys), unique, count)
    return unique[:number].copy(), count[:number].copy()


def _added(keys: Index, counts: Index, more: Index, more_counts: Index) -> tuple[Index, Index]:
    """Return the union of two sorted sets of voxels, with their counts added."""
    unique, place = np.unique(np.concatenate([keys, more]), return_inverse=True)
    total = np.zeros(len(unique), np.int64)
    total[place[: len(keys)]] = counts
    total[place[len(keys) :]] += more_counts
    return unique, total


def _plan_shape(low: Values, high: Values, cell: float) -> tuple[int, int]:
    columns, rows = np.floor((high - low) / cell) + 1
    if rows * columns > _MAX_CELLS:
        msg = (
            f"low_outliers would need {rows * columns:.3g} cells of {cell:g} m; at most "
            f"{_MAX_CELLS:.3g} are possible. Set cell_m to a larger value, or crop the cloud."
        )
        raise InputError(msg)
    return int(rows), int(columns)


def _cell_for(blocks: Blocks, low: Values, high: Values) -> float:
    """Return the smallest cell at which half of the occupied ones hold 4 points or more."""
    cell = _SMALLEST_CELL_M
    while True:
        columns, rows = np.floor((high - low) / cell) + 1
        if rows * columns <= _MAX_CELLS:
            count = np.zeros((int(rows), int(columns)), np.int64)
            for block in blocks():
                raster.plan_count(block, low, high, cell, count)
            is_enough = float(np.median(count[count > 0])) >= _POINTS_PER_CELL
            if is_enough or cell >= _LARGEST_CELL_M:
                return cell
        cell *= np.sqrt(2.0)


def _levels(columns: _Columns, params: LowOutliers) -> NDArray[np.bool_]:
    """Return, per voxel, whether it belongs to a surface that is large enough to be real."""
    number = len(columns.unique)
    support = np.empty(number, np.int64)

    def block(start: int, stop: int) -> None:
        kernels.count_support(
            columns.unique, columns.counts, columns.starts, columns.shape, start, stop, support
        )

    for_blocks(number, _BLOCK, block)
    is_strong = np.empty(number, np.bool_)
    kernels.mark_strong(support, columns.starts, params.min_points, params.min_share, is_strong)
    parent = np.empty(number, np.int64)
    reach = 1 + int(np.ceil(_LINK_SLOPE * columns.cell / columns.level))
    kernels.link_surfaces(columns.unique, columns.starts, is_strong, columns.shape, reach, parent)
    smallest = int(np.ceil(params.smallest_level_m2 / columns.cell**2))
    is_level = np.empty(number, np.bool_)
    kernels.mark_levels(columns.unique, columns.shape[2], is_strong, parent, smallest, is_level)
    return is_level | _are_upright(columns, is_strong & ~is_level, parent, params)


def _are_upright(
    columns: _Columns, asked: NDArray[np.bool_], parent: Index, params: LowOutliers
) -> NDArray[np.bool_]:
    """Return which of the `asked` voxels belong to a surface that is large seen from a side.

    The wall of a moat, the back of a vault below a terrace: they have next to no area in plan.
    """
    least = int(np.ceil(params.smallest_level_m2 / (columns.cell * columns.level)))
    voxels = np.flatnonzero(asked)
    surfaces, of, held = np.unique(parent[voxels], return_inverse=True, return_counts=True)
    # Of fewer voxels no side is large enough: hardly any surface is left.
    is_many = held[of] >= least
    voxels, of = voxels[is_many], of[is_many]
    plan, height = np.divmod(columns.unique[voxels], columns.shape[2])
    is_large = np.zeros(len(surfaces), np.bool_)
    for along in np.divmod(plan, columns.shape[1]):
        seen = np.unique(np.column_stack([of, along, height]), axis=0)
        is_large |= np.bincount(seen[:, 0], minlength=len(surfaces)) >= least
    found = np.zeros(len(asked), np.bool_)
    found[voxels[is_large[of]]] = True
    return found


def _ground(columns: _Columns, is_level: NDArray[np.bool_], params: LowOutliers) -> Values:
    """Return the lower side of the ground per column (rows * columns,), z; NaN: unknown."""
    rows, plan_columns, levels = columns.shape
    lowest = np.full(rows * plan_columns, np.inf)
    voxels = columns.unique[is_level]
    np.minimum.at(lowest, voxels // levels, voxels % levels * columns.level + columns.origin[2])
    size = 2 * int(np.ceil(params.ground_window_m / 2 / columns.cell)) + 1
    grid = minimum_filter(lowest.reshape(rows, plan_columns), size, mode="constant", cval=np.inf)
    grid[np.isinf(grid)] = -np.inf
    grid = maximum_filter(grid, size, mode="constant", cval=-np.inf)
    grid[np.isinf(grid)] = np.inf
    # A wall seen from the air drops inside one cell: the lower side of a step counts for both.
    grid = minimum_filter(grid, 3, mode="constant", cval=np.inf)
    grid[np.isinf(grid)] = np.nan
    return np.ascontiguousarray(grid.reshape(-1))
