"""The paper's Table 2: what octree depth and cloth threshold take, and what each of them costs.

Each generated building is scanned; octree depth 9 to 20 (octree voxel grid) is paid in surface
that no kept point covers any more, the cloth's class threshold 0.5 to 0.05 m in points on the wrong
side of ground and building.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.evaluation.mesh import CLUTTER, FINE, GROUND, SURFACE, VEGETATION
from dougong.evaluation.metrics import percentile95
from dougong.evaluation.scenes import BUILDERS, make_scene
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.tabulate import as_text, chosen, distinct, new_figure, numbers, spread
from dougong.filters.cloth_simulation import GROUND as CALLED_GROUND
from dougong.filters.cloth_simulation import ClothSimulation, cloth_simulation
from dougong.filters.low_outliers import low_outliers
from dougong.filters.neighbourhood import build_index, nearest
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid
from dougong.pipeline.progress import Progress
from dougong.typing import Points

RUNS, QUICK_RUNS = 3, 1
POINTS, QUICK_POINTS = 1_000_000, 60_000
QUICK_KINDS = ("hall", "wall")
DEPTHS = tuple(range(9, 21))
THRESHOLDS_M = (0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15, 0.1, 0.09, 0.05)
COVER_M = 0.05
"""A place of the surface is covered when a point lies within this."""
AGAINST = (
    "the generator's noise-free surface (covered: a kept point within 50 mm, of what was covered "
    "before) and the true label of every point"
)
FIGURES = (
    "reduction_percent",
    "completeness_percent",
    "gap95_mm",
    "ground_missed_percent",
    "building_lost_percent",
    "ground_error_percent",
    "seconds",
)
COLUMNS = {
    "filter": "filter",
    "value": "value",
    "building": "building",
    "n": "n",
    "points_before": "points",
    "reduction_percent": "less %",
    "completeness_percent": "covered %",
    "gap95_mm": "gap 95 mm",
    "ground_missed_percent": "ground missed %",
    "building_lost_percent": "building lost %",
    "ground_error_percent": "wrong side %",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Filter every building at every depth and threshold; quick: two buildings, small."""
    kinds = QUICK_KINDS if setting.is_quick else tuple(BUILDERS)
    points = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)

    def measure(kind: str, seed: int, points: int) -> dict[str, Any]:
        return {"settings": list(_settings(kind, seed, points))}

    keys = [(kind, seed, points) for seed in setting.seeds(RUNS, QUICK_RUNS) for kind in kinds]
    rows = [row for one in measured(setting, keys, measure, progress) for row in one["settings"]]
    table = summary(rows)
    text = (
        "Scanner clouds; median over n surveys (building 'all': over all of them). Covered: places "
        "of the true surface\nwith a point within 50 mm, of those that had one before. Gap: "
        "from these places to the nearest kept point, 95 %.\n\n"
        + as_text(chosen(table, building="all"), COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_costs(table, path),
    )


def _settings(kind: str, seed: int, points: int) -> Iterator[dict[str, Any]]:
    """Yield one row per setting of both filters on a building's scan."""
    scene = make_scene(kind, seed, lidar_points=points, photogrammetry_points=points // 10)
    about = {"building": kind, "seed": seed}
    surface = scene.truth.surface_points - scene.lidar.frame.origin
    gaps = _gaps(scene.lidar.xyz, surface)
    for depth in DEPTHS:
        row = {**about, "filter": "octree depth", "value": depth}
        yield {**row, **_thinned(scene.lidar, depth, surface, gaps)}
    clean = scene.lidar.select(np.flatnonzero(low_outliers(scene.lidar.xyz).is_kept))
    for threshold in THRESHOLDS_M:
        row = {**about, "filter": "cloth threshold m", "value": threshold}
        yield {**row, **_parted(clean, threshold)}


def _gaps(kept: Points, surface: Points) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the distance from every place of the surface to the nearest point, metres."""
    return np.asarray(nearest(build_index(kept), surface)[1])


def _thinned(
    cloud: Cloud, depth: int, surface: Points, before: np.ndarray[Any, np.dtype[np.float64]]
) -> dict[str, Any]:
    start = time.perf_counter()
    is_kept = octree_voxel_grid(cloud.xyz, OctreeVoxelGrid(depth=depth)).is_kept
    seconds = time.perf_counter() - start
    gaps = _gaps(cloud.xyz[is_kept], surface)
    was_covered = before <= COVER_M
    return {
        "points_before": len(cloud),
        "points_after": int(is_kept.sum()),
        "reduction_percent": 100.0 * float(1.0 - is_kept.mean()),
        "completeness_percent": 100.0 * float((gaps[was_covered] <= COVER_M).mean()),
        "gap95_mm": 1e3 * percentile95(gaps[was_covered]),
        "seconds": seconds,
    }


def _parted(cloud: Cloud, threshold_m: float) -> dict[str, Any]:
    """Return what the cloth calls ground at a threshold, against the labels."""
    start = time.perf_counter()
    found = cloth_simulation(cloud.xyz, ClothSimulation(class_threshold_m=threshold_m))
    seconds = time.perf_counter() - start
    is_called = np.asarray(found.attributes["ground_class"]) == CALLED_GROUND
    label = np.asarray(cloud.attribute("truth_label"))
    is_ground = label == GROUND
    is_building = np.isin(label, (SURFACE, FINE))
    is_other = is_building | np.isin(label, (VEGETATION, CLUTTER))
    wrong = np.count_nonzero(is_ground & ~is_called) + np.count_nonzero(is_other & is_called)
    return {
        "points_before": len(cloud),
        "points_after": int(np.count_nonzero(~is_called)),
        "reduction_percent": 100.0 * float(is_called.mean()),
        "ground_missed_percent": 100.0 * float((~is_called[is_ground]).mean()),
        "building_lost_percent": 100.0 * float(is_called[is_building].mean()),
        "ground_error_percent": 100.0 * wrong / int(np.count_nonzero(is_ground | is_other)),
        "seconds": seconds,
    }


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per setting and building, and per setting over all buildings."""
    table = []
    for name, value in distinct(rows, "filter", "value"):
        group = chosen(rows, filter=name, value=value)
        for kind in [*(kind for (kind,) in distinct(group, "building")), "all"]:
            some = group if kind == "all" else chosen(group, building=kind)
            line: dict[str, Any] = {
                "filter": name,
                "value": value,
                "building": kind,
                "n": len(some),
                "seeds": " ".join(str(seed) for (seed,) in distinct(some, "seed")),
                "points_before": round(float(numbers(some, "points_before").mean())),
                "points_after": round(float(numbers(some, "points_after").mean())),
            }
            for key in FIGURES:
                line |= spread(some, key)
            table.append(line)
    return table


def draw_costs(table: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw reduction and costs over depth and over threshold, a line per building, as PNG."""
    figure = new_figure(9.6, 6.4)
    panels = figure.subplots(2, 2, sharex="col")
    shown = (
        ("octree depth", ("reduction_percent", "completeness_percent")),
        ("cloth threshold m", ("reduction_percent", "ground_error_percent")),
    )
    words = {
        "reduction_percent": "reduction, percent",
        "completeness_percent": "surface still covered, percent",
        "ground_error_percent": "points on the wrong side, percent",
    }
    for column, (name, keys) in zip(panels.T, shown, strict=True):
        rows = chosen(table, filter=name)
        for panel, key in zip(column, keys, strict=True):
            for (kind,) in distinct(rows, "building"):
                line = chosen(rows, building=kind)
                style = {"color": "black", "linewidth": 2.0} if kind == "all" else {}
                values = [row[key] for row in line]
                panel.plot([row["value"] for row in line], values, "o-", ms=3, label=kind, **style)
            panel.set_ylabel(words[key], fontsize=9)
            panel.grid(alpha=0.3)
        column[-1].set_xlabel(name.replace(" m", ", m"))
    panels[0, 0].set_xticks(DEPTHS)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=6, fontsize=9)
    figure.savefig(path, dpi=130)
