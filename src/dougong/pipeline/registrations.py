"""``registration.json``: one registration as a document, and read back to be applied."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dougong._checks import as_transform
from dougong.cloud import Frame
from dougong.errors import InputError, RegistrationError
from dougong.formats.units import METRES, as_wkt, units_of
from dougong.pipeline.exports import inverse
from dougong.pipeline.outputs import finite
from dougong.registration.document import registration_to_json
from dougong.registration.result import Registration
from dougong.typing import Transform

Unit = tuple[float, float, float]
_SAME_PLACE_M = 0.001


def to_document(
    result: Registration,
    *,
    source: str,
    target: str,
    source_frame: Frame,
    target_frame: Frame,
    inputs: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the contract's document of one registration.

    Parameters
    ----------
    result : Registration
    source, target : str
        Names of the clouds.
    source_frame, target_frame : Frame
        What the coordinates of both files are in; the target's turns local ones into its file's.
    inputs : sequence of mapping
        ``{"path", "sha256", "points"}`` of every file read.
    """
    document = registration_to_json(
        result, source=source, target=target, target_frame=target_frame, inputs=inputs
    )
    # What `dougong transform` needs to tell which clouds the matrix is for, and to write a moved
    # one as the target's file would be.
    document["matrix_inverse"] = None if result.matrix is None else inverse(result.matrix)
    document["source_frame"] = {"crs_wkt": source_frame.crs, "unit_m": source_frame.unit_m}
    document["target_frame"] = {"crs_wkt": target_frame.crs, "unit_m": target_frame.unit_m}
    cleaned: dict[str, Any] = finite(document)
    return cleaned


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """A registration read back from its file."""

    status: Literal["ok", "ambiguous"]
    matrix: Transform
    source: str
    target: str
    reason: str
    source_crs: str | None
    source_unit_m: Unit | None
    """Metres per unit of the coordinates that the matrix takes; None: searched, no file says it."""
    target_crs: str | None
    target_unit_m: Unit
    inputs: tuple[Mapping[str, Any], ...]
    """Of every file that was registered: path, SHA-256, points."""
    without_source: str
    """In words that the file does not say what the matrix takes, so metres are; empty: it does."""
    notes: tuple[str, ...]
    """What is doubtful about the file itself."""


def read_registration(path: Path, *, accept_best: bool) -> Known:
    """Read a registration that may be applied.

    Raises
    ------
    InputError
        Missing, no registration, or not sure while `accept_best` is False.
    RegistrationError
        The registration failed: it has no pose.
    """
    document = _load(path)
    _require_pose(document, path, accept_best)
    is_searched = _member(document, "scale_search", path).get("side") == "source"
    source_crs, source_unit_m, lacks_source = _frame(document, "source_frame", path)
    target_crs, target_unit_m, lacks_target = _frame(document, "target_frame", path)
    matrix = _matrix_of(document["matrix"], path)
    source, target = (str(document.get(name, "")) for name in ("source", "target"))
    notes = [
        f"{lacking}: the coordinates that its matrix {does} are taken for metres. "
        f"Right only if {name or 'the cloud'} was in metres"
        for lacking, does, name in (
            ("" if is_searched else lacks_source, "takes", source),
            (lacks_target, "gives", target),
        )
        if lacking
    ]
    inputs = document.get("inputs")
    listed = inputs if isinstance(inputs, list) else []
    return Known(
        status=document["status"],
        matrix=matrix,
        source=source,
        target=target,
        reason=str(document.get("reason", "")),
        source_crs=source_crs,
        source_unit_m=None if is_searched else source_unit_m,
        target_crs=target_crs,
        target_unit_m=target_unit_m,
        inputs=tuple(one for one in listed if isinstance(one, dict)),
        without_source=lacks_source,
        notes=(*notes, *_contradiction(matrix, document.get("matrix_inverse"), path)),
    )


