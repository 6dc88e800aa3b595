"""Tiles on disk: rows of points in files that grow by appending.

A file is a chain of blocks, one per append: how many rows, then their places, coordinates and
records, as they lie in memory. So any number of tiles can grow at once without being open, a file
is read back in the pieces it was written in, and coordinates are read without the records. Nothing
is compressed: that costs twice what all else here does, for rows that are read once or twice and
deleted.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Records, chosen_rows
from dougong.errors import OutputError
from dougong.typing import Index, Points

_COUNT = np.dtype("<i8")
_ROW_BYTES, _XYZ_BYTES = 8, 24


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
        places = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        # Twice as fast as brackets where a row has several columns.
        xyz = np.take(self.xyz, places, axis=0)
        return Rows(self.row[places], xyz, chosen_rows(self.records, places))


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
        with told(self.path), self.path.open("ab") as file:
            file.write(np.array(len(rows.row), _COUNT).tobytes())
            for values in rows:
                file.write(_bytes_of(np.ascontiguousarray(values)))

    def pieces(self) -> Iterator[Rows]:
        """Yield the rows in the pieces they were appended in."""
        with self.path.open("rb") as file:
            for count in _counts(file):
                rows = self._empty(count)
                _fill(file, rows, slice(None))
                yield rows

    def coordinates(self) -> Iterator[Points]:
        """Yield the coordinates of the pieces; the records are not read."""
        with self.path.open("rb") as file:
            for count in _counts(file):
                xyz = np.empty((count, 3))
                file.seek(count * _ROW_BYTES, os.SEEK_CUR)
                _read_into(file, xyz)
                file.seek(count * self.layout.itemsize, os.SEEK_CUR)
                yield xyz

    def read(self) -> Rows:
        """Return all rows."""
        with self.path.open("rb") as file:
            counts = []
            for count in _counts(file):
                counts.append(count)
                file.seek(count * self._bytes_per_row, os.SEEK_CUR)
            rows = self._empty(sum(counts))
            file.seek(0)
            start = 0
            for count in _counts(file):
                _fill(file, rows, slice(start, start + count))
                start += count
        return rows

    def remove(self) -> None:
        """Delete the file."""
        self.path.unlink()

    @property
    def _bytes_per_row(self) -> int:
        return _ROW_BYTES + _XYZ_BYTES + self.layout.itemsize

    def _empty(self, count: int) -> Rows:
        return Rows(np.empty(count, np.int64), np.empty((count, 3)), np.empty(count, self.layout))


def _counts(file: IO[bytes]) -> Iterator[int]:
    """Yield how many rows each block has, the file being read up to them."""
    while head := file.read(_COUNT.itemsize):
        yield int(np.frombuffer(head, _COUNT)[0])


def _fill(file: IO[bytes], rows: Rows, part: slice) -> None:
    """Read a block into a part of `rows`."""
    for values in rows:
        _read_into(file, values[part])


def _read_into(file: IO[bytes], values: NDArray[Any]) -> None:
    into = _bytes_of(values)
    if file.readinto(into) != len(into):  # type: ignore[attr-defined]
        msg = f"{file.name} was cut short while it was in use. Delete its folder and start again."
        raise OutputError(msg)


def _bytes_of(values: NDArray[Any]) -> memoryview:
    """Return rows, whatever they hold, as bytes: no copy is made."""
    return values.reshape(-1).view(np.uint8).data


@contextmanager
def told(path: Path) -> Iterator[None]:
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
    with told(folder / "tiles"):
        folder.mkdir(parents=True, exist_ok=True)

    def make(name: str, layout: np.dtype[Any]) -> RowFile:
        return RowFile(folder / f"{name}.rows", layout)

    return make
