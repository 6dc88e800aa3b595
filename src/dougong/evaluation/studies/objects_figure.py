"""The figure of the study of objects: success by level, convergence, errors."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.studies.coarse_figure import beside, draw_rates
from dougong.evaluation.tabulate import chosen, distinct, new_figure, numbers

Rows = Sequence[Mapping[str, Any]]


def draw_objects(rows: Rows, table: Rows, path: Path) -> None:
    """Draw how often each method's best pose is right, how fast it gets there, and its errors."""
    figure = new_figure(13.0, 5.0)
    panels = figure.subplots(1, 3)
    draw_rates(panels[0], chosen(table, shapes="all"), ("level", "motion"))
    _draw_object_iterations(panels[1], chosen(rows, part="iterations"))
    _draw_object_errors(panels[2], chosen(rows, part="pairs"))
    figure.savefig(path, dpi=130)


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
    beside(panel, 3)


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
    beside(panel, 3)
