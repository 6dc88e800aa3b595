"""The cloth of the cloth simulation filter (Zhang et al. 2016), on a grid of heights.

Everything here is upside down, as in the paper: `surface` is the height of the inverted cloud
(minus z), and the cloth falls on it from above. A particle that reaches the surface lands and
stays. Particles are visited row by row and pull on their 16 neighbours in one fixed order, each
pull seeing the ones before it (Gauss-Seidel): the order of the published implementation
when it runs on one thread, which labels depend on.
"""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._arrays import Flags, Floats, Ints, Keys
from dougong.kernels._jit import kernel
from dougong.kernels.raster import rounded

FREE = 0
LANDED = 1
ABSENT = 2
"""State of a particle; ABSENT ones are the two-cell rim that spares the loops a border test."""

RIM = 2
DAMPING = 0.01
"""Share of a particle's velocity that each step takes away."""
REFRESH = 8
"""Steps after which particles that can no longer move or pull are left out of the loops."""

# (row, column) of the neighbours in the order in which they are pulled: ring 1, then ring 2.
_RING = ((-1, -1), (0, -1), (1, -1), (-1, 0), (-1, 1), (0, 1), (1, 0), (1, 1))


@kernel
def neighbour_offsets(stride: int) -> Keys:
    """Return the flat positions of the 16 neighbours, counted from the cell (-2, -2)."""
    out = np.empty(16, np.uint64)
    for reach in range(1, 3):
        for m in range(8):
            row = _RING[m][0] * reach + RIM
            column = _RING[m][1] * reach + RIM
            out[(reach - 1) * 8 + m] = np.uint64(row * stride + column)
    return out


@kernel
def _keep_active(
    active: Keys,
    count: int,
    state: NDArray[np.uint8],
    offsets: Keys,
    centre: np.uint64,
) -> int:
    """Shorten `active` to the particles that move or can pull one that does; return how many."""
    kept = 0
    for k in range(count):
        base = active[k]
        is_active = state[base + centre] == FREE
        for m in range(16):
            is_active = is_active or state[base + offsets[m]] == FREE
        if is_active:
            active[kept] = base
            kept += 1
    return kept


@kernel
def _fall(
    active: Keys,
    count: int,
    state: NDArray[np.uint8],
    centre: np.uint64,
    drop: float,
    height: Floats,
    before: Floats,
) -> None:
    """Move every free particle one Verlet step: keep (1 - DAMPING) of the velocity, fall `drop`."""
    for k in range(count):
        i = active[k] + centre
        if state[i] == FREE:
            now = height[i]
            height[i] = now + (now - before[i]) * (1.0 - DAMPING) - drop
            before[i] = now


@kernel
def _pull(
    active: Keys,
    count: int,
    state: NDArray[np.uint8],
    offsets: Keys,
    centre: np.uint64,
    single: float,
    double: float,
    height: Floats,
) -> None:
    """Let the springs act: each particle, in turn, meets its 16 neighbours, in turn.

    A pair of free particles closes `double` of its height difference from both ends; a free one
    closes `single` of it towards a landed one.
    """
    for k in range(count):
        base = active[k]
        i = base + centre
        mine = height[i]
        if state[i] == FREE:
            for m in range(16):
                j = base + offsets[m]
                other = height[j]
                if state[j] == FREE:
                    height[j] = other * (1.0 - double) + mine * double
                    mine = mine * (1.0 - double) + other * double
                elif state[j] == LANDED:
                    mine = mine * (1.0 - single) + other * single
            height[i] = mine
        else:
            for m in range(16):
                j = base + offsets[m]
                if state[j] == FREE:
                    height[j] = height[j] * (1.0 - single) + mine * single


@kernel
def _land(
    active: Keys,
    count: int,
    surface: Floats,
    centre: np.uint64,
    state: NDArray[np.uint8],
    height: Floats,
    before: Floats,
) -> float:
    """Stop the particles that are below the surface; return the largest move of this step."""
    largest = 0.0
    for k in range(count):
        i = active[k] + centre
        if state[i] == FREE:
            largest = max(largest, abs(before[i] - height[i]))
            if height[i] < surface[i]:
                height[i] = surface[i]
                state[i] = LANDED
    return largest


