"""Points on disk in files that grow by appending, before and while they are cut into tiles.

A cloud in its own order is one file of coordinates and one of records (`CloudFile`). Rows of a tile
are a chain of blocks, one per append: how many rows, then their places and coordinates, as they lie
in memory (`RowFile`); the records stay where they are. So any number of tiles can grow at once
without being open, and what grows is as small as it can be: writing is what cutting a cloud costs.
Nothing is compressed: that costs twice what all else here does, for rows that are read once or
twice and deleted.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud, Records, chosen_rows
from dougong.errors import OutputError
from dougong.typing import Index, Points

_COUNT = np.dtype("<i8")
_ROW_BYTES, _XYZ_BYTES, _STANDS_FOR_BYTES = 8, 24, 4


class CloudFile:
    """A cloud on disk in its own order, in the pieces that it came in. One of them is held."""

    def __init__(self, folder: Path, name: str) -> None:
        """Begin an empty cloud in `folder`, which is made where it is missing.

        Raises
        ------
        OutputError
            The folder cannot be made.
        """
        self.points = 0
        self.first: Cloud | None = None
        """Without points: name, frame, header and layout of every piece."""
        self._pieces: list[int] = []
        self._xyz, self._records = (folder / f"{name}.{part}" for part in ("xyz", "records"))
        with told(self._xyz):
            folder.mkdir(parents=True, exist_ok=True)
            for path in (self._xyz, self._records):
                path.write_bytes(b"")

    def append(self, piece: Cloud) -> None:
        """Write a piece behind those that are there.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        if self.first is None:
            self.first = piece.select(np.arange(0))
        for path, values in ((self._xyz, piece.xyz), (self._records, piece.records)):
            with told(path), path.open("ab") as file:
                file.write(_bytes_of(np.ascontiguousarray(values)))
        self._pieces.append(len(piece))
        self.points += len(piece)

    def pieces(self) -> Iterator[Cloud]:
        """Yield the cloud in the pieces that it came in."""
        assert self.first is not None
        layout = self.first.records.dtype
        with self._records.open("rb") as file:
            for xyz in self.coordinates():
                records = np.empty(len(xyz), layout)
                _read_into(file, records)
                yield replace(self.first, xyz=xyz, records=records)

    def coordinates(self) -> Iterator[Points]:
        """Yield the coordinates of the pieces; the records are not read."""
        with self._xyz.open("rb") as file:
            for count in self._pieces:
                xyz = np.empty((count, 3))
                _read_into(file, xyz)
                yield xyz

    def records_at(self, rows: Index) -> Records:
        """Return the records of the points at the places `rows`."""
        assert self.first is not None
        return chosen_rows(np.memmap(self._records, self.first.records.dtype, "r"), rows)

    def remove(self) -> None:
        """Delete the files."""
        for path in (self._xyz, self._records):
            path.unlink(missing_ok=True)


class Rows(NamedTuple):
    """Some points of a cloud."""

    row: Index
    """(n,) their places in the cloud."""
    xyz: Points
    """(n, 3) local metres."""
    stands_for: NDArray[np.int32] | None = None
    """(n,) how many points each stands for; None: for itself."""

    def take(self, chosen: Any) -> "Rows":
        """Return the `chosen` of them: a mask or places."""
        places = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
        # Twice as fast as brackets where a row has several columns.
        xyz = np.take(self.xyz, places, axis=0)
        counts = None if self.stands_for is None else self.stands_for[places]
        return Rows(self.row[places], xyz, counts)

    @property
    def columns(self) -> Iterator[NDArray[Any]]:
        """The arrays that there are, as they lie in a file."""
        return (values for values in self if values is not None)


class RowFile:
    """A file of rows. Nothing of it is held."""

    def __init__(self, path: Path, *, is_thinned: bool) -> None:
        """Name the file; `is_thinned`: its rows say how many points each stands for."""
        self.path = path
        self.is_thinned = is_thinned

    def append(self, rows: Rows) -> None:
        """Write `rows` behind those that are there.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        with told(self.path), self.path.open("ab") as file:
            file.write(np.array(len(rows.row), _COUNT).tobytes())
            for values in rows.columns:
                file.write(_bytes_of(np.ascontiguousarray(values)))

    def pieces(self) -> Iterator[Rows]:
        """Yield the rows in the pieces they were appended in."""
        with self.path.open("rb") as file:
            for count in _counts(file):
                rows = self._empty(count)
                _fill(file, rows, slice(None))
                yield rows

    def coordinates(self) -> Iterator[Points]:
        """Yield the coordinates of the pieces; what else is known of them is not read."""
        behind = _STANDS_FOR_BYTES if self.is_thinned else 0
        with self.path.open("rb") as file:
            for count in _counts(file):
                xyz = np.empty((count, 3))
                file.seek(count * _ROW_BYTES, os.SEEK_CUR)
                _read_into(file, xyz)
                file.seek(count * behind, os.SEEK_CUR)
                yield xyz

    def read(self) -> Rows:
        """Return all rows."""
        row_bytes = _ROW_BYTES + _XYZ_BYTES + (_STANDS_FOR_BYTES if self.is_thinned else 0)
        with self.path.open("rb") as file:
            counts = []
            for count in _counts(file):
                counts.append(count)
                file.seek(count * row_bytes, os.SEEK_CUR)
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

    def _empty(self, count: int) -> Rows:
        counts = np.empty(count, np.int32) if self.is_thinned else None
        return Rows(np.empty(count, np.int64), np.empty((count, 3)), counts)


def _counts(file: IO[bytes]) -> Iterator[int]:
    """Yield how many rows each block has, the file being read up to them."""
    while head := file.read(_COUNT.itemsize):
        yield int(np.frombuffer(head, _COUNT)[0])


def _fill(file: IO[bytes], rows: Rows, part: slice) -> None:
    """Read a block into a part of `rows`."""
    for values in rows.columns:
        _read_into(file, values[part])


def _read_into(file: IO[bytes], values: NDArray[Any]) -> None:
    into = _bytes_of(values)
    if file.readinto(into) != len(into):  # type: ignore[attr-defined]
        msg = f"{file.name} was cut short while it was in use. Delete its folder and start again."
        raise OutputError(msg)


def _bytes_of(values: NDArray[Any]) -> memoryview:
    """Return rows, whatever they hold, as bytes: no copy is made."""
    if not values.nbytes:
        return memoryview(bytearray())
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
