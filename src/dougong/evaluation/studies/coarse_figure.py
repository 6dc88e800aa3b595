"""The figure of the study of coarse methods: success, and convergence against iterations."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.tabulate import chosen, distinct, new_figure, numbers

Rows = Sequence[Mapping[str, Any]]


def draw_coarse(rows: Rows, table: Rows, path: Path) -> None:
    """Draw how often methods lead to the truth, and errors and finds over iterations."""
    figure = new_figure(13.0, 4.2)
    panels = figure.subplots(1, 3)
    _draw_rates(panels[0], table)
    _draw_iterations(panels[1], chosen(rows, part="fine iterations"))
    _draw_samples(panels[2], chosen(rows, part="samples"))
    figure.savefig(path, dpi=130)


def _draw_rates(panel: Any, table: Rows) -> None:
    """Draw how often the first pose leads to the truth, per method and place."""
    groups = [on for (on,) in distinct(table, "on") if on == "buildings" or " " in on]
    methods = list(dict.fromkeys(row["method"] for row in table if row["on"] in groups))
    methods = [m for m in methods if m != "ours"] if "plan" in methods else methods
    width = 0.8 / len(groups)
    for number, on in enumerate(groups):
        at, values = [], []
        for k, method in enumerate(methods):
            # On objects our method is the search over all rotations, on buildings that of the plan.
            wanted = ("plan", "ours") if method == "plan" else (method,)
            at.append(k + width * (number - (len(groups) - 1) / 2))
            found = [row for row in chosen(table, on=on) if row["method"] in wanted]
            values.append(found[0]["fitted_percent"] if found else np.nan)
        panel.bar(at, values, 0.9 * width, label=on)
    panel.set_xticks(range(len(methods)), ["ours" if m == "plan" else m for m in methods])
    panel.tick_params(labelsize=8)
    panel.set_ylim(0, 105)
    panel.set_ylabel("first pose is correct after the fine fit, percent", fontsize=9)
    panel.legend(fontsize=7)


def _draw_iterations(panel: Any, rows: Rows) -> None:
    for (method,) in distinct(rows, "method"):
        line = chosen(rows, method=method)
        steps = [most for (most,) in distinct(line, "most_iterations_per_level")]
        medians = [
            float(np.median(numbers(chosen(line, most_iterations_per_level=most), "pose95_mm")))
            for most in steps
        ]
        panel.plot(steps, medians, "o-", ms=3, label=method)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel("most fine iterations per level", fontsize=9)
    panel.set_ylabel("TRE95 from the first coarse pose, mm, median", fontsize=9)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)


def _draw_samples(panel: Any, rows: Rows) -> None:
    for (method,) in distinct(rows, "method"):
        line = chosen(rows, method=method)
        counts = [count for (count,) in distinct(line, "samples")]
        for key, style in (("is_first_right", "-"), ("is_listed", "--")):
            shares = [
                100.0 * float(np.mean([row[key] for row in chosen(line, samples=count)]))
                for count in counts
            ]
            label = f"{method}, {'first pose' if key == 'is_first_right' else 'one of eight'}"
            colour = "C3" if method == "sac-ia" else "C4"
            panel.plot(counts, shares, f"o{style}", ms=3, color=colour, label=label)
    panel.set_xscale("log")
    panel.set_ylim(-3, 103)
    panel.set_xlabel("samples drawn (SAC-IA) or bases (4PCS)", fontsize=9)
    panel.set_ylabel("pairs with a right coarse pose, percent", fontsize=9)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)
