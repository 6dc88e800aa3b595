"""Noise filters over generated pieces and real clouds: a table and the trade-off curves.

As the paper's Table 3: samples of known noise, several runs, mean and spread. Definitions:
METHOD.md section 5 and `dougong.evaluation.denoise`.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.denoise import (
    DENSITIES,
    LEVELS,
    METHODS,
    curve,
    rates,
    scores,
    summary,
)
from dougong.evaluation.denoise_noise import NOISE_KINDS, Pattern, Sample, make_sample
from dougong.evaluation.denoise_real import real_samples
from dougong.evaluation.denoise_shapes import SHAPES
from dougong.evaluation.studies import Findings, Setting
from dougong.pipeline.progress import Progress

PATTERNS: tuple[Pattern, ...] = ("poisson", "gradient", "scan")
RUNS, QUICK_RUNS = 10, 1
QUICK_SHAPES, QUICK_DENSITY = ("facade", "tiles", "statue"), 0.3
COLUMNS = ("noise", "separable", "feature", "flat", "worst_patches", "vegetation")
BY_KIND = tuple(f"separable_{kind}" for kind in NOISE_KINDS.values())


def study(setting: Setting, progress: Progress) -> Findings:
    """Run every filter on every sample.

    Six pieces, each sampled at random, with a density gradient and as a scan, drawn anew in every
    run with 3 % noise; with a data folder also its buildings and clouds with noise added.
    """
    rows: list[dict[str, Any]] = []
    for run, sample in _samples(setting):
        progress.stage(f"{sample.name}, run {run}: {len(sample.points):,} points")
        about = {"sample": sample.name, "run": run, "seed": run, "points": len(sample.points)}
        for method in METHODS:
            found = rates(method.is_kept(sample.points), sample)
            rows.append({**about, "filter": method.name, **found})
        for name, score in scores(sample).items():
            rows.append({**about, "filter": name, "curve": curve(score, sample)})
    measured = [row for row in rows if "curve" not in row]
    return Findings(
        rows=rows,
        table=_table(measured),
        against="the labels of the generated noise and features, known for every point",
        text="\n".join([_text(measured), "", *_along_the_curve(rows)]),
        draw=lambda path: draw_curves(rows, path),
    )


def _samples(setting: Setting) -> Iterator[tuple[int, Sample]]:
    shapes = QUICK_SHAPES if setting.is_quick else tuple(SHAPES)
    patterns = PATTERNS[-1:] if setting.is_quick else PATTERNS
    for seed in setting.seeds(RUNS, QUICK_RUNS):
        for name in shapes:
            shape = SHAPES[name](np.random.default_rng([seed, 1]))
            for pattern in patterns:
                density = DENSITIES[name] * (QUICK_DENSITY if setting.is_quick else 1.0)
                title = f"{name}, {pattern}"
                yield seed, make_sample(title, shape, density=density, pattern=pattern, seed=seed)
        if setting.data is not None:
            for sample in real_samples(setting.data, seed):
                yield seed, sample


def _table(measured: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per sample and filter, percent over the runs; last those over all samples."""
    table = []
    for name in [*dict.fromkeys(row["sample"] for row in measured), "all"]:
        chosen = [row for row in measured if name in (row["sample"], "all")]
        kinds = summary(chosen, "filter", BY_KIND)
        for method, cells in summary(chosen, "filter", COLUMNS).items():
            line: dict[str, Any] = {"sample": name, "filter": method}
            for column, (mean, spread) in zip(COLUMNS, cells, strict=True):
                line[f"{column}_percent"] = None if np.isnan(mean) else round(mean, 2)
                line[f"{column}_spread"] = None if np.isnan(spread) else round(spread, 2)
            for column, (mean, _) in zip(BY_KIND, kinds[method], strict=True):
                line[f"{column}_percent"] = None if np.isnan(mean) else round(mean, 2)
            table.append(line)
    return table


def _text(measured: Sequence[Mapping[str, Any]]) -> str:
    samples = len({row["sample"] for row in measured})
    runs = len({row["run"] for row in measured})
    lines = [
        f"Percent, mean and standard deviation over {samples} samples x {runs} runs: noise and "
        "separable noise removed,",
        "feature, flat, worst-patch (5 %) and vegetation points kept.",
        "",
        f"{'':24s}" + "".join(f"{name.replace('_', ' '):>16s}" for name in COLUMNS),
    ]
    for name, cells in summary(measured, "filter", COLUMNS).items():
        shown = "".join(
            f"{'-':>16s}" if np.isnan(mean) else f"{mean:9.1f} ±{spread:5.2f}"
            for mean, spread in cells
        )
        lines.append(f"{name:24s}{shown}")
    return "\n".join([*lines, "", *_by_kind(measured)])


def _by_kind(measured: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the lines of a table of separable noise removed, by its kind."""
    yield "Separable noise removed, percent, by its kind."
    yield ""
    yield f"{'':24s}" + "".join(f"{kind:>12s}" for kind in NOISE_KINDS.values())
    for name, cells in summary(measured, "filter", BY_KIND).items():
        shown = "".join(f"{'-':>12s}" if np.isnan(mean) else f"{mean:12.1f}" for mean, _ in cells)
        yield f"{name:24s}{shown}"


def _along_the_curve(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the lines of a table of separable noise removed at each feature retention."""
    curves = [row for row in rows if "curve" in row]
    yield "Separable noise removed, percent, where each filter is cut to keep so many features."
    yield ""
    yield f"{'':24s}" + "".join(f"{100.0 * level:>7g}" for level in LEVELS)
    for name in dict.fromkeys(row["filter"] for row in curves):
        chosen = [
            [point["separable"] for point in row["curve"]]
            for row in curves
            if row["filter"] == name
        ]
        yield f"{name:24s}" + "".join(f"{mean:7.1f}" for mean in np.nanmean(chosen, axis=0))


def draw_curves(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw separable noise removed over feature points kept, a panel per sample, into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    curves = [row for row in rows if "curve" in row]
    samples = list(dict.fromkeys(row["sample"] for row in curves))
    methods = list(dict.fromkeys(row["filter"] for row in curves))
    across = min(3, len(samples))
    down = -(-len(samples) // across)
    figure = Figure(figsize=(4.2 * across, 3.0 * down + 1.1), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    kept = [100.0 * level for level in LEVELS]
    for panel, sample in zip(panels.ravel(), samples, strict=False):
        for number, method in enumerate(methods):
            chosen = [
                [point["separable"] for point in row["curve"]]
                for row in curves
                if row["sample"] == sample and row["filter"] == method
            ]
            is_ours = method == "CWASF protective"
            color = "black" if is_ours else f"C{number}"
            width = 2.2 if is_ours else 1.1
            panel.plot(kept, np.mean(chosen, axis=0), color=color, linewidth=width, label=method)
        panel.set_title(sample, fontsize=10)
        panel.grid(alpha=0.3)
        panel.set_ylim(0, 102)
    for panel in panels.ravel()[len(samples) :]:
        panel.set_visible(False)
    figure.supxlabel("feature points kept, percent")
    figure.supylabel("separable noise removed, percent")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=9)
    figure.savefig(path, dpi=130)
