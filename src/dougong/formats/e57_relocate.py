"""Copy sections of an E57 file to another place: tables of points and blobs of pictures.

A section knows where it lies: its head and its index packets hold physical positions, which move
with it. Source: ASTM E2807-11, sections 8.4.4 and 9.2 to 9.5.
"""

from __future__ import annotations

import struct

from dougong.formats.e57_container import (
    BLOB,
    INDEX_PACKET,
    SECTION,
    Appender,
    Pages,
    packet_batches,
    read_section,
)

_INDEX_HEAD, _ENTRY = 16, 16
_COPY_BYTES = 8 << 20


def copy_section(pages: Pages, place: int, out: Appender) -> int:
    """Append the section at the physical position `place` to `out`; return its new position.

    Raises
    ------
    FormatError
        A packet runs past its section, or a page is damaged.
    """
    section = read_section(pages, place)
    out.align()
    new = out.tell()
    if section.kind == BLOB:
        _copy(pages, section.start, section.stop, out)
        return out.physical(new)
    shift = new - section.start

    def relocated(physical: int) -> int:
        return out.physical(pages.layout.logical(physical) + shift) if physical else 0

    length = section.stop - section.start
    data = out.physical(section.data + shift)
    out.write(SECTION.pack(section.kind, length, data, relocated(section.index)))
    _copy(pages, section.start + SECTION.size, section.data, out)
    for _, batch, begins in packet_batches(pages, section):
        for begin in begins:
            if batch[begin] != INDEX_PACKET:
                continue
            for entry in range(struct.unpack_from("<H", batch, begin + 4)[0]):
                at = begin + _INDEX_HEAD + entry * _ENTRY + 8
                struct.pack_into("<Q", batch, at, relocated(*struct.unpack_from("<Q", batch, at)))
        out.write(bytes(batch))
    return out.physical(new)


def _copy(pages: Pages, start: int, stop: int, out: Appender) -> None:
    for at in range(start, stop, _COPY_BYTES):
        out.write(pages.read(at, min(_COPY_BYTES, stop - at)))
