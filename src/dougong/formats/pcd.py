"""Read PCD: ASCII, binary and binary_compressed. Source: Point Cloud Library, PCD v0.7."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from dougong.cloud import BitField, Records
from dougong.errors import FormatError
from dougong.formats.stream import Block, opened, refuse_empty, stem_of
from dougong.formats.text_rows import RowFormat, parse_rows

_KINDS = {"F": "f", "U": "u", "I": "i"}
_PACKED = ("rgb", "rgba")
"""Fields that hold a colour in 4 bytes; some writers call them floats."""


@dataclass(frozen=True)
class PcdHeader:
    """The header lines of a PCD file, keyword to words."""

    lines: tuple[tuple[str, tuple[str, ...]], ...]
    source: Path | None = field(default=None, compare=False)


@dataclass
class PcdScan:
    """The points of one PCD file."""

    path: Path
    name: str
    header: PcdHeader
    stored: np.dtype[np.void]
    count: int
    start: int
    encoding: str
    crs: str | None = None
    notes: tuple[str, ...] = ()
    bits: dict[str, BitField] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Record layout: the stored one without padding, packed colours as integers."""
        return _useful(self.stored)

    def blocks(self, rows: int) -> Iterator[Block]:
        """Yield the points in blocks."""
        dtype = self.dtype
        for stored in self._stored(rows):
            records = np.empty(len(stored), dtype=dtype)
            for name in dtype.names or ():
                values = stored[name]
                is_packed = name in _PACKED and values.dtype.kind == "f"
                records[name] = np.ascontiguousarray(values).view("<u4") if is_packed else values
            coordinates = np.stack([records[a].astype(np.float64) for a in "xyz"], axis=1)
            yield Block(records, coordinates)

    def _stored(self, rows: int) -> Iterator[Records]:
        if self.encoding == "ascii":
            yield from self._ascii(rows)
            return
        with opened(self.path) as file:
            file.seek(self.start)
            if self.encoding == "binary_compressed":
                whole = self._unpacked(file)
                yield from (whole[first : first + rows] for first in range(0, self.count, rows))
                return
            for first in range(0, self.count, rows):
                wanted = min(rows, self.count - first)
                stored = np.fromfile(file, dtype=self.stored, count=wanted)
                if len(stored) < wanted:
                    raise _truncated(self.path, self.count, first + len(stored))
                yield stored

    def _ascii(self, rows: int) -> Iterator[Records]:
        widths = [int(np.prod(self.stored[n].shape, dtype=int)) for n in self.stored.names or ()]
        done = 0
        for table in parse_rows(self.path, self.start, self.count, RowFormat(sum(widths)), rows):
            stored = np.empty(len(table), dtype=self.stored)
            at = 0
            for name, width in zip(self.stored.names or (), widths, strict=True):
                part = table[:, at] if width == 1 else table[:, at : at + width]
                with np.errstate(invalid="ignore"):
                    stored[name] = part
                at += width
            done += len(table)
            yield stored
        if done < self.count:
            raise _truncated(self.path, self.count, done)

    def _unpacked(self, file: IO[bytes]) -> Records:
        """Return all points of a compressed file, which is one block, field after field."""
        from dougong.kernels.lzf import unpack_lzf

        sizes = np.frombuffer(file.read(8), dtype="<u4")
        expected = self.count * self.stored.itemsize
        if len(sizes) < 2 or int(sizes[1]) != expected:
            raise _truncated(self.path, self.count, 0)
        packed = np.frombuffer(file.read(int(sizes[0])), dtype=np.uint8)
        out = np.empty(expected, dtype=np.uint8)
        if len(packed) < int(sizes[0]) or unpack_lzf(packed, out) != expected:
            raise _truncated(self.path, self.count, 0)
        records = np.empty(self.count, dtype=self.stored)
        at = 0
        for name in self.stored.names or ():
            size = self.stored[name].itemsize * self.count
            column = out[at : at + size].view(self.stored[name].base)
            records[name] = column.reshape(records[name].shape)
            at += size
        return records


