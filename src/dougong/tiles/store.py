"""Tiles on disk: rows of points in Arrow files that grow by appending.

A file is a chain of Arrow streams, one per append, so any number of tiles can grow at once without
being open, and a file is read back in the pieces it was written in. Nothing is compressed: that
costs twice what all else here does, for rows that are read once or twice and deleted.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dougong.cloud import Records, chosen_rows
from dougong.errors import OutputError
from dougong.typing import Index, Points


class Rows(NamedTuple):
    """Some points of a cloud."""

    row: Index
    """(n,) their places in the cloud."""
    xyz: Points
    """(n, 3) local metres."""
    records: Records
    """(n,) the input's own records."""

    def take(self, chosen: Any) -> "Rows":
        """Return the `chosen` of them: a mask or places."""
        return Rows(self.row[chosen], self.xyz[chosen], chosen_rows(self.records, chosen))


class RowFile:
    """A file of rows. Nothing of it is held."""

    def __init__(self, path: Path, layout: np.dtype[Any]) -> None:
        self.path = path
        self.layout = layout

    def append(self, rows: Rows) -> None:
        """Write `rows` behind those that are there.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        batch = _to_batch(rows)
        with (
            _told(self.path),
            self.path.open("ab") as file,
            pa.ipc.new_stream(file, batch.schema) as writer,
        ):
            writer.write_batch(batch)

    def pieces(self) -> Iterator[Rows]:
        """Yield the rows in the pieces they were appended in."""
        with pa.OSFile(str(self.path), "rb") as file:
            while file.tell() < file.size():
                yield from _read_stream(file, self.layout)

    def read(self) -> Rows:
        """Return all rows."""
        return concatenate(list(self.pieces()))

    def remove(self) -> None:
        """Delete the file."""
        self.path.unlink()


def concatenate(parts: list[Rows]) -> Rows:
    """Return the rows of at least one part as one."""
    if len(parts) == 1:
        return parts[0]
    row, xyz, records = zip(*parts, strict=True)
    return Rows(np.concatenate(row), np.concatenate(xyz), np.concatenate(records))


def _to_batch(rows: Rows) -> pa.RecordBatch:
    columns = [pa.array(rows.row), _packed(rows.xyz), _packed(rows.records)]
    return pa.record_batch(columns, names=list(Rows._fields))


def _packed(values: NDArray[Any]) -> pa.Array:
    """Return an array of rows, whatever they hold, as a column of bytes: no copy is made."""
    held = np.ascontiguousarray(values)
    width = held.nbytes // max(len(held), 1)
    data = pa.py_buffer(held.reshape(-1).view(np.uint8))
    return pa.Array.from_buffers(pa.binary(width), len(held), [None, data])


def _unpacked(column: pa.Array, layout: np.dtype[Any]) -> NDArray[Any]:
    """Return the rows of a column of bytes."""
    width = column.type.byte_width
    start = column.offset * width
    data = column.buffers()[1][start : start + len(column) * width]
    return np.frombuffer(data, dtype=layout)


def _read_stream(file: pa.NativeFile, layout: np.dtype[Any]) -> Iterator[Rows]:
    for batch in pa.ipc.open_stream(file):
        yield Rows(
            row=batch.column("row").to_numpy(zero_copy_only=True),
            xyz=_unpacked(batch.column("xyz"), np.dtype(np.float64)).reshape(-1, 3),
            records=_unpacked(batch.column("records"), layout),
        )


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Say in one sentence why a tile could not be written."""
    try:
        yield
    except OSError as error:
        msg = (
            f"{path.parent} could not be written: {error.strerror or error}. "
            "Free some space or pass another --work."
        )
        raise OutputError(msg) from error


RowFileMaker: TypeAlias = Callable[[str, np.dtype[Any]], RowFile]
"""Makes a new file of rows by its name and the layout of their records."""


def make_row_file(folder: Path) -> RowFileMaker:
    """Return a maker of new row files in `folder`, which is made where it is missing."""
    with _told(folder / "tiles"):
        folder.mkdir(parents=True, exist_ok=True)

    def make(name: str, layout: np.dtype[Any]) -> RowFile:
        return RowFile(folder / f"{name}.arrows", layout)

    return make
