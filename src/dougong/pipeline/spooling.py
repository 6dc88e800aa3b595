"""A cloud that was filtered on tiles, decoded once more: what was kept goes to disk."""

from collections.abc import Callable, Iterable
from pathlib import Path

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.pipeline.kept import Kept, KeptFile, together
from dougong.pipeline.removed import removed_sample, shortened
from dougong.pipeline.steps import Filtered
from dougong.pipeline.store import Books


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
    file = KeptFile(folder)
    removed: Cloud | None = None
    done = 0
    for chunk in chunks:
        here = slice(done, done + len(chunk))
        done += len(chunk)
        codes = books.codes[here]
        if len(codes) < len(chunk):
            break
        file.add(kept(books.part(chunk, here)))
        details = {name: values[here] for name, values in books.details.items()}
        more = removed_sample(chunk, codes, details=details)
        removed = more if removed is None else shortened(together([removed, more]))
    if done != len(books.codes):
        msg = (
            f"the finished step that --work keeps is of {len(books.codes):,} points, the cloud has "
            f"{done:,}. Delete the --work folder."
        )
        raise InputError(msg)
    assert removed is not None
    return file.finished(), removed
