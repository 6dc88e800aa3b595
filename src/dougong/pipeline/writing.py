"""What a run writes beside its result.json: clouds, the merged one, registrations."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dougong.cloud import Cloud
from dougong.formats import write, write_merged
from dougong.pipeline.distances import (
    with_distances,
)
from dougong.pipeline.exports import Ends, write_registration
from dougong.pipeline.links import Linked
from dougong.pipeline.loading import Mover
from dougong.pipeline.merging import Merge, Part, choose
from dougong.pipeline.progress import Progress

MERGED = "merged.copc.laz"
REMOVED = "removed"


def write_clouds(
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
            source_frame=mover.clouds[0].frame,
            target_frame=reference.clouds[0].frame,
            # One scan of a file cannot be named in a pipeline that reads whole files.
            files=[shown(source.file) for source in mover.sources if not source.is_scan],
        )
        write_registration(out / "registrations", mover.name, document, ends)
