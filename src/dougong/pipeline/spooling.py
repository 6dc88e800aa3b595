"""A cloud that was filtered on tiles, gone through once more: what was kept goes to disk."""

from collections.abc import Callable, Iterable
from pathlib import Path

from dougong.cloud import Cloud, joined
from dougong.pipeline.books import Books
from dougong.pipeline.kept import Kept
from dougong.pipeline.removed import removed_sample, shortened
from dougong.pipeline.steps import Filtered
from dougong.threads import ahead
from dougong.tiles.store import CloudFile


def spooled(
    chunks: Iterable[Cloud],
    books: Books,
    folder: Path,
    kept: Callable[[Filtered], Cloud] = lambda part: part.cloud,
) -> tuple[Kept, Cloud]:
    """Write the kept points to `folder`; return them, and the sample of the removed ones.

    `kept` makes what is written of each filtered chunk.

    Raises
    ------
    InputError
        The books are of another cloud.
    OutputError
        The disk is full, or `folder` cannot be written.
    """
    file = CloudFile(folder, "kept")
    removed: Cloud | None = None
    for chunk, part in books.along(ahead(chunks)):
        file.append(kept(part))
        more = removed_sample(chunk, part.codes, details=part.details)
        removed = more if removed is None else shortened(joined([removed, more]))
    assert removed is not None
    return Kept.on_disk(file), removed
