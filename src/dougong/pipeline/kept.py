"""What the filters left of a file: held, or on disk in the order of the file.

Whoever works on it takes it in pieces; what is held is one piece.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud, Frame, Pieces
from dougong.tiles.store import RowFile, Rows, make_row_file

_NOBODY = np.arange(0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """The kept points of one file, or of one station in it."""

    first: Cloud
    """Without points: name, frame, header and layout of every piece."""
    points: int
    pieces: Pieces
    is_held: bool = True
    """False: the points are on disk."""

    @classmethod
    def of(cls, cloud: Cloud) -> Kept:
        """Return a cloud that is held."""
        return cls(first=cloud.select(_NOBODY), points=len(cloud), pieces=lambda: (cloud,))

    @property
    def frame(self) -> Frame:
        """Frame of the points."""
        return self.first.frame

    @property
    def name(self) -> str:
        """Name of the file, or of the station."""
        return self.first.name


class KeptFile:
    """Kept points on their way to disk."""

    def __init__(self, folder: Path) -> None:
        self._make = make_row_file(folder)
        self._file: RowFile | None = None
        self._first: Cloud | None = None
        self._points = 0

    def add(self, piece: Cloud) -> None:
        """Write a piece behind those that are there.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        if self._file is None or self._first is None:
            self._first = piece.select(_NOBODY)
            self._file = self._make("kept", piece.records.dtype)
            self._file.path.unlink(missing_ok=True)
        rows = np.arange(self._points, self._points + len(piece))
        self._file.append(Rows(rows, piece.xyz, piece.records))
        self._points += len(piece)

    def finished(self) -> Kept:
        """Return what was written, at least one piece."""
        file, first = self._file, self._first
        assert file is not None
        assert first is not None

        def pieces() -> Iterator[Cloud]:
            for rows in file.pieces():
                yield replace(first, xyz=rows.xyz, records=rows.records)

        return Kept(first=first, points=self._points, pieces=pieces, is_held=False)


def batches(pieces: Iterable[Cloud], most: int) -> Iterator[list[Cloud]]:
    """Yield pieces together while they have at most `most` points; one alone may have more."""
    batch: list[Cloud] = []
    held = 0
    for piece in pieces:
        if batch and held + len(piece) > most:
            yield batch
            batch, held = [], 0
        batch.append(piece)
        held += len(piece)
    if batch:
        yield batch


def together(batch: list[Cloud]) -> Cloud:
    """Return clouds of one frame and layout, at least one, as one."""
    if len(batch) == 1:
        return batch[0]
    return replace(
        batch[0],
        xyz=np.concatenate([piece.xyz for piece in batch]),
        records=np.concatenate([piece.records for piece in batch]),
    )
