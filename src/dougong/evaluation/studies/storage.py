"""Bytes on disk before and after filtering, by format, for both sensors' clouds of each building.

The paper gives one figure per sensor without a format. Here every format that the program writes
holds the raw cloud and the filtered one, with the same attributes.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dougong.cloud import Cloud
from dougong.evaluation.building_runs import DRONE_SHARE
from dougong.evaluation.scenes import BUILDERS, make_scene
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.tabulate import as_text, chosen, distinct, new_figure, numbers, spread
from dougong.formats import WRITABLE, write
from dougong.pipeline.progress import Progress
from dougong.pipeline.recipes import Recipe, filter_cloud
from dougong.typing import Kind

RUNS, QUICK_RUNS = 3, 1
POINTS, QUICK_POINTS = 1_000_000, 60_000
QUICK_KINDS = ("hall",)
RECIPES: Mapping[str, Recipe] = {
    "default": Recipe(),
    "voxels of 5 cm": Recipe.model_validate({"lidar": {"octree_voxel_grid": {"voxel_m": 0.05}}}),
}
"""The default recipe decimates below 5 mm only; the other one is how clouds are often delivered."""
AGAINST = "the file of the unfiltered cloud, same format and attributes, written by this program"
COLUMNS = {
    "sensor": "cloud",
    "recipe": "recipe",
    "format": "format",
    "n": "n",
    "points_reduction_percent": "points less %",
    "bytes_before": "bytes before",
    "bytes_after": "bytes after",
    "bytes_reduction_percent": "bytes less %",
    "bytes_reduction_percent_min": "min",
    "bytes_reduction_percent_max": "max",
    "bytes_per_point": "bytes per point",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Write every cloud of every building in every format; quick: one building, small."""
    kinds = QUICK_KINDS if setting.is_quick else tuple(BUILDERS)
    points = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)

    def measure(kind: str, seed: int, points: int) -> dict[str, Any]:
        return {"files": list(_files(kind, seed, points))}

    keys = [(kind, seed, points) for seed in setting.seeds(RUNS, QUICK_RUNS) for kind in kinds]
    rows = [row for one in measured(setting, keys, measure, progress) for row in one["files"]]
    table = summary(rows)
    text = (
        "Medians over n surveys (every building, every seed), with smallest and largest reduction. "
        "Bytes are of the files.\n\n" + as_text(table, COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_bytes(table, path),
    )


def _files(kind: str, seed: int, points: int) -> Iterator[dict[str, Any]]:
    """Yield one row per sensor, recipe and format of a building's survey."""
    flown = round(DRONE_SHARE * points)
    scene = make_scene(kind, seed, lidar_points=points, photogrammetry_points=flown)
    sensors: tuple[tuple[Kind, Cloud], ...] = (
        ("lidar", scene.lidar),
        ("photogrammetry", scene.photogrammetry),
    )
    for sensor, cloud in sensors:
        before = _sizes(cloud)
        for name, recipe in RECIPES.items():
            if sensor == "photogrammetry" and name != "default":
                continue
            kept = filter_cloud(cloud, sensor, recipe).cloud
            after = _sizes(kept)
            for suffix in WRITABLE:
                yield {
                    "building": kind,
                    "seed": seed,
                    "sensor": sensor,
                    "recipe": name,
                    "format": suffix,
                    "points_before": len(cloud),
                    "points_after": len(kept),
                    "points_reduction_percent": 100.0 * (1.0 - len(kept) / len(cloud)),
                    "bytes_before": before[suffix],
                    "bytes_after": after[suffix],
                    "bytes_reduction_percent": 100.0 * (1.0 - after[suffix] / before[suffix]),
                    "bytes_per_point": after[suffix] / len(kept),
                }


def _sizes(cloud: Cloud) -> dict[str, int]:
    """Return the size of a cloud's file in every format, bytes."""
    with tempfile.TemporaryDirectory(prefix="dougong-study-") as folder:
        paths = {suffix: Path(folder) / f"cloud{suffix}" for suffix in WRITABLE}
        for path in paths.values():
            write(cloud, path)
        return {suffix: path.stat().st_size for suffix, path in paths.items()}


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per sensor, recipe and format, over all buildings and seeds."""
    table = []
    for sensor, recipe, suffix in distinct(rows, "sensor", "recipe", "format"):
        group = chosen(rows, sensor=sensor, recipe=recipe, format=suffix)
        line: dict[str, Any] = {
            "sensor": sensor,
            "recipe": recipe,
            "format": suffix,
            "n": len(group),
            "seeds": " ".join(str(seed) for (seed,) in distinct(group, "seed")),
            "bytes_before": round(float(numbers(group, "bytes_before").mean())),
            "bytes_after": round(float(numbers(group, "bytes_after").mean())),
        }
        for key in ("points_reduction_percent", "bytes_reduction_percent", "bytes_per_point"):
            line |= spread(group, key, 2)
        table.append(line)
    return table


def draw_bytes(table: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw bytes before and after, a panel per sensor and recipe, as PNG."""
    groups = distinct(table, "sensor", "recipe")
    figure = new_figure(3.4 * len(groups) + 0.6, 3.8)
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for panel, (sensor, recipe) in zip(panels, groups, strict=True):
        rows = chosen(table, sensor=sensor, recipe=recipe)
        at = list(range(len(rows)))
        for shift, key, label in ((-0.2, "bytes_before", "before"), (0.2, "bytes_after", "after")):
            values = [row[key] / 1e6 for row in rows]
            panel.bar([x + shift for x in at], values, 0.38, label=label)
        for x, row in zip(at, rows, strict=True):
            words = f"-{row['bytes_reduction_percent']:.0f} %"
            top = max(row["bytes_before"], row["bytes_after"]) / 1e6
            panel.annotate(words, (x, top), ha="center", va="bottom", fontsize=8)
        panel.set_xticks(at, [row["format"] for row in rows], fontsize=8)
        panel.set_title(f"{sensor}, {recipe}", fontsize=9)
    panels[0].set_ylabel("megabytes, mean of the buildings")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=9)
    figure.savefig(path, dpi=130)
