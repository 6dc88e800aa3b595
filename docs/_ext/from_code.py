"""Reference pages that are read off the code: parameters, commands, reasons, evidence.

``{parameters} MODULE:MODEL TABLE`` lists the fields of a parameter set and of those within it;
``{commands}`` every command and its options; ``{reasons}`` the reason codes of removed points;
``{evidence} STUDY`` the table of a study that was run, or how to run it; ``{bench}``
that of the speed measurements; ``{large-site}`` those of runs larger than memory.
"""

from __future__ import annotations

import importlib
import inspect
import json
import types
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from docutils import nodes
from docutils.statemachine import StringList
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from dougong.evaluation.bench.table import as_markdown, as_markdown_all

EVIDENCE = Path(__file__).parent.parent / "evidence"
MOST_ROWS = 80


class Written(SphinxDirective):
    """A directive whose content is Markdown made by a function of its arguments."""

    has_content = False
    optional_arguments = 2

    def run(self) -> list[nodes.Node]:
        """Return what the Markdown says."""
        lines = StringList(list(self.markdown(*self.arguments)), source=str(self.get_source_info()))
        holder = nodes.Element()
        self.state.nested_parse(lines, self.content_offset, holder, match_titles=True)
        return holder.children

    def markdown(self, *arguments: str) -> Iterator[str]:
        """Yield lines of Markdown."""
        raise NotImplementedError


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield a Markdown table."""
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |"
    yield ""


class ParameterTables(Written):
    """``{parameters} MODULE:MODEL TABLE``: one table per set, those within it after it."""

    required_arguments = 1

    def markdown(self, where: str, name: str = "") -> Iterator[str]:
        """Yield a set's own fields, then each set that it holds, under their dotted names."""
        module, _, attribute = where.partition(":")
        yield from self._set(getattr(importlib.import_module(module), attribute), name, None)

    def _set(
        self, model: type[BaseModel], name: str, instance: Any, is_list: bool = False
    ) -> Iterator[str]:
        plain, inner = [], []
        for key, field in model.model_fields.items():
            held = _model_in(field.annotation)
            default = getattr(instance, key) if instance is not None else field.get_default()
            (inner if held else plain).append((field.alias or key, field, held, default))
        if name:
            yield f"**`[[{name}]]`**" if is_list else f"**`[{name}]`**"
            yield ""
        yield inspect.cleandoc(model.__doc__ or "").split("\n\n")[0].replace("\n", " ")
        yield ""
        if plain:
            rows = [
                (f"`{key}`", _type_of(field), _shown(default), _words(field))
                for key, field, _, default in plain
            ]
            yield from table(("field", "type", "default", "meaning"), rows)
        for key, field, held, default in inner:
            assert held is not None
            value = default if isinstance(default, BaseModel) else None
            inside = f"{name}.{key}" if name else key
            yield from self._set(held, inside, value, get_origin(field.annotation) is tuple)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the parameter set that a field holds, or holds several of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in get_args(annotation):
        found = _model_in(inner)
        if found is not None:
            return found
    return None


def _type_of(field: FieldInfo) -> str:
    bounds = [
        f"{sign} {value:g}"
        for item in field.metadata
        for name, sign in (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))
        if (value := getattr(item, name, None)) is not None
    ]
    return " ".join([_type_words(field.annotation), ", ".join(bounds)]).strip()


