"""The paper's Figure 4 and run times: errors, seconds and memory against the number of points.

One building surveyed with more and more points; every coarse method with both fine methods. The
inlier RMSE says how well the clouds fit, the check RMSE how far the pose is from the true one at
places of the surface that took no part: only the second is an error.
"""

import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import DougongError
from dougong.evaluation.apart import apart
from dougong.evaluation.building_runs import DRONE_SHARE
from dougong.evaluation.coarse_trials import METHODS
from dougong.evaluation.machine import memory_beyond
from dougong.evaluation.metrics import Truth, displacements, pose_errors
from dougong.evaluation.scenes import Scene, make_scene
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.tabulate import as_text, chosen, distinct, new_figure, numbers, spread
from dougong.pipeline.progress import Progress
from dougong.registration import Register, register
from dougong.threads import get_threads, set_threads
from dougong.typing import Transform

RUNS, QUICK_RUNS = 1, 1
POINTS, QUICK_POINTS = 1_000_000, 45_000
LEAST, QUICK_LEAST = 30_000, 15_000
STEPS_PER_DECADE = 2
BUILDING = "hall"
FINE = ("point-to-plane", "point-to-point")
QUICK_METHODS = ("plan",)
WARM_UP = 10_000
AGAINST = (
    "check RMSE and TRE95: the generator's exact pose, over the noise-free surface that both "
    "sensors saw; inlier RMSE: the other cloud, within the last distance bound of the fit"
)
FIGURES = {
    "inlier_rmse_mm": 2,
    "check_rmse_mm": 2,
    "pose95_mm": 2,
    "seconds": 2,
    "cpu_s": 2,
    "memory_bytes": 0,
}
COLUMNS = {
    "coarse": "coarse",
    "fine": "fine",
    "points": "points",
    "n": "n",
    "ok": "ok",
    "inlier_rmse_mm": "inlier RMSE mm",
    "check_rmse_mm": "check RMSE mm",
    "pose95_mm": "TRE95 mm",
    "seconds": "seconds",
    "cpu_s": "CPU s",
    "memory_bytes": "memory bytes",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Register the hall at every size with every method; quick: two sizes, one method."""
    methods = QUICK_METHODS if setting.is_quick else tuple(METHODS)
    fits = FINE[:1] if setting.is_quick else FINE
    surveyed = cache(_surveyed)

    def measure(seed: int, points: int, coarse: str, fine: str) -> dict[str, Any]:
        if surveyed.cache_info().currsize > 1:
            surveyed.cache_clear()
        about: dict[str, Any] = {"seed": seed, "building": BUILDING, "points_aimed": points}
        about |= {"coarse": coarse, "fine": fine}
        scenes = _surveyed(seed, WARM_UP), surveyed(seed, points)
        return {**about, **apart(registered, *scenes, coarse, fine, get_threads())}

    keys = [
        (seed, points, coarse, fine)
        for seed in setting.seeds(RUNS, QUICK_RUNS)
        for points in sizes(setting)
        for coarse in methods
        for fine in fits
    ]
    rows = measured(setting, keys, measure, progress)
    table = summary(rows)
    text = (
        "Points: of both clouds together. Registration alone, without reading and filtering; "
        "medians over n surveys.\nMemory: the peak beyond what the clouds hold, of a process of "
        "its own. The search "
        "works on at most 600,000 points of each.\n\n" + as_text(table, COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_growth(table, path),
    )


def sizes(setting: Setting) -> list[int]:
    """Return the numbers of points of both clouds, two a decade up to the largest asked for."""
    most = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)
    least = min(QUICK_LEAST if setting.is_quick else LEAST, most)
    steps = int(np.floor(STEPS_PER_DECADE * np.log10(most / least) + 1e-9))
    found = [round(least * 10 ** (k / STEPS_PER_DECADE)) for k in range(steps + 1)]
    return found if found[-1] > 0.9 * most else [*found, most]


def _surveyed(seed: int, points: int) -> Scene:
    scanned = points / (1.0 + DRONE_SHARE)
    return make_scene(
        BUILDING,
        seed,
        lidar_points=round(scanned),
        photogrammetry_points=round(DRONE_SHARE * scanned),
    )


def registered(small: Scene, scene: Scene, coarse: str, fine: str, threads: int) -> dict[str, Any]:
    """Register a scene one way, in a process that did nothing before but register a `small` one.

    Kernels are compiled or loaded at their first use: neither time nor memory counts that.
    """
    set_threads(threads)
    _registered(small, coarse, fine)
    return _registered(scene, coarse, fine)


def _registered(scene: Scene, coarse: str, fine: str) -> dict[str, Any]:
    """Register a scene one way; what it took and how far it is from the truth."""
    params = Register.model_validate({"coarse": coarse, "fine": fine})
    row: dict[str, Any] = {"points": len(scene.lidar) + len(scene.photogrammetry)}
    start, cpu = time.perf_counter(), time.process_time()
    with memory_beyond() as memory:
        try:
            result = register(scene.lidar, scene.photogrammetry, params)
        except DougongError as error:
            return {**row, "status": "failed", "reason": str(error)}
    row |= {"seconds": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
    row["memory_bytes"] = memory["bytes"]
    row |= {"status": result.status, "reason": result.reason}
    if result.fine is not None:
        row |= {
            "inlier_rmse_mm": 1e3 * result.fine.inlier_rmse_m,
            "max_distance_mm": 1e3 * result.fine.max_distance_m,
            "fitness": result.fine.fitness,
        }
    if result.matrix is not None:
        row["check_rmse_mm"] = 1e3 * check_rmse_m(result.matrix, scene.truth)
        row["pose95_mm"] = 1e3 * pose_errors(result.matrix, scene.truth).tre95_m
    return row


def check_rmse_m(pose: Transform, truth: Truth) -> float:
    """Return the root mean square distance of a pose from the best one over the shared surface."""
    moved = displacements(pose, truth.T_best, truth.surface_points)
    return float(np.sqrt(np.square(moved).sum(axis=1).mean()))


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per method and size."""
    table = []
    for coarse, fine, aimed in distinct(rows, "coarse", "fine", "points_aimed"):
        group = chosen(rows, coarse=coarse, fine=fine, points_aimed=aimed)
        line: dict[str, Any] = {
            "coarse": coarse,
            "fine": fine,
            "points": round(float(numbers(group, "points").mean())),
            "n": len(group),
            "seeds": " ".join(str(row["seed"]) for row in group),
            "ok": len(chosen(group, status="ok")),
        }
        for key, digits in FIGURES.items():
            line |= spread(group, key, digits)
        table.append(line)
    return table


def _plain(value: float, _place: int) -> str:
    """Return the label of a tick on a logarithmic axis: of 1, 2 and 5 times a power of ten."""
    lead = value / 10.0 ** np.floor(np.log10(value) + 1e-9)
    return f"{value:,.10g}" if round(lead, 6) in (1.0, 2.0, 5.0) else ""


def draw_growth(table: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw errors, processor seconds and memory over the number of points, as PNG."""
    figure = new_figure(11.0, 7.0)
    panels = figure.subplots(2, 2, sharex=True)
    told = {
        "inlier_rmse_mm": ("inlier RMSE, mm", 1.0),
        "check_rmse_mm": ("check RMSE against the truth, mm", 1.0),
        "cpu_s": ("processor seconds", 1.0),
        "memory_bytes": ("memory beyond the clouds, MB", 1e-6),
    }
    methods = [coarse for (coarse,) in distinct(table, "coarse")]
    for panel, (key, (words, scale)) in zip(panels.ravel(), told.items(), strict=True):
        for coarse, fine in distinct(table, "coarse", "fine"):
            line = [row for row in chosen(table, coarse=coarse, fine=fine) if row[key]]
            style = "-" if fine == FINE[0] else "--"
            panel.plot(
                [row["points"] for row in line],
                [scale * row[key] for row in line],
                f"o{style}",
                ms=3,
                color=f"C{methods.index(coarse)}",
                label=f"{coarse}, {fine}",
            )
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_ylabel(words, fontsize=9)
        panel.grid(alpha=0.3, which="both")
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_major_formatter(_plain)
            axis.set_minor_formatter(_plain)
    for panel in panels[1]:
        panel.set_xlabel("points of both clouds", fontsize=9)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5, fontsize=8)
    figure.savefig(path, dpi=130)
