"""The report as plain data: what is said, before anything is drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

Tone = Literal["good", "unsure", "bad"]
TONES: dict[str, Tone] = {"ok": "good", "ambiguous": "unsure", "failed": "bad"}
WORDS: dict[Tone, str] = {"good": "Registered", "unsure": "Ambiguous", "bad": "Not registered"}
NO_CHECKS = (
    "No independent check points were given: no accuracy grade is stated (no USIBD level of "
    "accuracy, LOA). The numbers on this page say how well the clouds fit each other, not how "
    "well they fit the world."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyNumber:
    """One of the three numbers of the first screen."""

    label: str
    value: str
    unit: str
    definition: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The first thing a reader sees."""

    tone: Tone
    word: str
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudRow:
    """What the filters did to one cloud."""

    name: str
    kind: str
    files: tuple[str, ...]
    points_in: int
    points_out: int
    stages: tuple[Mapping[str, Any], ...]
    frame: str


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Everything the page says."""

    title: str
    subtitle: str
    verdict: Verdict
    key_numbers: tuple[KeyNumber, ...]
    checks: tuple[str, ...]
    """What is known of the accuracy, one sentence per registration; or that nothing is."""
    clouds: tuple[CloudRow, ...]
    links: tuple[Link, ...]
    notes: tuple[str, ...]
    outputs: tuple[tuple[str, str], ...]
    inputs: tuple[Mapping[str, Any], ...]
    parameters: tuple[tuple[str, str], ...]
    provenance: tuple[tuple[str, str], ...]
    legend: tuple[tuple[str, str], ...] = field(default=())
    """Cloud name and colour (CSS)."""


def from_run(result: Mapping[str, Any], demo: Mapping[str, Any] | None) -> Report:
    """Return the report of a run (and of a demo, where its errors against truth are known)."""
    links = tuple(link(document) for document in result["registrations"])
    return Report(
        title=result["project"],
        subtitle=_subtitle(result),
        verdict=_run_verdict(result, demo),
        key_numbers=_key_numbers(result, demo),
        checks=_accuracy(result["registrations"], result.get("quality")),
        clouds=tuple(_cloud(cloud) for cloud in result["clouds"]),
        links=links,
        notes=tuple(result["notes"]),
        outputs=tuple(_outputs(result)),
        inputs=tuple(result["inputs"]),
        parameters=tuple(flat(result["parameters"])),
        provenance=_provenance(result),
    )


def _outputs(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the files of a run and what each is."""
    rows = [
        ("merged.copc.laz", _merged(result["merged"])),
        ("clouds/", "each filtered cloud in the frame of the reference"),
        (
            "registrations/",
            "the transform of each cloud, both ways, with its proof; beside it for "
            "CloudCompare, PDAL and Metashape",
        ),
        ("distances/", "what is left between the clouds: signed distances with their detection"),
        ("removed/", "a sample of the removed points, each with its reason"),
    ]
    if result.get("full_resolution"):
        rows.append(("full/", "every input file, undecimated, in the frame of the reference"))
    return [*rows, ("result.json", "everything on this page for machines")]


def from_registration(document: Mapping[str, Any]) -> Report:
    """Return the report of a single registration."""
    only = link(document)
    return Report(
        title=f"{document['source']} onto {document['target']}",
        subtitle="Registration of two clouds",
        verdict=Verdict(tone=only.tone, word=only.word, sentence=_plain(document)),
        key_numbers=tuple(_pair_numbers([document])),
        checks=_accuracy([document], None),
        clouds=(),
        links=(only,),
        notes=tuple(document["notes"]),
        outputs=(("registration.json", "the transform with its proof, for machines"),),
        inputs=tuple(document["inputs"]),
        parameters=tuple(flat(document["parameters"])),
        provenance=_provenance(document),
    )


