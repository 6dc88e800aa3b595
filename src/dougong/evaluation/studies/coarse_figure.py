"""The figure of the study of coarse methods: success, and convergence against iterations."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.tabulate import chosen, distinct, new_figure, numbers

Rows = Sequence[Mapping[str, Any]]
_DOTS = {"ms": 3, "ls": "-"}
_RINGS = {"ms": 8, "mfc": "none", "ls": "--"}


def draw_coarse(rows: Rows, table: Rows, path: Path) -> None:
    """Draw how often methods lead to the truth, and errors and finds over iterations."""
    figure = new_figure(13.0, 4.2)
    panels = figure.subplots(1, 3)
    draw_rates(panels[0], chosen(table, on="buildings"))
    _draw_iterations(panels[1], chosen(rows, part="fine iterations"))
    _draw_samples(panels[2], chosen(rows, part="samples"))
    figure.savefig(path, dpi=130)


def beside(panel: Any, columns: int) -> None:
    """Put the legend above the panel, where it hides nothing."""
    panel.legend(
        fontsize=7,
        ncol=columns,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        frameon=False,
        handlelength=3,
    )


def draw_rates(panel: Any, table: Rows, by: tuple[str, ...] = ("on",)) -> None:
    """Draw how often the best pose is correct after the fine fit, per method and group."""
    groups = distinct(table, *by)
    methods = [method for (method,) in distinct(table, "method")]
    width = 0.8 / max(len(groups), 1)
    for number, group in enumerate(groups):
        lines = chosen(table, **dict(zip(by, group, strict=True)))
        found = {row["method"]: row["fitted_percent"] for row in lines}
        at = [k + width * (number - (len(groups) - 1) / 2) for k in range(len(methods))]
        values = [found.get(method) for method in methods]
        heights = [np.nan if value is None else value for value in values]
        panel.bar(at, heights, 0.9 * width, label=" ".join(group))
    panel.set_xticks(range(len(methods)), methods, rotation=20)
    panel.tick_params(labelsize=8)
    panel.set_ylim(0, 105)
    panel.set_ylabel("best pose is correct after the fine fit, percent", fontsize=9)
    if len(groups) > 1:
        beside(panel, 3)


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
        # Often the two coincide: rings round the dots, and both are seen.
        for key, style in (("is_first_right", _DOTS), ("is_listed", _RINGS)):
            shares = [
                100.0 * float(np.mean([row[key] for row in chosen(line, samples=count)]))
                for count in counts
            ]
            label = f"{method}, {'first pose' if key == 'is_first_right' else 'one of eight'}"
            colour = "C3" if method == "sac-ia" else "C4"
            panel.plot(counts, shares, marker="o", color=colour, label=label, **style)
    panel.set_xscale("log")
    panel.set_ylim(-3, 103)
    panel.set_xlabel("samples drawn (SAC-IA) or bases (4PCS)", fontsize=9)
    panel.set_ylabel("pairs with a right coarse pose, percent", fontsize=9)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)
