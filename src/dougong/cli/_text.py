"""Plain text for people: tables, counts, units."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_MARKS = {"ok": "OK", "ambiguous": "AMBIGUOUS", "failed": "FAILED"}


def count(number: int | None) -> str:
    """Return 1234567 as ``1,234,567``."""
    return "unknown" if number is None else f"{number:,}"


def size(number: int | None) -> str:
    """Return a number of bytes with a unit."""
    if number is None:
        return "unknown"
    value = float(number)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000 or unit == "GB":
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def percent(share: float) -> str:
    """Return 0.7246 as ``72.46 %``."""
    return f"{100 * share:.2f} %"


def sentence(text: str) -> str:
    """Return a text with a capital, as it follows a full stop."""
    return text[:1].upper() + text[1:]


def millimetres(metres: float | None) -> str:
    """Return metres as millimetres in words."""
    return "unknown" if metres is None else f"{1000 * metres:.1f} mm"


def table(rows: Sequence[Sequence[str]], heads: Sequence[str]) -> str:
    """Lay out `rows` under `heads`; columns of figures are set flush right."""
    every = [list(heads), *[list(row) for row in rows]]
    widths = [max(len(row[column]) for row in every) for column in range(len(heads))]
    right = [
        all(row[column][:1].isdigit() or row[column][:1] in "-" for row in rows)
        for column in range(len(heads))
    ]
    lines = []
    for row in every:
        cells = [
            cell.rjust(width) if flush else cell.ljust(width)
            for cell, width, flush in zip(row, widths, right, strict=True)
        ]
        lines.append("  " + "  ".join(cells).rstrip())
    return "\n".join(lines)


def stages(document: Sequence[Mapping[str, Any]]) -> str:
    """Return the stage table of one filtered cloud."""
    rows = [
        [
            stage["name"].replace("_", " "),
            count(stage["points_in"]),
            count(stage["points_out"]),
            percent(stage["reduction"]),
            f"{stage['seconds']:.2f} s",
        ]
        for stage in document
    ]
    return table(rows, ["stage", "points in", "points out", "reduction", "time"])


def registration(document: Mapping[str, Any]) -> str:
    """Return one registration in a few lines."""
    status = _MARKS[document["status"]]
    reason = sentence(document["reason"])
    lines = [f"{document['source']} -> {document['target']}: {status}. {reason}"]
    fine = document["fine"]
    if fine:
        lines.append(
            f"  inlier RMSE {millimetres(fine['inlier_rmse_m'])} "
            f"(within {millimetres(fine['max_distance_m'])}), overlap of source "
            f"{percent(fine['overlap_source'])}, of target {percent(fine['overlap_target'])}"
        )
    lines.append(
        f"  coarse margin to the runner-up {document['coarse']['margin']:.2f}, "
        f"probability {document['probability']:.3f}, {document['dof']} degrees of freedom"
    )
    lines += [f"  not observable: {direction['text']}" for direction in document["unobservable"]]
    if document.get("pairs"):
        lines.append(_pairs(document["pairs"]))
    if document.get("checks"):
        lines += _checks(document["checks"])
    return "\n".join(lines)


def _pairs(document: Mapping[str, Any]) -> str:
    """Return what the pose leaves of each picked pair (or their own best fit, without a pose)."""
    rows = document["pairs"]
    is_posed = all(row["residual_m"] is not None for row in rows)
    key = "residual_m" if is_posed else "fit_residual_m"
    off = ", ".join(f"{row['name']} {millimetres(row[key])}" for row in rows)
    return f"  picked pairs, {'under this pose' if is_posed else 'under their own best fit'}: {off}"


def _checks(document: Mapping[str, Any]) -> list[str]:
    """Return what control and check points say, in lines."""
    lines = []
    if document["control_points"]:
        used = [p for p in document["points"] if p["is_used"]]
        off = ", ".join(f"{p['name']} {millimetres(p['residual_m'])}" for p in used)
        lines.append(f"  control points: {off or 'none used'}")
    lines += [
        f"  control point {name} contradicts the others: left out" for name in document["bad"]
    ]
    check = document["check"]
    if check is None:
        return [*lines, f"  no level of accuracy: {document['why_no_level']}"]
    grade = check["level"] or "coarser than LOA10"
    return [
        *lines,
        f"  check RMSE {millimetres(check['check_rmse_m'])} at {check['points']} points, 95 % "
        f"error at most {millimetres(check['upper95_m'])} (95 % confidence): {grade}",
    ]


def notes(document: Sequence[str]) -> str:
    """Return notes, one per line."""
    return "\n".join(f"note: {text}" for text in document)


def join(*parts: str) -> str:
    """Join the parts that are not empty, one below the other."""
    return "\n".join(part for part in parts if part)


def origin(cloud: dict[str, Any]) -> str:
    """Return the sensor of a cloud, and what it was read from where its name does not tell."""
    names = [Path(file).name for file in cloud["files"]]
    if len(names) > 1:
        return f"{cloud['kind']}, {len(names)} files"
    told = all(name.startswith(f"{cloud['name']}.") for name in names)
    return cloud["kind"] if told else f"{cloud['kind']}, {names[0]}"
