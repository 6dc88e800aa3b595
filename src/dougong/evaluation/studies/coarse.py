"""Coarse methods: precision and recall on buildings, and how they converge.

Every method proposes poses; what follows (fine fit, verdict) is the same for all, and may abstain.
Precision: correct / returned. Recall: correct / all (METHOD.md 5). Objects: the study `objects`.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dougong.evaluation.building_runs import DRONE_SHARE
from dougong.evaluation.coarse_trials import (
    FINE_ITERATIONS,
    METHODS,
    converging,
    judged,
    made_ready,
    proposed,
    sampling,
)
from dougong.evaluation.scenes import BUILDERS, make_scene
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.studies.coarse_figure import draw_coarse
from dougong.evaluation.tabulate import as_text, chosen, distinct, spread
from dougong.pipeline.progress import Progress

RUNS, QUICK_RUNS = 3, 1
POINTS, QUICK_POINTS = 250_000, 30_000
QUICK_KINDS = ("hall",)
AGAINST = (
    "the true pose: correct is TRE95 of at most 50 mm; a coarse pose is right within 2 degrees of "
    "yaw and 0.5 m in plan"
)
COLUMNS = {
    "on": "on",
    "method": "method",
    "n": "n",
    "first_right_percent": "first right %",
    "listed_percent": "among 8 %",
    "fitted_percent": "fitted %",
    "returned": "returned",
    "wrong": "wrong",
    "precision_percent": "precision %",
    "recall_percent": "recall %",
    "error": "error",
    "error_unit": "of",
    "seconds": "seconds",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Compare the methods on every building."""
    kinds = QUICK_KINDS if setting.is_quick else tuple(BUILDERS)
    points = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)

    def measure(kind: str, seed: int, points: int) -> dict[str, Any]:
        return {"rows": list(building_rows(kind, seed, points, setting.is_quick))}

    keys = [(kind, seed, points) for seed in setting.seeds(RUNS, QUICK_RUNS) for kind in kinds]
    rows = [row for one in measured(setting, keys, measure, progress) for row in one["rows"]]
    table = summary(rows)
    text = (
        "Over n pairs. First right, among 8: the poses as proposed; fitted: the first one is "
        "correct after the fine fit.\nReturned, precision, recall: of the whole registration that "
        "starts from them, which may abstain. Error: median, of\nthe first pose fitted. Seconds: "
        "median, of the coarse search alone.\n\n" + as_text(table, COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_coarse(rows, table, path),
    )


def building_rows(
    kind: str, seed: int, points: int, is_quick: bool = False
) -> Iterator[dict[str, Any]]:
    """Yield what every method does on one building: its poses, its convergence, the verdict.

    Quick: few steps of the convergence, and the verdict of the plan search alone.
    """
    flown = round(DRONE_SHARE * points)
    scene = make_scene(kind, seed, lidar_points=points, photogrammetry_points=flown)
    ready = made_ready(scene)
    about = {"on": "buildings", "building": kind, "seed": seed, "points": points}
    for method in METHODS:
        row, found = proposed(ready, method)
        most = FINE_ITERATIONS[::3] if is_quick else FINE_ITERATIONS
        steps = list(converging(ready, found, most))
        row |= {"fitted95_mm": None, "is_fitted": False}
        if steps:
            row |= {"fitted95_mm": steps[-1]["pose95_mm"], "is_fitted": steps[-1]["is_correct"]}
        verdict = {"status": None} if is_quick and method != "plan" else judged(scene, method)
        yield {**about, "part": "pairs", "method": method, **row, **verdict}
        for step in steps:
            yield {**about, "part": "fine iterations", "method": method, **step}
    for sample in sampling(ready, seed):
        yield {**about, "part": "samples", **sample}


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per method on all buildings, and on each."""
    table = []
    pairs = chosen(rows, part="pairs", on="buildings")
    groups = [(kind, chosen(pairs, building=kind)) for (kind,) in distinct(pairs, "building")]
    for name, group in [("buildings", pairs), *groups]:
        for (method,) in distinct(group, "method"):
            table.append(_building_line(name, method, chosen(group, method=method)))
    return table


def _building_line(name: str, method: str, group: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    ok = chosen(group, status="ok")
    right = sum(row["is_correct"] for row in ok)
    with_verdict = [row for row in group if row["status"] is not None]
    error, seconds = spread(group, "fitted95_mm", 2), spread(group, "coarse_s", 2)
    return {
        "on": name,
        "method": method,
        "n": len(group),
        "seeds": " ".join(str(seed) for (seed,) in distinct(group, "seed")),
        "first_right_percent": _percent(sum(row["is_first_right"] for row in group), len(group)),
        "listed_percent": _percent(sum(row["is_listed"] for row in group), len(group)),
        "fitted_percent": _percent(sum(row["is_fitted"] for row in group), len(group)),
        "returned": len(ok) if with_verdict else None,
        "ambiguous": len(chosen(group, status="ambiguous")) if with_verdict else None,
        "wrong": len(ok) - right if with_verdict else None,
        "precision_percent": _percent(right, len(ok)),
        "recall_percent": _percent(right, len(with_verdict)),
        "error": error["fitted95_mm"],
        "error_min": error["fitted95_mm_min"],
        "error_max": error["fitted95_mm_max"],
        "error_unit": "mm, TRE95",
        "seconds": seconds["coarse_s"],
    }


def _percent(part: int, whole: int) -> float | None:
    return round(100.0 * part / whole, 2) if whole else None