def _require_pose(document: Mapping[str, Any], path: Path, accept_best: bool) -> None:
    """Refuse a document without a pose that may be applied; see `read_registration`."""
    status = document.get("status")
    if status not in ("ok", "ambiguous", "failed"):
        said = "no status" if status is None else f"status {status!r:.40}"
        msg = f"{path} is no registration.json: it has {said}; expected ok, ambiguous or failed."
        raise InputError(msg)
    if "matrix" not in document:
        msg = f"{path} is no registration.json: it has no matrix. Name one of `dougong register`."
        raise InputError(msg)
    if status == "failed" or document["matrix"] is None:
        reason = document.get("reason", "")
        msg = f"{path}: the registration failed, there is no pose to apply: {reason}"
        raise RegistrationError(msg)
    if status != "ok" and not accept_best:
        msg = (
            f"{path}: the registration is {status}: {document.get('reason', '')} "
            "Nothing was moved. Pass --accept-best to apply the best pose all the same."
        )
        raise InputError(msg)


def _member(document: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    """Return an object of the document; an empty one where it is missing or null."""
    value = document.get(name)
    if value is None:
        return {}
    if not isinstance(value, dict):
        msg = f"{name} of {path.name} must be an object, got {value!r:.60}. Register again."
        raise InputError(msg)
    return value


def _frame(document: Mapping[str, Any], name: str, path: Path) -> tuple[str | None, Unit, str]:
    """Return the system and the unit of one side, and in words that it names no unit."""
    frame = _member(document, name, path)
    crs, unit = frame.get("crs_wkt"), frame.get("unit_m")
    if crs is not None and (not isinstance(crs, str) or as_wkt(crs) is None):
        msg = (
            f"{name}.crs_wkt of {path.name} is no coordinate system: {crs!r:.60}; expected WKT, "
            "EPSG:n or null. Register again."
        )
        raise InputError(msg)
    if unit is None and crs is not None:
        return crs, units_of(crs).unit_m, ""
    if unit is None:
        lacks = f"unit_m in its {name}" if frame else name
        return crs, METRES, f"{path.name} names no {lacks}"
    is_right = isinstance(unit, list) and len(unit) == 3
    if not is_right or not all(_is_positive(value) for value in unit):
        msg = (
            f"{name}.unit_m of {path.name} must be three positive numbers, metres per unit of x, y "
            f"and z, got {unit!r:.60}. Register again."
        )
        raise InputError(msg)
    x, y, z = map(float, unit)
    return crs, (x, y, z), ""


def _is_positive(value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and 0 < value < math.inf


def _contradiction(matrix: Transform, back: Any, path: Path) -> list[str]:
    """Return in words that the matrix and its inverse, where it is given, are of two poses."""
    if back is None:
        return []
    names = f"matrix and matrix_inverse of {path.name}"
    try:
        undone = np.array(back, dtype=np.float64) @ matrix
    except (TypeError, ValueError):
        undone = np.empty(0)
    if undone.shape != (4, 4) or not np.isfinite(undone).all():
        return [f"matrix_inverse of {path.name} is no transform; matrix is applied"]
    off = float(np.linalg.norm(undone[:3, 3]))
    if np.allclose(undone[:3, :3], np.eye(3), rtol=0.0, atol=1e-6) and off < _SAME_PLACE_M:
        return []
    return [
        f"{names} are not of one pose ({off:.3g} m apart at the origin): was one changed by hand? "
        "matrix is applied"
    ]


def _matrix_of(value: Any, path: Path) -> Transform:
    try:
        values = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        msg = f"the matrix of {path.name} must be four rows of four numbers, got {value!r:.60}."
        raise InputError(msg) from None
    return as_transform(values, f"the matrix of {path.name}")


def _load(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        msg = f"there is no file {path}. `dougong register` writes registration.json."
        raise InputError(msg) from None
    except OSError as error:
        msg = f"{path} cannot be read: {error.strerror}. Name a registration.json."
        raise InputError(msg) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        why = "it is no UTF-8 text"
        if isinstance(error, json.JSONDecodeError):
            why = f"line {error.lineno}, column {error.colno}: {error.msg}"
        msg = (
            f"{path} is no JSON file: {why}. Name a registration.json, as `dougong register` "
            "writes it."
        )
        raise InputError(msg) from None
    if not isinstance(document, dict):
        msg = f"{path} is no registration.json: it holds a {type(document).__name__}."
        raise InputError(msg)
    return document
