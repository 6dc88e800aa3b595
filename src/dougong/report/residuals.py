"""What is left between the clouds: the signed maps, the histogram and the faces, as figures."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dougong.formats import read
from dougong.report.figures import Figure
from dougong.report.maps import (
    UNTOLD,
    axes_of,
    lay_sheet,
    medians,
    sheet_plate,
    signed_colours,
    signed_scale,
    signs,
)
from dougong.report.plates import round_length
from dougong.typing import Points, Values

_FACADES = 3
_SAME_SIDE = float(np.cos(np.radians(40.0)))
_ROWS = 12
_BARS = 60
_CELL_SPACINGS = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Core:
    """Core points of one link, as its file holds them; about an origin of their own."""

    xyz: Points
    normals: Points
    distance: Values
    lod: Values


@dataclass(frozen=True, slots=True, kw_only=True)
class FaceRow:
    """One face, as text."""

    name: str
    size: str
    median: str
    within: str
    lod: str
    share: str
    stands: str
    is_off: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Residuals:
    """What is said and drawn of one link's distances."""

    source: str
    target: str
    sentence: str
    definition: str
    faces: tuple[FaceRow, ...]
    more_faces: int
    maps: tuple[Figure, ...]
    key: str
    """SVG."""
    histogram: str
    """SVG; empty where the core points are not at hand."""


def residuals(folder: Path, document: Mapping[str, Any]) -> Residuals | None:
    """Return what is left between the clouds of one registration; None where nothing was measured.

    Parameters
    ----------
    folder : Path
        The result's: the core points lie in it.
    document : mapping
        Of the registration.
    """
    found = document.get("distances")
    if not found:
        return None
    source, target = document["source"], document["target"]
    path = folder / found["file"]
    core = _read(path) if path.is_file() else None
    limit = round_length(2.2 * max(found["within95_m"], 1.5 * found["lod95_m"], 0.002))
    return Residuals(
        source=source,
        target=target,
        sentence=found["sentence"],
        definition=_definition(found, source, target),
        faces=tuple(_row(face) for face in found["faces"][:_ROWS]),
        more_faces=max(0, len(found["faces"]) - _ROWS),
        maps=() if core is None else _maps(core, found, limit),
        key=signed_scale(limit, found["lod95_m"], f"{source} behind, below",
                         f"{source} in front, above"),
        histogram="" if core is None else _histogram(core, found, limit),
    )  # fmt: skip


def _read(path: Path) -> Core:
    cloud = read(path)
    columns = {name: np.asarray(cloud.attribute(name), dtype=np.float64) for name in (
        "NormalX", "NormalY", "NormalZ", "m3c2_distance", "m3c2_lod95")}  # fmt: skip
    seen = np.isfinite(columns["m3c2_distance"])
    return Core(
        xyz=cloud.xyz[seen],
        normals=np.column_stack([columns[f"Normal{axis}"] for axis in "XYZ"])[seen],
        distance=columns["m3c2_distance"][seen],
        lod=columns["m3c2_lod95"][seen],
    )


def _definition(found: Mapping[str, Any], source: str, target: str) -> str:
    scales = found["scales"]
    pose = (
        "the registration's own uncertainty at that place"
        if found["has_registration_term"]
        else "(the registration's own uncertainty is not known and not in it)"
    )
    return (
        f"Signed distance from {target} to {source} along the surface's normal (M3C2): at "
        f"{found['observed_points']:,} of {found['core_points']:,} core points both clouds show "
        f"one surface within {100 * scales['max_distance_m']:.0f} cm. Normals from balls "
        f"{100 * scales['normal_m']:.0f} cm wide, distances from cylinders "
        f"{100 * scales['projection_m']:.0f} cm wide. The level of detection (95 %) holds noise, "
        f"roughness and {pose}; a smaller distance cannot be told from none. A drone cloud that "
        "bends differs by more than that: the distances are real, and no rigid pose removes them."
    )


def _row(face: Mapping[str, Any]) -> FaceRow:
    is_off = abs(face["median_m"]) > face["lod95_m"]
    return FaceRow(
        name=face["name"],
        size=f"{face['width_m']:.1f} x {face['height_m']:.1f} m",
        median=f"{1e3 * face['median_m']:+.1f} mm",
        within=f"{1e3 * face['within95_m']:.1f} mm",
        lod=f"{1e3 * face['lod95_m']:.1f} mm",
        share=f"{100 * face['significant_share']:.0f} %",
        stands=face["stands"],
        is_off=is_off,
    )


