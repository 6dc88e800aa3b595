"""Hard and impossible pairs: the matrix of scenes, cases and seeds, by verdict.

Five generated scenes and six places that repeat; with a data folder also its two meshes. The
answer that each case must get is written down in `dougong.evaluation.hard`. A run that is stopped
goes on where it was.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from dougong.errors import InputError
from dougong.evaluation.copies import COPIES
from dougong.evaluation.hard import GENERATED, OTHER_PLACE, SCENES, Maker, cases_on, is_missed, run
from dougong.evaluation.hard_trials import Base
from dougong.evaluation.mesh import load_mesh
from dougong.evaluation.scenes import Scene, make_scene, scan_mesh
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.pipeline.progress import Progress

RUNS, QUICK_RUNS = 10, 1
QUICK = {"lidar_points": 50_000, "photogrammetry_points": 35_000}
QUICK_CASES = ("plain", "part", "mirror-x", "feet", OTHER_PLACE)
VERDICTS = ("right", "ambiguous", "failed", "WRONG")
COLOURS = {"right": "#2c7a4b", "ambiguous": "#d9a521", "failed": "#8a8a8a", "WRONG": "#c0271d"}
FILES = {
    "nuyda": ("nuyda_house/nuyda.ply", False),
    "monastery": ("monastery_mesh/samurai_monastry.obj.gz", True),
}
"""Where the data folder has the meshes, and whether their y is up."""


def study(setting: Setting, progress: Progress) -> Findings:
    """Put every scene through every case; quick: the hall, five cases, fewer points."""
    scenes = GENERATED if setting.data is None else SCENES
    scenes = scenes[:1] if setting.is_quick else (*scenes, *COPIES)
    make = maker(setting.data)
    surveys: dict[Any, Base] = {}

    def measure(scene: str, seed: int, case: str) -> dict[str, Any]:
        if any(key[:2] != (scene, seed) for key in surveys):
            surveys.clear()
        return run(case, scene, seed, make, surveys, **(QUICK if setting.is_quick else {}))

    keys = [
        (scene, seed, case)
        for seed in setting.seeds(RUNS, QUICK_RUNS)
        for scene in scenes
        for case in cases_on(scene)
        if not setting.is_quick or case in QUICK_CASES
    ]
    rows = measured(setting, keys, measure, progress)
    table = summary(rows)
    return Findings(
        rows=rows,
        table=table,
        against="the true pose of each pair and the answer that its case must get",
        text=text(table),
        draw=lambda path: draw_verdicts(table, path),
    )


def maker(data: Path | None) -> Maker:
    """Return what surveys a place by its name: a generated one, or a mesh of the data folder.

    Raises
    ------
    InputError
        The data folder lacks a mesh.
    """

    @cache
    def mesh(name: str) -> Any:
        path, is_y_up = FILES[name]
        if data is None or not (data / path).is_file():
            msg = (
                f"there is no mesh {data}/{path}. Leave --data out for the generated scenes alone."
            )
            raise InputError(msg)
        return load_mesh(data / path, is_y_up=is_y_up)

    def make(name: str, seed: int, *, site: bool = True, **options: Any) -> Scene:
        if name in GENERATED:
            return make_scene(name, seed, site=site, **options)
        vertices, faces = mesh(name)
        return scan_mesh(vertices, faces, seed=seed, name=name, ground=site, **options)

    return make


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per case and expected answer, last one over all: pairs by verdict."""
    kinds = list(dict.fromkeys((row["case"], row["expected"]) for row in rows))
    table = []
    for kind in [*kinds, ("all", "")]:
        chosen = [row for row in rows if kind in ((row["case"], row["expected"]), ("all", ""))]
        line: dict[str, Any] = {"case": kind[0], "expected": kind[1], "pairs": len(chosen)}
        for verdict in VERDICTS:
            line[verdict.lower()] = sum(row["verdict"] == verdict for row in chosen)
        missed = [f"{row['case']} {row['scene']} {row['seed']}" for row in chosen if is_missed(row)]
        table.append({**line, "missed": len(missed), "missed_pairs": "; ".join(missed)})
    return table


def text(table: Sequence[Mapping[str, Any]]) -> str:
    """Return the table for a terminal."""
    lines = [
        "Pairs by verdict. WRONG: ok with TRE95 above 50 mm, or where no pose or no single pose is",
        "true. Missed: WRONG, or not right where the pair has one answer.",
        "",
        f"{'':18}{'expected':11}{'pairs':>6}{'right':>7}{'ambiguous':>11}{'failed':>8}{'WRONG':>7}"
        f"{'missed':>8}",
    ]
    for row in table:
        lines.append(
            f"{row['case']:18}{row['expected']:11}{row['pairs']:>6}{row['right']:>7}"
            f"{row['ambiguous']:>11}{row['failed']:>8}{row['wrong']:>7}{row['missed']:>8}"
        )
    return "\n".join(lines)


def draw_verdicts(table: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the share of every verdict, a bar per case, into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 0.24 * len(table) + 1.4), layout="constrained")
    FigureCanvasAgg(figure)
    panel = figure.subplots()
    names = [f"{row['case']} ({row['expected']})" if row["expected"] else "all" for row in table]
    left = [0.0] * len(table)
    for verdict in VERDICTS:
        share = [100.0 * row[verdict.lower()] / max(row["pairs"], 1) for row in table]
        panel.barh(names, share, left=left, color=COLOURS[verdict], label=verdict)
        left = [a + b for a, b in zip(left, share, strict=True)]
    panel.set_ylim(len(set(names)) - 0.5, -0.5)
    panel.set_xlim(0, 100)
    panel.tick_params(labelsize=8)
    panel.set_xlabel("percent of the pairs; in brackets the answer the case must get", fontsize=9)
    figure.legend(loc="outside upper center", ncols=4, fontsize=9)
    figure.savefig(path, dpi=130)
