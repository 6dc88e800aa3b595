"""Objects of unknown attitude: precision, recall and errors of every coarse method, by level.

Every method proposes poses; thinning, fine fit and verdict are the same for all. The shapes are
those of ModelNet40 with ``--data`` (``modelnet40_half/modelnet40_half.npz``), else what stands on
our generated sites. Levels, motions, counts: `dougong.evaluation.modelnet`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError
from dougong.evaluation.modelnet import Ladder, Trial, climb, summarise
from dougong.evaluation.object_convergence import ITERATIONS, converging_object
from dougong.evaluation.object_symmetry import describe_shape
from dougong.evaluation.site import burner, lion, stele
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.studies.objects_figure import draw_objects
from dougong.evaluation.tabulate import as_text, chosen, distinct, spread
from dougong.pipeline.progress import Progress
from dougong.typing import Points

RUNS, QUICK_RUNS = 1, 1
ARCHIVE = Path("modelnet40_half/modelnet40_half.npz")
EVERY, QUICK_EVERY = 8, 39
"""Every so-many-th shape of the archive is taken: one pose of each level and motion per run."""
LADDER = Ladder(levels=("L0", "L1", "L2"), motions=("45", "any"), poses=1)
QUICK_LADDER = Ladder(levels=("L1",), motions=("any",), poses=1)
GENERATED = {"stele": stele, "lion": lion, "burner": burner}
DENSE = 10_000
"""Points of a generated shape that pairs are drawn from, as many as the archive's have."""
AGAINST = (
    "the true pose: correct is within 5 degrees and 0.05 radii of it; symmetric: of any pose that "
    "a symmetry of the shape makes equal, an ambiguous answer counting where it lists one"
)
COLUMNS = {
    "level": "level",
    "motion": "motion",
    "shapes": "shapes",
    "method": "method",
    "n": "n",
    "returned": "returned",
    "wrong": "wrong",
    "precision_percent": "precision %",
    "recall_percent": "recall %",
    "precision_symmetric_percent": "symmetric %",
    "recall_symmetric_percent": "recall %",
    "rre_median_deg": "error deg",
    "rre_mean_deg": "mean",
    "rre_symmetric_median_deg": "symmetric",
    "rre_symmetric_mean_deg": "mean",
    "seconds": "seconds",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Climb the ladder with every shape and method."""
    ladder = QUICK_LADDER if setting.is_quick else LADDER
    shapes = shapes_of(setting)

    def measure(name: str, seed: int, points: int) -> dict[str, Any]:
        one = ladder.model_copy(update={"seed": seed, "points": points})
        return {"rows": list(object_rows(name, shapes[name], one, setting.is_quick))}

    seeds = setting.seeds(RUNS, QUICK_RUNS)
    points = setting.points or ladder.points
    keys = [(name, seed, points) for seed in seeds for name in shapes]
    rows = [row for one in measured(setting, keys, measure, progress) for row in one["rows"]]
    table = object_lines(chosen(rows, part="pairs"))
    text = (
        f"Of {len(shapes)} shapes. Returned: status ok; precision: correct of these, recall: "
        "correct of all n. Wrong: ok, and no symmetry of the\nshape makes it right. Errors: of the "
        "rotation of the best pose of all pairs, median and mean; then up to symmetry.\n\n"
        + as_text(table, COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_objects(rows, table, path),
    )


def shapes_of(setting: Setting) -> dict[str, Points]:
    """Return the shapes by name, points (n, 3) in the unit sphere: the archive's or generated."""
    if setting.data is not None:
        return shapes_in(setting.data, setting.is_quick)
    shapes = {}
    for name in ("lion",) if setting.is_quick else GENERATED:
        points = GENERATED[name]().samples(DENSE, np.random.default_rng(0))[0]
        points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
        shapes[name] = points / np.linalg.norm(points, axis=1).max()
    return shapes


def shapes_in(data: Path, is_quick: bool) -> dict[str, Points]:
    """Return the chosen shapes of the archive in the data folder.

    Raises
    ------
    InputError
        The folder lacks the archive.
    """
    path = data / ARCHIVE
    if not path.is_file():
        msg = f"there is no archive {path}. Leave --data out for generated objects."
        raise InputError(msg)
    with np.load(path) as archive:
        names = archive.files[:: QUICK_EVERY if is_quick else EVERY]
        return {name: archive[name].astype(np.float64) for name in names}


def object_rows(
    name: str, points: Points, ladder: Ladder, is_quick: bool = False
) -> Iterator[dict[str, Any]]:
    """Yield every method's answers on one shape, and how its first pose converges.

    The latter where the shape has no symmetry.
    """
    shape = describe_shape(name, points)
    about = {"seed": ladder.seed}
    for trial in climb(shape, ladder):
        yield {**about, "part": "pairs", **asdict(trial)}
    steps = ITERATIONS[::3] if is_quick else ITERATIONS
    if len(shape.symmetries):
        return
    for level in ladder.levels[1:] or ladder.levels:
        for row in converging_object(shape, level, ladder.motions[-1], ladder, steps):
            yield {**about, "part": "iterations", **row}


def object_lines(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per level, motion, method and group of shapes, as the study's table has them."""
    return [_object_line(line, rows) for line in summarise([_trial(row) for row in rows])]


def _trial(row: Mapping[str, Any]) -> Trial:
    """Return a kept row as the trial it was."""
    values = {name: row[name] for name in Trial.__slots__}
    for name in ("rre_deg", "rte", "rre_symmetric_deg", "rte_symmetric"):
        values[name] = float("nan") if values[name] is None else values[name]
    return Trial(**values)


def _object_line(line: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    keys = ("level", "motion", "method")
    group = chosen(rows, **{key: line[key] for key in keys})
    if line["shapes"] != "all":
        group = chosen(group, has_symmetry=False)
    return {
        "level": line["level"],
        "motion": line["motion"],
        "shapes": line["shapes"],
        "method": line["method"],
        "n": line["pairs"],
        "seeds": " ".join(str(seed) for (seed,) in distinct(group, "seed")),
        "returned": line["ok"],
        "ambiguous": line["ambiguous"],
        "wrong": line["wrong_symmetric"],
        "precision_percent": _percent(line["precision"]),
        "recall_percent": _percent(line["recall"]),
        "precision_symmetric_percent": _percent(line["precision_symmetric"]),
        "recall_symmetric_percent": _percent(line["recall_symmetric"]),
        "fitted_percent": _percent(line["best_correct_symmetric"]),
        "rre_median_deg": _rounded(line["rre_deg_median"]),
        "rre_mean_deg": _rounded(line["rre_deg_mean"]),
        "rre_max_deg": spread(group, "rre_deg")["rre_deg_max"],
        "rre_symmetric_median_deg": _rounded(line["rre_symmetric_deg_median"]),
        "rre_symmetric_mean_deg": _rounded(line["rre_symmetric_deg_mean"]),
        "seconds": round(line["seconds_median"], 2),
    }


def _percent(share: float) -> float | None:
    return None if np.isnan(share) else round(100.0 * share, 2)


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 3)
