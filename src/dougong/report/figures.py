"""The still pictures of the report: before and after, height, and thin slices through both."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dougong.report.drawing import View, draw_dots, draw_surface, height_colours, oblique_view
from dougong.report.layers import Layer, near
from dougong.report.plates import Mark, plate
from dougong.typing import Points, Values

_WIDE, _HIGH = 1100, 680
_ZOOM_M = 3.0
_ZOOM_PX = 520


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A picture with its words."""

    title: str
    caption: str
    svg: str
    is_wide: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where the building is: the part of the site worth looking at."""

    centre: Values
    """(3,)"""
    radius: float
    floor: float
    top: float
    yaw_deg: float
    """Direction of its walls."""


def find_place(layers: list[Layer]) -> Place:
    """Find the middle, the size and the wall direction of what the clouds show."""
    moving = [layer for layer in layers if not layer.is_reference and layer.is_sure]
    points = np.concatenate([layer.after for layer in moving or layers[-1:]])
    plan = points[:, :2]
    middle = np.median(plan, axis=0)
    radius = float(np.percentile(np.hypot(*(plan - middle).T), 90))
    inside = points[np.hypot(*(plan - middle).T) <= radius]
    floor = np.percentile(inside[:, 2], 3)
    # A scanner on the ground sees no roof: the top is that of whichever cloud reaches highest.
    tops = [_robust_top(layer.after, middle, radius) for layer in layers if layer.is_sure]
    top = max(tops, default=float(inside[:, 2].max()))
    high = inside[inside[:, 2] > floor + 0.2 * (top - floor)]
    return Place(
        centre=np.array([*middle, (floor + top) / 2]),
        radius=max(radius, 0.5),
        floor=float(floor),
        top=float(max(top, floor + 0.1)),
        yaw_deg=_wall_direction(high if len(high) > 100 else inside, radius),
    )


def _robust_top(points: Points, middle: Values, radius: float) -> float:
    inside = points[np.hypot(*(points[:, :2] - middle).T) <= radius, 2]
    return float(np.percentile(inside, 99.95)) if len(inside) else -np.inf


def _wall_direction(points: Points, radius: float) -> float:
    """Return the yaw in 0..90 degrees at which the plan's histograms are sharpest."""
    sample = points[:: max(1, len(points) // 40_000), :2]
    sample = sample - np.median(sample, axis=0)
    bins = np.linspace(-radius, radius, 201)
    best, best_score = 0.0, -1.0
    for yaw in range(0, 90, 2):
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        along = np.histogram(sample @ [c, s], bins)[0].astype(float)
        across = np.histogram(sample @ [-s, c], bins)[0].astype(float)
        score = float((along**2).sum() + (across**2).sum())
        if score > best_score:
            best, best_score = float(yaw), score
    return best


def overview(layers: list[Layer], place: Place) -> list[Figure]:
    """Return before, after and height pictures, all from one direction."""
    heights = np.array([place.floor - 2.0, place.top + 0.5])
    placed = [layer for layer in layers if layer.is_placed]
    shown = near(placed, place.centre, place.radius, heights)
    low = np.array([*(place.centre[:2] - place.radius), place.floor])
    high = np.array([*(place.centre[:2] + place.radius), place.top])
    view = oblique_view(low, high, place.yaw_deg + 305, 28, _WIDE, _HIGH)
    points = np.concatenate([layer.after for layer in shown])
    by_source = np.concatenate(
        [np.tile(np.array(layer.colour, np.uint8), (len(layer.after), 1)) for layer in shown]
    )
    figures = []
    if len(layers) > 1:
        figures += _before(layers, place, view)
    if len(placed) > 1:
        is_sure = all(layer.is_sure for layer in placed)
        figures.append(
            Figure(
                title="After" if is_sure else "After, not sure",
                caption=(
                    "The same clouds in the frame of the reference, coloured by source."
                    if is_sure
                    else "The best of several possible poses, coloured by source; it is not sure, "
                    "and the clouds were not merged."
                ),
                svg=plate(
                    draw_surface(points, by_source, view), view, "registered clouds", text_px=30
                ),
            )
        )
    colours = height_colours(points[:, 2])
    figures.append(
        Figure(
            title="Height",
            caption=(
                f"Coloured by height, dark low ({place.floor:.1f} m) to bright high "
                f"({place.top:.1f} m above the local origin)."
            ),
            svg=plate(draw_surface(points, colours, view), view, "cloud coloured by height"),
        )
    )
    return figures


def _before(layers: list[Layer], place: Place, view: View) -> list[Figure]:
    """Return the clouds as delivered, each set down about one middle so that all are seen.

    Empty where a cloud shows nothing at this size (one in millimetres beside one in metres).
    """
    placed, colours = [], []
    for layer in layers:
        own = layer.before
        middle = np.median(own, axis=0)
        plan = np.hypot(*(own[:, :2] - middle[:2]).T)
        own = own[plan <= place.radius]
        if not len(own):
            return []
        floor = np.percentile(own[:, 2], 3)
        placed.append(own + [*(place.centre[:2] - middle[:2]), place.floor - floor])
        colours.append(np.tile(np.array(layer.colour, np.uint8), (len(own), 1)))
    image = draw_surface(np.concatenate(placed), np.concatenate(colours), view)
    return [
        Figure(
            title="Before",
            caption=(
                "As delivered: each cloud in its own axes, shifted to one middle so that both "
                "fit into the picture. Nothing is turned."
            ),
            svg=plate(image, view, "clouds before registration", text_px=30),
        )
    ]


def slices(layers: list[Layer], place: Place) -> list[Figure]:
    """Return thin slices through all clouds: one level, two upright, each with an enlargement.

    Where two clouds show the same wall, their lines must lie on each other.
    """
    c, s = np.cos(np.radians(place.yaw_deg)), np.sin(np.radians(place.yaw_deg))
    along, across, up = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), np.array([0.0, 0.0, 1.0])
    heights = np.array([place.floor - 1.0, place.top + 1.0])
    shown = near(layers, place.centre, place.radius, heights)
    bottom = place.floor + min(0.5, 0.1 * (place.top - place.floor)) - place.centre[2]
    figures = []
    for title, right, vertical, normal in (
        ("Plan slice", along, across, up),
        ("Section along the walls", along, up, -across),
        ("Section across the walls", across, up, along),
    ):
        figures += _slice(shown, place, title, (right, vertical, normal), bottom)
    return figures


def _slice(
    layers: list[Layer],
    place: Place,
    title: str,
    axes: tuple[Values, Values, Values],
    bottom: float,
) -> list[Figure]:
    right, vertical, normal = axes
    is_plan = abs(normal[2]) > 0.5
    reach = place.radius / 2
    low, high = (bottom, place.top - place.centre[2]) if is_plan else (-reach, reach)
    above = [layer.after[layer.after[:, 2] - place.centre[2] >= bottom] for layer in layers]
    position = _best_position(above, place, axes, low, high)
    thickness = _thickness(above, place.centre, normal, position)
    cut = [
        (layer.after[np.abs((layer.after - place.centre) @ normal - position) <= thickness / 2])
        for layer in layers
    ]
    if sum(map(len, cut)) < 50:
        return []
    height = 760 if is_plan else 330
    tall = place.top - place.floor if not is_plan else 2 * place.radius
    view = View(
        right=right,
        up=vertical,
        towards=normal,
        centre=place.centre,
        width_m=max(2.04 * place.radius, 1.1 * tall * 1000 / height),
        width_px=1000,
        height_px=height,
    )
    zoom = _zoom(cut, place, axes, height)
    coloured = [(points, layer.colour) for points, layer in zip(cut, layers, strict=True)]
    mark = _mark(zoom, view)
    where = (
        f"{position + place.centre[2] - place.floor:.1f} m above the ground"
        if is_plan
        else f"{position:+.1f} m from the middle"
    )
    words = f"{thickness * 100:.0f} cm thick, {where}; the frame is enlarged beside it."
    return [
        Figure(
            title=title,
            caption=words,
            svg=plate(draw_dots(coloured, view, 3), view, title, (mark,), text_px=24),
            is_wide=True,
        ),
        Figure(
            title="Enlarged",
            caption="Where lines of two colours lie on each other, the clouds agree.",
            svg=plate(draw_dots(coloured, zoom, 5), zoom, f"{title}, enlarged"),
        ),
    ]


def _best_position(
    clouds: list[Points], place: Place, axes: tuple[Values, Values, Values], low: float, high: float
) -> float:
    """Return where along the normal a slice shows most lines that two clouds share."""
    normal = axes[2]
    clouds = [xyz[:: max(1, len(xyz) // 250_000)] for xyz in clouds]
    depths = [(xyz - place.centre) @ normal for xyz in clouds]
    best, best_count = (low + high) / 2, -1
    for position in np.linspace(low, high, 26)[1:-1]:
        cut = [
            xyz[np.abs(depth - position) <= 0.1] for xyz, depth in zip(clouds, depths, strict=True)
        ]
        count = int(_shared_lines(cut, place.centre, axes, place.radius).sum())
        if count > best_count:
            best, best_count = float(position), count
    return best


def _shared_lines(
    cut: list[Points], centre: Values, axes: tuple[Values, Values, Values], reach: float
) -> NDArray[np.bool_]:
    """Return the cells of a slice in which two clouds show a line, not a surface seen flat.

    (k, k), along the picture's right and up; cells of 1/200 of `reach`, at least 10 cm.
    """
    cell = max(0.1, reach / 200)
    cells = int(np.ceil(2 * reach / cell))
    layers = []
    for points in cut:
        relative = points - centre
        right, up = (
            np.floor((relative @ axis + reach) / cell).astype(np.int64) for axis in axes[:2]
        )
        is_in = (right >= 0) & (right < cells) & (up >= 0) & (up < cells)
        seen = np.zeros((cells, cells), dtype=np.bool_)
        seen[right[is_in], up[is_in]] = True
        layers.append(seen)
    count = np.sum(layers, axis=0)
    # A wall that lies in the slice fills cells all round; a wall cut by it leaves a line.
    around = cv2.blur((count > 0).astype(np.float32), (5, 5))
    lines: NDArray[np.bool_] = (count >= 2) & (around < 0.56)
    return lines


def _thickness(clouds: list[Points], centre: Values, normal: Values, position: float) -> float:
    """Return the thinnest slice (5-60 cm) in which every cloud still draws a line."""
    distance = [np.abs((xyz - centre) @ normal - position) for xyz in clouds]
    for thickness in (0.05, 0.1, 0.2, 0.3, 0.4):
        inside = sorted(int((d <= thickness / 2).sum()) for d in distance)[-2:]
        if min(inside) >= 3000:
            return thickness
    return 0.6


def _zoom(
    cut: list[Points], place: Place, axes: tuple[Values, Values, Values], height_px: int
) -> View:
    """Return the view of the place in the slice where two clouds share most lines."""
    lines = _shared_lines(cut, place.centre, axes, place.radius).astype(np.float32)
    cell = 2 * place.radius / len(lines)
    size = min(_ZOOM_M, place.radius / 2)
    # A bell rather than a box: its peak lies in the middle of what is worth looking at.
    wide, tall = size / cell / 4, size / cell / 4 * height_px / _ZOOM_PX
    found = cv2.GaussianBlur(lines, (0, 0), sigmaX=tall, sigmaY=wide)
    right, up = np.unravel_index(int(np.argmax(found)), found.shape)
    offset = (np.array([right, up]) + 0.5) * cell - place.radius
    # The enlargement stays inside the slice it enlarges.
    offset = np.clip(offset, size / 2 - place.radius, place.radius - size / 2)
    return View(
        right=axes[0],
        up=axes[1],
        towards=axes[2],
        centre=place.centre + offset[0] * axes[0] + offset[1] * axes[1],
        width_m=size,
        width_px=_ZOOM_PX,
        height_px=height_px,
    )


def _mark(zoom: View, view: View) -> Mark:
    column, row, _ = view.project(zoom.centre[None, :])
    width = zoom.width_m / view.pixel_m
    height = width * zoom.height_px / zoom.width_px
    return Mark(
        left=float(column[0] - width / 2),
        top=float(row[0] - height / 2),
        width=width,
        height=height,
    )
