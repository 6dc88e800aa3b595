"""Is the verdict's probability the frequency with which it is right? On generated pairs.

Held out: seeds that the fit has not seen on kinds of building that it has, and kinds that it has
not. The fit itself: ``benchmarks/fit_probability.py``. A run that is stopped goes on where it was.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.calibration import (
    BINS,
    area_under_roc,
    calibration_error,
    error_by_chance,
    measure,
    probabilities,
    reliability,
)
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.trial_pairs import KINDS, TRAINED
from dougong.pipeline.progress import Progress
from dougong.registration.probability import BELIEF

FIRST_SEED = 100_130
"""Seeds below are the fit's."""
RUNS, QUICK_RUNS = 500, 1
GROUPS = ("known kinds", "new kinds", "all", "all with a pose")


def study(setting: Setting, progress: Progress) -> Findings:
    """Register one pair of every kind per run; declared against observed."""
    keys = [(kind, FIRST_SEED + seed) for seed in setting.seeds(RUNS, QUICK_RUNS) for kind in KINDS]
    rows = measured(setting, keys, measure, progress)
    table = [summary(name, group) for name, group in groups(rows).items() if group]
    return Findings(
        rows=rows,
        table=table,
        against="the true pose of each generated pair: right is TRE95 of at most 50 mm",
        text=text(table),
        draw=lambda path: draw_reliability(rows, path),
    )


def groups(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Return the rows by group, as `GROUPS` names them."""
    chosen = (
        [row for row in rows if row["kind"] in TRAINED],
        [row for row in rows if row["kind"] not in TRAINED],
        list(rows),
        [row for row in rows if "probability" in row],
    )
    return dict(zip(GROUPS, chosen, strict=True))


def summary(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what a group of pairs shows.

    A pair whose poses were all refused counts with probability 0, except in the last group.
    """
    p = probabilities(rows, BELIEF)
    is_correct = np.array([bool(row["is_correct"]) for row in rows])
    said_ok = [row for row in rows if row["status"] == "ok"]
    wrong = [row for row in said_ok if not row["is_correct"]]
    count = len(said_ok)
    return {
        "group": name,
        "pairs": len(rows),
        "without_single_answer": sum(not row["is_unique"] for row in rows),
        "calibration_error": round(calibration_error(p, is_correct), 4),
        "calibration_error_by_chance": round(error_by_chance(p), 4),
        "area_under_roc": round(area_under_roc(p, is_correct), 4),
        "ok": count,
        "wrong": len(wrong),
        # Of no wrong one among n: the rate is below this with 95 % confidence (rule of three).
        "wrong_rate_below": None if wrong or not count else round(1 - 0.05 ** (1 / count), 5),
        "ambiguous": sum(row["status"] == "ambiguous" for row in rows),
        "failed": sum(row["status"] == "failed" for row in rows),
    }


def text(table: Sequence[Mapping[str, Any]]) -> str:
    """Return the table for a terminal."""
    lines = [
        "Right: within 50 mm (TRE95). Expected calibration error in "
        f"{BINS} bins, and what so few pairs show by chance where every probability is exact;",
        "ROC: a right pose declared more probable than a wrong one.",
        "",
        f"{'':18}{'pairs':>7}{'no single answer':>18}{'calibration':>13}{'by chance':>11}"
        f"{'ROC area':>10}{'ok':>6}{'wrong':>7}{'ambiguous':>11}{'failed':>8}",
    ]
    for row in table:
        none = row["without_single_answer"] / row["pairs"]
        lines.append(
            f"{row['group']:18}{row['pairs']:>7}{none:>17.0%} {row['calibration_error']:>13.3f}"
            f"{row['calibration_error_by_chance']:>11.3f}"
            f"{row['area_under_roc']:>10.3f}{row['ok']:>6}{row['wrong']:>7}{row['ambiguous']:>11}"
            f"{row['failed']:>8}"
        )
    return "\n".join(lines)


def draw_reliability(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the observed frequency over the declared probability, known and new kinds, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    by_group = groups(rows)
    for panel, name in zip(panels, GROUPS, strict=False):
        chosen = [row for row in by_group[name] if "probability" in row]
        panel.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="declared = observed")
        if chosen:
            p = probabilities(chosen, BELIEF)
            table = reliability(p, np.array([bool(row["is_correct"]) for row in chosen]))
            declared = [row["declared"] for row in table]
            observed = np.array([row["observed"] for row in table])
            low = np.array([row["low95"] for row in table])
            high = np.array([row["high95"] for row in table])
            panel.errorbar(
                declared,
                observed,
                yerr=np.clip([observed - low, high - observed], 0.0, None),
                fmt="o",
                markersize=5,
                color="black",
                ecolor="C0",
                label="observed, 95 % interval",
            )
            for row in table:
                panel.annotate(
                    f"{row['pairs']}",
                    (row["declared"], row["low95"]),
                    textcoords="offset points",
                    xytext=(0, -10),
                    ha="center",
                    fontsize=7,
                    color="0.35",
                )
        panel.set_title(f"{name}: {len(chosen)} pairs with a pose", fontsize=10)
        panel.set_xlim(-0.02, 1.02)
        panel.set_ylim(-0.08, 1.02)
        panel.grid(alpha=0.3)
    figure.supxlabel("declared probability that the pose is right (within 50 mm)", fontsize=10)
    figure.supylabel("share that was right", fontsize=10)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=8)
    figure.savefig(path, dpi=130)
