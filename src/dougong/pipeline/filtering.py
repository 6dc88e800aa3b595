"""``dougong filter``: one file through a recipe or one filter, with its books beside it."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import dougong
from dougong.cloud import Cloud, Pieces
from dougong.errors import InputError
from dougong.filters.protective import Taken
from dougong.filters.selection import Reason
from dougong.formats import (
    describe,
    faults_of,
    in_system,
    read,
    write,
)
from dougong.formats.model import Hold
from dougong.formats.stream import stem_of
from dougong.formats.unfinished import passing_folder, sole_user, watched
from dougong.params import Parameters
from dougong.pipeline.books import Books, Tally
from dougong.pipeline.marking import GROUND_CLASS, marked, marks_clutter, with_classes, with_clutter
from dougong.pipeline.memory import Room, refuse_whole_output
from dougong.pipeline.outputs import finite, refuse_output, write_json
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import (
    Clock,
    Stamp,
    identified,
    peak_memory_bytes,
    require_unchanged,
    software,
)
from dougong.pipeline.recipes import (
    LidarRecipe,
    PhotogrammetryRecipe,
    Recipe,
    filter_cloud,
    steps_of,
)
from dougong.pipeline.settings import parse_overrides, updated
from dougong.pipeline.single import (
    filter_name,
    filter_single,
    single_fields,
    single_parameters,
    single_steps,
)
from dougong.pipeline.steps import Filtered
from dougong.pipeline.tiled import (
    TiledJob,
    decoded,
    filter_chunks,
    is_too_large,
    tiled_job,
)
from dougong.threads import ahead
from dougong.tiles.folder import Folder, LocalFolder
from dougong.tiles.shared import copies_in
from dougong.tiles.spool import remove_spool
from dougong.typing import Kind

Document = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterJob:
    """A sensor's recipe, or one filter alone."""

    kind: Kind | None
    only: str | None
    params: Parameters
    crs: str | None = None
    """The coordinate system of a file that names none."""

    def run(self, cloud: Cloud, progress: Progress) -> Filtered:
        """Filter `cloud`."""
        if self.only is not None:
            return filter_single(cloud, self.only, self.params, progress)
        assert self.kind is not None
        recipe = Recipe().model_copy(update={self.kind: self.params})
        return filter_cloud(cloud, self.kind, recipe, progress)

    def tiled(self) -> TiledJob:
        """Return the job as tiles do it."""
        if self.only is not None:
            return tiled_job(single_steps(self.only, self.params))
        assert self.kind is not None
        recipe = Recipe().model_copy(update={self.kind: self.params})
        return tiled_job(steps_of(self.kind, recipe))


def filter_job(
    kind: Kind | None, only: str | None, settings: Sequence[str], crs: str | None = None
) -> FilterJob:
    """Return what ``dougong filter`` was asked for.

    Raises
    ------
    InputError
        Neither a kind nor a filter is named, or a setting is wrong.
    """
    if only is not None:
        name = filter_name(only)
        values = parse_overrides(settings, {name: single_fields(name)})
        params = single_parameters(name, values.get(name, {}))
        return FilterJob(kind=kind, only=name, params=params, crs=crs)
    if kind is None:
        msg = (
            "--kind is missing: say which sensor made the cloud, --kind lidar or "
            "--kind photogrammetry, or name one filter with --only."
        )
        raise InputError(msg)
    recipe: LidarRecipe | PhotogrammetryRecipe = getattr(Recipe(), kind)
    fields = {name: list(type(getattr(recipe, name)).model_fields) for name in _filters_of(recipe)}
    changes = {
        name: updated(getattr(recipe, name), values, name)
        for name, values in parse_overrides(settings, fields).items()
    }
    return FilterJob(kind=kind, only=None, params=recipe.model_copy(update=changes), crs=crs)


def _filters_of(recipe: Parameters) -> list[str]:
    return list(type(recipe).model_fields)


def filter_file(
    input: Path,
    output: Path,
    *,
    job: FilterJob,
    mark: bool,
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
    work: Folder | None = None,
) -> Document:
    """Filter one file into another and write its books beside it (``OUTPUT.json``).

    `work` keeps the tiles of a cloud larger than memory: a run that was stopped goes on there.

    Raises
    ------
    InputError
        An output exists, or the job needs more memory than it may use.
    FormatError, OutputError
        The input cannot be read or is replaced meanwhile, the output not written (a full disk).
    """
    beside = output.with_name(output.name + ".json")
    refuse_output(input, output, [output, beside], overwrite)
    clock = Clock()
    progress.stage(f"reading {input.name}")
    with clock.measure("read"):
        digest, stamp = identified(input)
    room = Room.of(memory_bytes)
    on_tiles = is_too_large(input, room, 0)
    facts = f"{digest} in {job.crs} {job.tiled().grid!r}"
    with _places(output, work, facts, is_alone=on_tiles) as places:
        result: Cloud | Pieces
        if on_tiles:
            progress.note(f"{input.name} is larger than memory: it is filtered on tiles")
            if mark:  # every point is written, whatever the filters take
                refuse_whole_output(output, describe(input).points, room)
            with clock.measure("filter"):
                books, again = _filtered_on_tiles(input, stamp, job, room, places, progress)
            refuse_whole_output(output, books.points if mark else books.tally().kept, room)
            result = _pieces(again, job, books, mark)
        else:
            books, result = _filtered_whole(input, stamp, job, mark, clock, progress)
        progress.stage(f"writing {output.name}")
        with watched(output, beside):
            with clock.measure("write"):
                hold = Hold(room.held_points(), places.writing)
                written = write(result, output, overwrite=overwrite, hold=hold)
            said = [f"{stem_of(input)}, {note}" for note in books.notes]
            notes = [*books.noticed, *said, *written.notes]
            document = {
                "input": {"path": str(input), "sha256": digest, "points": books.points},
                "output": str(output),
                **_filter_document(job, books, written.points, mark),
                "notes": notes,
                "seconds": {**clock.seconds, "total": clock.total()},
                "peak_memory_bytes": peak_memory_bytes(),
                "software": software(),
            }
            cleaned: Document = finite(document)
            write_json(beside, cleaned)
    return cleaned