def _maps(core: Core, found: Mapping[str, Any], limit: float) -> tuple[Figure, ...]:
    """Return the map from above and those of the sides with most wall."""
    spacing = found["scales"]["core_spacing_m"]
    figures = []
    above = np.abs(core.normals[:, 2]) >= 0.5
    if above.sum() >= 50:
        axes = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
        words = "Ground, terraces and roofs; +y is up."
        figures.append(_map(core, above, axes, spacing, limit, "From above", words))
    for name, normal in _sides(found["faces"]):
        facing = (core.normals @ normal >= _SAME_SIDE) & ~above
        if facing.sum() >= 50:
            words = "All walls that face this way, as one who stands before them sees them."
            title = f"Walls facing {name}"
            figures.append(_map(core, facing, axes_of(normal), spacing, limit, title, words))
    return tuple(figures)


def _sides(faces: list[Mapping[str, Any]]) -> list[tuple[str, Values]]:
    """Return the directions that have most wall."""
    areas: dict[str, float] = {}
    normals: dict[str, Values] = {}
    for face in faces:
        if face["kind"] != "wall":
            continue
        name = face["name"].split(",")[0].removesuffix(" facade").removeprefix("wall facing ")
        areas[name] = areas.get(name, 0.0) + face["area_m2"]
        normals.setdefault(name, np.array(face["normal"]))
    most = sorted(areas, key=lambda name: -areas[name])[:_FACADES]
    return [(name, normals[name]) for name in most]


def _map(
    core: Core,
    chosen: Any,
    axes: tuple[Values, Values],
    spacing: float,
    limit: float,
    title: str,
    words: str,
) -> Figure:
    xyz, distance, lod = core.xyz[chosen], core.distance[chosen], core.lod[chosen]
    # Cells of several core points: one alone is noise, a patch of them is a finding.
    sheet = lay_sheet(xyz, *axes, _CELL_SPACINGS * spacing)
    cells = sheet.cells(xyz)
    count = sheet.rows * sheet.columns
    value, detectable = medians(cells, distance, count), medians(cells, lod, count)
    is_told = np.isfinite(value) & (np.abs(np.nan_to_num(value)) > np.nan_to_num(detectable))
    colours = signed_colours(value, limit)
    colours[~is_told] = UNTOLD
    over = signs(sheet, value, is_told)
    told = 100.0 * float(is_told.sum()) / max(int(np.isfinite(value).sum()), 1)
    return Figure(
        title=title,
        caption=f"{words} {told:.0f} % of the cells differ by more than their level of detection.",
        svg=sheet_plate(sheet, colours, np.isfinite(value), f"signed distances, {title}", over),
    )


def _histogram(core: Core, found: Mapping[str, Any], limit: float) -> str:
    """Return the distances as bars, the level of detection as a band behind them."""
    width, height, left, low = 620, 210, 16, 46
    edges = np.linspace(-1.5 * limit, 1.5 * limit, _BARS + 1)
    inside = np.clip(core.distance, edges[0], edges[-1])
    counts, _ = np.histogram(inside, edges)
    per = (width - 2 * left) / (edges[-1] - edges[0])
    middles = (edges[1:] + edges[:-1]) / 2.0
    colours = signed_colours(middles, limit)
    colours[np.abs(middles) < found["lod95_m"]] = UNTOLD
    tall = (height - low - 24) / max(int(counts.max()), 1)
    bars = "".join(
        f'<rect x="{left + (edges[i] - edges[0]) * per:.1f}" '
        f'y="{height - low - counts[i] * tall:.1f}" '
        f'width="{(edges[1] - edges[0]) * per - 1:.1f}" height="{counts[i] * tall:.1f}" '
        f'fill="rgb({r},{g},{b})"/>'
        for i, (r, g, b) in enumerate(colours.tolist())
    )

    def at(value: float) -> float:
        return float(left + (value - edges[0]) * per)

    ticks = "".join(
        f'<text x="{at(share * limit):.0f}" y="{height - low + 17}" text-anchor="middle">'
        f"{1000 * share * limit:+.3g}</text>"
        for share in (-1.0, -0.5, 0.0, 0.5, 1.0)
    )
    lod, median = found["lod95_m"], found["median_m"]
    lines = "".join(
        f'<path class="lod" d="M{at(v):.1f} 20V{height - low}"/>'
        for v in (-lod, lod)
        if abs(v) < edges[-1]
    )
    return (
        f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="histogram of '
        f"the signed distances: median {1e3 * median:+.1f} mm, 95 % within "
        f'{1e3 * found["within95_m"]:.1f} mm">{bars}{lines}'
        f'<path class="median" d="M{at(median):.1f} 20V{height - low}"/>'
        f'<path class="axis" d="M{left} {height - low}H{width - left}"/>{ticks}'
        f'<text x="{at(median):.0f}" y="14" text-anchor="middle">median {1e3 * median:+.1f} mm'
        "</text>"
        f'<text x="{left}" y="{height - 6}">− behind, below</text>'
        f'<text x="{width - left}" y="{height - 6}" text-anchor="end">in front, above +</text>'
        f'<text x="{width / 2}" y="{height - 6}" text-anchor="middle">mm</text></svg>'
    )
