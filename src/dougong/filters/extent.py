"""The extent of a cloud without its isolated far points and heaps."""

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from dougong.kernels import raster
from dougong.typing import Blocks, Points, Values

_BINS = 64
_FAR_BINS = 16
_FEW_POINTS = 16
_FEW_SHARE = 1e-4
_FEW_SHARE_OF_SMALL = 0.01


def plan_box(points: Points) -> tuple[Values, Values, float]:
    """Return the box of the cloud in plan, isolated far points left out: low, high, lowest z.

    The box is cut into 64 x 64 bins, and bins less than a quarter of the box apart are one group.
    A group of at most 1 in 10,000 points (or 16, or 1 in 100, whichever of these two is less) is
    far, and so is any number at one single place, as scanners write missing returns; the box
    shrinks to the others, and again until nothing is far.
    points (n >= 1, 3), metres; low, high (2,): x and y; lowest: the smallest z inside.
    """
    return plan_box_of(lambda: (points,), len(points))


def plan_box_of(blocks: Blocks, points: int) -> tuple[Values, Values, float]:
    """Return the `plan_box` of a cloud of so many `points` that comes in blocks, in some passes."""
    everywhere = np.full(2, np.inf)
    bounds = _bounds(blocks, -everywhere, everywhere)
    while True:
        low, high = bounds[:2], bounds[2:4]
        cut = _without_far_bins(blocks, points, low, high)
        if cut is None:
            return low, high, float(bounds[4])
        before, bounds = bounds, _bounds(blocks, *cut)
        if np.array_equal(bounds, before):
            return low, high, float(bounds[4])


def _bounds(blocks: Blocks, low: Values, high: Values) -> Values:
    out = np.array([np.inf, np.inf, -np.inf, -np.inf, np.inf])
    for block in blocks():
        raster.plan_bounds(block, low, high, out)
    return out


def _without_far_bins(
    blocks: Blocks, points: int, low: Values, high: Values
) -> tuple[Values, Values] | None:
    """Return the part of a plan box without far bins; None where there are none."""
    size = float((high - low).max()) / _BINS
    if size <= 0:
        return None
    count = np.zeros((_BINS + 1, _BINS + 1), np.int64)
    for block in blocks():
        raster.plan_count(block, low, high, size, count)
    is_near = distance_transform_edt(count == 0) <= _FAR_BINS / 2
    groups, number = label(is_near, structure=np.ones((3, 3)))
    groups[count == 0] = 0
    total = np.bincount(groups.ravel(), weights=count.ravel(), minlength=number + 1)
    few = max(_FEW_SHARE * points, min(_FEW_POINTS, _FEW_SHARE_OF_SMALL * points))
    is_kept = total > few
    is_kept[0] = False
    for group in np.flatnonzero(is_kept):
        rows, columns = np.nonzero(groups == group)
        if len(rows) == 1:
            corner = low + size * np.array([columns[0], rows[0]])
            is_kept[group] = not _is_heap(blocks, corner, size)
    if is_kept[1:].all() or not is_kept.any():
        return None
    rows, columns = np.nonzero(is_kept[groups])
    cut_low = low + size * np.array([columns.min(), rows.min()])
    cut_high = low + size * np.array([columns.max() + 1, rows.max() + 1])
    return np.maximum(low, cut_low), np.minimum(high, cut_high)


def _is_heap(blocks: Blocks, corner: Values, size: float) -> bool:
    """Say whether all points in a bin that stands alone lie at one place in plan."""
    # Half a bin more on all sides: the border of a bin is rounded, and nothing else is near.
    x_low, y_low, x_high, y_high, _ = _bounds(blocks, corner - size / 2, corner + 1.5 * size)
    return bool(x_low == x_high and y_low == y_high)
