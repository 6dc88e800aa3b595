"""The JSON documents of a result folder, which anyone may have changed since they were written."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError
from dougong.formats.units import METRES
from dougong.pipeline.provenance import sha256
from dougong.typing import Values

_OF_RESULT = ("clouds", "registrations", "inputs", "merged", "project", "reference")
_OF_REGISTRATION = ("status", "matrix", "source", "target", "inputs")


def load_result(folder: Path) -> dict[str, Any]:
    """Return ``result.json`` of a folder; see `load`."""
    return load(folder / "result.json", _OF_RESULT)


def load_registration(folder: Path) -> dict[str, Any]:
    """Return ``registration.json`` of a folder; see `load`."""
    return load(folder / "registration.json", _OF_REGISTRATION)


def load(path: Path, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return a document that has members of such names.

    Raises
    ------
    InputError
        It is no JSON text, or a document of something else.
    """
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path} is no UTF-8 text. {_AGAIN}") from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}: {error.msg}"
        raise InputError(f"{path} is no JSON text: {place}. {_AGAIN}") from None
    if not isinstance(document, dict):
        msg = f"{path} holds a {type(document).__name__}, expected an object. {_AGAIN}"
        raise InputError(msg)
    missing = [name for name in names if name not in document]
    if missing:
        raise InputError(f"{path} has no {' and no '.join(missing)}. {_AGAIN}")
    return document


_AGAIN = "Give the command that wrote it again, with --overwrite."


def not_as_written(folder: Path, error: Exception) -> InputError:
    """Return the error that says that a document has other contents than we write."""
    return InputError(
        f"the JSON files in {folder} are not as this dougong writes them "
        f"({type(error).__name__}: {error}). {_AGAIN}"
    )


def in_metres(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's or a registration's document with the matrices that clouds are drawn by.

    Those that are written lead from file to file; clouds are drawn in metres.
    """
    if "registrations" in document:
        links = [in_metres(link) for link in document["registrations"]]
        return {**document, "registrations": links}
    source, target = (
        np.array((document.get(name) or {}).get("unit_m") or METRES)
        for name in ("source_frame", "target_frame")
    )
    coarse = document["coarse"]
    return {
        **document,
        "matrix": _in_metres(document["matrix"], source, target),
        "coarse": {
            **coarse,
            "hypotheses": [
                {**pose, "matrix": _in_metres(pose["matrix"], source, target)}
                for pose in coarse["hypotheses"]
            ],
        },
    }


def _in_metres(
    matrix: Sequence[Sequence[float]] | None, source_unit: Values, target_unit: Values
) -> list[list[float]] | None:
    if matrix is None:
        return None
    metric = np.diag([*target_unit, 1.0]) @ np.array(matrix) @ np.diag([*(1.0 / source_unit), 1.0])
    moved: list[list[float]] = metric.tolist()
    return moved


def replaced_inputs(document: Mapping[str, Any]) -> list[str]:
    """Return in words which inputs of a registration are other files by now."""
    paths = [(Path(entry["path"]), entry["sha256"]) for entry in document["inputs"]]
    return [
        f"{path} is not the file that was registered: it was changed or replaced since. What is "
        "drawn of it is the new file."
        for path, digest in paths
        if path.is_file() and sha256(path) != digest
    ]
