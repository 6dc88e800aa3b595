"""Coarse methods: precision and recall on buildings and on ModelNet40, and how they converge.

Every method proposes poses; what follows (fine fit, verdict) is the same for all, and may abstain.
Precision: correct / returned. Recall: correct / all (METHOD.md 5). With ``--data`` the folder's
``modelnet40_half/modelnet40_half.npz`` is climbed too (`dougong.evaluation.modelnet`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError
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
from dougong.evaluation.modelnet import Ladder, Trial, run_ladder, summarise
from dougong.evaluation.scenes import BUILDERS, make_scene
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.studies.coarse_figure import draw_coarse
from dougong.evaluation.tabulate import as_text, chosen, distinct, numbers, spread
from dougong.pipeline.progress import Progress
from dougong.typing import Points

RUNS, QUICK_RUNS = 3, 1
POINTS, QUICK_POINTS = 250_000, 30_000
QUICK_KINDS = ("hall",)
ARCHIVE = Path("modelnet40_half/modelnet40_half.npz")
SHAPES, QUICK_SHAPES = 13, 2
"""Shapes of the archive that are taken, evenly: one pose of each per run."""
LADDER = Ladder(levels=("L0", "L1", "L2"), motions=("any",), poses=1)
QUICK_LADDER = Ladder(levels=("L1",), motions=("any",), poses=1)
AGAINST = (
    "the true pose: on buildings correct is TRE95 of at most 50 mm (a coarse pose: right within 2 "
    "degrees of yaw and 0.5 m in plan), on ModelNet40 within 5 degrees and 0.05 radii"
)
COLUMNS = {
    "on": "on",
    "method": "method",
    "n": "n",
    "first_right_percent": "first right %",
    "listed_percent": "among 8 %",
    "fitted_percent": "fitted %",
    "returned": "returned",
    "precision_percent": "precision %",
    "recall_percent": "recall %",
    "recall_symmetric_percent": "with symmetry %",
    "error": "error",
    "error_unit": "of",
    "seconds": "seconds",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Compare the methods on every building, and on ModelNet40 if its folder is given."""
    kinds = QUICK_KINDS if setting.is_quick else tuple(BUILDERS)
    points = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)
    ladder = QUICK_LADDER if setting.is_quick else LADDER
    shapes = shapes_of(setting)

    def measure(on: str, name: str, seed: int, points: int) -> dict[str, Any]:
        if on == "buildings":
            return {"rows": list(building_rows(name, seed, points, setting.is_quick))}
        one = ladder.model_copy(update={"seed": seed})
        return {"rows": list(object_rows(name, shapes[name], one))}

    keys: list[tuple[Any, ...]] = []
    for seed in setting.seeds(RUNS, QUICK_RUNS):
        keys += [("buildings", kind, seed, points) for kind in kinds]
        keys += [("modelnet40", name, seed, ladder.points) for name in shapes]
    rows = [row for one in measured(setting, keys, measure, progress) for row in one["rows"]]
    table = summary(rows)
    text = (
        "Over n pairs. First right, among 8: the poses as proposed; fitted: the first one is "
        "correct after the fine fit.\nReturned, precision, recall: of the whole registration that "
        "starts from them, which may abstain. Error: median, of\nthe first pose fitted. Seconds: "
        "median, on buildings of the coarse search alone.\n\n" + as_text(table, COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_coarse(rows, table, path),
    )


def shapes_of(setting: Setting) -> dict[str, Points]:
    """Return the chosen shapes of the archive in the data folder; none without a folder.

    Raises
    ------
    InputError
        The folder lacks the archive.
    """
    if setting.data is None:
        return {}
    path = setting.data / ARCHIVE
    if not path.is_file():
        msg = f"there is no archive {path}. Leave --data out for the generated buildings alone."
        raise InputError(msg)
    wanted = QUICK_SHAPES if setting.is_quick else SHAPES
    with np.load(path) as archive:
        names = archive.files[:: max(1, len(archive.files) // wanted)][:wanted]
        return {name: archive[name].astype(np.float64) for name in names}


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


def object_rows(name: str, points: Points, ladder: Ladder) -> Iterator[dict[str, Any]]:
    """Yield every method's answer on one shape of ModelNet40."""
    for trial in run_ladder({name: points}, ladder):
        yield {"on": "modelnet40", "part": "pairs", "seed": ladder.seed, **asdict(trial)}


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per method on the buildings, and per level, motion and method on ModelNet40."""
    table = []
    pairs = chosen(rows, part="pairs", on="buildings")
    groups = [(kind, chosen(pairs, building=kind)) for (kind,) in distinct(pairs, "building")]
    for name, group in [("buildings", pairs), *groups]:
        for (method,) in distinct(group, "method"):
            table.append(_building_line(name, method, chosen(group, method=method)))
    objects = chosen(rows, part="pairs", on="modelnet40")
    for line in summarise([_trial(row) for row in objects]):
        if line["shapes"] == "all":
            table.append(_object_line(line, objects))
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
        "wrong": len(ok) - right if with_verdict else None,
        "precision_percent": _percent(right, len(ok)),
        "recall_percent": _percent(right, len(with_verdict)),
        "recall_symmetric_percent": None,
        "error": error["fitted95_mm"],
        "error_min": error["fitted95_mm_min"],
        "error_max": error["fitted95_mm_max"],
        "error_unit": "mm, TRE95",
        "seconds": seconds["coarse_s"],
    }


def _trial(row: Mapping[str, Any]) -> Trial:
    """Return a kept row as the trial it was."""
    values = {name: row[name] for name in Trial.__slots__}
    for name in ("rre_deg", "rte"):
        values[name] = float("nan") if values[name] is None else values[name]
    return Trial(**values)


def _object_line(line: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    keys = {key: line[key] for key in ("level", "motion", "method")}
    group = chosen(rows, **keys)
    first = sum(row["is_correct"] for row in group)
    rre = numbers(group, "rre_deg")
    rre = rre[np.isfinite(rre)]
    return {
        "on": f"ModelNet40 {line['level']} {line['motion']}",
        "method": line["method"],
        "n": line["pairs"],
        "seeds": " ".join(str(seed) for (seed,) in distinct(group, "seed")),
        "first_right_percent": None,
        "listed_percent": None,
        "fitted_percent": _percent(first, len(group)),
        "returned": line["ok"],
        "wrong": line["ok"] - sum(row["is_correct"] for row in chosen(group, status="ok")),
        "precision_percent": round(100.0 * line["precision"], 2) if line["ok"] else None,
        "recall_percent": round(100.0 * line["recall"], 2),
        "recall_symmetric_percent": round(100.0 * line["recall_symmetric"], 2),
        "error": round(float(np.median(rre)), 3) if len(rre) else None,
        "error_min": round(float(rre.min()), 3) if len(rre) else None,
        "error_max": round(float(rre.max()), 3) if len(rre) else None,
        "error_unit": "degrees, rotation",
        "seconds": round(line["seconds_median"], 2),
    }


def _percent(part: int, whole: int) -> float | None:
    return round(100.0 * part / whole, 2) if whole else None
