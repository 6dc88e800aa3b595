"""A small point renderer: nearest point per pixel, depth shading, no GPU and no window.

Pictures are drawn at twice their size and shrunk, on a transparent ground, so that they sit on
a light page and on a dark one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dougong.typing import Points, Values

Image = NDArray[np.uint8]
"""(height, width, 4) red, green, blue, alpha."""

_SUPERSAMPLE = 2
_MAX_SPLAT = 9
_CELL = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A parallel projection: picture axes in the world, and the window that is shown."""

    right: Values
    """(3,) unit; points to the right of the picture."""
    up: Values
    """(3,) unit; points to its top."""
    towards: Values
    """(3,) unit; points to the viewer."""
    centre: Values
    """(3,) metres; the middle of the picture."""
    width_m: float
    width_px: int = 1100
    height_px: int = 720

    @property
    def pixel_m(self) -> float:
        """Edge of a pixel, metres."""
        return self.width_m / self.width_px

    def project(self, points: Points, scale: int = 1) -> tuple[Values, Values, Values]:
        """Return column, row (pixels at `scale`) and depth (metres, larger is farther)."""
        relative = points - self.centre
        per_metre = scale / self.pixel_m
        column = relative @ self.right * per_metre + scale * self.width_px / 2
        row = scale * self.height_px / 2 - relative @ self.up * per_metre
        return column, row, -(relative @ self.towards)


