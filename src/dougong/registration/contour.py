"""Contour feature points of improved PCA: Canny edges of the plan, lifted back to 3-D."""

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dougong._sorting import distinct
from dougong.params import Parameters
from dougong.registration.cleaning import extent
from dougong.registration.levelling import rotation_to_vertical
from dougong.registration.prepare import Prepared
from dougong.typing import Index

Image = NDArray[np.float32]


class Contour(Parameters):
    """How contour feature points are found (METHOD.md 2.1, step 1)."""

    cell_spacings: Annotated[float, Field(gt=0)] = 2.5
    """Cell of the raster in median point spacings ..."""
    max_cells: Annotated[int, Field(ge=16)] = 2048
    """... or the extent divided by this, whichever is coarser."""
    close_cells: Annotated[int, Field(ge=0)] = 1
    """Holes are closed by growing and shrinking by so many cells: those up to twice as wide."""
    blur_cells: Annotated[float, Field(gt=0)] = 1.4
    """Standard deviation of the Gaussian before the gradient."""
    high_percentile: Annotated[float, Field(gt=0, lt=100)] = 90.0
    """Canny's upper threshold: this percentile of the gradient where there is one."""
    low_share: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Canny's lower threshold as a share of the upper one."""


def contour_points(cloud: Prepared, params: Contour | None = None) -> Index:
    """Return which points of `cloud` are contour feature points.

    Non-ground points are rasterised in plan with two channels, greatest height above ground and
    logarithm of the density; the stronger gradient of the two goes into Canny's edge detection
    (Canny 1986). Each edge cell gives back its highest original point: the eaves.

    Returns
    -------
    ndarray, shape (k,)
        Positions in ``cloud.xyz``, ascending. All non-ground points where there is no edge.
    """
    params = params or Contour()
    objects = np.flatnonzero(~cloud.is_ground)
    if len(objects) < 3:
        objects = np.arange(len(cloud.xyz))
    level = cloud.xyz[objects] @ rotation_to_vertical(cloud.up).T
    low, high = extent(level[:, :2])
    cell = max(params.cell_spacings * cloud.spacing_m, float((high - low).max()) / params.max_cells)
    # A rim of empty cells lets the outline itself be an edge.
    rim = int(np.ceil(3.0 * params.blur_cells)) + 1
    place = np.floor((level[:, :2] - low) / cell).astype(np.int64) + rim
    columns, rows = np.floor((high - low) / cell).astype(int) + 1 + 2 * rim
    flat = place[:, 1] * columns + place[:, 0]
    height = np.maximum(cloud.height_above_ground[objects], 0.0)
    highest = _highest(flat, height, level, int(rows * columns))
    edges = _edges(flat, height, (int(rows), int(columns)), params)
    lifted = _lift(edges, highest, height)
    found: Index = objects if len(lifted) < 3 else np.sort(objects[lifted])
    return found


def _highest(
    flat: Index, height: NDArray[np.float64], level: NDArray[np.float64], size: int
) -> Index:
    """Return the highest point of each cell (size,), -1 where empty; ties by place."""
    order = np.lexsort((level[:, 1], level[:, 0], height))
    highest = np.full(size, -1, dtype=np.int64)
    highest[flat[order]] = order
    return highest


def _edges(
    flat: Index, height: NDArray[np.float64], shape: tuple[int, int], params: Contour
) -> NDArray[np.bool_]:
    """Return the edge cells of the two-channel raster."""
    size = shape[0] * shape[1]
    tallest = np.zeros(size)
    np.maximum.at(tallest, flat, height)
    density = np.log1p(np.bincount(flat, minlength=size))
    strongest = np.zeros(shape, dtype=np.float32)
    dx, dy = strongest.copy(), strongest.copy()
    for channel in (tallest, density):
        across, down = _gradient(channel.reshape(shape).astype(np.float32), params)
        strength = np.hypot(across, down)
        is_stronger = strength > strongest
        dx = np.where(is_stronger, across, dx)
        dy = np.where(is_stronger, down, dy)
        strongest = np.maximum(strongest, strength)
    peak = float(strongest.max())
    if peak <= 0.0:
        return np.zeros(shape, dtype=bool)
    unit = 16000.0 / peak
    upper = unit * float(np.percentile(strongest[strongest > 1e-3 * peak], params.high_percentile))
    edges = cv2.Canny(
        np.rint(dx * unit).astype(np.int16),
        np.rint(dy * unit).astype(np.int16),
        params.low_share * upper,
        upper,
        L2gradient=True,
    )
    is_edge: NDArray[np.bool_] = edges > 0
    return is_edge


def _gradient(channel: Image, params: Contour) -> tuple[Image, Image]:
    """Return the gradient of a channel scaled to 0..1, holes closed and blurred."""
    filled = channel[channel > 0]
    if len(filled):
        channel = np.minimum(channel / np.percentile(filled, 99.0), 1.0).astype(np.float32)
    if params.close_cells > 0:
        width = 2 * params.close_cells + 1
        closed = cv2.morphologyEx(channel, cv2.MORPH_CLOSE, np.ones((width, width), np.uint8))
        channel = np.where(channel > 0, channel, closed)
    blurred = cv2.GaussianBlur(channel, (0, 0), params.blur_cells)
    return cv2.Sobel(blurred, cv2.CV_32F, 1, 0), cv2.Sobel(blurred, cv2.CV_32F, 0, 1)


def _lift(edges: NDArray[np.bool_], highest: Index, height: NDArray[np.float64]) -> Index:
    """Return the highest point at each edge cell, or beside it where the cell is empty."""
    rows, columns = edges.shape
    row, column = np.nonzero(edges)
    best = highest[row * columns + column]
    is_empty = best < 0
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            r = np.clip(row + down, 0, rows - 1)
            c = np.clip(column + across, 0, columns - 1)
            other = highest[r * columns + c]
            is_higher = is_empty & (other >= 0)
            is_higher &= (best < 0) | (height[other] > height[best])
            best = np.where(is_higher, other, best)
    return distinct(best[best >= 0])