@kernel
def drop_cloth(
    surface: Floats,
    start: float,
    drop: float,
    single: float,
    double: float,
    iterations: int,
    smallest_move: float,
    out: Floats,
    is_landed: Flags,
) -> int:
    """Let the cloth fall on `surface` and return the number of steps made.

    surface (rows, columns): inverted heights, metres, finite; start: height of the cloth at first;
    drop: fall per step from gravity (m); single, double: shares of a height difference that
    springs close (see `_pull`); ends after `iterations`, or when no particle moves as
    much as `smallest_move`. out, is_landed (rows, columns): heights, and who rests on the surface.
    """
    rows, columns = surface.shape
    stride = columns + 2 * RIM
    state = np.full((rows + 2 * RIM) * stride, ABSENT, np.uint8)
    height = np.full(state.size, start)
    before = np.full(state.size, start)
    ground = np.full(state.size, -np.inf)
    active = np.empty(rows * columns, np.uint64)
    for row in range(rows):
        for column in range(columns):
            base = row * stride + column
            i = base + RIM * stride + RIM
            state[i] = FREE
            ground[i] = surface[row, column]
            active[row * columns + column] = np.uint64(base)
    centre = np.uint64(RIM * stride + RIM)
    offsets = neighbour_offsets(stride)
    count = active.size
    step = 0
    while step < iterations:
        step += 1
        _fall(active, count, state, centre, drop, height, before)
        _pull(active, count, state, offsets, centre, single, double, height)
        largest = _land(active, count, ground, centre, state, height, before)
        if largest < smallest_move:
            break
        if step % REFRESH == 0:
            count = _keep_active(active, count, state, offsets, centre)
    for row in range(rows):
        for column in range(columns):
            i = row * stride + column + RIM * stride + RIM
            out[row, column] = height[i]
            is_landed[row, column] = state[i] == LANDED
    return step


@kernel
def fill_empty(heights: Floats, out: Floats) -> None:
    """Fill NaN cells: from the first known cell to the right, else left, else below, else above.

    heights, out (rows, columns); "below" is towards row 0. Cells whose whole row and column are
    empty stay NaN. Values come from `heights` only, never from cells filled here.
    """
    rows, columns = heights.shape
    for row in range(rows):
        known = np.nan
        for column in range(columns):
            if not np.isnan(heights[row, column]):
                known = heights[row, column]
            out[row, column] = known
        known = np.nan
        for column in range(columns - 1, -1, -1):
            if not np.isnan(heights[row, column]):
                known = heights[row, column]
            if not np.isnan(known):
                out[row, column] = known
    # A row with any known cell is full by now; an empty one takes from its columns.
    for column in range(columns):
        known = np.nan
        for row in range(rows):
            if not np.isnan(heights[row, column]):
                known = heights[row, column]
            elif np.isnan(out[row, column]):
                out[row, column] = known
        known = np.nan
        for row in range(rows - 1, -1, -1):
            if not np.isnan(heights[row, column]):
                known = heights[row, column]
            elif np.isnan(out[row, column]):
                out[row, column] = known


@kernel
def heights_above(points: Floats, origin: Floats, cell: float, cloth: Floats, out: Floats) -> None:
    """Fill out[i] with the height of a point above the cloth, interpolated bilinearly.

    points (n, 3); origin (3,), cell: as for `nearest_heights`; cloth (rows, columns): upright
    heights above origin[2]. out (n,), metres, positive above the cloth, NaN outside the grid.
    """
    rows, columns = cloth.shape
    for i in range(points.shape[0]):
        x = rounded(points[i, 0], origin[0]) / cell
        y = rounded(points[i, 1], origin[1]) / cell
        column = int(np.floor(x))
        row = int(np.floor(y))
        if column < 0 or row < 0 or column >= columns - 1 or row >= rows - 1:
            out[i] = np.nan
            continue
        x -= column
        y -= row
        low = cloth[row, column] * (1.0 - x) + cloth[row, column + 1] * x
        high = cloth[row + 1, column] * (1.0 - x) + cloth[row + 1, column + 1] * x
        out[i] = rounded(points[i, 2], origin[2]) - (low * (1.0 - y) + high * y)


