"""Control files: places surveyed in both frames, as CSV, and what a project asks of them."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError
from dougong.pipeline.pairs import COORDINATES, HEADER, coordinates_in, csv_rows
from dougong.pipeline.project import Project
from dougong.pipeline.provenance import sha256
from dougong.registration.checks import reaches
from dougong.registration.control_solve import ControlPoints

_ROLES = ("control", "check")


def read_control(path: Path) -> dict[str, ControlPoints]:
    """Read a control file: the points of each cloud that it names.

    Parameters
    ----------
    path : Path
        A CSV file with the columns `HEADER`: ``cloud`` is the cloud that moves, its source
        coordinates are those of its file, the target ones those of the cloud it moves onto.

    Raises
    ------
    InputError
        The file cannot be read, a column is missing, a value is wrong, or a name comes twice.
    """
    clouds: dict[str, list[dict[str, Any]]] = {}
    for number, row in enumerate(csv_rows(path, HEADER), 2):
        clouds.setdefault((row["cloud"] or "").strip(), []).append(_point(path, number, row))
    if not clouds:
        msg = f"{path.name} holds no points. Give one row per point: {','.join(HEADER)}."
        raise InputError(msg)
    record = {"file": str(path), "sha256": sha256(path)}
    return {name: _points(path, name, rows, record) for name, rows in clouds.items()}


def _point(path: Path, number: int, row: Mapping[str, str]) -> dict[str, Any]:
    name = (row["name"] or "").strip()
    if not name:
        raise InputError(f"{path.name}, line {number}: the point has no name. Give it one.")
    if not (row["sigma_m"] or "").strip():
        # A default would give places clicked in a cloud the weight of a survey.
        msg = (
            f"{path.name}, point {name}: sigma_m is empty; the standard deviation of a surveyed "
            "point, in metres, is expected. Write it, or pass places that were picked in the "
            "clouds to `register --pairs`."
        )
        raise InputError(msg)
    *coordinates, sigma_m = coordinates_in(path, number, dict(row), (*COORDINATES, "sigma_m"))
    if sigma_m <= 0.0:
        msg = (
            f"{path.name}, point {name}: sigma_m is {sigma_m:g}; the standard deviation of a "
            "coordinate difference, above 0 metres, is expected."
        )
        raise InputError(msg)
    role = (row["role"] or "").strip().lower()
    if role not in _ROLES:
        msg = (
            f"{path.name}, point {name}: role is {row['role']!r}; control (used in the fit) or "
            "check (held out) is expected."
        )
        raise InputError(msg)
    return {"name": name, "at": coordinates, "sigma_m": sigma_m, "is_check": role == "check"}


def _points(
    path: Path, cloud: str, rows: Sequence[Mapping[str, Any]], record: Mapping[str, Any]
) -> ControlPoints:
    twice = [name for name, count in Counter(row["name"] for row in rows).items() if count > 1]
    if twice:
        msg = (
            f"{path.name}: point {twice[0]} of {cloud or 'the cloud'} comes twice. Name each point "
            "once; a point in two clouds has one row for each cloud."
        )
        raise InputError(msg)
    at = np.array([row["at"] for row in rows])
    return ControlPoints(
        names=tuple(row["name"] for row in rows),
        source=at[:, :3],
        target=at[:, 3:],
        sigma_m=np.array([row["sigma_m"] for row in rows]),
        is_check=np.array([row["is_check"] for row in rows]),
        where=path.name,
        record=record,
    )


def control_of(control: Mapping[str, ControlPoints], *names: str) -> ControlPoints | None:
    """Return the points of a cloud by its `names`, the first that is there, and everybody's.

    Rows without a cloud are everybody's.

    Raises
    ------
    InputError
        A point is among both.
    """
    own = next((control[name] for name in names if name in control), None)
    shared = control.get("")
    if own is None or shared is None:
        return own or shared
    twice = sorted({*own.names} & {*shared.names})
    if twice:
        msg = (
            f"{own.where}: point {twice[0]} has a row for {names[0]} and one without a cloud. Keep "
            "one of them."
        )
        raise InputError(msg)
    return replace(
        own,
        names=(*own.names, *shared.names),
        source=np.concatenate([own.source, shared.source]),
        target=np.concatenate([own.target, shared.target]),
        sigma_m=np.concatenate([own.sigma_m, shared.sigma_m]),
        is_check=np.concatenate([own.is_check, shared.is_check]),
    )


def control_of_project(project: Project, folder: Path) -> dict[str, ControlPoints]:
    """Return the control and check points of a project, by cloud; paths are relative to `folder`.

    Raises
    ------
    InputError
        The file is wrong, names a cloud that the project does not have, or holds no check points
        where a level of accuracy is required.
    """
    quality = project.quality
    control = {} if quality.control is None else read_control(folder / quality.control)
    _refuse_level_without_checks(quality.required_level, control)
    for name in control:
        # Stations of a cloud are told apart by a number behind its name.
        if name and not any(
            re.fullmatch(rf"{re.escape(entry.name)}(-\d+)?", name) for entry in project.cloud
        ):
            msg = (
                f"{quality.control}: there is no cloud {name!r}. Clouds of this project: "
                f"{', '.join(entry.name for entry in project.cloud)}."
            )
            raise InputError(msg)
    return control


def require_control_of(
    control: Mapping[str, ControlPoints], path: Path, name: str
) -> ControlPoints:
    """Return the points of cloud `name`.

    Raises
    ------
    InputError
        The file has none.
    """
    found = control_of(control, name)
    if found is None:
        msg = (
            f"{path.name} has no point of {name}: its column cloud names "
            f"{', '.join(sorted(control))}. Write {name} there, or leave the column empty."
        )
        raise InputError(msg)
    return found


def _refuse_level_without_checks(
    required: str | None, control: Mapping[str, ControlPoints]
) -> None:
    """Refuse to promise a level of accuracy that nothing independent could prove."""
    if required is not None and not any(points.is_check.any() for points in control.values()):
        msg = (
            f"quality.required_level is {required}, but there are no check points: a level of "
            "accuracy needs independent points. Give quality.control a file with rows of role "
            "check, or leave required_level out."
        )
        raise InputError(msg)


def quality_document(
    required: str | None, registrations: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return what a result says of its accuracy: the coarsest level that check points prove.

    Parameters
    ----------
    required : str or None
        The level that the project asks for.
    registrations : sequence of mapping
        Documents as ``registration.json``.
    """
    levels = {
        document["source"]: document["checks"]["level"]
        for document in registrations
        if document["checks"] is not None and document["checks"]["check_points"]
    }
    unchecked = [d["source"] for d in registrations if d["source"] not in levels]
    short = [name for name, level in levels.items() if required and not reaches(level, required)]
    return {
        "required_level": required,
        "levels": levels,
        "unchecked": unchecked,
        "below_required": short,
        "is_reached": None if required is None else bool(levels) and not short and not unchecked,
    }


def quality_notes(quality: Mapping[str, Any]) -> list[str]:
    """Return in one sentence whether the level that a project requires is reached, and why not.

    Parameters
    ----------
    quality : mapping
        As `quality_document` returns it.
    """
    required = quality["required_level"]
    if required is None:
        return []
    if quality["is_reached"]:
        return [f"the required level of accuracy, {required}, is reached"]
    levels = quality["levels"]
    why = [
        f"check points of {name} prove {levels[name] or 'none'}"
        for name in quality["below_required"]
    ]
    why += [f"no check points tell of {name}" for name in quality["unchecked"]]
    told = "; ".join(why) or "nothing was registered"
    return [f"the required level of accuracy, {required}, is NOT reached: {told}"]
