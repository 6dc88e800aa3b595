"""One number for what a run found: the kept raw records, sorted, and the matrices.

Records are sorted by their bytes. What does not fit in memory is parted by its first bytes into
files, which are sorted one by one: the same bytes in the same order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import sorted_places
from dougong.cloud import Frame, Records
from dougong.formats.copc_parts import RecordFile
from dougong.formats.model import Hold
from dougong.pipeline.links import Linked


def result_hash(linked: Sequence[Linked], reference: Frame, hold: Hold) -> str:
    """Return the SHA-256 of kept records and local matrices: no time, path or header in it.

    Parameters
    ----------
    linked : sequence of Linked
    reference : Frame
        Of the cloud that the others were moved to.
    hold : Hold
        How many records may be sorted at once, and where the others wait.
    """
    digest = hashlib.sha256()
    to_local = np.linalg.inv(reference.T_file_local())
    for link in linked:
        for source in link.mover.sources:
            pieces = (piece.records for piece in source.kept.pieces())
            for records in in_byte_order(pieces, source.kept.points, hold):
                digest.update(records.view(np.uint8).data)
        if link.result is not None and link.result.matrix is not None:
            local = to_local @ link.result.matrix @ link.mover.frame.T_file_local()
            # Adding zero turns -0.0 into 0.0, which has other bytes.
            digest.update((np.round(local, 9) + 0.0).tobytes())
    return digest.hexdigest()


def in_byte_order(pieces: Iterable[Records], count: int, hold: Hold) -> Iterator[Records]:
    """Yield all records, `count` in all, sorted by their bytes, in parts that fit `hold`."""
    if count <= hold.points:
        parts = list(pieces)
        if parts:
            yield _sorted(parts[0] if len(parts) == 1 else np.concatenate(parts))
        return
    hold.folder.mkdir(parents=True, exist_ok=True)
    yield from _parted(pieces, 0, hold, "sort")


def _parted(pieces: Iterable[Records], byte: int, hold: Hold, name: str) -> Iterator[Records]:
    """Part records that agree in all bytes before `byte` by that one; yield them sorted."""
    files: dict[int, RecordFile] = {}
    layout: np.dtype[np.void] | None = None
    for records in pieces:
        layout = records.dtype
        values = _bytes_of(records)[:, byte]
        order = np.argsort(values, kind="stable")
        bounds = np.searchsorted(values[order], np.arange(257))
        for value in np.flatnonzero(bounds[1:] > bounds[:-1]).tolist():
            if value not in files:
                files[value] = RecordFile(hold.folder / f"{name}-{value:02x}", layout)
                files[value].remove()
            files[value].append(records.take(order[bounds[value] : bounds[value + 1]]))
    for value in sorted(files):
        file = files[value]
        assert layout is not None
        if file.points > hold.points and byte + 1 < layout.itemsize:
            yield from _parted(file.pieces(), byte + 1, hold, file.path.name)
        else:
            yield _sorted(file.read())
        file.remove()


def _bytes_of(records: Records) -> NDArray[np.uint8]:
    return np.ascontiguousarray(records).view(np.uint8).reshape(len(records), -1)


def _sorted(records: Records) -> Records:
    """Return records sorted by their bytes, as unsigned numbers from the first one on."""
    raw = _bytes_of(records)
    width = raw.shape[1]
    first = _word(raw, 0)
    order = sorted_places(first)
    first = first[order]
    is_same = first[1:] == first[:-1]
    is_tied = np.concatenate(([False], is_same)) | np.concatenate((is_same, [False]))
    tied = order[is_tied]
    if len(tied):
        words = [_word(raw[tied], start) for start in range(0, width, 8)]
        order[is_tied] = tied[np.lexsort(words[::-1])]
    return np.ascontiguousarray(records).take(order)


def _word(raw: NDArray[np.uint8], start: int) -> NDArray[np.uint64]:
    """Return eight bytes of each row from `start` on as numbers in the order of the bytes."""
    part = np.zeros((len(raw), 8), np.uint8)
    chosen = raw[:, start : start + 8]
    part[:, : chosen.shape[1]] = chosen
    return part.view(">u8")[:, 0].astype(np.uint64)
