"""One registration as rows of words and numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dougong.report.verdict import TONES, WORDS, Tone, millimetres, sentence

_SHOWN_POINTS = 8
"""Control and check points that the certificate's one page has room for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """One registration, ready to be laid out."""

    source: str
    target: str
    tone: Tone
    word: str
    reason: str
    facts: tuple[tuple[str, str], ...]
    """Name and value, both with their units."""
    matrix: tuple[tuple[str, ...], ...]
    hypotheses: tuple[Mapping[str, Any], ...]
    margin: float
    unobservable: tuple[str, ...]
    history_mm: tuple[float, ...]
    points: tuple[Mapping[str, Any], ...]
    """Control and check points: name, role, residual in millimetres, remark."""
    shown_points: tuple[Mapping[str, Any], ...]
    """Those that a page has room for: bad ones first, then the worst."""
    accuracy: tuple[tuple[str, str], ...]
    """The check points' error, name and value, or why there is none; empty without any points."""
    scale: str
    """A scale that was searched, with its standard deviation; empty where it was known."""


def link(document: Mapping[str, Any]) -> Link:
    """Return one registration document as rows of words and numbers."""
    tone = TONES[document["status"]]
    fine = document["fine"]
    history = [step.get("inlier_rmse_m") for step in (fine or {}).get("history", [])]
    return Link(
        source=document["source"],
        target=document["target"],
        tone=tone,
        word=WORDS[tone],
        reason=sentence(document["reason"]),
        facts=tuple(_facts(document)),
        matrix=_matrix(document["matrix"]),
        hypotheses=tuple(document["coarse"]["hypotheses"][:8]),
        margin=document["coarse"]["margin"],
        unobservable=tuple(direction["text"] for direction in document["unobservable"]),
        history_mm=tuple(1000 * value for value in history if value is not None),
        points=tuple(_points(document.get("checks"))),
        shown_points=tuple(_points(_worst(document.get("checks")))),
        accuracy=tuple(_accuracy(document.get("checks"))),
        scale=_searched(document),
    )


