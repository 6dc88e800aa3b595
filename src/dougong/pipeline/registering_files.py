"""``dougong register``: one file onto another, and the folder that tells of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dougong.cloud import Cloud
from dougong.errors import RegistrationError
from dougong.formats import (
    describe,
    faults_of,
    in_system,
    read,
)
from dougong.formats.faults import NO_SYSTEM
from dougong.formats.stream import stem_of
from dougong.pipeline.control import read_control, require_control_of
from dougong.pipeline.distances import Measured, distances_document, measure, write_distances
from dougong.pipeline.exports import Ends, write_registration
from dougong.pipeline.guess import guess_kind_of
from dougong.pipeline.memory import refuse_too_large
from dougong.pipeline.pairs import read_pairs
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import (
    identified,
    peak_memory_bytes,
    require_unchanged,
    software,
)
from dougong.pipeline.registering import impossible, register
from dougong.pipeline.registrations import to_document
from dougong.pipeline.settings import validated
from dougong.registration import Register
from dougong.registration.free_scale_result import in_found_unit
from dougong.registration.result import Registration
from dougong.typing import Kind

DISTANCES = "distances.laz"


def register_files(
    source: Path,
    target: Path,
    out: Path,
    *,
    options: Mapping[str, Any],
    source_kind: Kind | None,
    target_kind: Kind | None,
    memory_bytes: int | None,
    progress: Progress,
    pairs: Path | None = None,
    control: Path | None = None,
    crs: tuple[str | None, str | None] = (None, None),
) -> dict[str, Any]:
    """Register one file onto another; write ``registration.json`` into the folder `out`.

    Raises
    ------
    InputError
        A setting, the file of picked pairs or the control file is wrong, or the job needs more
        memory than it may use.
    FormatError, FrameError
        The clouds cannot be read or combined.
    """
    params = validated(Register, options, "register")
    picked = None if pairs is None else read_pairs(pairs, stem_of(source))
    surveyed = None
    if control is not None:
        surveyed = require_control_of(read_control(control), control, stem_of(source))
    refuse_too_large([source, target], memory_bytes)
    one = _read(source, source_kind, crs[0], progress)
    two = _read(target, target_kind, crs[1], progress)
    progress.stage(f"registering {source.name} onto {target.name}")
    try:
        result = register(
            one.cloud,
            two.cloud,
            params,
            source_kind=one.kind,
            target_kind=two.kind,
            pairs=picked,
            control=surveyed,
        )
    except RegistrationError as error:
        result = impossible(error, params, surveyed)
    said = _still_true(result, one, two)
    if one.record["sha256"] == two.record["sha256"]:
        said.insert(0, f"{source.name} and {target.name} are the same file, or copies of one")
    result = replace(result, notes=(*said, *result.notes))
    measured = None
    if result.status == "ok" or params.accept_best:
        progress.stage(f"measuring {source.name} against {target.name}")
        measured = measure(*in_found_unit(result, (one.cloud, two.cloud)))
    if measured is not None:
        write_distances(measured, out / DISTANCES)
    document = _document(result, one, two, measured)
    ends = Ends(
        source=one.cloud.name,
        target=two.cloud.name,
        source_frame=one.cloud.frame,
        target_frame=two.cloud.frame,
        files=[str(source.parent.resolve() / source.name)],
    )
    write_registration(out, "registration", document, ends)
    return document


@dataclass(frozen=True, slots=True, kw_only=True)
class _Input:
    """One file of a pair, read."""

    cloud: Cloud
    kind: Kind
    record: dict[str, Any]
    """Its path, SHA-256 and points."""
    notes: tuple[str, ...]


def _read(path: Path, kind: Kind | None, system: str | None, progress: Progress) -> _Input:
    """Read a cloud; its kind is guessed where it is not given, and that is said."""
    progress.stage(f"reading {path.name}")
    digest, stamp = identified(path)
    cloud = in_system(read(path), system)
    guessed = []
    if kind is None:
        kind, why = guess_kind_of(path, describe(path))
        guessed = [f"{path.name} is taken for {kind} ({why})"]
    require_unchanged(path, stamp)
    noticed = [f"{path.name}: {note}" for note in (*cloud.notes, *faults_of(cloud))]
    return _Input(
        cloud=replace(cloud, name=stem_of(path)),
        kind=kind,
        record={"path": str(path), "sha256": digest, "points": len(cloud)},
        notes=(*guessed, *noticed),
    )


def _still_true(result: Registration, source: _Input, target: _Input) -> list[str]:
    """Return the notes of both files without "taken as metres" where a scale was found."""
    searched = (result.scale_search or {}).get("side")
    return [
        note
        for side, one in (("source", source), ("target", target))
        for note in one.notes
        if not (side == searched and note.endswith(NO_SYSTEM))
    ]


def _document(
    result: Registration, source: _Input, target: _Input, measured: Measured | None
) -> dict[str, Any]:
    """Return the contents of ``registration.json``."""
    document = to_document(
        result,
        source=source.cloud.name,
        target=target.cloud.name,
        source_frame=source.cloud.frame,
        target_frame=target.cloud.frame,
        inputs=[source.record, target.record],
    )
    return document | {
        "distances": None if measured is None else distances_document(measured, DISTANCES),
        "kinds": {"source": source.kind, "target": target.kind},
        "peak_memory_bytes": peak_memory_bytes(),
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "software": software(),
    }
