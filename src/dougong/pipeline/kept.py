"""What the filters left of a file: held, or on disk in the order of the file.

Whoever works on it takes it in pieces; what is held is one piece.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from dougong.cloud import Cloud, Frame, Pieces
from dougong.tiles.store import CloudFile


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
        return cls(first=cloud.select(np.arange(0)), points=len(cloud), pieces=lambda: (cloud,))

    @classmethod
    def on_disk(cls, file: CloudFile) -> Kept:
        """Return a cloud of at least one piece that is on disk."""
        assert file.first is not None
        return cls(first=file.first, points=file.points, pieces=file.pieces, is_held=False)

    @property
    def frame(self) -> Frame:
        """Frame of the points."""
        return self.first.frame

    @property
    def name(self) -> str:
        """Name of the file, or of the station."""
        return self.first.name


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