@kernel
def smooth_slopes(
    surface: Floats,
    smooth_threshold: float,
    height_threshold: float,
    smallest_patch: int,
    cloth: Floats,
    is_landed: Flags,
) -> int:
    """Lay hanging parts of the cloth down on steep slopes; return the number of particles laid.

    A hanging particle is laid on the surface when a particle beside it (4 neighbours) rests
    already, the surface between the two steps by `smooth_threshold` at most (the published filter
    asks for less, but leaves ties to rounding, and lets about half of them pass), and it hangs
    less than `height_threshold` above; this floods on through each connected hanging patch of more
    than `smallest_patch` particles. surface, cloth, is_landed (rows, columns): inverted heights;
    cloth and is_landed are changed. The order of the flood does not change what it reaches.
    """
    rows, columns = surface.shape
    is_seen = np.zeros((rows, columns), np.bool_)
    patch = np.empty(rows * columns, np.int64)
    laid = 0
    for row in range(rows):
        for column in range(columns):
            if is_landed[row, column] or is_seen[row, column]:
                continue
            size = _hanging_patch(row, column, is_landed, is_seen, patch)
            if size > smallest_patch:
                laid += _lay_patch(
                    patch, size, surface, smooth_threshold, height_threshold, cloth, is_landed
                )
    return laid


_BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


@kernel
def _hanging_patch(
    row: int,
    column: int,
    is_landed: Flags,
    is_seen: Flags,
    patch: Ints,
) -> int:
    """Fill `patch` with the flat positions of the hanging particles connected to one."""
    rows, columns = is_landed.shape
    patch[0] = row * columns + column
    is_seen[row, column] = True
    size = 1
    done = 0
    while done < size:
        for m in range(4):
            r = patch[done] // columns + _BESIDE[m][0]
            c = patch[done] % columns + _BESIDE[m][1]
            if 0 <= r < rows and 0 <= c < columns and not (is_landed[r, c] or is_seen[r, c]):
                is_seen[r, c] = True
                patch[size] = r * columns + c
                size += 1
        done += 1
    return size


@kernel
def _lay_patch(
    patch: Ints,
    size: int,
    surface: Floats,
    smooth_threshold: float,
    height_threshold: float,
    cloth: Floats,
    is_landed: Flags,
) -> int:
    """Flood one hanging patch from the particles that rest beside it; return how many were laid."""
    rows, columns = surface.shape
    queue = np.empty(size, np.int64)
    step = rounded(smooth_threshold, 0.0)
    laid = 0
    # First the rim of the patch, then (positions size...) what was laid: one loop does both.
    done = 0
    while done < size + laid:
        position = patch[done] if done < size else queue[done - size]
        row = position // columns
        column = position % columns
        is_source = done >= size
        for m in range(4):
            r = row + _BESIDE[m][0]
            c = column + _BESIDE[m][1]
            if not (0 <= r < rows and 0 <= c < columns):
                continue
            # On the rim the neighbour supports this particle; later this one supports it.
            to_row, to_column = (r, c) if is_source else (row, column)
            is_supported = is_source or is_landed[r, c]
            if (
                is_supported
                and not is_landed[to_row, to_column]
                and rounded(abs(surface[row, column] - surface[r, c]), 0.0) <= step
                and cloth[to_row, to_column] - surface[to_row, to_column] < height_threshold
            ):
                cloth[to_row, to_column] = surface[to_row, to_column]
                is_landed[to_row, to_column] = True
                queue[laid] = to_row * columns + to_column
                laid += 1
        done += 1
    return laid
