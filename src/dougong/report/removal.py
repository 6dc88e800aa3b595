"""What the filters took out: why, how much per square metre of surface, and where."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dougong._sorting import count_rows
from dougong.filters.selection import Reason
from dougong.formats import read
from dougong.report.figures import Figure
from dougong.report.layers import Layer
from dougong.report.maps import amount_colours, amount_scale, lay_sheet, sheet_plate
from dougong.report.plates import round_length
from dougong.typing import Values

WORDS = {
    Reason.DECIMATED: "decimated: another point of its voxel was kept",
    Reason.LOW_OUTLIER: "noise below the ground",
    Reason.CURVATURE_WEIGHTED: "noise, isolated for the curvature around it",
    Reason.STATISTICAL: "noise, far from its neighbours",
    Reason.RADIUS: "noise, too few neighbours",
    Reason.PASS_THROUGH: "cropped",
    Reason.CLUTTER: "clutter: looks like a person, vehicle, pole or wire",
    Reason.CLOTH: "on the side of the ground that was not asked for",
}
_CELL_M = 0.5
_SURFACE_CELL_M = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class ReasonRow:
    """One reason, as text."""

    words: str
    points: int
    share: str
    per_m2: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal:
    """What one cloud lost."""

    rows: tuple[ReasonRow, ...]
    surface: str
    map: Figure | None
    key: str


def removals(folder: Path, result: Mapping[str, Any], layers: list[Layer]) -> dict[str, Removal]:
    """Return what each cloud of a run lost, by its name."""
    by_name = {layer.name: layer for layer in layers}
    return {
        cloud["name"]: _one(folder, cloud, by_name[cloud["name"]])
        for cloud in result["clouds"]
        if cloud["name"] in by_name and cloud.get("reasons")
    }


def _one(folder: Path, cloud: Mapping[str, Any], layer: Layer) -> Removal:
    surface = surface_m2(layer)
    rows = []
    for reason, words in WORDS.items():
        count = cloud["reasons"].get(reason.name.lower(), 0)
        if count:
            rows.append(
                ReasonRow(
                    words=words,
                    points=count,
                    share=f"{100 * count / cloud['points_in']:.2f} %",
                    per_m2=f"{count / surface:.3g}",
                )
            )
    drawn, key = _map(folder, cloud, layer)
    return Removal(
        rows=tuple(rows),
        surface=f"{surface:,.0f} m² of surface (cells of {100 * _SURFACE_CELL_M:.0f} cm that hold "
        "kept points)",
        map=drawn,
        key=key,
    )


def surface_m2(layer: Layer) -> float:
    """Return about how much surface a cloud shows: occupied voxels times their face."""
    cells = count_rows(np.floor(layer.after / _SURFACE_CELL_M).astype(np.int64))
    return max(cells * _SURFACE_CELL_M**2, _SURFACE_CELL_M**2)


def _map(folder: Path, cloud: Mapping[str, Any], layer: Layer) -> tuple[Figure | None, str]:
    """Return where points other than decimated ones were taken out, from above."""
    path = folder / "removed" / f"{cloud['name']}.laz"
    if not path.is_file() or layer.origin is None or not layer.is_sure:
        return None, ""
    taken = read(path)
    if not len(taken):
        return None, ""
    xyz = taken.rebased(layer.origin).xyz
    whole = sum(n for name, n in cloud["reasons"].items() if name not in ("kept", "decimated"))
    sheet = lay_sheet(
        layer.after, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), _CELL_M, most=220
    )
    cells, stands_for = sheet.cells(xyz), _stands_for(cloud, len(taken), whole)
    is_in = cells >= 0
    count = np.bincount(cells[is_in], stands_for[is_in], minlength=sheet.rows * sheet.columns)
    amount = count / sheet.cell_m**2
    own = sheet.cells(layer.after)
    ground = np.bincount(own[own >= 0], minlength=len(amount)) > 0
    limit = max(
        round_length(float(np.quantile(amount[amount > 0], 0.95))) if amount.any() else 1, 1
    )
    colours = amount_colours(amount, limit)
    colours[amount == 0] = (228, 229, 226)
    shown = f", {len(taken):,} of them drawn" if len(taken) < whole else ""
    figure = Figure(
        title="Where points were taken out",
        caption=(
            f"Points per square metre of plan, from above; grey: nothing was taken. {whole:,} "
            f"points{shown}; decimated ones are not among them."
        ),
        svg=sheet_plate(sheet, colours, ground | (amount > 0), "removed points from above"),
    )
    return figure, amount_scale(limit, "points per m²")


def _stands_for(cloud: Mapping[str, Any], shown: int, whole: int) -> Values:
    """Return for how many removed points each drawn one stands, (shown,).

    Each file has a sample of its own, one behind the other. Older results do not say how many.
    """
    files = [file for file in cloud.get("removed_by_file", ()) if file["shown"]]
    if sum(file["shown"] for file in files) != shown:
        return np.full(shown, whole / shown)
    samples = np.array([file["shown"] for file in files])
    return np.repeat(np.array([file["removed"] for file in files]) / samples, samples)
