"""What result.json says of a run: its clouds, registrations and parameters, as plain data."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dougong.filters.selection import Reason
from dougong.pipeline.distances import (
    distances_document,
)
from dougong.pipeline.links import Linked
from dougong.pipeline.loading import Loader
from dougong.pipeline.movers import Mover
from dougong.pipeline.project import Project
from dougong.pipeline.registrations import to_document

DISTANCES = "distances"


def registration_documents(
    linked: Sequence[Linked], reference: Mover, loader: Loader
) -> list[dict[str, Any]]:
    """Return what each registration says of itself, as ``registration.json`` does."""
    return [
        to_document(
            link.result,
            source=link.mover.name,
            target=reference.name,
            source_frame=link.mover.frame,
            target_frame=reference.frame,
            inputs=[
                loader.inputs[source.file] for source in (*link.mover.sources, *reference.sources)
            ],
        )
        | {"distances": _distances_document(link)}
        for link in linked
        if link.result is not None
    ]


def _distances_document(link: Linked) -> dict[str, Any] | None:
    if link.measured is None:
        return None
    return distances_document(link.measured, f"{DISTANCES}/{link.mover.name}.laz")


def cloud_document(link: Linked, loader: Loader) -> dict[str, Any]:
    """Return the counts of one cloud, stage by stage."""
    mover = link.mover
    reasons: Counter[str] = Counter()
    details: Counter[str] = Counter()
    for source in mover.sources:
        reasons.update(source.tally.reasons)
        details.update(source.tally.details)
    return {
        "name": mover.name,
        "kind": mover.kind,
        "files": [loader.shown(source.file) for source in mover.sources],
        "frame": "of the reference" if link.is_sure else "its own, as it is not registered",
        "scale_known": mover.scale is None,
        "points_in": mover.points_in,
        "points_out": mover.points_out,
        "reduction": 1.0 - mover.points_out / mover.points_in,
        "stages": stage_documents(mover),
        "reasons": {name: count for name, count in reasons.items() if count},
        "removal_details": dict(details),
        "removed_shown": sum(len(source.removed) for source in mover.sources),
        "removed_by_file": [
            {"removed": _taken_out(source.tally.reasons), "shown": len(source.removed)}
            for source in mover.sources
        ],
        "ground_points": sum(source.tally.ground for source in mover.sources),
    }


def _taken_out(reasons: Counter[str]) -> int:
    """Return how many points of a file the sample of removed ones is of."""
    left = (Reason.KEPT, Reason.DECIMATED)
    return reasons.total() - sum(reasons[reason.name.lower()] for reason in left)


def stage_documents(mover: Mover) -> list[dict[str, Any]]:
    """Return the stages of a mover, summed over its files."""
    rows: dict[str, dict[str, Any]] = {}
    for source in mover.sources:
        for stage in source.stages:
            row = rows.setdefault(
                stage.name, {"name": stage.name, "points_in": 0, "points_out": 0, "seconds": 0.0}
            )
            row["points_in"] += stage.points_in
            row["points_out"] += stage.points_out
            row["seconds"] += stage.seconds
            for name, count in stage.found.items():
                found = row.setdefault("found", {})
                found[name] = found.get(name, 0) + count
    for row in rows.values():
        row["reduction"] = 1.0 - row["points_out"] / row["points_in"] if row["points_in"] else 0.0
    return list(rows.values())


def project_document(project: Project, shown: Callable[[Path], str]) -> dict[str, Any]:
    """Return the project as data, its files named as everywhere in the results."""
    document: dict[str, Any] = project.model_dump(mode="json", by_alias=True)
    for entry in document["cloud"]:
        entry["files"] = [shown(Path(file)) for file in entry["files"]]
    return document


def notes_of(linked: Sequence[Linked]) -> list[str]:
    """Return what files, filters and registrations had to say, each once."""
    notes = [note for link in linked for source in link.mover.sources for note in source.notes]
    for link in linked:
        if link.result is not None:
            notes += [f"registering {link.mover.name}: {note}" for note in link.result.notes]
    return list(dict.fromkeys(notes))
