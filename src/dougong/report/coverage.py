"""Who saw what, how densely, and where to go back: walls, and holes in plan."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from dougong.filters import neighbourhood
from dougong.report.figures import Figure, Place
from dougong.report.layers import Layer, near
from dougong.report.maps import Sheet, axes_of, lay_sheet, sheet_plate
from dougong.typing import Index, Mask, Points, Values

_SAMPLE = 250_000
_NEIGHBOURS = 16
_CELL_M = 0.5
_LEAST_POINTS = 3
_WALL = 0.5
_PLACES = 5
_FEWEST = 20
_LEAST_PLACE_M2 = 1.0
SCALES = (20, 50, 100, 200)
_PAPER_MM = 0.1
BOTH, SCAN, DRONE = 0, 1, 2
_COLOURS = np.array([[120, 130, 138], [230, 125, 30], [45, 125, 195]], dtype=np.uint8)
"""Grey both, orange scan only, blue drone only, as the clouds usually are; what the drone alone saw
has crosses too, so that colour is not all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """What is said and drawn of who saw the building."""

    words: tuple[str, ...]
    scales: tuple[tuple[str, str, str], ...]
    """Drawing scale, spacing it needs, share of the scanned wall that has it."""
    places: tuple[str, ...]
    """Where to go back and scan, in words; the largest first."""
    maps: tuple[Figure, ...]
    legend: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Walls:
    """Half-metre voxels of wall: where they are, who saw them, how far apart its points lie."""

    middle: Points
    normals: Points
    seen: Index
    area: Values
    """Square metres."""
    spacing: Values
    """Of the scan's points, metres; infinite where it has none."""


def coverage(layers: list[Layer], result: Mapping[str, Any], place: Place) -> Coverage | None:
    """Return who saw the building, from the clouds whose pose is sure; None for one sensor."""
    kinds = {cloud["name"]: (cloud["kind"], cloud["points_out"]) for cloud in result["clouds"]}
    sure = [layer for layer in layers if layer.is_sure and layer.name in kinds]
    heights = np.array([place.floor - 1.0, place.top + 1.0])
    shown = near(sure, place.centre, 1.3 * place.radius, heights)
    groups: list[list[tuple[Points, float]]] = [[], []]
    for whole, layer in zip(sure, shown, strict=True):
        kind, points = kinds[layer.name]
        times = points / max(len(whole.after), 1)
        groups[0 if kind == "lidar" else 1].append((layer.after, times))
    if any(sum(len(xyz) for xyz, _ in group) < 100 for group in groups):
        return None
    walls = _walls(groups)
    if walls is None:
        return None
    totals = [float(walls.area[walls.seen == kind].sum()) for kind in (BOTH, SCAN, DRONE)]
    hole = _holes(groups)
    words = (
        f"Of about {sum(totals):,.0f} m² of wall, both sensors saw {totals[BOTH]:,.0f} m², only "
        f"the scanner {totals[SCAN]:,.0f} m², only the drone {totals[DRONE]:,.0f} m² (cells of "
        f"{100 * _CELL_M:.0f} cm with at least {_LEAST_POINTS} points; walls are steeper than "
        "60 deg).",
        f"Seen from above, {hole:,.0f} m² inside the outline hold no point of either."
        if hole >= 1.0
        else "Seen from above, no hole of a square metre lies inside the outline.",
    )
    return Coverage(
        words=words,
        scales=_scales(walls),
        places=_places(walls, layers),
        maps=_maps(walls),
        legend=tuple(
            (name, "rgb({}, {}, {})".format(*colour))
            for name, colour in zip(
                ("both sensors", "only the scanner", "only the drone: go back and scan here"),
                _COLOURS.tolist(),
                strict=True,
            )
        ),
    )


