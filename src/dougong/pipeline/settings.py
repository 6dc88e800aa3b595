"""Settings from text: ``NAME.FIELD=VALUE``, unknown names, pydantic's errors in one sentence."""

import difflib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from dougong.errors import InputError

M = TypeVar("M", bound=BaseModel)


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return ``, did you mean 'x'?`` for a near miss, else nothing."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f", did you mean {near[0]!r}?" if near else "."


def module_name(name: str) -> str:
    """Return a filter's name as its module has it: hyphens become underscores."""
    return name.strip().replace("-", "_").lower()


def parse_value(text: str) -> Any:
    """Read `text` as a TOML value (0.5, true, [1, 2], "a"); anything else is a plain string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def parse_overrides(
    texts: Sequence[str], fields: Mapping[str, Sequence[str]]
) -> dict[str, dict[str, Any]]:
    """Turn ``NAME.FIELD=VALUE`` texts into {name: {field: value}}.

    Parameters
    ----------
    texts : sequence of str
        As given to ``--set``.
    fields : mapping
        The names that may be set, each with its fields.

    Raises
    ------
    InputError
        A text has another shape, or its name or field is unknown.
    """
    overrides: dict[str, dict[str, Any]] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        name, dot, field = key.partition(".")
        name, field = module_name(name), field.strip()
        if not equals or not dot or not field:
            example = "curvature_weighted.rule=paper"
            msg = f"--set needs NAME.FIELD=VALUE, got {text!r}. Example: {example}"
            raise InputError(msg)
        if name not in fields:
            msg = (
                f"--set {text}: there is no filter {name!r} here{suggestion(name, fields)} "
                f"Filters: {', '.join(fields)}."
            )
            raise InputError(msg)
        if field not in fields[name]:
            msg = (
                f"--set {text}: {name} has no field {field!r}{suggestion(field, fields[name])} "
                f"Fields: {', '.join(fields[name])}."
            )
            raise InputError(msg)
        overrides.setdefault(name, {})[field] = parse_value(value.strip())
    return overrides


def validated(model: type[M], values: Mapping[str, Any], where: str) -> M:
    """Build `model` from `values`, or say in one sentence what is wrong with them.

    Raises
    ------
    InputError
        A value is missing, unknown, of the wrong type or out of range.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise InputError(explain(error, model, where)) from None


def updated(model: M, changes: Mapping[str, Any], where: str) -> M:
    """Return `model` with some fields changed, validated again as a whole.

    Fields that were never set stay open, so that one of two alternatives may take their place.
    """
    return validated(type(model), {**model.model_dump(exclude_unset=True), **changes}, where)


def explain(error: ValidationError, model: type[BaseModel], where: str) -> str:
    """Return a pydantic error as: where, field, value seen, what was expected; then other places.

    A list that has too few items because one of them is wrong is no error of its own.
    """
    errors = error.errors()
    errors = [one for one in errors if one["type"] != "too_short"] or errors
    first = errors[0]
    path = [str(part) for part in first["loc"]]
    others = [place_of(one["loc"]) for one in errors[1:]]
    more = f" Also wrong: {', '.join(others)}." if others else ""
    key = place_of(first["loc"]) or model.__name__
    if first["type"] == "extra_forbidden":
        known = _fields_at(model, path[:-1])
        return (
            f"{where}: unknown name {key!r}{suggestion(path[-1], known)} "
            f"Known here: {', '.join(known)}.{more}"
        )
    if first["type"] == "missing":
        return f"{where}: {key!r} is missing and has no default. Add it.{more}"
    if first["type"] == "value_error":
        # Our own validators say a whole sentence, the value included.
        own = first["msg"].removeprefix("Value error, ").rstrip(".")
        place = f"{key}: " if path else ""
        return f"{where}: {place}{own}.{more}"
    said = (
        first["msg"]
        .removeprefix("Input should be ")
        .replace("a valid tuple", "a list in square brackets")
    )
    if first["type"] == "string_pattern_mismatch":
        said = f"text that matches {first['ctx']['pattern']}"
    expected = said if said[:1].isupper() else f"expected {said}"
    seen = "" if isinstance(first["input"], dict) else f", got {first['input']!r}"
    return f"{where}: {key}{seen}: {expected.rstrip('.')}.{more}"


def place_of(path: Sequence[str | int]) -> str:
    """Return where a setting stands, as a person counts: ``[[cloud]] number 2, files``."""
    place = ""
    for part in path:
        if isinstance(part, int):
            place = f"[[{place}]] number {part + 1}"
        elif place.startswith("[["):
            place += f", {part}"
        else:
            place += f".{part}" if place else part
    return place


def _fields_at(model: type[BaseModel], path: Sequence[str]) -> list[str]:
    """Return the field names of the model at `path` inside `model`, as a file spells them."""
    for part in path:
        nested = [
            field.annotation
            for name, field in model.model_fields.items()
            if part in (name, field.alias)
        ]
        inner = nested[0] if nested else None
        candidates = [inner, *getattr(inner, "__args__", ())]
        models = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        if models:
            model = models[0]
    return [field.alias or name for name, field in model.model_fields.items()]
