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
from dougong.pipeline.exports import inverse
from dougong.registration.document import registration_to_json
from dougong.registration.result import Registration
from dougong.typing import Transform


def finite(value: Any) -> Any:
    """Return `value` as JSON can hold it: arrays as lists, NaN and infinity as null."""
    if isinstance(value, np.ndarray):
        return finite(value.tolist())
    if isinstance(value, np.generic):
        return finite(value.item())
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


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

    status: Literal["ok", "ambiguous", "failed"]
    matrix: Transform
    source: str
    target: str
    reason: str
    source_crs: str | None
    source_unit_m: tuple[float, float, float] | None
    """Metres per unit of the coordinates that the matrix takes; None: searched, no file says it."""
    target_crs: str | None
    target_unit_m: tuple[float, float, float]


def read_registration(path: Path, *, accept_best: bool) -> Known:
    """Read a registration that may be applied.

    Raises
    ------
    InputError
        Missing, no registration, or not sure while `accept_best` is False.
    RegistrationError
        The registration failed: it has no matrix.
    """
    document = _load(path)
    status = document.get("status")
    if status not in ("ok", "ambiguous", "failed") or "matrix" not in document:
        msg = f"{path} is no registration.json: it has no status or no matrix."
        raise InputError(msg)
    if document["matrix"] is None:
        reason = document.get("reason", "")
        msg = f"{path}: the registration failed, there is no pose to apply. {reason}"
        raise RegistrationError(msg)
    if status != "ok" and not accept_best:
        msg = (
            f"{path}: the registration is {status}: {document.get('reason', '')} "
            "Nothing was moved. Pass --accept-best to apply the best pose all the same."
        )
        raise InputError(msg)
    source, frame = document.get("source_frame") or {}, document.get("target_frame") or {}
    is_searched = (document.get("scale_search") or {}).get("side") == "source"
    return Known(
        status=status,
        matrix=_matrix_of(document["matrix"], path),
        source=str(document.get("source", "")),
        target=str(document.get("target", "")),
        reason=str(document.get("reason", "")),
        source_crs=source.get("crs_wkt"),
        source_unit_m=None if is_searched else tuple(source.get("unit_m", (1.0, 1.0, 1.0))),
        target_crs=frame.get("crs_wkt"),
        target_unit_m=tuple(frame.get("unit_m", (1.0, 1.0, 1.0))),
    )


def _matrix_of(value: Any, path: Path) -> Transform:
    try:
        values = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        msg = f"the matrix of {path.name} must be four rows of four numbers, got {value!r:.60}."
        raise InputError(msg) from None
    return as_transform(values, f"the matrix of {path.name}")


def _load(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        msg = f"there is no file {path}. `dougong register` writes registration.json."
        raise InputError(msg) from None
    except OSError as error:
        msg = f"{path} cannot be read: {error.strerror}. Name a registration.json."
        raise InputError(msg) from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        msg = f"{path} is no JSON file. Name a registration.json, as `dougong register` writes it."
        raise InputError(msg) from None
    if not isinstance(document, dict):
        msg = f"{path} is no registration.json: it holds a {type(document).__name__}."
        raise InputError(msg)
    return document