@dataclass(frozen=True, slots=True, kw_only=True)
class _Places:
    """Where a cloud that is larger than memory lies meanwhile."""

    tiles: Folder
    scratch: Path
    """On a disk: gets what is of use while tiles are cut."""
    writing: Path
    """On a disk: gets what is of use while the output is written."""


@contextmanager
def _places(output: Path, work: Folder | None, facts: str, *, is_alone: bool) -> Iterator[_Places]:
    """Yield where tiles go: in `work`, named by what they depend on, else beside the output.

    What is beside the output goes again. With `is_alone` no other process may work there.
    """
    told = f"{dougong.__version__} {facts}"
    key = hashlib.sha256(told.encode()).hexdigest()[:16]
    with passing_folder(output.with_name(f"tiles-{output.name}-")) as beside:
        folder = LocalFolder(beside / "tiles") if work is None else work / f"tiles-{key}"
        scratch = folder.local or beside / "cut"
        writing = beside / "written"
        writing.mkdir(parents=True)
        try:
            alone = sole_user(folder.local) if is_alone and folder.local else nullcontext()
            with alone, copies_in(beside / "copies"):
                yield _Places(tiles=folder, scratch=scratch, writing=writing)
        finally:
            remove_spool(scratch)


def _pieces(cloud: Pieces, job: FilterJob, books: Books, mark: bool) -> Pieces:
    """Return what is written of a cloud that was filtered on tiles and comes once more."""

    def pieces() -> Iterator[Cloud]:
        for chunk, part in books.along(ahead(cloud())):
            yield _chosen(job, chunk, part, mark)

    return pieces


def _decoded(input: Path, stamp: Stamp, crs: str | None) -> Iterator[Cloud]:
    """Yield the chunks of a file, all its scans as one cloud, if it stays as it is meanwhile."""
    for chunk in decoded(input):
        yield in_system(chunk, crs)
    require_unchanged(input, stamp)


def _filter_document(job: FilterJob, books: Books, written: int, mark: bool) -> Document:
    """Return what the books say of the filter: counts per stage, reasons, parameters."""
    tally = books.tally()
    return {
        "kind": job.kind,
        "only": job.only,
        "is_marked": mark,
        "points_in": books.points,
        "points_kept": tally.kept,
        "points_written": written,
        "reduction": 1.0 - tally.kept / books.points,
        "stages": [
            {
                "name": stage.name,
                "points_in": stage.points_in,
                "points_out": stage.points_out,
                "reduction": stage.reduction,
                "seconds": stage.seconds,
                **({"found": dict(stage.found)} if stage.found else {}),
            }
            for stage in books.stages
        ],
        "reasons": reason_table(tally),
        "ground_points": tally.ground,
        "parameters": job.params.model_dump(mode="json"),
    }


def _filtered_whole(
    input: Path, stamp: Stamp, job: FilterJob, mark: bool, clock: Clock, progress: Progress
) -> tuple[Books, Cloud]:
    """Return what was decided about every point of the file, and what is written of it."""
    with clock.measure("read"):
        cloud = in_system(read(input), job.crs)
        require_unchanged(input, stamp)
        noticed = (*cloud.notes, *faults_of(cloud))
    with clock.measure("filter"):
        filtered = job.run(cloud, progress)
    return Books.of(filtered, noticed), _chosen(job, cloud, filtered, mark)


def _filtered_on_tiles(
    input: Path, stamp: Stamp, job: FilterJob, room: Room, places: _Places, progress: Progress
) -> tuple[Books, Pieces]:
    """Return what was decided about every point of the file, and its points once more."""
    books, spool = filter_chunks(
        _decoded(input, stamp, job.crs),
        job.tiled(),
        points=describe(input).points,
        room=room,
        waiting=0,
        folder=places.tiles,
        scratch=places.scratch,
        progress=progress,
    )
    return books, partial(_decoded, input, stamp, job.crs) if spool is None else spool.pieces


def reason_table(tally: Tally) -> dict[str, dict[str, Any]]:
    """Return per reason its code in ``dougong_reason`` and the points it took, in detail too."""
    table: dict[str, dict[str, Any]] = {}
    for reason in Reason:
        points = tally.reasons[reason.name.lower()]
        if not points:
            continue
        row: dict[str, Any] = {"code": int(reason), "points": points}
        if reason == Reason.CURVATURE_WEIGHTED:
            row["details"] = {
                name: {"code": int(Taken[name.upper()]), "points": count}
                for name, count in tally.details.items()
            }
        table[reason.name.lower()] = row
    return table


def _chosen(job: FilterJob, cloud: Cloud, filtered: Filtered, mark: bool) -> Cloud:
    """Return what is written: the kept points, or all points with their marks."""
    if mark:
        return marked(cloud, filtered.codes, filtered.ground_class, filtered.details)
    if job.only == "cloth_simulation" and getattr(job.params, "keep", "") == "all":
        # Alone, the cloth takes nothing out: its answer is the class.
        return with_classes(filtered.cloud, [(filtered.is_ground, GROUND_CLASS)])
    if any(marks_clutter(step) for step in job.tiled().steps):
        return with_clutter(filtered)
    return filtered.cloud
