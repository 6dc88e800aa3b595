"""Read PTX: the scans of one text file, each with its pose applied, kept apart as stations.

Each scan begins with ten lines: columns, rows, the scanner's place and axes (repeated in the
matrix), and a 4 x 4 matrix for row vectors. Then one line per cell of the grid: x y z intensity,
or x y z intensity red green blue; a cell that got no echo is 0 0 0.
Source: Leica Geosystems, "Cyclone pointcloud export format - Description of ASCII .ptx format".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import BitField
from dougong.errors import FormatError
from dougong.formats.stream import Block, opened, refuse_empty, stem_of
from dougong.formats.text_rows import RowFormat, parse_rows
from dougong.typing import Points

_HEADER_WORDS = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
"""Numbers in each of the ten lines before a scan's points."""
_BLOCK_BYTES = 1 << 24
_NEWLINE = 10
_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_FIELDS = [
    *((axis, "<f8") for axis in _AXES), ("intensity", "<f8"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"),
]  # fmt: skip


@dataclass(frozen=True)
class PtxHeader:
    """Where a cloud stands in its PTX file."""

    station: int
    rotation: NDArray[np.float64]
    """(3, 3), scanner to file coordinates."""
    translation: NDArray[np.float64]
    """(3,), metres."""
    source: Path | None = field(default=None, compare=False)
    stations: tuple[PtxHeader, ...] = ()
    """Of several scans read as one cloud: the header of each."""


@dataclass
class PtxScan:
    """One scan of a PTX file."""

    path: Path
    name: str
    header: PtxHeader
    count: int
    """Cells of the grid, those without an echo included."""
    start: int
    """File position of the first point."""
    columns: int
    crs: str | None = None
    notes: tuple[str, ...] = ()
    bits: dict[str, BitField] = field(default_factory=dict)
    lacking: str = "no finite coordinates or another number of columns"

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Record layout: coordinates as the scanner measured them, intensity, colour."""
        return np.dtype(_FIELDS[: self.columns])

    def blocks(self, rows: int) -> Iterator[Block]:
        """Yield the scan in blocks, pose applied."""
        names = self.dtype.names or ()
        done = 0
        for table in parse_rows(self.path, self.start, self.count, RowFormat(self.columns), rows):
            records = np.zeros(len(table), dtype=self.dtype)
            with np.errstate(invalid="ignore"):  # rows without coordinates will be dropped
                for index, name in enumerate(names):
                    records[name] = table[:, index]
            local: Points = np.ascontiguousarray(table[:, :3])
            is_empty = (local == 0).all(axis=1)
            placed = local @ self.header.rotation.T + self.header.translation
            done += len(table)
            yield Block(records, placed, is_empty)
        if done < self.count:
            msg = (
                f"{self.path.name}: scan {self.header.station + 1} should hold {self.count:,} "
                f"points, file ends after {done:,}. Copy it again."
            )
            raise FormatError(msg)


def open_ptx(path: Path) -> list[PtxScan]:
    """Find the scans of a PTX file; one scan object for each that has points.

    Raises
    ------
    FormatError
        Not a PTX file, a damaged header, or without any point.
    """
    scans: list[PtxScan] = []
    with opened(path) as file:
        while (lines := _header_lines(file, path, len(scans))) is not None:
            scans.append(_scan(file, path, lines, len(scans)))
            _pass_over(file, scans[-1].count)
    filled = [scan for scan in scans if scan.count]
    refuse_empty(len(filled), path)
    return filled


def _header_lines(file: IO[bytes], path: Path, station: int) -> list[list[float]] | None:
    """Return the numbers of the ten lines before a scan's points; None at the end of the file."""
    found: list[list[float]] = []
    for count in _HEADER_WORDS:
        line = file.readline(100_000)
        while line and not line.strip():
            line = file.readline(100_000)
        if not line and not found:
            return None
        words = line.decode("utf-8", "replace").split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != count or not np.isfinite(numbers).all():
            raise _damaged(path, station, len(found) + 1, count, words)
        found.append(numbers)
    if any(size < 0 or size != int(size) for size in (found[0][0], found[1][0])):
        raise _damaged(path, station, 1, 1, [f"{found[0][0]:g} x {found[1][0]:g}"])
    return found


def _damaged(path: Path, station: int, line: int, count: int, words: list[str]) -> FormatError:
    seen = " ".join(words)[:60]
    return FormatError(
        f"{path.name}: line {line} of the header of scan {station + 1} reads {seen!r}, expected "
        f"{'one number' if count == 1 else f'{count} numbers'}. Export it again."
    )


def _scan(file: IO[bytes], path: Path, lines: list[list[float]], station: int) -> PtxScan:
    matrix = np.array(lines[6:])
    linear, translation = matrix[:3, :3].T, matrix[3, :3]
    # Written matrices have six decimals.
    if np.abs(linear @ linear.T - np.eye(3)).max() > 1e-3 or np.linalg.det(linear) < 0:
        msg = (
            f"{path.name}: the matrix of scan {station + 1} is no rotation (it scales, shears or "
            "mirrors). Export it with a rigid pose."
        )
        raise FormatError(msg)
    start = file.tell()
    first = file.readline(100_000).split()
    file.seek(start)
    count = int(lines[0][0]) * int(lines[1][0])
    if count and len(first) not in (4, 7):
        msg = (
            f"{path.name}: the first point of scan {station + 1} has {len(first)} columns, "
            "expected 4 (x y z intensity) or 7 (and red green blue). Export it again."
        )
        raise FormatError(msg)
    u, _, vt = np.linalg.svd(linear)
    return PtxScan(
        path=path,
        name=f"{stem_of(path)}_{station + 1}",
        header=PtxHeader(station, u @ vt, translation, source=path),
        count=count,
        start=start,
        columns=len(first) or 4,
    )


def _pass_over(file: IO[bytes], lines: int) -> None:
    """Move behind the next `lines` line ends, or to the end of the file."""
    left = lines
    while left and (block := file.read(_BLOCK_BYTES)):
        ends = np.flatnonzero(np.frombuffer(block, np.uint8) == _NEWLINE)
        if len(ends) >= left:
            file.seek(int(ends[left - 1]) + 1 - len(block), 1)
            return
        left -= len(ends)
