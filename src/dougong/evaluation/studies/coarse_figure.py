"""The figure of the study of coarse methods: success, and convergence against iterations."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.tabulate import chosen, distinct, new_figure, numbers

Rows = Sequence[Mapping[str, Any]]


def draw_coarse(rows: Rows, table: Rows, path: Path) -> None:
    """Draw how often methods lead to the truth, and errors and finds over iterations.

    Buildings above, objects, where there are any, below.
    """
    objects = chosen(table, part="ModelNet40", shapes="all")
    figure = new_figure(13.0, 8.2 if objects else 4.2)
    panels = figure.subplots(2 if objects else 1, 3, squeeze=False)
    buildings = chosen(table, part="buildings")
    _draw_rates(panels[0][0], [row for row in buildings if row["on"] == "buildings"])
    _draw_iterations(panels[0][1], chosen(rows, part="fine iterations"))
    _draw_samples(panels[0][2], chosen(rows, part="samples"))
    if objects:
        _draw_rates(panels[1][0], objects)
        _draw_object_iterations(panels[1][1], chosen(rows, part="object iterations"))
        _draw_object_errors(panels[1][2], chosen(rows, part="pairs", on="modelnet40"))
    figure.savefig(path, dpi=130)


def _draw_rates(panel: Any, table: Rows) -> None:
    """Draw how often the best pose is correct after the fine fit, per method and place."""
    groups = [on for (on,) in distinct(table, "on")]
    methods = [method for (method,) in distinct(table, "method")]
    width = 0.8 / max(len(groups), 1)
    for number, on in enumerate(groups):
        found = {row["method"]: row["fitted_percent"] for row in chosen(table, on=on)}
        at = [k + width * (number - (len(groups) - 1) / 2) for k in range(len(methods))]
        values = [found.get(method) for method in methods]
        heights = [np.nan if value is None else value for value in values]
        panel.bar(at, heights, 0.9 * width, label=on)
    panel.set_xticks(range(len(methods)), methods, rotation=20)
    panel.tick_params(labelsize=8)
    panel.set_ylim(0, 105)
    panel.set_ylabel("best pose is correct after the fine fit, percent", fontsize=9)
    panel.legend(fontsize=7, loc="lower left")


def _draw_object_iterations(panel: Any, rows: Rows) -> None:
    colours = {method: f"C{k}" for k, (method,) in enumerate(distinct(rows, "method"))}
    for (level, style), (method, colour) in itertools.product(
        zip([level for (level,) in distinct(rows, "level")], ("-", "--", ":"), strict=False),
        colours.items(),
    ):
        line = chosen(rows, level=level, method=method)
        steps = [most for (most,) in distinct(line, "most_iterations_per_level")]
        shares = [
            100.0
            * float(np.mean([r["is_correct"] for r in chosen(line, most_iterations_per_level=n)]))
            for n in steps
        ]
        label = f"{method}, {level}"
        panel.plot(steps, shares, f"o{style}", ms=3, color=colour, label=label)
    panel.set_xscale("log")
    panel.set_ylim(-3, 103)
    panel.set_xlabel("most fine iterations per reach, from the first coarse pose", fontsize=9)
    panel.set_ylabel("shapes without symmetry: correct, percent", fontsize=9)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=6, ncol=2)


def _draw_object_errors(panel: Any, rows: Rows) -> None:
    """Draw the share of pairs by rotation error on the hardest level, any rotation."""
    levels = [level for (level,) in distinct(rows, "level")]
    hardest = chosen(rows, level=levels[-1], motion="any")
    for (method,) in distinct(hardest, "method"):
        found = chosen(hardest, method=method)
        errors = np.sort(numbers(found, "rre_symmetric_deg"))
        share = 100.0 * np.arange(1, len(errors) + 1) / len(found)
        panel.step(np.maximum(errors, 0.01), share, where="post", label=method)
    panel.set_xscale("log")
    panel.set_ylim(-3, 103)
    panel.set_xlabel(f"rotation error up to symmetry, degrees ({levels[-1]}, any)", fontsize=9)
    panel.set_ylabel("pairs, percent", fontsize=9)
    panel.grid(alpha=0.3)
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