def oblique_view(
    low: Values, high: Values, azimuth_deg: float, elevation_deg: float, width: int, height: int
) -> View:
    """Return a view of the box `low`..`high` from above one of its corners."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.cross(towards, right)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    across, along = corners @ right, corners @ up
    width_m = 1.04 * max(np.ptp(across), np.ptp(along) * width / height)
    middle = (
        (across.max() + across.min()) / 2 * right
        + (along.max() + along.min()) / 2 * up
        + (low + high) / 2 @ towards * towards
    )
    return View(
        right=right,
        up=up,
        towards=towards,
        centre=middle,
        width_m=float(width_m),
        width_px=width,
        height_px=height,
    )


def draw_surface(points: Points, colours: NDArray[np.uint8], view: View) -> Image:
    """Draw points as a shaded surface: the nearest wins, depth steps darken (eye-dome lighting).

    Parameters
    ----------
    points : ndarray, shape (n, 3)
    colours : ndarray, shape (n, 3), uint8
    view : View
    """
    width, height = view.width_px * _SUPERSAMPLE, view.height_px * _SUPERSAMPLE
    column, row, depth = view.project(points, _SUPERSAMPLE)
    margin = _MAX_SPLAT
    is_near = (column > -margin) & (column < width + margin) & (row > -margin)
    is_near &= row < height + margin
    chosen = np.flatnonzero(is_near)
    rows, columns = row[chosen].astype(np.int64), column[chosen].astype(np.int64)
    depth_of = depth[chosen].astype(np.float32)
    nearest = np.full((height, width), -1, dtype=np.int64)
    depths = np.full((height, width), np.inf, dtype=np.float32)
    sizes = _splats(rows, columns, width, height)
    for size in np.unique(sizes):
        members = np.flatnonzero(sizes == size)
        # Far points first, so that near ones are written over them.
        members = members[np.argsort(-depth_of[members], kind="stable")]
        _splat(members, rows, columns, depth_of, int(size), nearest, depths)
    is_seen = nearest >= 0
    image = np.zeros((height, width, 4), dtype=np.float32)
    image[is_seen, :3] = colours[chosen[nearest[is_seen]]]
    image[..., 3] = 255.0 * is_seen
    image[..., :3] *= _eye_dome(depths, view.pixel_m / _SUPERSAMPLE)[..., None]
    return _shrunk(image)


def _splats(
    rows: NDArray[np.int64], columns: NDArray[np.int64], width: int, height: int
) -> NDArray[np.int64]:
    """Return the square each point covers, pixels: about the spacing of points around it."""
    across, down = width // _CELL + 3, height // _CELL + 3
    cells = (rows // _CELL + 1) * across + columns // _CELL + 1
    counts = np.bincount(cells, minlength=across * down).astype(np.float32)
    around = cv2.blur(counts.reshape(down, across), (3, 3)).ravel()
    spacing = _CELL / np.sqrt(np.maximum(around[cells], 1e-3))
    sizes: NDArray[np.int64] = np.clip(np.ceil(2.1 * spacing), 3, _MAX_SPLAT).astype(np.int64)
    # A lone point stays a dot: it is no surface.
    sizes[around[cells] < _CELL**2 / (3.0 * _MAX_SPLAT**2)] = 2
    return sizes


def _splat(
    members: NDArray[np.int64],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    depth: NDArray[np.float32],
    size: int,
    nearest: NDArray[np.int64],
    depths: NDArray[np.float32],
) -> None:
    """Write points of one splat size, far to near, into the buffers where they are nearest."""
    height, width = nearest.shape
    layer = np.full(nearest.size, -1, dtype=np.int64)
    reach = np.arange(size) - size // 2
    shift_row, shift_column = (shift.ravel() for shift in np.meshgrid(reach, reach))
    is_disc = np.hypot(shift_row + 0.5 * (1 - size % 2), shift_column + 0.5 * (1 - size % 2))
    shift_row, shift_column = (s[is_disc <= size / 2 + 0.1] for s in (shift_row, shift_column))
    down = rows[members][:, None] + shift_row
    across = columns[members][:, None] + shift_column
    is_inside = (down >= 0) & (down < height) & (across >= 0) & (across < width)
    layer[(down * width + across)[is_inside]] = np.broadcast_to(members[:, None], down.shape)[
        is_inside
    ]
    found = layer.reshape(height, width)
    is_nearer = found >= 0
    is_nearer[is_nearer] = depth[found[is_nearer]] < depths[is_nearer]
    nearest[is_nearer] = found[is_nearer]
    depths[is_nearer] = depth[found[is_nearer]]


def _eye_dome(depth: NDArray[np.float32], pixel_m: float) -> NDArray[np.float32]:
    """Return 0..1 per pixel: darker the more its neighbours lie in front of it.

    Boucheny 2009, with neighbours at 1, 3 and 8 pixels.
    """
    hidden = np.zeros_like(depth)
    padded = np.pad(depth, 8, constant_values=np.inf)
    here = np.where(np.isfinite(depth), depth, -np.inf)
    height, width = depth.shape
    for distance, weight in ((1, 0.9), (3, 0.5), (8, 0.3)):
        step_m = 6 * distance * pixel_m
        for down, across in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            top, left = 8 + down * distance, 8 + across * distance
            there = padded[top : top + height, left : left + width]
            # Where either pixel is empty the difference is -inf, which clips to nothing.
            hidden += weight * np.clip((here - there) / step_m - 0.15, 0.0, 1.0)
    shade: NDArray[np.float32] = np.exp(-0.3 * hidden)
    return shade


def draw_dots(layers: list[tuple[Points, tuple[int, int, int]]], view: View, dot: int = 3) -> Image:
    """Draw layers of points as see-through dots: where two layers meet, both are seen.

    Parameters
    ----------
    layers : list of (points (n, 3), colour)
    view : View
    dot : int
        Diameter of a dot, pixels.
    """
    width, height = view.width_px * _SUPERSAMPLE, view.height_px * _SUPERSAMPLE
    size = dot * _SUPERSAMPLE
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(np.float32)
    total = np.zeros((height, width), dtype=np.float32)
    image = np.zeros((height, width, 4), dtype=np.float32)
    for points, colour in layers:
        column, row, _ = view.project(points, _SUPERSAMPLE)
        is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixels = row[is_inside].astype(np.int64) * width + column[is_inside].astype(np.int64)
        counts = np.bincount(pixels, minlength=width * height).reshape(height, width)
        spread = cv2.filter2D(np.minimum(counts, 8).astype(np.float32), -1, disc)
        cover = 1.0 - np.exp(-1.6 * spread)
        image[..., :3] += cover[..., None] * np.array(colour, dtype=np.float32)
        total += cover
    image[..., :3] /= np.maximum(total, 1e-6)[..., None]
    image[..., 3] = 255 * np.minimum(total, 1.0)
    return _shrunk(image)


def _shrunk(image: NDArray[np.float32]) -> Image:
    """Return the picture at its final size; colours weighted by alpha so that edges stay clean."""
    image[..., :3] *= image[..., 3:] / 255.0
    size = (image.shape[1] // _SUPERSAMPLE, image.shape[0] // _SUPERSAMPLE)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    small[..., :3] *= 255.0 / np.maximum(small[..., 3:], 1.0)
    result: Image = np.clip(np.round(small), 0, 255).astype(np.uint8)
    return result


def height_colours(heights: Values) -> NDArray[np.uint8]:
    """Return viridis-like colours (n, 3) over the 1-99 % range of `heights` (n,)."""
    low, high = np.percentile(heights, [1, 99]) if len(heights) else (0.0, 1.0)
    share = np.clip((heights - low) / max(high - low, 1e-9), 0.0, 1.0)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
    colours: NDArray[np.uint8] = table[:, 0, ::-1][(share * 255).astype(np.uint8)]
    return colours


def png(image: Image) -> bytes:
    """Return the picture as a PNG file."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA))
    assert done
    encoded: bytes = data.tobytes()
    return encoded