def _type_words(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(_type_words(a) for a in arguments if a is not type(None))
    if origin is tuple:
        return f"list of {_type_words(arguments[0])}"
    if origin is not None and arguments:
        return _type_words(arguments[0])
    names = {"float": "number", "int": "whole number", "str": "text", "bool": "true or false"}
    name = getattr(annotation, "__name__", str(annotation))
    return names.get(name, name)


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if type(value).__name__ == "PydanticUndefinedType":
        return "must be given"
    if isinstance(value, bool):
        return "`true`" if value else "`false`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _words(field: FieldInfo) -> str:
    return " ".join((field.description or "").replace("``", "`").split())


class Commands(Written):
    """Every command with its usage, what it does, and its options."""

    def markdown(self) -> Iterator[str]:
        """Yield one section per command, from its signature and docstring."""
        from dougong.cli._commands import app

        for name in [key for key in app if not key.startswith("-")]:
            command = app[name]
            yield f"## dougong {name}"
            yield ""
            function = command.default_command
            yield from self._words(function)
            arguments = command.assemble_argument_collection(parse_docstring=True)
            shared = [a for a in arguments if a.show and _group_of(a) == "Global options"]
            own = [a for a in arguments if a.show and _group_of(a) != "Global options"]
            rows = [_option(argument) for argument in own]
            if rows:
                yield from table(("option", "default", "meaning"), rows)
            self.shared = [_option(argument) for argument in shared]
        yield "## Options of every command"
        yield ""
        yield from table(("option", "default", "meaning"), self.shared)

    def _words(self, function: Callable[..., Any]) -> Iterator[str]:
        text = inspect.cleandoc(function.__doc__ or "").split("\nParameters\n")[0]
        for paragraph in text.split("\n\n"):
            if paragraph.strip().startswith("Example:"):
                yield from ("```sh", paragraph.strip().removeprefix("Example:").strip(), "```", "")
            else:
                yield from (paragraph.replace("``", "`"), "")


def _group_of(argument: Any) -> str:
    return next((str(group.name) for group in argument.parameter.group or ()), "")


def _option(argument: Any) -> tuple[str, str, str]:
    names = [name for name in argument.names if not name.startswith("--no-")]
    default = argument.field_info.default
    is_empty = default is inspect.Parameter.empty or default in (None, (), False)
    help_text = " ".join((argument.parameter.help or "").replace("``", "`").split())
    choices = _choices(argument.hint)
    words = f"{help_text} One of {choices}." if choices else help_text
    return ", ".join(f"`{name}`" for name in names), "" if is_empty else f"`{default}`", words


def _choices(hint: Any) -> str:
    if get_origin(hint) is Literal:
        return ", ".join(f"`{value}`" for value in get_args(hint))
    return next((found for inner in get_args(hint) if (found := _choices(inner))), "")


class Reasons(Written):
    """The reason codes of removed points: ``{reasons} MODULE:ENUM``."""

    required_arguments = 1

    def markdown(self, where: str) -> Iterator[str]:
        """Yield the codes in their order."""
        module, _, attribute = where.partition(":")
        codes: type[IntEnum] = getattr(importlib.import_module(module), attribute)
        rows = [(f"`{c.value}`", c.name.lower().replace("_", " ")) for c in codes]
        yield from table(("code", "removed by"), rows)


class Evidence(Written):
    """The table of a study as it was run: ``{evidence} STUDY``."""

    required_arguments = 1

    def markdown(self, study: str) -> Iterator[str]:
        """Yield who measured what where, and the study's table."""
        path = EVIDENCE / f"{study}.json"
        self.env.note_dependency(str(path))
        if not path.is_file():
            yield f"Not in this copy. It is made by `dougong evaluate {study} --out docs/evidence`."
            yield ""
            return
        document = json.loads(path.read_text(encoding="utf-8"))
        yield from _provenance(study, document)
        if path.with_suffix(".png").is_file():
            yield from (f"![{study}](evidence/{study}.png)", "")
        rows, note = _shown_rows(document["table"])
        columns = list(dict.fromkeys(key for row in rows for key in row))
        cells = [[_cell(row.get(key)) for key in columns] for row in rows]
        yield from table([column.replace("_", " ") for column in columns], cells)
        yield from (note, "") if note else ()


class Bench(Written):
    """Everyone's seconds and memory as they were measured: ``{bench}``."""

    def markdown(self) -> Iterator[str]:
        """Yield who measured what where, and a row per contender."""
        path = EVIDENCE / "bench.json"
        self.env.note_dependency(str(path))
        document = json.loads(path.read_text(encoding="utf-8"))
        yield from (*as_markdown(document).splitlines(), "")
        yield from ("Everyone who was asked, and what they answered:", "")
        yield from (*as_markdown_all(document).splitlines(), "")


class LargeSite(Written):
    """Runs of ``benchmarks/large_site.py run``, smallest first: ``{large-site}``."""

    def markdown(self) -> Iterator[str]:
        """Yield who measured what where, a row per run, and where its CPU time went."""
        path = EVIDENCE / "large_site.jsonl"
        self.env.note_dependency(str(path))
        lines = path.read_text(encoding="utf-8").splitlines()
        runs = sorted(map(json.loads, lines), key=lambda run: (run["points"], run["memory"]))
        machine = runs[-1]["machine"]
        yield f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB."
        yield ""
        head = ("points", "`--memory`", "peak, GB", "points merged", "wall, s", "CPU, s")
        head = (*head, "CPU a point, us", "decoding alone, CPU s", "run / decoding, CPU")
        yield from table(head, [_run_cells(run) for run in runs])
        stages = list(_the_run(runs[-1])["cpu_seconds"])
        rows = [
            [f"{run['points']:,}", *(_cell(_the_run(run)["cpu_seconds"][s]) for s in stages)]
            for run in runs
        ]
        yield from ("CPU seconds by stage:", "", *table(["points", *stages], rows))


def _the_run(run: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = next(job for job in run["jobs"] if job["job"] == "run")
    return found


def _run_cells(run: dict[str, Any]) -> list[str]:
    job = _the_run(run)
    decoding = [j["cpu_s"] for j in run["jobs"] if j["job"] == "decode"]
    alone = sum(decoding) / len(decoding)
    numbers = (job["peak_pss_bytes"] / 1e9, job["merged"]["points"], job["wall_s"], job["cpu_s"])
    per_point = 1e6 * job["cpu_s"] / run["points"]
    numbers = (*numbers, per_point, alone, job["cpu_s"] / alone)
    return [f"{run['points']:,}", run["memory"], *(_cell(number) for number in numbers)]


def _shown_rows(rows: Sequence[dict[str, Any]]) -> tuple[Sequence[dict[str, Any]], str]:
    """Return the rows that fit on a page, and what was left out: the summaries go first."""
    if len(rows) <= MOST_ROWS:
        return rows, ""
    whole = [row for row in rows if "all" in row.values()] or list(rows)
    return whole[:MOST_ROWS], f"{len(whole[:MOST_ROWS])} of {len(rows)} rows; the file has all."


def _provenance(study: str, document: dict[str, Any]) -> Iterator[str]:
    machine = document.get("machine", {})
    software = document.get("software", {})
    seeds = document.get("seeds") or []
    measured = document.get("measurements") or len(document.get("rows", document["table"]))
    facts = [
        f"`dougong evaluate {study}`",
        f"dougong {software.get('dougong', '?')}",
        f"{measured:,} measurements",
        document.get("measured_against", ""),
        f"{len(seeds)} seed{'s' * (len(seeds) > 1)}" if seeds else "",
        ", ".join(str(machine[key]) for key in ("processor", "cpu", "system") if key in machine),
        "a quick look, not a measurement" if document.get("is_quick") else "",
    ]
    yield "; ".join(fact for fact in facts if fact) + "."
    yield ""


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    if isinstance(value, list):
        return ", ".join(_cell(item) for item in value)
    return str(value)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("parameters", ParameterTables)
    app.add_directive("commands", Commands)
    app.add_directive("reasons", Reasons)
    app.add_directive("evidence", Evidence)
    app.add_directive("bench", Bench)
    app.add_directive("large-site", LargeSite)
    return {"parallel_read_safe": True}
