"""From a result folder to one self-contained HTML page."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from dougong.errors import DougongError, InputError
from dougong.pipeline.outputs import write_text
from dougong.report.annex import Annex, annex_of
from dougong.report.documents import (
    in_metres,
    load,
    load_registration,
    load_result,
    not_as_written,
    replaced_inputs,
)
from dougong.report.figures import Figure, find_place, overview, slices
from dougong.report.layers import Layer, pair_layers, run_layers
from dougong.report.model import Report, from_registration, from_run
from dougong.report.plates import line_chart
from dougong.report.poses import score_chart
from dougong.report.viewer import View3D, view_3d, why_missing


def rebuild(folder: Path) -> Path:
    """Write ``report.html`` anew, as `build`, from files that may have been changed since.

    Raises
    ------
    InputError
        The folder holds no result, or one that is not as we write it.
    """
    try:
        return build(folder, is_fresh=False)
    except DougongError:
        raise
    except (LookupError, TypeError, AttributeError, ValueError, jinja2.TemplateError) as error:
        raise not_as_written(folder, error) from error


def build(folder: Path, *, is_fresh: bool = True) -> Path:
    """Write ``report.html`` from the files in a result folder and return its path.

    `is_fresh` says that they were written just now: nobody can have replaced an input since.

    Raises
    ------
    InputError
        The folder holds no result.
    """
    result, single = folder / "result.json", folder / "registration.json"
    if result.is_file():
        document = load_result(folder)
        demo = folder / "demo.json"
        drawn = in_metres(document)
        layers = run_layers(folder, drawn)
        report = from_run(document, load(demo) if demo.is_file() else None)
    elif single.is_file():
        document = load_registration(folder)
        drawn = in_metres(document)
        layers = pair_layers(drawn, folder)
        report = from_registration(document)
        if not is_fresh:
            report = replace(report, notes=(*report.notes, *replaced_inputs(document)))
        if not layers:
            note = "The input files are not where they were, so nothing could be drawn."
            report = replace(report, notes=(*report.notes, note))
    else:
        msg = (
            f"{folder} holds no result.json and no registration.json. Name the --out folder of "
            "a run, a demo or a registration."
        )
        raise InputError(msg)
    path = folder / "report.html"
    place = find_place(layers) if layers else None
    write_text(path, render(report, layers, annex_of(folder, drawn, layers, place)))
    return path


def render(report: Report, layers: list[Layer], annex: Annex | None = None) -> str:
    """Return the page. Everything is inside it: no request leaves it."""
    report = replace(
        report,
        legend=tuple((layer.name, "rgb({}, {}, {})".format(*layer.colour)) for layer in layers),
    )
    first: Figure | None = None
    general: list[Figure] = []
    cuts: list[Figure] = []
    three: View3D | None = None
    missing = why_missing()
    if layers:
        place = find_place(layers)
        first, general = _first(overview(layers, place))
        sure = [layer for layer in layers if layer.is_sure]
        cuts = slices(sure, place) if len(sure) > 1 else []
        three = view_3d(layers, place) if missing is None else None
    return (
        environment()
        .get_template("report.html")
        .render(
            report=report,
            first=first,
            overview=general,
            slices=cuts,
            three=three,
            missing=missing,
            annex=annex or Annex(),
        )
    )


def _first(figures: list[Figure]) -> tuple[Figure | None, list[Figure]]:
    """Return the picture of the first screen, registered clouds where there are any; the others."""
    if not figures:
        return None, []
    after = [figure for figure in figures if figure.title.startswith("After")]
    first = after[0] if after else figures[-1]
    return first, [figure for figure in figures if figure is not first]


def environment() -> jinja2.Environment:
    """Return the template engine: everything escaped, unknown names refused."""
    engine = jinja2.Environment(
        loader=jinja2.PackageLoader("dougong.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    engine.filters["svg"] = Markup
    engine.filters["count"] = lambda value: f"{value:,}"
    engine.filters["percent"] = lambda value: f"{100 * value:.2f} %"
    engine.filters["chart"] = _chart
    engine.filters["built"] = Markup
    engine.filters["breakable"] = _breakable
    engine.filters["scores"] = lambda link: Markup(score_chart(link.hypotheses, link.margin))
    return engine


def _breakable(name: str) -> Markup:
    """Return a dotted name that may go on in the next line behind each of its parts."""
    return Markup(re.sub(r"([._])", r"\1<wbr>", str(escape(name))))


def _chart(link: Any) -> Markup:
    label = "inlier RMSE over the iterations of the fine registration, millimetres"
    return Markup(line_chart(link.history_mm, "mm", label))
