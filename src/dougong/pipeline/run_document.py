"""What result.json says of a run: its clouds, registrations and parameters, as plain data."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dougong.filters.selection import Reason
from dougong.pipeline.distances import (
    distances_document,
)
from dougong.pipeline.links import Linked
from dougong.pipeline.loading import Loader, Mover
from dougong.pipeline.project import Project
from dougong.pipeline.registrations import to_document
from dougong.pipeline.removed import detail_totals

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
            target_frame=reference.clouds[0].frame,
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
        "reasons": reason_counts([source.filtered.codes for source in mover.sources]),
        "removal_details": detail_totals(source.filtered for source in mover.sources),
        "removed_shown": sum(len(source.removed) for source in mover.sources),
        "ground_points": int(sum(source.filtered.is_ground.sum() for source in mover.sources)),
    }


def stage_documents(mover: Mover) -> list[dict[str, Any]]:
    """Return the stages of a mover, summed over its files."""
    rows: dict[str, dict[str, Any]] = {}
    for source in mover.sources:
        for stage in source.filtered.stages:
            row = rows.setdefault(
                stage.name, {"name": stage.name, "points_in": 0, "points_out": 0, "seconds": 0.0}
            )
            row["points_in"] += stage.points_in
            row["points_out"] += stage.points_out
            row["seconds"] += stage.seconds
    for row in rows.values():
        row["reduction"] = 1.0 - row["points_out"] / row["points_in"] if row["points_in"] else 0.0
    return list(rows.values())


def reason_counts(codes: Sequence[np.typing.NDArray[np.uint8]]) -> dict[str, int]:
    """Return how many points each reason took (and how many were kept)."""
    counts: Counter[int] = Counter()
    for array in codes:
        counts.update(dict(enumerate(np.bincount(array, minlength=len(Reason)).tolist())))
    return {reason.name.lower(): counts[reason] for reason in Reason if counts[reason]}


def project_document(project: Project, shown: Callable[[Path], str]) -> dict[str, Any]:
    """Return the project as data, its files named as everywhere in the results."""
    document: dict[str, Any] = project.model_dump(mode="json", by_alias=True)
    for entry in document["cloud"]:
        entry["files"] = [shown(Path(file)) for file in entry["files"]]
    return document


def result_hash(linked: Sequence[Linked], reference: Mover) -> str:
    """Return the SHA-256 of kept records and local matrices: no time, path or header in it."""
    digest = hashlib.sha256()
    target = reference.joined().frame
    for link in linked:
        for cloud in link.mover.clouds:
            records = np.ascontiguousarray(cloud.records)
            digest.update(np.sort(records.view(f"V{records.dtype.itemsize}")).tobytes())
        if link.result is not None and link.result.matrix is not None:
            to_file = link.mover.joined().frame.T_file_local()
            local = np.linalg.inv(target.T_file_local()) @ link.result.matrix @ to_file
            # Adding zero turns -0.0 into 0.0, which has other bytes.
            digest.update((np.round(local, 9) + 0.0).tobytes())
    return digest.hexdigest()


def notes_of(linked: Sequence[Linked]) -> list[str]:
    """Return what files, filters and registrations had to say, each once."""
    notes = [note for link in linked for source in link.mover.sources for note in source.notes]
    for link in linked:
        if link.result is not None:
            notes += [f"{link.mover.name}: {note}" for note in link.result.notes]
    return list(dict.fromkeys(notes))
