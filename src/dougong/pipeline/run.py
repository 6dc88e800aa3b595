"""The main job: read, filter, register every cloud onto the reference, merge, write."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dougong.pipeline.control import (
    control_of_project,
    quality_document,
    quality_notes,
)
from dougong.pipeline.distances import (
    write_distances,
)
from dougong.pipeline.full_resolution import Place, full_notes, write_full_resolution
from dougong.pipeline.links import Linked, measured_link
from dougong.pipeline.loading import Loader
from dougong.pipeline.memory import Room
from dougong.pipeline.movers import Mover, ReducedClouds
from dougong.pipeline.network import Frames, register_all
from dougong.pipeline.outputs import finite, scratch_folder, write_json
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import Project
from dougong.pipeline.provenance import Clock, peak_memory_bytes, software
from dougong.pipeline.refusals import refuse_full_disk_after_filters
from dougong.pipeline.result_hash import result_hash
from dougong.pipeline.run_document import (
    DISTANCES,
    cloud_document,
    notes_of,
    project_document,
    registration_documents,
)
from dougong.pipeline.scaling import load_all
from dougong.pipeline.store import Store
from dougong.pipeline.writing import write_clouds, write_registrations
from dougong.registration.control_solve import ControlPoints
from dougong.tiles.shared import copies_in

_WORST = ("failed", "ambiguous", "ok")


def run(
    project: Project,
    folder: Path,
    out: Path,
    *,
    store: Store,
    progress: Progress,
    room: Room | None = None,
    shown: Callable[[Path], str] = str,
) -> dict[str, Any]:
    """Run a whole project and write its files into the empty folder `out`.

    Parameters
    ----------
    project : Project
    folder : Path
        What the project's paths are relative to.
    out : Path
        Gets merged.copc.laz, clouds/, removed/, distances/, registrations/, result.json and,
        if asked, full/.
    store : Store
        Keeps finished filter steps.
    progress : Progress
    room : Room, optional
        Memory that may be used; what does not fit is worked on in tiles on disk.
    shown : callable
        How a path is named in the results.

    Returns
    -------
    dict
        The document of result.json.
    """
    with (
        store.claimed(),
        scratch_folder(store.of_run) as scratch,
        copies_in(scratch / "copies"),
    ):
        loader = Loader(
            folder=folder,
            recipe=project.filter,
            store=store,
            progress=progress,
            clock=Clock(),
            shown=shown,
            room=room or Room.of(None),
            scratch=scratch,
        )
        result: dict[str, Any] = finite(_result(project, loader, out))
    write_json(out / "result.json", result)
    return result


def _result(project: Project, loader: Loader, out: Path) -> dict[str, Any]:
    """Do the work and write all but result.json, whose document is returned."""
    clock, progress = loader.clock, loader.progress
    control = control_of_project(project, loader.folder)
    movers = load_all(project, loader, control)
    refuse_full_disk_after_filters(
        movers, loader.room, loader.scratch, full=project.project.full_resolution
    )
    reference = next(mover for mover in movers if mover.entry == project.reference())
    found = _registered(project, loader, movers, reference, control)
    linked, hold = found.linked, loader.hold()
    documents = registration_documents(linked, reference, loader)
    for link in linked:
        if link.measured is not None:
            write_distances(link.measured, out / DISTANCES / f"{link.mover.name}.laz")
    merged, said = write_clouds(linked, reference.frame, project.merge, out, progress, clock, hold)
    write_registrations(documents, linked, reference, out, loader.shown)
    asked = project.project.full_resolution
    full = _written_in_full(linked, reference, loader, out) if asked else None
    with clock.measure("hash"):
        digest = result_hash(linked, reference.frame, hold)
    statuses = [document["status"] for document in documents] or ["ok"]
    quality = quality_document(project.quality.required_level, documents)
    return {
        "status": min(statuses, key=_WORST.index),
        "is_settled": all(link.is_sure for link in linked) and quality["is_reached"] is not False,
        "quality": quality,
        "project": project.project.name,
        "reference": reference.name,
        "clouds": [cloud_document(link, loader) for link in linked],
        "registrations": documents,
        "network": found.document,
        "merged": merged,
        "full_resolution": full,
        "seconds": {**clock.seconds, "total": clock.total()},
        "cpu_seconds": dict(clock.cpu_seconds),
        "peak_memory_bytes": peak_memory_bytes(),
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "result_hash": digest,
        "software": software(),
        "parameters": project_document(project, loader.shown),
        "inputs": list(loader.inputs.values()),
        "notes": [
            *quality_notes(quality),
            *notes_of(linked),
            *said,
            *(f"{merged['file']}: {note}" for note in merged["notes"]),
            *full_notes(full),
        ],
    }


def _registered(
    project: Project,
    loader: Loader,
    movers: Sequence[Mover],
    reference: Mover,
    control: Mapping[str, ControlPoints],
) -> Frames:
    """Register all clouds, reduced, and measure what is left between them."""
    clouds, progress = ReducedClouds(movers), loader.progress
    with loader.clock.measure("register"):
        found = register_all(movers, reference, project.registration, control, progress, clouds)
    with loader.clock.measure("distances"):
        linked = [measured_link(link, reference, clouds, progress) for link in found.linked]
    return replace(found, linked=linked)


def _written_in_full(
    linked: Sequence[Linked], reference: Mover, loader: Loader, out: Path
) -> dict[str, Any]:
    """Write every input file with all its points in the frame of the reference."""
    with loader.clock.measure("full_resolution"):
        return write_full_resolution(
            _places(linked),
            reference.frame,
            out,
            reference=reference.name,
            inputs=loader.inputs,
            require_unchanged=loader.require_unchanged,
            shown=loader.shown,
            progress=loader.progress,
        )


def _places(linked: Sequence[Linked]) -> list[Place]:
    """Return where each file, or each scan that moves by itself, goes."""
    return [
        Place(
            mover=link.mover.name,
            entry=link.mover.entry,
            file=source.file,
            # Scans without points are not among the stations; the header counts them.
            station=source.kept.first.header.station if source.is_scan else -1,
            status="reference" if link.result is None else link.result.status,
            matrix=link.matrix,
        )
        for link in linked
        for source in link.mover.sources
    ]