def _colours_of(stored: np.dtype[np.void]) -> dict[str, BitField]:
    """Return where the parts of a packed colour sit."""
    packed = [n for n in _PACKED if n in (stored.names or ()) and stored[n].itemsize == 4]
    if not packed:
        return {}
    name = packed[0]
    bits = {
        "red": BitField(name, 0xFF0000, 16),
        "green": BitField(name, 0xFF00, 8),
        "blue": BitField(name, 0xFF),
    }
    return bits | ({"alpha": BitField(name, 0xFF000000, 24)} if name == "rgba" else {})


def _useful(stored: np.dtype[np.void]) -> np.dtype[np.void]:
    fields: list[tuple[str, Any]] = []
    for name in stored.names or ():
        kind = stored[name]
        if name.startswith("_"):
            continue
        fields.append((name, "<u4" if name in _PACKED and kind.itemsize == 4 else kind))
    return np.dtype(fields)


def _truncated(path: Path, promised: int, found: int) -> FormatError:
    after = f"ends after {found:,}" if found else "is damaged or ends early"
    return FormatError(
        f"{path.name}: header says {promised:,} points, file {after}. Copy it again."
    )


def open_pcd(path: Path) -> PcdScan:
    """Read the header of a PCD file.

    Raises
    ------
    FormatError
        Not a PCD file, a damaged header, or points without x, y and z.
    """
    lines: dict[str, tuple[str, ...]] = {}
    with opened(path) as file:
        while "DATA" not in lines:
            line = file.readline(100_000)
            text = line.decode("utf-8", "replace").strip()
            if not line or (not lines and not text.startswith(("#", "VERSION", "FIELDS"))):
                msg = f"{path.name} is not a PCD file: no header with FIELDS and DATA was found."
                raise FormatError(msg)
            if text and not text.startswith("#"):
                keyword, *words = text.split()
                lines[keyword] = tuple(words)
            elif not lines:
                lines["#"] = ()
        start = file.tell()
    lines.pop("#", None)
    return _scan(path, lines, start)


def _scan(path: Path, lines: dict[str, tuple[str, ...]], start: int) -> PcdScan:
    try:
        names = lines["FIELDS"]
        counts = lines.get("COUNT", ("1",) * len(names))
        fields: list[tuple[str, Any]] = []
        for k, (name, size, kind, count) in enumerate(
            zip(names, lines["SIZE"], lines["TYPE"], counts, strict=True)
        ):
            dtype = f"<{_KINDS[kind]}{int(size)}"
            key = f"_{k}" if name == "_" else name
            shape = () if int(count) == 1 else (int(count),)
            fields.append((key, np.dtype((dtype, shape))))
        stored = np.dtype(fields)
        width, height = int(lines.get("WIDTH", ("0",))[0]), int(lines.get("HEIGHT", ("1",))[0])
        total = int(lines["POINTS"][0]) if "POINTS" in lines else width * height
        encoding = lines["DATA"][0]
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise FormatError(
            f"{path.name} has a damaged PCD header ({error}). Export it again."
        ) from error
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise FormatError(f"{path.name} has PCD data {encoding!r}, which is not known.")
    if not {"x", "y", "z"} <= set(names):
        msg = f"{path.name} has points without x, y and z; its fields are {', '.join(names)}."
        raise FormatError(msg)
    refuse_empty(total, path)
    bits = _colours_of(stored)
    notes: tuple[str, ...] = ()
    if lines.get("VIEWPOINT", ("0", "0", "0", "1", "0", "0", "0"))[:7] != tuple("0001000"):
        notes = ("names a viewpoint, which is kept out of the coordinates.",)
    header = PcdHeader(tuple(lines.items()), source=path)
    return PcdScan(
        path, stem_of(path), header, stored, total, start, encoding,
        notes=notes, bits=bits,
    )  # fmt: skip
