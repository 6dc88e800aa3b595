"""Write the records of a scan as a section of an E57 file: packets of bit-packed fields.

Each packet holds a multiple of eight records of every field, so that no field is cut inside a
byte, and its size is known beforehand. Source: ASTM E2807-11, sections 9.2 to 9.7.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.formats.e57_container import (
    DATA_PACKET,
    INDEX_PACKET,
    SECTION,
    TABLE,
    Appender,
)
from dougong.formats.e57_fields import FieldSpec

_INDEX_PACKET = struct.Struct("<BBHHB9xQQ")
_MOST_PACKET = 65_536
_PACKETS_AT_ONCE = 64


class _Plan:
    """How many records go into a packet, and where each field lies in it."""

    def __init__(self, specs: list[FieldSpec], count: int) -> None:
        self.head = 6 + 2 * len(specs)
        self.bits = [spec.bits for spec in specs]
        room = (_MOST_PACKET - self.head - 4 - len(specs)) * 8
        per_record = max(1, sum(self.bits))
        self.records = min(max(8, room // per_record // 8 * 8), 65_528)
        self.whole, self.rest = divmod(count, self.records)

    def lengths(self, records: int) -> list[int]:
        """Return the bytes of each field in a packet of so many records."""
        return [-(-records * bits // 8) for bits in self.bits]

    def packet_bytes(self, records: int) -> int:
        """Return the size of a packet, which is a multiple of four."""
        return -(-(self.head + sum(self.lengths(records))) // 4) * 4

    def head_bytes(self, records: int) -> bytes:
        """Return what stands before the fields of a packet."""
        lengths = self.lengths(records)
        return struct.pack(
            f"<BBHH{len(lengths)}H",
            DATA_PACKET, 0, self.packet_bytes(records) - 1, len(lengths), *lengths,
        )  # fmt: skip

    @property
    def data_bytes(self) -> int:
        """Size of all packets."""
        last = self.packet_bytes(self.rest) if self.rest else 0
        return self.whole * self.packet_bytes(self.records) + last


def write_section(
    out: Appender,
    fields: Mapping[str, tuple[FieldSpec, NDArray[Any]]],
    seen: Callable[[Any], None],
) -> int:
    """Append the records of a scan; return the physical position of their section.

    Parameters
    ----------
    fields : mapping
        Field name to its type and values (n,), in the order of the prototype.
    seen : callable
        Gets the bytes of every field, block by block.
    """
    out.align()
    start = out.tell()
    count = len(next(iter(fields.values()))[1])
    plan = _Plan([spec for spec, _ in fields.values()], count)
    data = start + SECTION.size
    index = data + plan.data_bytes
    length = index + _INDEX_PACKET.size - start
    out.write(SECTION.pack(TABLE, length, out.physical(data), out.physical(index)))
    block = plan.records * _PACKETS_AT_ONCE
    for first in range(0, count, block):
        stop = min(first + block, count)
        streams = [
            spec.packed(spec.raw(values[first:stop], name))
            for name, (spec, values) in fields.items()
        ]
        for stream in streams:
            seen(stream)
        _write_packets(out, plan, streams, stop - first)
    out.write(
        _INDEX_PACKET.pack(INDEX_PACKET, 0, _INDEX_PACKET.size - 1, 1, 0, 0, out.physical(data))
    )
    return out.physical(start)


def _write_packets(
    out: Appender, plan: _Plan, streams: list[NDArray[np.uint8]], count: int
) -> None:
    """Write the packets of one block: whole ones side by side as rows, then a shorter one."""
    whole, rest = divmod(count, plan.records)
    done = [0] * len(streams)
    for rows, records in ((whole, plan.records), (1 if rest else 0, rest)):
        if not rows:
            continue
        packets = np.zeros((rows, plan.packet_bytes(records)), dtype=np.uint8)
        packets[:, : plan.head] = np.frombuffer(plan.head_bytes(records), dtype=np.uint8)
        at = plan.head
        for k, (stream, size) in enumerate(zip(streams, plan.lengths(records), strict=True)):
            piece = stream[done[k] : done[k] + rows * size]
            packets[:, at : at + size] = piece.reshape(rows, size)
            done[k] += rows * size
            at += size
        out.write(packets.reshape(-1))
