"""Read PLY (ASCII, binary of both byte orders) and write it; other elements are left alone.

The header is parsed here and the vertices are memory-mapped, because a mesh's face lists would
cost a Python loop each; plyfile reads the rare files whose vertices lie behind a list.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import BitField, Cloud, Records
from dougong.errors import FormatError
from dougong.formats.ply_lists import TYPES, Element, end_of
from dougong.formats.stream import Block, opened, refuse_empty, stem_of
from dougong.formats.text_rows import RowFormat, parse_rows
from dougong.formats.units import as_wkt, is_same_crs

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_AXES = (("x", "y", "z"), ("X", "Y", "Z"))
CRS_COMMENT = "crs "
_LINE_END = 2
"""Bytes that a text tool may leave behind the points."""


@dataclass(frozen=True)
class PlyHeader:
    """What a PLY file says before its first vertex, kept to write the same again."""

    encoding: str
    comments: tuple[str, ...] = ()
    """Lines "comment ..." and "obj_info ...", whole and in order."""
    elements: tuple[tuple[str, int], ...] = ()
    """Other elements of the file: name and how many; they are not read."""
    source: Path | None = field(default=None, compare=False)


@dataclass
class PlyScan:
    """The vertices of one PLY file."""

    path: Path
    name: str
    header: PlyHeader
    dtype: np.dtype[np.void]
    count: int
    start: int
    crs: str | None = None
    notes: tuple[str, ...] = ()
    bits: dict[str, BitField] = field(default_factory=dict)
    loaded: Records | None = None
    elements: tuple[Element, ...] = ()
    """All of the file, as its header declares them."""
    first: int = 0
    """Where the first of them begins."""
    is_asked: bool = False
    """Whether it is known by now what follows behind them."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the coordinate properties."""
        return next(axes for axes in _AXES if set(axes) <= set(self.dtype.names or ()))

    def blocks(self, rows: int) -> Iterator[Block]:
        """Yield the vertices in blocks."""
        for records in self._records(rows):
            coordinates = np.stack([records[a].astype(np.float64) for a in self.axes], axis=1)
            yield Block(records, coordinates)
        if not self.is_asked:
            self.is_asked = True
            note = self._ending()
            self.notes = self.notes if note is None else (*self.notes, note)

    def _ending(self) -> str | None:
        """Return in words that more or less is there than the header declares; None: neither."""
        if self.header.encoding == "ascii":
            with opened(self.path) as file:
                file.seek(self.first)
                extra = sum(bool(line.strip()) for line in file)
            extra -= sum(count for _, count, _ in self.elements)
            said = f"{extra:,} lines"
            end: int | str | None = "other" if extra < 0 else 0
        else:
            end = end_of(self.path, self.first, self.elements, _ORDERS[self.header.encoding])
            extra = self.path.stat().st_size - end if isinstance(end, int) else 0
            # What `loaded` holds has no lists: it does not tell the bytes of a point.
            each = "" if self.loaded is not None else f" (of {self.dtype.itemsize} a point)"
            said = f"{extra:,} bytes{each}"
            if isinstance(end, int) and extra <= _LINE_END and not self._tail(end):
                return None
        if isinstance(end, str):
            return (
                f"it ends inside its {end} elements, or its header declares {self.count:,} points "
                "wrongly. Copy it again."
            )
        if extra <= 0:
            return None
        return (
            f"its header declares {self.count:,} points, wrongly: {said} follow after all that it "
            "declares, and are not read. Export it again."
        )

    def _tail(self, start: int) -> bytes:
        """Return the few bytes from `start` on, but for line ends."""
        with opened(self.path) as file:
            file.seek(start)
            return file.read().strip()

    def _records(self, rows: int) -> Iterator[Records]:
        if self.loaded is not None:
            yield from (self.loaded[i : i + rows] for i in range(0, self.count, rows))
        elif self.header.encoding == "ascii":
            yield from self._ascii(rows)
        else:
            with opened(self.path) as file:
                file.seek(self.start)
                for first in range(0, self.count, rows):
                    wanted = min(rows, self.count - first)
                    records = np.fromfile(file, dtype=self.dtype, count=wanted)
                    if len(records) < wanted:
                        raise _truncated(self.path, self.count, first + len(records))
                    yield records

    def _ascii(self, rows: int) -> Iterator[Records]:
        names = self.dtype.names or ()
        done = 0
        for table in parse_rows(self.path, self.start, self.count, RowFormat(len(names)), rows):
            records = np.empty(len(table), dtype=self.dtype)
            for column, name in enumerate(names):
                records[name] = table[:, column]
            done += len(table)
            yield records
        if done < self.count:
            raise _truncated(self.path, self.count, done)


def _truncated(path: Path, promised: int, found: int) -> FormatError:
    return FormatError(
        f"{path.name}: header says {promised:,} points, file ends after {found:,}. Copy it again."
    )


