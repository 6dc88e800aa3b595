"""The paper's Table 4 on five generated kinds of building: the whole program, judged by the truth.

Files of two surveys go through `dougong run`. A to D are those of METHOD.md section 5: A the pose
alone (TRE95 against the best rigid pose), B what the drone cloud's bending leaves by itself, C all
of it between corresponding points, D the distances that are observed, noise included.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dougong.evaluation.building_runs import PAIRS, run_pair
from dougong.evaluation.scenes import BUILDERS
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.tabulate import as_text, chosen, distinct, new_figure, numbers, spread
from dougong.pipeline.progress import Progress, Silent

RUNS, QUICK_RUNS = 3, 1
POINTS, QUICK_POINTS = 1_000_000, 60_000
QUICK_KINDS = ("hall", "wall")
AGAINST = (
    "the generator's exact pose and noise-free surface: 95 % over the area that both sensors saw; "
    "D against the other cloud (M3C2)"
)
FIGURES = {
    "pose95_mm": 2,
    "bending_floor95_mm": 2,
    "total95_mm": 2,
    "observed95_mm": 2,
    "rotation_error_deg": 5,
    "translation_error_mm": 2,
    "source_reduction_percent": 2,
    "target_reduction_percent": 2,
    "total_s": 1,
}
"""Columns whose median and range are told, with their digits."""
SHOWN_MM = (0.1, 200.0)
"""What the figure shows; no bending is below it, a wrong pose beyond it."""
COLUMNS = {
    "pair": "pair",
    "building": "building",
    "n": "n",
    "ok": "ok",
    "wrong": "wrong",
    "source_points_before": "points in",
    "source_reduction_percent": "less %",
    "target_points_before": "other in",
    "target_reduction_percent": "less %",
    "pose95_mm": "A mm",
    "pose95_mm_max": "max",
    "bending_floor95_mm": "B mm",
    "total95_mm": "C mm",
    "observed95_mm": "D mm",
    "rotation_error_deg": "turn deg",
    "pose_level": "A level",
    "total_level": "C level",
    "total_s": "seconds",
}


def study(setting: Setting, progress: Progress) -> Findings:
    """Run every kind of pair of every building; quick: scanner and drone, two buildings, small."""
    kinds = QUICK_KINDS if setting.is_quick else tuple(BUILDERS)
    pairs = list(PAIRS)[:1] if setting.is_quick else list(PAIRS)
    points = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)

    def measure(pair: str, kind: str, seed: int, points: int) -> dict[str, Any]:
        row = run_pair(PAIRS[pair](kind, seed, points), Silent())
        return {"pair": pair, "building": kind, "seed": seed, **row}

    keys = [
        (pair, kind, seed, points)
        for seed in setting.seeds(RUNS, QUICK_RUNS)
        for pair in pairs
        for kind in kinds
    ]
    rows = measured(setting, keys, measure, progress)
    table = summary(rows)
    text = (
        "Medians over n surveys, drawn anew for each seed. 95 % errors: A pose, B bending alone, "
        "C total, D observed\ndistances with noise. Levels of accuracy: USIBD, 95 %, of the worst "
        "run.\n\n" + as_text(table, COLUMNS)
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_errors(rows, path),
    )


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per kind of pair and building: median, smallest and largest of every figure."""
    table = []
    for pair, kind in distinct(rows, "pair", "building"):
        group = chosen(rows, pair=pair, building=kind)
        said_ok = chosen(group, status="ok")
        line: dict[str, Any] = {
            "pair": pair,
            "building": kind,
            "n": len(group),
            "seeds": " ".join(str(row["seed"]) for row in group),
            "ok": len(said_ok),
            "wrong": sum(not row["is_correct"] for row in said_ok),
        }
        for name in ("source", "target"):
            for when in ("before", "after"):
                key = f"{name}_points_{when}"
                line[key] = round(float(numbers(group, key).mean()))
        for name, digits in FIGURES.items():
            line |= spread(group, name, digits)
        line["bytes_peak"] = int(numbers(group, "peak_memory_bytes").max())
        worst = max(said_ok, key=lambda row: row["total95_mm"], default={})
        line |= {key: worst.get(key) for key in ("pose_level", "total_level")}
        table.append(line)
    return table


def draw_errors(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw A, B, C and D of every run, a panel per kind of pair, into a PNG."""
    pairs = [pair for (pair,) in distinct(rows, "pair")]
    figure = new_figure(4.6 * len(pairs) + 0.8, 4.0)
    panels = figure.subplots(1, len(pairs), sharey=True, squeeze=False)[0]
    ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200)
    told = {
        "pose95_mm": "A: pose",
        "bending_floor95_mm": "B: bending alone",
        "total95_mm": "C: total",
        "observed95_mm": "D: observed, with noise",
    }
    for panel, pair in zip(panels, pairs, strict=True):
        group = chosen(rows, pair=pair)
        kinds = [kind for (kind,) in distinct(group, "building")]
        for number, (key, label) in enumerate(told.items()):
            colour = f"C{number}"
            for row in group:
                value = row.get(key)
                if value is None or value < SHOWN_MM[0]:
                    continue
                at = kinds.index(row["building"]) + 0.18 * (number - 1.5)
                # Off the scale: an arrow at its edge.
                marker = "^" if value > SHOWN_MM[1] else "o"
                face = colour if row["status"] == "ok" else "none"
                style = {"marker": marker, "facecolors": face, "edgecolors": colour}
                panel.scatter(at, min(value, SHOWN_MM[1]), s=26, zorder=3, **style)
            panel.scatter([], [], s=26, color=colour, label=label)
        for level, edge in (("LOA40", 5.0), ("LOA30", 15.0), ("LOA20", 50.0)):
            panel.axhline(edge, color="0.75", linewidth=0.8)
            panel.annotate(level, (len(kinds) - 0.5, edge), fontsize=7, color="0.4", ha="right")
        panel.set_xticks(range(len(kinds)), kinds)
        panel.set_xlim(-0.5, len(kinds) - 0.5)
        panel.set_yscale("log")
        panel.set_ylim(SHOWN_MM[0], 1.15 * SHOWN_MM[1])
        panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        panel.set_title(pair, fontsize=10)
    panels[0].set_ylabel("95 % error, mm (hollow: ambiguous)")
    handles, labels = panels[0].get_legend_handles_labels()
    across = 2 if len(pairs) == 1 else 4
    figure.legend(handles, labels, loc="outside upper center", ncols=across, fontsize=9)
    figure.savefig(path, dpi=130)
