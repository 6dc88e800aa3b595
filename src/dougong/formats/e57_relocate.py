"""Copy sections of an E57 file to another place: tables of points and blobs of pictures.

A section knows where it lies: its header and its index packets hold physical positions, which
move with it. Source: ASTM E2807-11, sections 8.4.4 and 9.2 to 9.5.
"""

from __future__ import annotations

import struct

from dougong.errors import FormatError
from dougong.formats.e57_container import Appender, Pages

_SECTION = struct.Struct("<BxxxxxxxQQQ")
_BLOB, _INDEX_PACKET = 0, 0
_INDEX_HEAD, _ENTRY = 16, 16
_BATCH_BYTES = 8 << 20


def copy_section(pages: Pages, place: int, out: Appender) -> int:
    """Append the section at the physical position `place` to `out`; return its new position.

    Raises
    ------
    FormatError
        A packet runs past its section, or a page is damaged.
    """
    layout = pages.layout
    start = layout.logical(place)
    kind, length, data, index = _SECTION.unpack(pages.read(start, _SECTION.size))
    out.align()
    moved_to = out.tell()
    if kind == _BLOB:
        _copy(pages, start, start + length, out)
        return out.physical(moved_to)

    def relocated(physical: int) -> int:
        return out.physical(layout.logical(physical) - start + moved_to) if physical else 0

    out.write(_SECTION.pack(kind, length, relocated(data), relocated(index)))
    first, stop = layout.logical(data), start + length
    _copy(pages, start + _SECTION.size, first, out)
    at = first
    while at < stop:
        batch = bytearray(pages.read(at, min(_BATCH_BYTES, stop - at)))
        used = 0
        while used + 4 <= len(batch):
            size = struct.unpack_from("<H", batch, used + 2)[0] + 1
            if used + size > len(batch):
                break
            if batch[used] == _INDEX_PACKET:
                for entry in range(struct.unpack_from("<H", batch, used + 4)[0]):
                    where = used + _INDEX_HEAD + entry * _ENTRY + 8
                    there = struct.unpack_from("<Q", batch, where)[0]
                    struct.pack_into("<Q", batch, where, relocated(there))
            used += size
        if not used:
            msg = f"{pages.name}: a packet of a scan runs past its section. Export it again."
            raise FormatError(msg)
        out.write(bytes(batch[:used]))
        at += used
    return out.physical(moved_to)


def _copy(pages: Pages, start: int, stop: int, out: Appender) -> None:
    for at in range(start, stop, _BATCH_BYTES):
        out.write(pages.read(at, min(_BATCH_BYTES, stop - at)))
