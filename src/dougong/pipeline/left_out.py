"""Which points of a cloud are left out, in pages that may lie on disk: never all of it at once."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dougong.pipeline.books import PAGE_POINTS
from dougong.tiles.store import told
from dougong.typing import Index, Mask

PLACE_BYTES = 8
"""Of a point that is left out, on disk."""


class LeftOut:
    """Places of points among all of a cloud, as they are found tile by tile."""

    def __init__(self, folder: Path | None = None) -> None:
        """Begin with none. `folder` gets them, and loses what it held; None: they are held."""
        self._folder = folder
        self._held: dict[int, list[Index]] = {}
        if folder is not None:
            with told(folder):
                # What a killed run left is of no use.
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)

    def add(self, places: Index) -> None:
        """Leave out the points at `places` (n,), each given once.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        places = np.sort(places.astype(np.int64))
        page = places // PAGE_POINTS
        starts = np.flatnonzero(np.diff(page, prepend=-1))
        for number, part in zip(page[starts].tolist(), np.split(places, starts[1:]), strict=False):
            if self._folder is None:
                self._held.setdefault(number, []).append(part)
                continue
            path = self._folder / f"{number}.places"
            with told(path), path.open("ab") as file:
                file.write(part.tobytes())

    def pages(self, first: int, last: int) -> Iterator[Index]:
        """Yield the places from `first` on, before `last`, page by page."""
        for number in range(first // PAGE_POINTS, -(-last // PAGE_POINTS)):
            places = self._page(number)
            yield places[(places >= first) & (places < last)]

    def _page(self, number: int) -> Index:
        parts = self._held.get(number, [])
        path = None if self._folder is None else self._folder / f"{number}.places"
        if path is not None and path.exists():
            with told(path):
                parts = [np.fromfile(path, np.int64)]
        return np.concatenate([np.empty(0, np.int64), *parts])


class Remaining(NamedTuple):
    """Which points of one part of a cloud remain."""

    left_out: LeftOut
    first: int
    """Place of the part's first point among all of the cloud."""
    points: int

    def mask(self, start: int, stop: int) -> Mask:
        """Return which of the part's points from `start` on, before `stop`, remain."""
        mask = np.ones(stop - start, dtype=bool)
        for places in self.left_out.pages(self.first + start, self.first + stop):
            mask[places - self.first - start] = False
        return mask

    def gone(self) -> int:
        """Return how many of the part's points are left out."""
        return sum(map(len, self.left_out.pages(self.first, self.first + self.points)))
