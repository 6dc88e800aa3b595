"""The points of a COPC file on disk, cut into parts that fit in memory."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Records
from dougong.errors import OutputError
from dougong.formats.copc_nodes import DEEPEST, GRID_BITS, Cube, codes_of, key_at, priorities
from dougong.formats.las_header import LasHeader
from dougong.formats.las_write import as_bytes

_READ_POINTS = 500_000
_COUNT_LEVELS = 9
"""Points are counted in nodes so many levels below the one that is cut."""


class RecordFile:
    """Records on disk, one behind the other. Nothing of them is held."""

    def __init__(self, path: Path, layout: np.dtype[Any]) -> None:
        self.path = path
        self.layout = layout
        self.points = 0

    def append(self, records: Records) -> None:
        """Write `records` behind those that are there.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        try:
            with self.path.open("ab") as file:
                file.write(as_bytes(records).data)
        except OSError as error:
            msg = (
                f"{self.path.parent} cannot be written: {error.strerror or error}. "
                "Free some space or pass another --work."
            )
            raise OutputError(msg) from error
        self.points += len(records)

    def pieces(self, most: int = _READ_POINTS) -> Iterator[Records]:
        """Yield the records in pieces of at most `most`."""
        size = self.layout.itemsize
        with self.path.open("rb") as file:
            while data := file.read(most * size):
                yield np.frombuffer(data, dtype=self.layout)

    def read(self) -> Records:
        """Return all records."""
        return np.fromfile(self.path, dtype=self.layout)

    def remove(self) -> None:
        """Delete the file."""
        self.path.unlink(missing_ok=True)


@dataclass(slots=True)
class Part:
    """All points of one node of the octree."""

    file: RecordFile
    level: int
    key: int
    firsts: NDArray[np.uint64] = field(default_factory=lambda: np.empty(0, np.uint64))
    """Priorities of its first points, ascending: as many as levels have cells larger than it."""
    shown_above: list[int] = field(default_factory=list)
    """Levels whose cells are larger than the part and that show its first points."""

    def add(self, records: Records, codes: NDArray[np.uint64]) -> None:
        """Write points of this node."""
        self.file.append(records)
        held = self.level - GRID_BITS
        if held > 0:
            both = np.concatenate([self.firsts, priorities(codes)])
            self.firsts = np.sort(both)[:held]


def cut(file: RecordFile, header: LasHeader, cube: Cube, most: int, folder: Path) -> list[Part]:
    """Cut the points of `file` into nodes of at most `most` points, in the order of the curve.

    The file is used up. A node of the deepest level is never cut.
    """
    parts = _cut(Part(file, 0, 0), header, cube, most, folder)
    _show_above(parts)
    return parts


def _cut(whole: Part, header: LasHeader, cube: Cube, most: int, folder: Path) -> list[Part]:
    deepest = min(whole.level + _COUNT_LEVELS, DEEPEST)
    keys, counts = _counted(whole.file, header, cube, deepest)
    starts, levels = _largest_nodes(keys, counts, whole.level, deepest, most)
    parts = [
        Part(
            RecordFile(folder / f"{level}-{_key(keys[start], deepest, level)}", whole.file.layout),
            int(level),
            _key(keys[start], deepest, level),
        )
        for start, level in zip(starts, levels, strict=True)
    ]
    first_keys = keys[starts]
    for records in whole.file.pieces():
        codes = codes_of(records, header, cube)
        place = np.searchsorted(first_keys, key_at(codes, deepest), side="right") - 1
        order = np.argsort(place, kind="stable")
        bounds = np.searchsorted(place[order], np.arange(len(parts) + 1))
        for number in np.flatnonzero(bounds[1:] > bounds[:-1]):
            chosen = order[bounds[number] : bounds[number + 1]]
            parts[number].add(records.take(chosen), codes[chosen])
    whole.file.remove()
    found: list[Part] = []
    for part in parts:
        is_crowded = part.file.points > most and part.level < DEEPEST
        found += _cut(part, header, cube, most, folder) if is_crowded else [part]
    return found


def _key(key: np.uint64, level: int, at: int) -> int:
    return int(key) >> 3 * (level - int(at))


def _counted(
    file: RecordFile, header: LasHeader, cube: Cube, level: int
) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """Return the occupied nodes of `level`, ascending, and the points of each."""
    keys = np.empty(0, np.uint64)
    counts = np.empty(0, np.int64)
    for records in file.pieces():
        found, held = np.unique(key_at(codes_of(records, header, cube), level), return_counts=True)
        both, place = np.unique(np.concatenate([keys, found]), return_inverse=True)
        sums = np.zeros(len(both), np.int64)
        np.add.at(sums, place, np.concatenate([counts, held]))
        keys, counts = both, sums
    return keys, counts


def _largest_nodes(
    keys: NDArray[np.uint64], counts: NDArray[np.int64], top: int, deepest: int, most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where in `keys` each of the largest nodes of at most `most` points begins, its level.

    Nodes of level `deepest` with more are returned as they are.
    """
    before = np.concatenate([[0], np.cumsum(counts)])
    starts: list[int] = []
    levels: list[int] = []
    stack = [(0, len(keys), top)]
    while stack:
        start, stop, level = stack.pop()
        if before[stop] - before[start] <= most or level == deepest:
            starts.append(start)
            levels.append(level)
            continue
        shift = np.uint64(3 * (deepest - level - 1))
        children = keys[start:stop] >> shift
        borders = np.flatnonzero(children[1:] != children[:-1]) + start + 1
        bounds = [start, *borders.tolist(), stop]
        stack += [(a, b, level + 1) for a, b in zip(bounds[-2::-1], bounds[:0:-1], strict=True)]
    return np.array(starts), np.array(levels)


def _show_above(parts: list[Part]) -> None:
    """Settle which levels with cells larger than a part show its first points."""
    used = [0] * len(parts)
    for level in range(max(part.level for part in parts) - GRID_BITS):
        cell_level = level + GRID_BITS
        best: dict[int, int] = {}
        for number, part in enumerate(parts):
            if part.level <= cell_level or used[number] >= part.file.points:
                continue
            cell = part.key >> 3 * (part.level - cell_level)
            other = best.get(cell)
            if other is None or part.firsts[used[number]] < parts[other].firsts[used[other]]:
                best[cell] = number
        for number in best.values():
            parts[number].shown_above.append(level)
            used[number] += 1