def open_ply(path: Path) -> PlyScan:
    """Read the header of a PLY file.

    Raises
    ------
    FormatError
        Not a PLY file, a damaged header, or no vertices with x, y and z.
    """
    with opened(path) as file:
        if file.readline(16).strip() != b"ply":
            raise FormatError(f"{path.name} is not a PLY file: its first line is not 'ply'.")
        lines = []
        while True:
            line = file.readline(1_000_000)
            if not line:
                raise FormatError(f"{path.name}: the file ends inside its header. Copy it again.")
            text = line.decode("utf-8", "replace").strip()
            if text == "end_header":
                break
            lines.append(text)
        return _scan(path, lines, file.tell())


def _scan(path: Path, lines: list[str], start: int) -> PlyScan:
    encoding, comments = "", []
    elements: list[Element] = []
    for line in lines:
        words = line.split()
        if not words:
            continue
        if words[0] == "format" and len(words) >= 2:
            encoding = words[1]
        elif words[0] in ("comment", "obj_info"):
            comments.append(line)
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) >= 3:
            elements[-1][2].append(words[1:])
        else:
            raise FormatError(f"{path.name} has a PLY header line that has no meaning: {line!r}.")
    if encoding not in _ORDERS:
        msg = f"{path.name} has PLY encoding {encoding!r}; expected one of {', '.join(_ORDERS)}."
        raise FormatError(msg)
    names = [name for name, _, _ in elements]
    if "vertex" not in names:
        msg = f"{path.name} has no vertices: its elements are {', '.join(names) or 'none'}."
        raise FormatError(msg)
    at = names.index("vertex")
    others = tuple((name, count) for name, count, _ in elements if name != "vertex")
    header = PlyHeader(encoding, tuple(comments), others, source=path)
    return _placed(path, header, elements, at, start)


def _placed(
    path: Path,
    header: PlyHeader,
    elements: list[Element],
    at: int,
    start: int,
) -> PlyScan:
    first, (_, count, properties) = start, elements[at]
    refuse_empty(count, path)
    order = _ORDERS[header.encoding]
    notes = tuple(
        f"also holds {number} {name} elements, which are not read."
        for name, number in header.elements
        if number
    )
    has_list = any(words[0] == "list" for _, _, words_ in elements[: at + 1] for words in words_)
    name = stem_of(path)
    crs = _crs_of(header.comments)
    if has_list or (header.encoding == "ascii" and at > 0):
        records, left_out = _by_plyfile(path)
        if left_out:
            notes = (*notes, f"list properties were not read: {', '.join(left_out)}.")
        scan = PlyScan(path, name, header, records.dtype, count, start, crs, notes, loaded=records)
    else:
        dtype = _layout(path, properties, order)
        start += sum(n * _layout(path, words, order).itemsize for _, n, words in elements[:at])
        scan = PlyScan(path, name, header, dtype, count, start, crs, notes)
    scan.elements, scan.first = tuple(elements), first
    if not any(set(axes) <= set(scan.dtype.names or ()) for axes in _AXES):
        msg = (
            f"{path.name} has vertices without x, y and z; its properties are "
            f"{', '.join(scan.dtype.names or ())}."
        )
        raise FormatError(msg)
    return scan


def _layout(path: Path, properties: list[list[str]], order: str) -> np.dtype[np.void]:
    fields = []
    for words in properties:
        if words[0] not in TYPES:
            raise FormatError(f"{path.name} has a PLY property of unknown type {words[0]!r}.")
        fields.append((words[1], order + TYPES[words[0]]))
    try:
        return np.dtype(fields)
    except ValueError as error:
        raise FormatError(f"{path.name} names a PLY property twice: {error}.") from error


def _by_plyfile(path: Path) -> tuple[Records, list[str]]:
    from plyfile import PlyData, PlyParseError

    try:
        data = PlyData.read(str(path))["vertex"].data
    except (PlyParseError, ValueError, OSError) as error:
        raise FormatError(f"{path.name} cannot be read as PLY: {error}.") from error
    kept = [name for name in data.dtype.names if data.dtype[name].kind != "O"]
    records = np.empty(len(data), dtype=[(name, data.dtype[name]) for name in kept])
    for name in kept:
        records[name] = data[name]
    return records, [name for name in data.dtype.names if name not in kept]


def _crs_of(comments: tuple[str, ...]) -> str | None:
    """Return the reference system from "comment crs WKT" or from an EPSG code in a comment."""
    for comment in comments:
        text = comment.partition(" ")[2].strip()
        if text.lower().startswith(("crs ", "crs:", "crs=")):
            wkt = as_wkt(text[4:].strip())
            if wkt is not None:
                return wkt
    codes = re.findall(r"\bEPSG:{1,2}(\d{4,6})\b", "\n".join(comments), flags=re.IGNORECASE)
    return as_wkt(f"EPSG:{codes[0]}") if codes else None


def has_crs(header: Any, crs: str | None) -> bool:
    """Say whether the comments of `header` give this reference system."""
    return isinstance(header, PlyHeader) and is_same_crs(_crs_of(header.comments), crs)


def axes_of(cloud: Cloud) -> tuple[str, ...] | None:
    """Return the names of the float coordinate fields of a cloud's records, if it has any."""
    names = set(cloud.records.dtype.names or ())
    for axes in _AXES:
        if set(axes) <= names and all(cloud.records.dtype[axis].kind == "f" for axis in axes):
            return axes
    return None