def _walls(groups: list[list[tuple[Points, float]]]) -> _Walls | None:
    """Return the wall voxels of both sensors."""
    every = np.concatenate([xyz for group in groups for xyz, _ in group])
    low = every.min(axis=0) - _CELL_M
    size = np.ceil((every.max(axis=0) - low) / _CELL_M).astype(np.int64) + 2
    strides = np.array([size[1] * size[2], size[2], 1], dtype=np.int64)

    def keys(points: Points) -> Index:
        cells = np.floor((points - low) / _CELL_M).astype(np.int64)
        return np.asarray(cells @ strides)

    voxels, normals = _upright(every[:: max(1, len(every) // _SAMPLE)], keys)
    if len(voxels) < _FEWEST:
        return None
    counts = [np.zeros(len(voxels)), np.zeros(len(voxels))]
    for side, group in enumerate(groups):
        for xyz, times in group:
            place, hit = _find(voxels, keys(xyz))
            counts[side] += times * np.bincount(place[hit], minlength=len(voxels))
    scan, drone = (count >= _LEAST_POINTS for count in counts)
    stays = scan | drone
    cells = np.column_stack(np.unravel_index(voxels, tuple(size)))
    with np.errstate(divide="ignore"):
        spacing = np.sqrt(_CELL_M**2 / counts[0])
    return _Walls(
        middle=(low + (cells + 0.5) * _CELL_M)[stays],
        normals=normals[stays],
        seen=np.where(scan & drone, BOTH, np.where(scan, SCAN, DRONE))[stays],
        area=_areas(voxels[stays], normals[stays], strides),
        spacing=np.where(scan, spacing, np.inf)[stays],
    )


def _find(voxels: Index, asked: Index) -> tuple[Index, Mask]:
    """Return the place of each asked key among sorted `voxels`, and whether it is there."""
    place = np.minimum(np.searchsorted(voxels, asked), len(voxels) - 1)
    return place.astype(np.int64), voxels[place] == asked


def _upright(sample: Points, keys: Callable[[Points], Index]) -> tuple[Index, Points]:
    """Return the sorted keys of voxels that hold mostly wall, and their mean normals."""
    surface = neighbourhood.normals(sample, _NEIGHBOURS, 2.0 * _CELL_M)
    is_wall = (np.abs(surface.normals[:, 2]) < _WALL) & (surface.variation < 0.05)
    key = keys(sample)
    known, at, asked = np.unique(key, return_inverse=True, return_counts=True)
    voxels = known[np.bincount(at.reshape(-1), is_wall, len(known)) / asked > 0.5]
    normals = np.zeros((len(voxels), 3))
    if len(voxels):
        place, hit = _find(voxels, key)
        member = is_wall & hit
        np.add.at(normals, place[member], surface.normals[member])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return voxels, normals


def _areas(voxels: Index, normals: Points, strides: Index) -> Values:
    """Return the wall in each voxel, square metres: one that lies in two rows counts once."""
    level = np.abs(normals[:, :2])
    stride = strides[np.argmax(level, axis=1)]
    rows = 1.0 + sum(_find(voxels, voxels + side * stride)[1] for side in (-1, 1))
    lean = np.maximum(level.max(axis=1), 0.5)
    return np.asarray(_CELL_M**2 / (rows * lean))


def _scales(walls: _Walls) -> tuple[tuple[str, str, str], ...]:
    """Return what share of the walls the scan holds densely enough for each drawing scale."""
    return tuple(
        (
            f"1:{scale}",
            f"{scale * _PAPER_MM:g} mm",
            f"{100 * _share(walls, walls.spacing <= scale * _PAPER_MM / 1000.0):.0f} %",
        )
        for scale in SCALES
    )


def _share(walls: _Walls, chosen: Mask) -> float:
    return float(walls.area[chosen].sum() / max(float(walls.area.sum()), 1e-12))


def _places(walls: _Walls, layers: list[Layer]) -> tuple[str, ...]:
    """Return the largest stretches of wall that only the drone saw, in words."""
    lonely = walls.middle[walls.seen == DRONE]
    origin = next((layer.origin for layer in layers if layer.origin is not None), np.zeros(3))
    if not len(lonely):
        return ()
    cells = np.floor((lonely - lonely.min(axis=0)) / _CELL_M + 0.5).astype(np.int64)
    grid = np.zeros(tuple(cells.max(axis=0) + 1), dtype=bool)
    grid[tuple(cells.T)] = True
    label, count = ndimage.label(grid, np.ones((3, 3, 3)))
    own = label[tuple(cells.T)]
    sizes = np.bincount(own, walls.area[walls.seen == DRONE], minlength=count + 1)
    floor = float(np.quantile(walls.middle[:, 2], 0.02))
    words = []
    for number in np.argsort(-sizes, kind="stable")[:_PLACES]:
        if number == 0 or sizes[number] < _LEAST_PLACE_M2:
            continue
        points = lonely[own == number]
        middle = np.median(points, axis=0) + origin
        low, high = points[:, 2].min() - floor, points[:, 2].max() - floor
        words.append(
            f"{sizes[number]:.0f} m² around x {middle[0]:.1f}, y {middle[1]:.1f}, "
            f"{max(low, 0.0):.1f} to {high + _CELL_M / 2:.1f} m above the lowest wall"
        )
    return tuple(words)


def _maps(walls: _Walls) -> tuple[Figure, ...]:
    """Return the walls from the four sides of the building's own directions that show most."""
    turn = np.arctan2(walls.normals[:, 1], walls.normals[:, 0])
    main = 0.25 * np.angle(np.exp(4j * turn).sum())
    figures = []
    for quarter in range(2):
        direction = main + quarter * np.pi / 2.0
        normal = np.array([np.cos(direction), np.sin(direction), 0.0])
        along = walls.normals @ normal
        facing = np.abs(along) >= np.cos(np.pi / 4.0)
        middle = float(np.median(walls.middle[facing] @ normal)) if facing.any() else 0.0
        for side in (1.0, -1.0):
            # Without signed normals the half of the building that is nearer is its front.
            front = facing & (side * (walls.middle @ normal - middle) >= 0.0)
            if front.sum() >= 20:
                figures.append(_map(walls, front, side * normal))
    return tuple(figures)


def _map(walls: _Walls, chosen: Mask, normal: Values) -> Figure:
    sheet = lay_sheet(walls.middle[chosen], *axes_of(normal), _CELL_M)
    cells = sheet.cells(walls.middle[chosen])
    order = np.argsort(walls.middle[chosen] @ normal, kind="stable")
    seen = np.full(sheet.rows * sheet.columns, -1, dtype=np.int64)
    inside = cells[order] >= 0
    seen[cells[order][inside]] = walls.seen[chosen][order][inside]
    colours = _COLOURS[np.maximum(seen, 0)]
    bearing = np.degrees(np.arctan2(normal[1], normal[0])) % 360.0
    area = walls.area[chosen]
    lonely = 100.0 * float(area[walls.seen[chosen] == DRONE].sum() / area.sum())
    return Figure(
        title=f"From the side {bearing:.0f} deg from +x towards +y",
        caption=f"{lonely:.0f} % of this wall was seen by the drone only (crosses).",
        svg=sheet_plate(
            sheet, colours, seen >= 0, "who saw the walls", _crosses(sheet, seen == DRONE)
        ),
    )


def _crosses(sheet: Sheet, is_marked: Mask) -> str:
    """Return a small cross on each marked cell, as SVG."""
    times = sheet.pixels
    size = 0.3 * times
    rows, columns = np.nonzero(is_marked.reshape(sheet.rows, sheet.columns))
    path = "".join(
        f"M{(c + 0.5) * times - size:.0f} {(r + 0.5) * times - size:.0f}l{2 * size:.0f} "
        f"{2 * size:.0f}m0 {-2 * size:.0f}l{-2 * size:.0f} {2 * size:.0f}"
        for r, c in zip(rows.tolist(), columns.tolist(), strict=True)
    )
    return f'<path class="cross" d="{path}"/>' if path else ""


def _holes(groups: list[list[tuple[Points, float]]]) -> float:
    """Return how much plan inside the outline holds no point, square metres."""
    plan = np.concatenate([xyz[:, :2] for group in groups for xyz, _ in group])
    low = plan.min(axis=0)
    cells = np.floor((plan - low) / _CELL_M).astype(np.int64) + 1
    seen = np.zeros(tuple(cells.max(axis=0) + 2), dtype=np.uint8)
    seen[tuple(cells.T)] = 1
    # Gaps of one cell are spacing, not holes.
    closed = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    whole = ndimage.binary_fill_holes(closed)
    return float((whole & (closed == 0)).sum()) * _CELL_M**2
