"""The main job: read, filter, register every cloud onto the reference, merge, write."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.filters.selection import Reason
from dougong.formats import write, write_merged
from dougong.pipeline.control import (
    control_of,
    control_of_project,
    quality_document,
)
from dougong.pipeline.distances import (
    Measured,
    distances_document,
    measure,
    with_distances,
    write_distances,
)
from dougong.pipeline.exports import Ends, write_registration
from dougong.pipeline.full_resolution import Place, full_notes, write_full_resolution
from dougong.pipeline.loading import Loader, Mover
from dougong.pipeline.memory import Room
from dougong.pipeline.merging import Merge, Part, choose
from dougong.pipeline.outputs import write_json
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import Project
from dougong.pipeline.provenance import Clock, peak_memory_bytes, software
from dougong.pipeline.registering import register
from dougong.pipeline.registrations import finite, to_document
from dougong.pipeline.removed import detail_totals
from dougong.pipeline.store import Store
from dougong.registration import Register
from dougong.registration.control_solve import ControlPoints
from dougong.registration.result import Registration
from dougong.typing import Transform

MERGED = "merged.copc.laz"
REMOVED = "removed"
DISTANCES = "distances"
_WORST = ("failed", "ambiguous", "ok")


@dataclass(frozen=True, slots=True, kw_only=True)
class Linked:
    """A mover and how it got into the reference's frame (None: it is the reference)."""

    mover: Mover
    result: Registration | None
    accepts_best: bool = False
    """The user takes the best pose of an ambiguous registration."""
    measured: Measured | None = None
    """What its registration leaves between it and the reference; None: not sure, or nothing."""

    @property
    def is_sure(self) -> bool:
        """True: its points belong into the merged cloud."""
        if self.result is None or self.result.status == "ok":
            return True
        return self.accepts_best and self.result.matrix is not None

    @property
    def matrix(self) -> Transform | None:
        """(4, 4) from its file coordinates to the reference's; None where that is not sure."""
        if self.result is None:
            return np.eye(4)
        return self.result.matrix if self.is_sure else None

    def in_reference(self, clouds: list[Cloud], reference: Cloud) -> list[Cloud]:
        """Return its `clouds` in the reference's frame; where that is not known, in their own."""
        if self.result is None or self.matrix is None:
            return clouds
        return [cloud.moved(self.matrix, reference.frame) for cloud in clouds]


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
        Memory that may be used; a laser scan that does not fit is decimated on tiles.
    shown : callable
        How a path is named in the results.

    Returns
    -------
    dict
        The document of result.json.
    """
    clock = Clock()
    loader = Loader(
        folder=folder,
        recipe=project.filter,
        store=store,
        progress=progress,
        clock=clock,
        shown=shown,
        room=room or Room.of(None),
    )
    control = control_of_project(project, folder)
    movers = [mover for entry in project.cloud for mover in loader.movers(entry)]
    reference = next(mover for mover in movers if mover.entry == project.reference())
    with clock.measure("register"):
        linked = _register_all(movers, reference, project.registration, control, progress)
    with clock.measure("distances"):
        linked = [_measured(link, reference, progress) for link in linked]
    documents = _registration_documents(linked, reference, loader)
    for link in linked:
        if link.measured is not None:
            write_distances(link.measured, out / DISTANCES / f"{link.mover.name}.laz")
    with clock.measure("write"):
        merged = _write_clouds(linked, reference, project.merge, out, progress)
    _write_registrations(documents, linked, reference, out, shown)
    full = None
    if project.project.full_resolution:
        with clock.measure("full_resolution"):
            full = write_full_resolution(
                _places(linked),
                reference.clouds[0].frame,
                out,
                reference=reference.name,
                inputs=loader.inputs,
                shown=shown,
                progress=progress,
            )
    statuses = [document["status"] for document in documents] or ["ok"]
    quality = quality_document(project.quality.required_level, documents)
    result: dict[str, Any] = {
        "status": min(statuses, key=_WORST.index),
        "is_settled": all(link.is_sure for link in linked) and quality["is_reached"] is not False,
        "quality": quality,
        "project": project.project.name,
        "reference": reference.name,
        "clouds": [_cloud_document(link, loader) for link in linked],
        "registrations": documents,
        "merged": merged,
        "full_resolution": full,
        "seconds": {**clock.seconds, "total": clock.total()},
        "peak_memory_bytes": peak_memory_bytes(),
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "result_hash": _result_hash(linked, reference),
        "software": software(),
        "parameters": _parameters(project, shown),
        "inputs": list(loader.inputs.values()),
        "notes": [*_notes(linked), *full_notes(full)],
    }
    result = finite(result)
    write_json(out / "result.json", result)
    return result


def _write_registrations(
    documents: Sequence[dict[str, Any]],
    linked: Sequence[Linked],
    reference: Mover,
    out: Path,
    shown: Callable[[Path], str],
) -> None:
    """Write each registration and, where it is sure, its forms for other programs."""
    moved = [link.mover for link in linked if link.result is not None]
    for document, mover in zip(documents, moved, strict=True):
        ends = Ends(
            source=mover.name,
            target=reference.name,
            source_frame=mover.clouds[0].frame,
            target_frame=reference.clouds[0].frame,
            # One scan of a file cannot be named in a pipeline that reads whole files.
            files=[shown(source.file) for source in mover.sources if not source.is_scan],
        )
        write_registration(out / "registrations", mover.name, document, ends)


def _places(linked: Sequence[Linked]) -> list[Place]:
    """Return where each file, or each scan that moves by itself, goes."""
    return [
        Place(
            mover=link.mover.name,
            entry=link.mover.entry,
            file=source.file,
            # Scans without points are not among the stations; the header counts them.
            station=source.filtered.cloud.header.station if source.is_scan else -1,
            status="reference" if link.result is None else link.result.status,
            matrix=link.matrix,
        )
        for link in linked
        for source in link.mover.sources
    ]


def _parameters(project: Project, shown: Callable[[Path], str]) -> dict[str, Any]:
    """Return the project as data, its files named as everywhere in the results."""
    document: dict[str, Any] = project.model_dump(mode="json", by_alias=True)
    for entry in document["cloud"]:
        entry["files"] = [shown(Path(file)) for file in entry["files"]]
    return document


def _register_all(
    movers: Sequence[Mover],
    reference: Mover,
    params: Register,
    control: Mapping[str, ControlPoints],
    progress: Progress,
) -> list[Linked]:
    target = reference.joined()
    params = params.model_copy(update={"filtered": True})
    linked = []
    for mover in movers:
        if mover is reference:
            linked.append(Linked(mover=mover, result=None))
            continue
        progress.stage(f"registering {mover.name} onto {reference.name}")
        result = register(
            mover.joined(),
            target,
            params,
            source_kind=mover.kind,
            target_kind=reference.kind,
            control=control_of(control, mover.name, mover.entry),
        )
        progress.note(f"{mover.name} -> {reference.name}: {result.status}. {result.reason}")
        linked.append(Linked(mover=mover, result=result, accepts_best=params.accept_best))
    return linked


def _registration_documents(
    linked: Sequence[Linked], reference: Mover, loader: Loader
) -> list[dict[str, Any]]:
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


def _measured(link: Linked, reference: Mover, progress: Progress) -> Linked:
    """Return a sure link with the distances that its registration leaves."""
    if link.result is None or not link.is_sure:
        return link
    progress.stage(f"measuring {link.mover.name} against {reference.name}")
    found = measure(link.mover.joined(), reference.joined(), link.result)
    return replace(link, measured=found)


def _distances_document(link: Linked) -> dict[str, Any] | None:
    if link.measured is None:
        return None
    return distances_document(link.measured, f"{DISTANCES}/{link.mover.name}.laz")


def _write_clouds(
    linked: Sequence[Linked], reference: Mover, merge: Merge, out: Path, progress: Progress
) -> dict[str, Any]:
    """Write each filtered cloud and the merged one; return what the merged one holds."""
    frame_of = reference.clouds[0]
    parts: list[Part] = []
    measured = [link.measured for link in linked if link.measured is not None]
    for source_id, link in enumerate(linked, 1):
        progress.stage(f"writing clouds/{link.mover.name}.laz")
        clouds = link.in_reference(link.mover.clouds, frame_of)
        _write_one(clouds, out / "clouds" / f"{link.mover.name}.laz", source_id)
        removed = [source.removed for source in link.mover.sources if len(source.removed)]
        if removed:
            placed = link.in_reference(removed, frame_of)
            _write_one(placed, out / REMOVED / f"{link.mover.name}.laz", source_id)
        if link.is_sure:
            if measured:
                own = measured if link.result is None else [link.measured] if link.measured else []
                clouds = [with_distances(cloud, own) for cloud in clouds]
            parts += [
                Part(cloud=c, source_id=source_id, name=link.mover.name, kind=link.mover.kind)
                for c in clouds
            ]
    progress.stage(f"writing {MERGED}")
    return {"file": MERGED, **_write_merged(parts, merge, out / MERGED, progress)}


def _write_merged(
    parts: Sequence[Part], merge: Merge, path: Path, progress: Progress
) -> dict[str, Any]:
    """Write what is chosen of the sure clouds as one; return what it holds and what it does not."""
    chosen = choose(parts, merge)
    pairs = zip(parts, chosen.kept, strict=True)
    write_merged(
        [part.cloud if kept.all() else part.cloud.select(kept) for part, kept in pairs],
        path,
        source_ids=[part.source_id for part in parts],
    )
    document = chosen.document(parts)
    for name, row in document["sources"].items():
        if row["left_out"]:
            progress.note(
                f"merged: {row['left_out']:,} points of {name} are left out where a better source "
                'saw the same surface (clouds/ holds them; [merge] mode = "all" brings them back)'
            )
    ids = {part.name: part.source_id for part in parts}
    return {**document, "clouds": list(ids), "source_ids": ids}


def _write_one(clouds: Sequence[Cloud], path: Path, source_id: int) -> None:
    path.parent.mkdir(exist_ok=True)
    if len(clouds) == 1:
        write(clouds[0], path)
    else:
        write_merged(clouds, path, source_ids=[source_id] * len(clouds))


def _cloud_document(link: Linked, loader: Loader) -> dict[str, Any]:
    mover = link.mover
    return {
        "name": mover.name,
        "kind": mover.kind,
        "files": [loader.shown(source.file) for source in mover.sources],
        "frame": "of the reference" if link.is_sure else "its own, as it is not registered",
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


def _result_hash(linked: Sequence[Linked], reference: Mover) -> str:
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


def _notes(linked: Sequence[Linked]) -> list[str]:
    notes = [note for link in linked for source in link.mover.sources for note in source.notes]
    for link in linked:
        if link.result is not None:
            notes += [f"{link.mover.name}: {note}" for note in link.result.notes]
    return list(dict.fromkeys(notes))
