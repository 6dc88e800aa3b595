"""The bytes of an E57 file: pages with checksums, and the XML that says what lies where.

A file is a sequence of pages (1024 bytes); the last four bytes of each are the CRC-32C of the
others. *Physical* positions count all bytes, *logical* ones leave the checksums out. Whoever only
changes the XML (a pose) can therefore copy all points and pictures as they are.
Source: ASTM E2807-11, sections 6 and 7.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dougong.errors import FormatError

_SIGNATURE = b"ASTM-E57"
_HEADER = struct.Struct("<8sIIQQQQ")
SECTION = struct.Struct("<B7xQQQ")
"""Head of a section: its kind, bytes, and the physical positions of data and index."""
BLOB, TABLE = 0, 1
"""Kinds of sections."""
INDEX_PACKET, DATA_PACKET = 0, 1
"""Kinds of packets in a table: the first byte of each."""
_CHECKSUM = 4
_COPY_PAGES = 4096
_LEAST_PAGE, _MOST_PAGE = 128, 1 << 20


@dataclass(frozen=True, slots=True)
class Layout:
    """The header of an E57 file."""

    version: tuple[int, int]
    page: int
    """Bytes per page, checksum included."""
    file_bytes: int
    xml_start: int
    """Logical position of the XML."""
    xml_bytes: int

    @property
    def payload(self) -> int:
        """Bytes per page without the checksum."""
        return self.page - _CHECKSUM

    def logical(self, physical: int) -> int:
        """Return a physical position as a logical one."""
        page, within = divmod(physical, self.page)
        return page * self.payload + min(within, self.payload)

    def physical(self, logical: int) -> int:
        """Return a logical position as a physical one."""
        page, within = divmod(logical, self.payload)
        return page * self.page + within

    def packed(self) -> bytes:
        """Return the header as it stands in the file."""
        return _HEADER.pack(
            _SIGNATURE, *self.version, self.file_bytes, self.physical(self.xml_start),
            self.xml_bytes, self.page,
        )  # fmt: skip


def read_layout(file: IO[bytes], path: Path) -> Layout:
    """Read the header of an open E57 file.

    Raises
    ------
    FormatError
        Not an E57 file, damaged, or shorter than it says.
    """
    head = file.read(_HEADER.size)
    if head[:8] != _SIGNATURE:
        msg = f"{path.name} is not an E57 file: it starts with {head[:8]!r}, expected b'ASTM-E57'."
        raise FormatError(msg)
    if len(head) < _HEADER.size:
        raise FormatError(f"{path.name}: the file ends inside its header. Copy it again.")
    _, major, minor, size, xml_at, xml_bytes, page = _HEADER.unpack(head)
    there = file.seek(0, 2)
    if not _LEAST_PAGE <= page <= _MOST_PAGE or size % page or xml_at + xml_bytes > size:
        msg = (
            f"{path.name} has a damaged E57 header: {size:,} bytes in pages of {page:,}, XML of "
            f"{xml_bytes:,} bytes at {xml_at:,}. Copy it again."
        )
        raise FormatError(msg)
    if there < size:
        msg = (
            f"{path.name}: its header says {size:,} bytes, the file has {there:,}. It is "
            "truncated; copy it again."
        )
        raise FormatError(msg)
    layout = Layout((major, minor), page, size, 0, xml_bytes)
    return Layout((major, minor), page, size, layout.logical(xml_at), xml_bytes)


class Pages:
    """Logical bytes of an open E57 file, read and written through its pages."""

    def __init__(self, file: Any, layout: Layout, name: str) -> None:
        self._file = file
        self.layout = layout
        self.name = name

    def read(self, start: int, count: int) -> bytes:
        """Return `count` logical bytes from `start`, their checksums tested.

        Raises
        ------
        FormatError
            A page is damaged or missing.
        """
        if count <= 0:
            return b""
        first, last = self._pages_of(start, count)
        payload = self._load(first, last)[:, : self.layout.payload]
        skip = start - first * self.layout.payload
        data: bytes = payload.tobytes()[skip : skip + count]
        return data

    def write(self, start: int, data: bytes | bytearray | memoryview) -> None:
        """Put `data` at the logical position `start`, with new checksums.

        Pages that are not there yet are added; what they hold behind `data` is zero.
        """
        if not len(data):
            return
        size, payload = self.layout.page, self.layout.payload
        first, last = self._pages_of(start, len(data))
        there = self._file.seek(0, 2) // size
        block = np.zeros((last - first, size), dtype=np.uint8)
        # Only the first and the last page can hold bytes that stay.
        for page in {first, last - 1}:
            if page < there:
                block[page - first] = self._load(page, page + 1)[0]
        flat = np.ascontiguousarray(block[:, :payload]).reshape(-1)
        skip = start - first * payload
        flat[skip : skip + len(data)] = np.frombuffer(data, dtype=np.uint8)
        block[:, :payload] = flat.reshape(-1, payload)
        block[:, payload:] = _checksums(block[:, :payload])
        self._file.seek(first * size)
        self._file.write(block.tobytes())

    def copy_into(self, sink: Any, stop: int) -> None:
        """Append all pages before the logical position `stop` to `sink`, checksums tested."""
        self._file.seek(0)
        whole = -(-stop // self.layout.payload)
        for first in range(0, whole, _COPY_PAGES):
            sink.write(self._load(first, min(first + _COPY_PAGES, whole)).tobytes())

    def _pages_of(self, start: int, count: int) -> tuple[int, int]:
        payload = self.layout.payload
        return start // payload, -(-(start + count) // payload)

    def _load(self, first: int, last: int) -> Any:
        size = self.layout.page
        self._file.seek(first * size)
        raw = self._file.read((last - first) * size)
        if len(raw) < (last - first) * size:
            msg = (
                f"{self.name}: the file ends at byte {first * size + len(raw):,}, expected "
                f"{last * size:,}. It is truncated; copy it again."
            )
            raise FormatError(msg)
        pages = np.frombuffer(raw, dtype=np.uint8).reshape(-1, size)
        is_bad = (_checksums(pages[:, :-_CHECKSUM]) != pages[:, -_CHECKSUM:]).any(axis=1)
        if is_bad.any():
            at = (first + int(np.flatnonzero(is_bad)[0])) * size
            msg = (
                f"{self.name} is damaged: the checksum of the {size} bytes at {at:,} does not "
                "agree with them. Copy it again."
            )
            raise FormatError(msg)
        return pages


@dataclass(frozen=True, slots=True)
class Section:
    """Where the bytes of a table of points or of a blob lie; positions are logical."""

    kind: int
    """`BLOB` or `TABLE`."""
    start: int
    stop: int
    data: int
    """First packet of a table."""
    index: int
    """First index packet of a table, physical; 0: none."""


def read_section(pages: Pages, place: int) -> Section:
    """Read the head of the section at the physical position `place`."""
    start = pages.layout.logical(place)
    kind, length, data, index = SECTION.unpack(pages.read(start, SECTION.size))
    return Section(kind, start, start + length, pages.layout.logical(data), index)


def packet_batches(
    pages: Pages, section: Section, batch_bytes: int = 8 << 20
) -> Iterator[tuple[int, bytearray, list[int]]]:
    """Yield (logical start, bytes, where packets begin in them) for some whole packets at a time.

    Raises
    ------
    FormatError
        A packet runs past its section.
    """
    at = section.data
    while at < section.stop:
        batch = bytearray(pages.read(at, min(batch_bytes, section.stop - at)))
        begins, used = [], 0
        while used + 4 <= len(batch):
            size = struct.unpack_from("<H", batch, used + 2)[0] + 1
            if used + size > len(batch):
                break
            begins.append(used)
            used += size
        if not used:
            msg = (
                f"{pages.name}: a packet of a scan runs past its section. The input is damaged; "
                "export it again."
            )
            raise FormatError(msg)
        del batch[used:]
        yield at, batch, begins
        at += used


class Appender:
    """A new E57 file that grows at its end: logical bytes in, pages with checksums out."""

    page = 1024
    _payload = page - _CHECKSUM

    def __init__(self, sink: Any) -> None:
        self._sink = sink
        self._waiting: list[Any] = []
        self._waiting_bytes = 0
        self._written = 0
        self.write(np.zeros(_HEADER.size, dtype=np.uint8))

    def tell(self) -> int:
        """Return the logical position of the next byte."""
        return self._written + self._waiting_bytes

    def physical(self, logical: int) -> int:
        """Return a logical position as a physical one."""
        page, within = divmod(logical, self._payload)
        return page * self.page + within

    def write(self, data: bytes | NDArray[np.uint8]) -> None:
        """Append bytes; whole pages go to the file."""
        piece = np.frombuffer(data, dtype=np.uint8) if isinstance(data, bytes) else data
        self._waiting.append(piece)
        self._waiting_bytes += len(piece)
        if self._waiting_bytes >= _COPY_PAGES * self._payload:
            self._flush(self._waiting_bytes // self._payload * self._payload)

    def align(self) -> None:
        """Fill up to a multiple of four, where sections begin."""
        self.write(bytes(-self.tell() % 4))

    def finish(self, xml: bytes) -> Layout:
        """Append the XML, put the header in its place, and return it."""
        self.align()
        start = self.tell()
        self.write(xml)
        self.write(bytes(-self.tell() % self._payload))
        self._flush(self._waiting_bytes)
        size = self._written // self._payload * self.page
        layout = Layout((1, 0), self.page, size, start, len(xml))
        Pages(self._sink, layout, "the new file").write(0, layout.packed())
        return layout

    def _flush(self, count: int) -> None:
        joined = np.concatenate(self._waiting) if len(self._waiting) > 1 else self._waiting[0]
        rows = joined[:count].reshape(-1, self._payload)
        pages = np.empty((len(rows), self.page), dtype=np.uint8)
        pages[:, : self._payload] = rows
        pages[:, self._payload :] = _checksums(pages[:, : self._payload])
        self._sink.write(pages.data)
        self._waiting = [joined[count:].copy()]
        self._waiting_bytes -= count
        self._written += count


def _checksums(payload: Any) -> Any:
    """Return the checksums (n, 4) of pages' payloads (n, m), as bytes, highest first."""
    from dougong.kernels.crc32c import page_checksums

    found = np.empty(len(payload), dtype=np.uint32)
    page_checksums(payload, found)
    return found.astype(">u4").view(np.uint8).reshape(-1, _CHECKSUM)