def _merged(merged: Mapping[str, Any]) -> str:
    """Return what the merged cloud holds and what was left out of it, and why."""
    said = f"{merged['points']:,} points, source_id per cloud"
    rows = merged.get("sources", {})
    out = [f"{row['left_out']:,} of {name}" for name, row in rows.items() if row["left_out"]]
    if not out:
        return said
    return (
        f"{said}; left out where a better source saw the same surface: {' and '.join(out)} (they "
        'are in clouds/; [merge] mode = "all" brings them back)'
    )


def _subtitle(result: Mapping[str, Any]) -> str:
    kinds = [cloud["kind"] for cloud in result["clouds"]]
    counted = [
        f"{kinds.count(kind)} {word}{'s' if kinds.count(kind) > 1 else ''}"
        for kind, word in (("lidar", "laser scan cloud"), ("photogrammetry", "drone cloud"))
        if kind in kinds
    ]
    return f"{' and '.join(counted)}, in the frame of {result['reference']}"


def sentence(text: str) -> str:
    """Return `text` with a capital at its start and a stop at its end."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def _plain(document: Mapping[str, Any]) -> str:
    """Return the verdict on one registration in words for people who sign it."""
    left = _left(document)
    if document["status"] != "ok" or not left:
        return sentence(document["reason"])
    return (
        f"{document['source']} fits {document['target']} at one pose, and at none of the others "
        f"that were searched for. {left}"
    )


def _left(document: Mapping[str, Any]) -> str:
    """Return what the registration leaves, in one sentence; empty where it was not measured."""
    return str((document.get("distances") or {}).get("sentence", ""))


def _run_verdict(result: Mapping[str, Any], demo: Mapping[str, Any] | None) -> Verdict:
    documents = result["registrations"]
    tone = TONES[result["status"]]
    if not documents:
        words = "One cloud was given, so it was filtered; there was nothing to register."
        return Verdict(tone="good", word="Filtered", sentence=words)
    sure = sum(document["status"] == "ok" for document in documents)
    if demo is not None and demo["tre95_m"] is not None:
        words = (
            f"The pose lies {1000 * demo['tre95_m']:.1f} mm from the truth (95 % of the surface): "
            f"{demo['verdict']}. {_left(documents[0])}"
        ).strip()
    elif len(documents) == 1:
        words = _plain(documents[0])
    else:
        words = f"{sure} of {len(documents)} clouds were registered with certainty."
    if tone != "good":
        words += f" The merged cloud holds only: {', '.join(result['merged']['clouds'])}."
    return Verdict(tone=tone, word=WORDS[tone], sentence=words)


def _key_numbers(
    result: Mapping[str, Any], demo: Mapping[str, Any] | None
) -> tuple[KeyNumber, ...]:
    if demo is not None and demo["tre95_m"] is not None:
        return _truth_numbers(demo)
    if result["registrations"]:
        return tuple(_pair_numbers(result["registrations"]))
    cloud = result["clouds"][0]
    return (
        KeyNumber(
            label="Points in",
            value=f"{cloud['points_in']:,}",
            unit="",
            definition="points with finite coordinates in the input files",
        ),
        KeyNumber(
            label="Points kept",
            value=f"{cloud['points_out']:,}",
            unit="",
            definition="original points, selected and never changed",
        ),
        KeyNumber(
            label="Reduction",
            value=f"{100 * cloud['reduction']:.2f}",
            unit="%",
            definition="data reduction rate: 1 - points kept / points in",
        ),
    )


def _truth_numbers(demo: Mapping[str, Any]) -> tuple[KeyNumber, ...]:
    return (
        KeyNumber(
            label="Pose error (TRE95)",
            value=f"{1000 * demo['tre95_m']:.1f}",
            unit="mm",
            definition=(
                "95 % of the surface that both sensors saw lies nearer than this to where the "
                "best possible pose would put it"
            ),
        ),
        KeyNumber(
            label="Rotation error",
            value=f"{demo['rotation_error_deg']:.4f}",
            unit="deg",
            definition="angle between the pose found and the best possible pose",
        ),
        KeyNumber(
            label="Bending floor",
            value=f"{1000 * demo['bending_floor95_m']:.1f}",
            unit="mm",
            definition=(
                "95 % residual that the best rigid pose itself leaves, since the drone cloud is "
                "slowly bent; no rigid registration can do better"
            ),
        ),
    )


def _pair_numbers(documents: Sequence[Mapping[str, Any]]) -> list[KeyNumber]:
    """Return what is left between the clouds; where it was not measured, how the fit went."""
    fit = _fit_numbers(documents)
    measured = [document["distances"] for document in documents if document.get("distances")]
    if not measured:
        return fit
    worst = max(measured, key=lambda found: float(found["within95_m"]))
    more = " (the worst of all links)" if len(documents) > 1 else ""
    return [
        KeyNumber(
            label="95 % of distances within",
            value=f"{1e3 * worst['within95_m']:.1f}",
            unit="mm",
            definition=(
                "between the two clouds along the surface's normal (M3C2), where both show it"
                f"{more}; fit to each other, not accuracy"
            ),
        ),
        KeyNumber(
            label="Level of detection (95 %)",
            value=f"{1e3 * worst['lod95_m']:.1f}",
            unit="mm",
            definition=(
                "a smaller distance cannot be told from none: noise, roughness and the "
                "registration's own uncertainty; the typical value"
            ),
        ),
        replace(
            fit[1], definition=f"share of the moved cloud with the other cloud {_reach(documents)}"
        ),
    ]


def _reach(documents: Sequence[Mapping[str, Any]]) -> str:
    """Return the distance bound of the overlap in words."""
    bounds = [document["fine"]["max_distance_m"] for document in documents if document["fine"]]
    return f"within {1000 * max(bounds):.0f} mm" if bounds else "near"


def _fit_numbers(documents: Sequence[Mapping[str, Any]]) -> list[KeyNumber]:
    fines = [document["fine"] for document in documents if document["fine"]]
    rmse = [fine["inlier_rmse_m"] for fine in fines if fine["inlier_rmse_m"] is not None]
    margin = min(document["coarse"]["margin"] for document in documents)
    worst = " (the worst of all links)" if len(documents) > 1 else ""
    reach = max((fine["max_distance_m"] for fine in fines), default=None)
    return [
        KeyNumber(
            label="Inlier RMSE",
            value=f"{1000 * max(rmse):.1f}" if rmse else "none",
            unit="mm" if rmse else "",
            definition=(
                "root mean square residual of the correspondences"
                + (f" within {1000 * reach:.0f} mm" if reach else "")
                + f"{worst}; a measure of fit, not of accuracy"
            ),
        ),
        KeyNumber(
            label="Overlap",
            value=f"{100 * min(fine['overlap_source'] for fine in fines):.0f}" if fines else "none",
            unit="%" if fines else "",
            definition=f"share of the moved cloud with the other cloud within that distance{worst}",
        ),
        KeyNumber(
            label="Margin",
            value=f"{margin:.2f}",
            unit="",
            definition=(
                "1 - s2/s1: how far the best coarse pose leads the next one that lies more than "
                f"5 deg or 0.5 m away; 0 is a tie, 1 is no rival{worst}"
            ),
        ),
    ]


def _cloud(cloud: Mapping[str, Any]) -> CloudRow:
    return CloudRow(
        name=cloud["name"],
        kind=cloud["kind"],
        files=tuple(cloud["files"]),
        points_in=cloud["points_in"],
        points_out=cloud["points_out"],
        stages=tuple(cloud["stages"]),
        frame=cloud["frame"],
    )


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
    )


def _points(checks: Mapping[str, Any] | None) -> list[dict[str, str]]:
    """Return control and check points as words: name, role, residual, remark."""
    if checks is None:
        return []
    return [
        {
            "name": point["name"],
            "role": point["role"],
            "residual": _millimetres(point["residual_m"]),
            "sigma": _millimetres(point["sigma_m"]),
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


def _millimetres(metres: float | None) -> str:
    return "-" if metres is None else f"{1000 * metres:.1f} mm"


def _accuracy(
    documents: Sequence[Mapping[str, Any]], quality: Mapping[str, Any] | None
) -> tuple[str, ...]:
    """Return what check points prove, one sentence per registration, or that none were given."""
    checked = [d for d in documents if (d.get("checks") or {}).get("check")]
    if not checked:
        return (NO_CHECKS,)
    said = []
    for document in checked:
        check = document["checks"]["check"]
        level = check["level"] or "coarser than LOA10"
        points = f"{check['points']} check point{'s' if check['points'] != 1 else ''}"
        said.append(
            f"{document['source']}: {points} that had no part in the fit lie "
            f"{_millimetres(check['check_rmse_m'])} (check RMSE, three dimensions) from their "
            f"places; with 95 % confidence 95 % of the errors are below "
            f"{_millimetres(check['upper95_m'])}: {level} (USIBD)."
        )
    if quality is not None and quality["required_level"] is not None:
        is_reached = "is" if quality["is_reached"] else "is NOT"
        said.append(f"The required level, {quality['required_level']}, {is_reached} reached.")
    return tuple(said)


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
    spread = _spread(document["covariance"])
    if spread:
        facts.append(("standard deviation of the fit", spread))
    return facts


def _scale(document: Mapping[str, Any]) -> str:
    """Return the scale of the matrix and what fixes it; documents before 0.2 do not say it."""
    scale = f"{document['scale']:.9g}"
    search, grid = document.get("scale_search"), document.get("grid")
    if search and search["sigma_ln"] is not None:
        scale += (
            f", searched: one unit of {search['cloud']} is {search['metres_per_unit']:.6g} m "
            f"(sigma {100 * search['sigma_ln']:.2g} %)"
        )
    if grid:
        scale += (
            f", known from the map projection ({grid['ppm']:+.1f} ppm in plan, "
            f"{'as given' if grid['from'] == 'given' else 'by the coordinate system'}; heights "
            f"off by at most {1000 * grid['height_error_m']:.1f} mm for it)"
        )
    return scale


def _overlap(fine: Mapping[str, Any], bound: str) -> str:
    return f"{100 * fine['overlap_source']:.1f} %, {100 * fine['overlap_target']:.1f} % ({bound})"


def _spread(covariance: Sequence[Sequence[float]] | None) -> str:
    if covariance is None:
        return ""
    sigma = np.sqrt(np.maximum(np.diag(np.array(covariance)), 0.0))
    turn, shift = np.degrees(np.linalg.norm(sigma[:3])), 1000 * np.linalg.norm(sigma[3:6])
    return f"{turn:.4f} deg, {shift:.1f} mm, at the middle of the overlap"


def flat(values: Any, path: str = "") -> list[tuple[str, str]]:
    """Return nested parameters as (dotted name, value) rows."""
    if isinstance(values, Mapping):
        rows = []
        for key, value in values.items():
            rows += flat(value, f"{path}.{key}" if path else str(key))
        return rows
    if isinstance(values, list) and values and isinstance(values[0], Mapping):
        rows = []
        for index, value in enumerate(values, 1):
            rows += flat(value, f"{path}[{index}]")
        return rows
    if values is None:
        return [(path, "not set")]
    return [(path, ", ".join(map(str, values)) if isinstance(values, list) else str(values))]


def _provenance(document: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    software = document["software"]
    libraries = ", ".join(f"{name} {number}" for name, number in software["libraries"].items())
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in document["seconds"].items())
    peak = document["peak_memory_bytes"]
    rows = [
        ("dougong", software["dougong"]),
        ("finished", document.get("finished_utc") or "not recorded"),
        ("time", seconds),
        ("peak memory", f"{peak / 1e9:.2f} GB" if peak else "not told by this system"),
        ("Python", f"{software['python']} on {software['platform']}"),
        ("libraries", libraries),
    ]
    if document.get("result_hash"):
        rows.insert(1, ("result hash (SHA-256)", document["result_hash"]))
    return tuple(rows)
