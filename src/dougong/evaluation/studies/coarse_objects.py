"""The part of the study of coarse methods that is on objects of unknown attitude: ModelNet40."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError
from dougong.evaluation.modelnet import Ladder, Trial, climb, summarise
from dougong.evaluation.object_convergence import ITERATIONS, converging_object
from dougong.evaluation.object_symmetry import describe_shape
from dougong.evaluation.tabulate import chosen, distinct, spread
from dougong.typing import Points

ARCHIVE = Path("modelnet40_half/modelnet40_half.npz")
EVERY, QUICK_EVERY = 6, 39
"""Every so-many-th shape of the archive is taken: one pose of each level and motion per run."""
LADDER = Ladder(levels=("L0", "L1", "L2"), motions=("45", "any"), poses=1)
QUICK_LADDER = Ladder(levels=("L1",), motions=("any",), poses=1)
LINE = (
    *("part", "on", "shapes", "method", "n", "seeds"),
    *("first_right_percent", "listed_percent", "fitted_percent", "returned", "ambiguous", "wrong"),
    *("precision_percent", "recall_percent"),
    *("precision_symmetric_percent", "recall_symmetric_percent"),
    *("error", "error_min", "error_max", "error_mean", "error_symmetric", "error_symmetric_mean"),
    *("error_unit", "seconds"),
)
"""Columns of the study's table, on buildings and on objects."""


def shapes_in(data: Path, is_quick: bool) -> dict[str, Points]:
    """Return the chosen shapes of the archive in the data folder.

    Raises
    ------
    InputError
        The folder lacks the archive.
    """
    path = data / ARCHIVE
    if not path.is_file():
        msg = f"there is no archive {path}. Leave --data out for the generated buildings alone."
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
    about = {"on": "modelnet40", "seed": ladder.seed}
    for trial in climb(shape, ladder):
        yield {**about, "part": "pairs", **asdict(trial)}
    steps = ITERATIONS[::3] if is_quick else ITERATIONS
    if len(shape.symmetries):
        return
    for level in ladder.levels[1:] or ladder.levels:
        for row in converging_object(shape, level, ladder.motions[-1], ladder, steps):
            yield {**about, "part": "object iterations", **row}


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
    group = chosen(rows, **{key: line[key] for key in ("level", "motion", "method")})
    if line["shapes"] != "all":
        group = chosen(group, has_symmetry=False)
    error = spread(group, "rre_deg")
    return {
        **dict.fromkeys(LINE),
        "part": "ModelNet40",
        "on": f"{line['level']} {line['motion']}",
        "shapes": line["shapes"],
        "method": line["method"],
        "n": line["pairs"],
        "seeds": " ".join(str(seed) for (seed,) in distinct(group, "seed")),
        "fitted_percent": _percent(line["best_correct_symmetric"]),
        "returned": line["ok"],
        "ambiguous": line["ambiguous"],
        "wrong": line["wrong_symmetric"],
        "precision_percent": _percent(line["precision"]),
        "recall_percent": _percent(line["recall"]),
        "precision_symmetric_percent": _percent(line["precision_symmetric"]),
        "recall_symmetric_percent": _percent(line["recall_symmetric"]),
        "error": error["rre_deg"],
        "error_min": error["rre_deg_min"],
        "error_max": error["rre_deg_max"],
        "error_mean": _rounded(line["rre_deg_mean"]),
        "error_symmetric": _rounded(line["rre_symmetric_deg_median"]),
        "error_symmetric_mean": _rounded(line["rre_symmetric_deg_mean"]),
        "error_unit": "degrees, rotation",
        "seconds": round(line["seconds_median"], 2),
    }


def _percent(share: float) -> float | None:
    return None if np.isnan(share) else round(100.0 * share, 2)


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 3)
