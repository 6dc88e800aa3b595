"""The report as plain data: what is said, before anything is drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dougong._words import counted
from dougong.report.key_numbers import KeyNumber, key_numbers, pair_numbers
from dougong.report.links import Link, link, network_rows
from dougong.report.verdict import Verdict, accuracy, plain, run_verdict


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
    network: tuple[Mapping[str, str], ...] = ()
    """Every pair that was registered, where there are three clouds or more: what, verdict, loop
    error, remark."""
    legend: tuple[tuple[str, str], ...] = field(default=())
    """Cloud name and colour (CSS)."""


def from_run(result: Mapping[str, Any], demo: Mapping[str, Any] | None) -> Report:
    """Return the report of a run (and of a demo, where its errors against truth are known)."""
    links = tuple(link(document) for document in result["registrations"])
    return Report(
        title=result["project"],
        subtitle=_subtitle(result),
        verdict=run_verdict(result, demo),
        key_numbers=key_numbers(result, demo),
        checks=accuracy(result["registrations"], result.get("quality")),
        clouds=tuple(_cloud(cloud) for cloud in result["clouds"]),
        links=links,
        notes=tuple(result["notes"]),
        network=tuple(network_rows(result.get("network"))),
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
        verdict=Verdict(tone=only.tone, word=only.word, sentence=plain(document)),
        key_numbers=tuple(pair_numbers([document])),
        checks=accuracy([document], None),
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
    said = f"{counted(merged['points'])}, source_id per cloud"
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


def flat(values: Any, path: str = "") -> list[tuple[str, str]]:
    """Return nested parameters as (dotted name, value) rows, values as a project file has them."""
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
    if isinstance(values, bool):
        return [(path, "true" if values else "false")]
    if isinstance(values, list):
        return [(path, ", ".join(map(str, values)) or "none")]
    return [(path, str(values))]


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