def _worst(checks: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return the checks with the points that matter most: bad ones, then the largest residuals."""
    if checks is None or len(checks["points"]) <= _SHOWN_POINTS:
        return checks
    ranked = sorted(
        checks["points"],
        key=lambda p: (p["name"] not in checks["bad"], -(p["residual_m"] or 0.0)),
    )
    chosen = {point["name"] for point in ranked[:_SHOWN_POINTS]}
    return {**checks, "points": [p for p in checks["points"] if p["name"] in chosen]}


def _accuracy(checks: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return the check points' error, or why there is no grade."""
    if checks is None:
        return []
    check = checks["check"]
    if check is None:
        return [("level of accuracy", f"none is stated: {checks['why_no_level']}")]
    points = f"{check['points']} held-out point{'s' if check['points'] != 1 else ''}"
    return [
        (
            f"check RMSE ({points})",
            f"{millimetres(check['check_rmse_m'])} in three dimensions, "
            f"{millimetres(check['check_rmse_plan_m'])} in plan, "
            f"{millimetres(check['check_rmse_height_m'])} in height",
        ),
    ]


def _points(checks: Mapping[str, Any] | None) -> list[dict[str, str]]:
    """Return control and check points as words: name, role, residual, remark."""
    if checks is None:
        return []
    return [
        {
            "name": point["name"],
            "role": point["role"],
            "residual": millimetres(point["residual_m"]),
            "sigma": millimetres(point["sigma_m"]),
            "short": (
                "left out"
                if point["role"] == "control" and not point["is_used"]
                else str(point["role"])
            ),
            "remark": (
                "held out"
                if point["role"] == "check"
                else "adjusted with the clouds"
                if point["is_used"]
                else "left out: contradicts the others"
            ),
        }
        for point in checks["points"]
    ]


def _matrix(matrix: Sequence[Sequence[float]] | None) -> tuple[tuple[str, ...], ...]:
    """Return a matrix as text: ten digits of rotation, a tenth of a millimetre of shift."""
    rows = [[*(f"{value:.10f}" for value in row[:3]), f"{row[3]:.4f}"] for row in matrix or ()]
    return tuple(map(tuple, rows))


def _facts(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    coarse, fine = document["coarse"], document["fine"]
    facts = [
        ("coarse method", f"{coarse['method']}, {len(coarse['hypotheses'])} hypotheses"),
        ("degrees of freedom", f"{document['dof']}"),
        ("scale", _scale(document)),
        ("probability that it is this pose", f"{document['probability']:.3f}"),
    ]
    if fine:
        rmse = fine["inlier_rmse_m"]
        bound = f"within {1000 * fine['max_distance_m']:.0f} mm"
        facts += [
            (
                "fine method",
                f"{fine['method']}, {fine['iterations']} iterations: {fine['stopped']}",
            ),
            ("inlier RMSE", f"{1000 * rmse:.2f} mm, {bound}" if rmse is not None else "none"),
            ("fitness (inliers / source points)", f"{fine['fitness']:.3f}"),
            ("overlap of source, of target", _overlap(fine, bound)),
        ]
    spread = _spread(document["covariance"], document.get("covariance_about"))
    if spread:
        facts.append(("standard deviation of the fit, widened where few blocks tell it", spread))
    return facts


def _scale(document: Mapping[str, Any]) -> str:
    """Return the scale of the matrix and what fixes it; documents before 0.2 do not say it."""
    scale, grid = f"{document['scale']:.9g}", document.get("grid")
    searched = _searched(document)
    if searched:
        scale += f", {searched}"
    if grid:
        scale += (
            f", known from the map projection ({grid['ppm']:+.1f} ppm in plan, "
            f"{'as given' if grid['from'] == 'given' else 'by the coordinate system'}; heights "
            f"off by at most {1000 * grid['height_error_m']:.1f} mm for it)"
        )
    return scale


def _searched(document: Mapping[str, Any]) -> str:
    """Return a searched scale in words; empty where none was searched, or none was found."""
    search = document.get("scale_search")
    if not search or search["sigma_ln"] is None or document["status"] == "failed":
        return ""
    by = search.get("control_points", 0)
    how = f"from the clouds and {by} control point{'s' if by != 1 else ''}" if by else "searched"
    return (
        f"{how}: one unit of {search['cloud']} is {search['metres_per_unit']:.6g} m "
        f"(sigma {100 * search['sigma_ln']:.2g} %)"
    )


def _overlap(fine: Mapping[str, Any], bound: str) -> str:
    return f"{100 * fine['overlap_source']:.1f} %, {100 * fine['overlap_target']:.1f} % ({bound})"


def _spread(covariance: Sequence[Sequence[float]] | None, about: Sequence[float] | None) -> str:
    if covariance is None:
        return ""
    sigma = np.sqrt(np.maximum(np.diag(np.array(covariance)), 0.0))
    turn, shift = np.degrees(np.linalg.norm(sigma[:3])), 1000 * np.linalg.norm(sigma[3:6])
    at = "" if about is None else f", at {', '.join(f'{value:,.1f}' for value in about)}"
    return f"{turn:.4f} deg, {shift:.1f} mm{at}"


def network_rows(network: Mapping[str, Any] | None) -> list[dict[str, str]]:
    """Return the pairs of a network as words; none where there are only two clouds."""
    return [] if network is None else [_network_row(row) for row in network["links"]]


def _network_row(row: Mapping[str, Any]) -> dict[str, str]:
    is_linked = row["weight"] is not None
    loop = "-"
    if row["loop_error_m"] is not None:
        loop = f"{1000 * row['loop_error_m']:.1f} mm, {row['loop_error_deg']:.3f} deg"
    tone = TONES[row["status"]]
    word = WORDS[tone]
    remark = "" if row["is_checked"] else "no loop checks it"
    if row["is_left_out"]:
        tone, word, remark = "bad", "Left out", "the other links contradict it"
    return {
        "pair": f"{row['source']} onto {row['target']}",
        "tone": tone,
        "word": word,
        "overlap": "-" if row["overlap"] is None else f"{100 * row['overlap']:.0f} %",
        "loop": loop,
        "remark": remark if is_linked else "not a link",
    }
