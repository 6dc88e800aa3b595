"""Scale float coordinates inside the packets of an E57 file, where they lie.

The points of a scan are one section: a header, then packets of at most 64 kB, each with a piece
of the byte stream of every field. A stream is cut anywhere, also inside a number.
Source: ASTM E2807-11, sections 9.2 to 9.5.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.errors import FormatError
from dougong.formats.e57_container import (
    DATA_PACKET,
    TABLE,
    Pages,
    packet_batches,
    read_section,
)

_BATCH_BYTES = 8 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class FloatFields:
    """The float coordinates of one scan and the factor for them."""

    place: int
    """Physical position of the scan's section."""
    records: int
    streams: int
    """Fields of a record, each with a byte stream."""
    chosen: dict[int, str]
    """Number of the stream to its dtype."""
    factor: float


@dataclass(slots=True)
class _Stream:
    """How far the numbers of one field are done."""

    dtype: np.dtype[Any]
    done: int = 0
    tail: bytes = b""
    """The first bytes of a number whose last ones lie in the next batch."""
    tail_places: list[int] = field(default_factory=list)
    """The logical position of each of them."""


def scale_floats(pages: Pages, fields: FloatFields) -> None:
    """Multiply the chosen fields of every record by the factor.

    Raises
    ------
    FormatError
        The section does not hold the packets that it should.
    """
    streams = {number: _Stream(np.dtype(kind)) for number, kind in fields.chosen.items()}
    section = read_section(pages, fields.place)
    if section.kind != TABLE:
        raise _damaged(pages, f"a scan's section is of kind {section.kind}, expected {TABLE}")
    for start, batch, begins in packet_batches(pages, section, _BATCH_BYTES):
        pieces = _pieces(pages, batch, begins, fields)
        for number, stream in streams.items():
            _scale_batch(pages, start, batch, pieces[number], stream, fields.factor)
        pages.write(start, batch)
    short = min(stream.done for stream in streams.values())
    if short < fields.records:
        what = f"the packets of a scan hold {short:,} of its {fields.records:,} points"
        raise _damaged(pages, what)


def _damaged(pages: Pages, what: str) -> FormatError:
    return FormatError(f"{pages.name}: {what}. The input is damaged; export it again.")


def _pieces(
    pages: Pages, batch: bytearray, begins: list[int], fields: FloatFields
) -> dict[int, list[slice]]:
    """Return where the chosen streams lie in the packets of `batch`."""
    found: dict[int, list[slice]] = {number: [] for number in fields.chosen}
    for begin in begins:
        if batch[begin] != DATA_PACKET:
            continue
        count = struct.unpack_from("<H", batch, begin + 4)[0]
        if count != fields.streams:
            what = f"a packet holds {count} fields, its scan has {fields.streams}"
            raise _damaged(pages, what)
        place = begin + 6 + 2 * count
        for number, length in enumerate(struct.unpack_from(f"<{count}H", batch, begin + 6)):
            if number in found:
                found[number].append(slice(place, place + length))
            place += length
    return found


def _scale_batch(
    pages: Pages,
    start: int,
    batch: bytearray,
    pieces: list[slice],
    stream: _Stream,
    factor: float,
) -> None:
    """Scale one field's numbers in a batch; a number begun in the batch before is finished."""
    data = stream.tail + b"".join(bytes(batch[piece]) for piece in pieces)
    before = len(stream.tail)
    size = stream.dtype.itemsize
    whole = len(data) // size * size
    values: NDArray[Any] = np.frombuffer(data[:whole], dtype=stream.dtype) * factor
    scaled = values.astype(stream.dtype).tobytes() + data[whole:]
    stream.done += whole // size
    if whole and before:
        for place, byte in zip(stream.tail_places, scaled[:before], strict=True):
            pages.write(place, bytes([byte]))
        stream.tail_places = []
    at = before
    for piece in pieces:
        length = piece.stop - piece.start
        batch[piece] = scaled[at : at + length]
        at += length
    rest = len(data) - whole
    stream.tail = data[whole:]
    if rest:
        stream.tail_places = _last_places(pieces, rest, start, stream.tail_places)


def _last_places(pieces: list[slice], count: int, start: int, earlier: list[int]) -> list[int]:
    """Return the logical positions of the last `count` bytes of a stream."""
    found: list[int] = []
    for piece in reversed(pieces):
        for place in range(piece.stop - 1, piece.start - 1, -1):
            if len(found) == count:
                break
            found.append(start + place)
    found.reverse()
    return [*earlier, *found][-count:]
