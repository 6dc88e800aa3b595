"""What a run writes beside its result.json: clouds, the merged one, registrations."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dougong.cloud import Cloud, Frame, Pieces, in_pieces
from dougong.formats import write, write_merged
from dougong.formats.model import Hold, Written
from dougong.pipeline.distances import Painter
from dougong.pipeline.exports import Ends, write_registration
from dougong.pipeline.left_out import Remaining
from dougong.pipeline.links import Linked
from dougong.pipeline.merging import Merge, Merged, Part, choose
from dougong.pipeline.movers import Mover
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import Clock

MERGED = "merged.copc.laz"
REMOVED = "removed"


def write_clouds(
    linked: Sequence[Linked],
    reference: Frame,
    merge: Merge,
    out: Path,
    progress: Progress,
    clock: Clock,
    hold: Hold,
) -> tuple[dict[str, Any], list[str]]:
    """Write each filtered cloud and the merged one.

    Returns
    -------
    merged : dict
        What the merged one holds, its notes included.
    notes : list of str
        What the files of clouds that are not merged could not hold.
    """
    notes: list[str] = []
    parts: list[Part] = []
    painters: list[Painter | None] = []
    measured = [link.measured for link in linked if link.measured is not None]
    for source_id, link in enumerate(linked, 1):
        progress.stage(f"writing clouds/{link.mover.name}.laz")
        kept = [source.kept for source in link.mover.sources]
        clouds = [link.placed_pieces(one, reference) for one in kept]
        with clock.measure("write"):
            written = _write_one(clouds, out / "clouds" / f"{link.mover.name}.laz", source_id, hold)
        removed = [source.removed for source in link.mover.sources if len(source.removed)]
        if removed:
            placed = [in_pieces(link.placed(cloud, reference)) for cloud in removed]
            _write_one(placed, out / REMOVED / f"{link.mover.name}.laz", source_id, hold)
        if not link.is_sure:
            notes += [f"clouds/{written.path.name}: {note}" for note in written.notes]
            continue
        own = measured if link.result is None else [link.measured] if link.measured else []
        paint = Painter(own) if measured else None
        for one, pieces in zip(kept, clouds, strict=True):
            parts.append(
                Part(
                    frame=link.placed(one.first, reference).frame,
                    points=one.points,
                    pieces=pieces,
                    source_id=source_id,
                    name=link.mover.name,
                    kind=link.mover.kind,
                )
            )
            painters.append(paint)
    return _write_merged(parts, painters, merge, out, progress, clock, hold), notes


def _write_merged(
    parts: Sequence[Part],
    painters: Sequence[Painter | None],
    merge: Merge,
    out: Path,
    progress: Progress,
    clock: Clock,
    hold: Hold,
) -> dict[str, Any]:
    """Write the merged cloud of `parts`, painted with their distances; return what it holds."""
    progress.stage("choosing what is merged")
    with clock.measure("merge"):
        chosen = choose(parts, merge, hold)
    progress.stage(f"writing {MERGED}")
    with clock.measure("write"):
        written = write_merged(
            [
                _left(part.pieces, remaining)
                for part, remaining in zip(parts, chosen.remaining, strict=True)
            ],
            out / MERGED,
            source_ids=[part.source_id for part in parts],
            hold=hold,
            finish=[None if paint is None else paint.painted for paint in painters],
        )
    document = _merged_document(parts, chosen, progress)
    return {"file": MERGED, **document, "notes": list(written.notes)}


def _merged_document(parts: Sequence[Part], chosen: Merged, progress: Progress) -> dict[str, Any]:
    """Return what the merged cloud holds and what it does not, and say the latter."""
    document = chosen.document(parts)
    for name, row in document["sources"].items():
        if row["left_out"]:
            progress.note(
                f"merged: {row['left_out']:,} points of {name} are left out where a better source "
                'saw the same surface (clouds/ holds them; [merge] mode = "all" brings them back)'
            )
    ids = {part.name: part.source_id for part in parts}
    return {**document, "clouds": list(ids), "source_ids": ids}


def _left(pieces: Pieces, remaining: Remaining) -> Pieces:
    """Return the pieces of a cloud without the points that do not remain."""

    def left() -> Iterator[Cloud]:
        done = 0
        for piece in pieces():
            here = remaining.mask(done, done + len(piece))
            done += len(piece)
            yield piece if here.all() else piece.select(here)

    return left


def _write_one(clouds: Sequence[Pieces], path: Path, source_id: int, hold: Hold) -> Written:
    path.parent.mkdir(exist_ok=True)
    if len(clouds) == 1:
        return write(clouds[0], path, hold=hold)
    return write_merged(clouds, path, source_ids=[source_id] * len(clouds), hold=hold)


def write_registrations(
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
            source_frame=mover.frame,
            target_frame=reference.frame,
            # One scan of a file cannot be named in a pipeline that reads whole files.
            files=[shown(source.file) for source in mover.sources if not source.is_scan],
        )
        write_registration(out / "registrations", mover.name, document, ends)
