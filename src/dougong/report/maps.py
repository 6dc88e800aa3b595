"""Maps of the report: values of points on a plane, cell by cell, as small plates."""

from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import escape
from numpy.typing import NDArray

from dougong.report.drawing import View
from dougong.report.plates import plate
from dougong.typing import Points, Values

Colours = NDArray[np.uint8]
_WIDE_PX = 900
_BLUE = np.array([24.0, 84.0, 160.0])
_ORANGE = np.array([190.0, 84.0, 0.0])
_PALE = (np.array([196.0, 219.0, 240.0]), np.array([255.0, 222.0, 184.0]))
UNTOLD = (203, 203, 200)
"""Grey: a distance below its level of detection."""
_RAMP = np.array([[237, 231, 214], [222, 184, 120], [196, 128, 60], [139, 74, 34], [74, 30, 18]])
_TILES_ACROSS = 26
_AGREED = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A plane that points are projected on, cut into square cells."""

    right: Values
    """(3,) unit."""
    up: Values
    """(3,) unit."""
    low: Values
    """(2,) corner, metres along `right` and `up`."""
    cell_m: float
    columns: int
    rows: int

    @property
    def pixels(self) -> int:
        """Return how many pixels of the picture a cell is wide."""
        return max(1, round(_WIDE_PX / self.columns))

    def cells(self, points: Points) -> NDArray[np.int64]:
        """Return the cell (n,) of each point, row by row from the top; -1 outside."""
        across = np.floor((points @ self.right - self.low[0]) / self.cell_m).astype(np.int64)
        upward = np.floor((points @ self.up - self.low[1]) / self.cell_m).astype(np.int64)
        is_in = (across >= 0) & (across < self.columns) & (upward >= 0) & (upward < self.rows)
        return np.where(is_in, (self.rows - 1 - upward) * self.columns + across, -1)


def lay_sheet(points: Points, right: Values, up: Values, cell_m: float, most: int = 450) -> Sheet:
    """Return the sheet that holds `points` but for the outermost; at most `most` cells a side."""
    at = np.column_stack([points @ right, points @ up])
    low, high = np.quantile(at, [0.002, 0.998], axis=0)
    cell = max(cell_m, float((high - low).max()) / most)
    low = low - cell
    columns, rows = (int(n) + 2 for n in np.ceil((high - low) / cell))
    return Sheet(right=right, up=up, low=low, cell_m=cell, columns=columns, rows=rows)


def medians(cells: NDArray[np.int64], values: Values, count: int) -> Values:
    """Return the lower median of the values in each of `count` cells; NaN where there is none."""
    inside = (cells >= 0) & np.isfinite(values)
    cells, values = cells[inside], values[inside]
    order = np.lexsort((values, cells))
    counts = np.bincount(cells, minlength=count)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1]
    result = np.full(count, np.nan)
    filled = counts > 0
    result[filled] = values[order][starts[filled] + (counts[filled] - 1) // 2]
    return result


def signed_colours(values: Values, limit: float) -> Colours:
    """Return colours (n, 3): blue below zero, orange above, paler the nearer to it.

    The two sides differ in hue for every common colour vision and get darker alike.
    """
    share = np.clip(np.abs(np.nan_to_num(values)) / limit, 0.0, 1.0)[:, None]
    low = _PALE[0] + share * (_BLUE - _PALE[0])
    high = _PALE[1] + share * (_ORANGE - _PALE[1])
    colours = np.where(np.nan_to_num(values)[:, None] < 0.0, low, high)
    result: Colours = np.round(colours).astype(np.uint8)
    return result


def amount_colours(values: Values, limit: float) -> Colours:
    """Return colours (n, 3) from pale to dark brown over 0 .. `limit`."""
    share = np.clip(np.nan_to_num(values) / limit, 0.0, 1.0) * (len(_RAMP) - 1)
    colours = [np.interp(share, np.arange(len(_RAMP)), _RAMP[:, band]) for band in range(3)]
    return np.round(np.column_stack(colours)).astype(np.uint8)


def sheet_plate(
    sheet: Sheet, colours: Colours, is_shown: NDArray[np.bool_], label: str, over: str = ""
) -> str:
    """Return a sheet as an SVG plate: `colours` (cells, 3) where `is_shown` (cells,)."""
    image = np.zeros((sheet.rows * sheet.columns, 4), dtype=np.uint8)
    image[is_shown, :3] = colours[is_shown]
    image[is_shown, 3] = 255
    times = sheet.pixels
    picture = image.reshape(sheet.rows, sheet.columns, 4)
    picture = cv2.resize(picture, None, fx=times, fy=times, interpolation=cv2.INTER_NEAREST)
    foot = np.zeros((max(40, 130 - picture.shape[0]), picture.shape[1], 4), dtype=np.uint8)
    picture = np.concatenate([picture, foot])
    height, width = picture.shape[:2]
    view = View(
        right=sheet.right,
        up=sheet.up,
        towards=np.cross(sheet.right, sheet.up),
        centre=np.zeros(3),
        width_m=sheet.columns * sheet.cell_m,
        width_px=width,
        height_px=height,
    )
    return plate(picture, view, label, text_px=20, over=over)


def signs(sheet: Sheet, values: Values, is_told: NDArray[np.bool_]) -> str:
    """Return + and - marks as SVG where most cells of a tile are on one side: colour is not all."""
    tile = max(5, -(-sheet.columns // _TILES_ACROSS))
    times = sheet.pixels
    grid = np.where(is_told, np.sign(np.nan_to_num(values)), 0.0).reshape(sheet.rows, -1)
    seen = np.isfinite(values).reshape(sheet.rows, -1)
    marks = []
    for row in range(0, sheet.rows - tile + 1, tile):
        for column in range(0, sheet.columns - tile + 1, tile):
            here = seen[row : row + tile, column : column + tile]
            if here.sum() < 0.4 * tile * tile:
                continue
            mean = grid[row : row + tile, column : column + tile].sum() / here.sum()
            if abs(mean) >= _AGREED:
                x, y = (column + tile / 2) * times, (row + tile / 2) * times
                marks.append(
                    f'<text class="sign" x="{x:.0f}" y="{y:.0f}">{"+" if mean > 0 else "−"}</text>'
                )
    return f'<g class="signs">{"".join(marks)}</g>'


def signed_scale(limit_m: float, lod_m: float, below: str, above: str) -> str:
    """Return the key of a signed map as SVG: ticks in millimetres, and what either end means."""
    below, above = str(escape(below)), str(escape(above))
    # Rows far enough apart for the larger letters of a narrow page.
    width, height, left = 520, 94, 20
    steps = np.linspace(-limit_m, limit_m, 41)
    colours = signed_colours(steps, limit_m)
    colours[np.abs(steps) < lod_m] = UNTOLD
    wide = (width - 2 * left) / len(steps)
    boxes = "".join(
        f'<rect x="{left + i * wide:.1f}" y="26" width="{wide + 0.6:.1f}" height="16" '
        f'fill="rgb({r},{g},{b})"/>'
        for i, (r, g, b) in enumerate(colours.tolist())
    )
    ticks = "".join(
        f'<text x="{left + (0.5 + share / 2) * (width - 2 * left):.0f}" y="62" '
        f'text-anchor="middle">{1000 * share * limit_m:+.3g}</text>'
        for share in (-1.0, -0.5, 0.5, 1.0)
    )
    middle = width / 2
    return (
        f'<svg class="key" viewBox="0 0 {width} {height}" role="img" aria-label="colour key: '
        f'blue, minus, {below}; orange, plus, {above}; grey, not told">{boxes}{ticks}'
        f'<text x="{middle}" y="62" text-anchor="middle">0 mm</text>'
        f'<text x="{left}" y="18">− {below}</text>'
        f'<text x="{width - left}" y="18" text-anchor="end">+ {above}</text>'
        f'<text x="{middle}" y="86" text-anchor="middle">grey: below the level of detection</text>'
        "</svg>"
    )


def amount_scale(limit: float, unit: str) -> str:
    """Return the key of a map of amounts as SVG."""
    width, left = 520, 20
    steps = np.linspace(0.0, limit, 40)
    wide = (width - 2 * left) / len(steps)
    boxes = "".join(
        f'<rect x="{left + i * wide:.1f}" y="4" width="{wide + 0.6:.1f}" height="16" '
        f'fill="rgb({r},{g},{b})"/>'
        for i, (r, g, b) in enumerate(amount_colours(steps, limit).tolist())
    )
    return (
        f'<svg class="key" viewBox="0 0 {width} 44" role="img" aria-label="colour key: pale few, '
        f'dark many">{boxes}<text x="{left}" y="38">0</text>'
        f'<text x="{width - left}" y="38" text-anchor="end">{limit:g} {unit} or more</text></svg>'
    )


def axes_of(normal: Values) -> tuple[Values, Values]:
    """Return right and up of the picture that one who stands before a facade sees."""
    level = np.array([normal[0], normal[1], 0.0])
    level = level / max(float(np.linalg.norm(level)), 1e-12)
    up = np.array([0.0, 0.0, 1.0])
    return np.cross(up, level), up
