"""The header of a LAS file, kept as the bytes it was read from.

A header is carried as raw bytes and patched where a number must change, so whatever else it holds
(system identifier, GUID, unknown records, padding) is written again bit for bit.
Source: ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import IO

import numpy as np

from dougong.cloud import BitField
from dougong.errors import FormatError

_COMMON = [
    ("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1"),
]  # fmt: skip
_LEGACY = [
    *_COMMON, ("raw_classification", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1"),
    ("point_source_id", "<u2"),
]  # fmt: skip
_MODERN = [
    *_COMMON, ("classification_flags", "u1"), ("classification", "u1"), ("user_data", "u1"),
    ("scan_angle", "<i2"), ("point_source_id", "<u2"), ("gps_time", "<f8"),
]  # fmt: skip
_TIME = [("gps_time", "<f8")]
_COLOUR = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
_NIR = [("nir", "<u2")]
_WAVE = [
    ("wavepacket_index", "u1"), ("wavepacket_offset", "<u8"), ("wavepacket_size", "<u4"),
    ("return_point_wave_location", "<f4"), ("x_t", "<f4"), ("y_t", "<f4"), ("z_t", "<f4"),
]  # fmt: skip
POINT_FORMATS = {
    0: _LEGACY,
    1: _LEGACY + _TIME,
    2: _LEGACY + _COLOUR,
    3: _LEGACY + _TIME + _COLOUR,
    4: _LEGACY + _TIME + _WAVE,
    5: _LEGACY + _TIME + _COLOUR + _WAVE,
    6: _MODERN,
    7: _MODERN + _COLOUR,
    8: _MODERN + _COLOUR + _NIR,
    9: _MODERN + _WAVE,
    10: _MODERN + _COLOUR + _NIR + _WAVE,
}
_BITS_LEGACY = {
    "return_number": BitField("bit_fields", 0b111),
    "number_of_returns": BitField("bit_fields", 0b111000, 3),
    "scan_direction_flag": BitField("bit_fields", 0b1000000, 6),
    "edge_of_flight_line": BitField("bit_fields", 0b10000000, 7),
    "classification": BitField("raw_classification", 0b11111),
    "synthetic": BitField("raw_classification", 0b100000, 5),
    "key_point": BitField("raw_classification", 0b1000000, 6),
    "withheld": BitField("raw_classification", 0b10000000, 7),
}
_BITS_MODERN = {
    "return_number": BitField("bit_fields", 0b1111),
    "number_of_returns": BitField("bit_fields", 0b11110000, 4),
    "synthetic": BitField("classification_flags", 0b1),
    "key_point": BitField("classification_flags", 0b10, 1),
    "withheld": BitField("classification_flags", 0b100, 2),
    "overlap": BitField("classification_flags", 0b1000, 3),
    "scanner_channel": BitField("classification_flags", 0b110000, 4),
    "scan_direction_flag": BitField("classification_flags", 0b1000000, 6),
    "edge_of_flight_line": BitField("classification_flags", 0b10000000, 7),
}
HEADER_BYTES = {2: 227, 3: 235, 4: 375}
EXTRA_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")
"""Data types 1..10 of an extra dimension; 11-20 and 21-30 are pairs and triples of them."""
EXTRA_BYTES = (b"LASF_Spec", 4)
PROJECTION = b"LASF_Projection"


def bits_of(point_format: int) -> dict[str, BitField]:
    """Return where the packed attributes of a point format sit."""
    return _BITS_MODERN if point_format >= 6 else _BITS_LEGACY


def las_attributes(header: LasHeader) -> set[str]:
    """Return the attributes that every point of the header's format has, used or not."""
    return {name for name, _ in POINT_FORMATS[header.point_format]} | set(
        bits_of(header.point_format)
    )


@dataclass(frozen=True, slots=True)
class Vlr:
    """One variable length record, its texts as the bytes of the file."""

    user_id: bytes
    record_id: int
    data: bytes
    description: bytes = b""
    reserved: bytes = b"\0\0"

    @property
    def key(self) -> tuple[bytes, int]:
        """User id (without padding) and record id: what the record is."""
        return self.user_id.split(b"\0")[0], self.record_id

    def packed(self, *, is_extended: bool = False) -> bytes:
        """Return the record as it stands in a file; extended ones have 8-byte lengths."""
        layout = "<2s16sHQ32s" if is_extended else "<2s16sHH32s"
        size = len(self.data)
        head = struct.pack(
            layout, self.reserved, self.user_id, self.record_id, size, self.description
        )
        return head + self.data


@dataclass(frozen=True)
class LasHeader:
    """A LAS header: its raw bytes, its records, and readings of both.

    The point layout (`dtype`) follows from the raw bytes and the extra-bytes record.
    """

    raw: bytes
    """The public header block, as long as it says it is."""
    vlrs: tuple[Vlr, ...] = ()
    evlrs: tuple[Vlr, ...] = ()
    padding: bytes = b""
    """Bytes between the last record and the first point."""
    source: Path | None = field(default=None, compare=False)

    def _get(self, layout: str, offset: int) -> tuple[float, ...]:
        return struct.unpack_from("<" + layout, self.raw, offset)

    @cached_property
    def minor(self) -> int:
        """LAS version 1.`minor`."""
        return self.raw[25]

    @cached_property
    def point_format(self) -> int:
        """Point format 0-10, without the compression bits."""
        return self.raw[104] & 0x3F

    @cached_property
    def is_compressed(self) -> bool:
        """True for LAZ and COPC."""
        return bool(self.raw[104] & 0x80)

    @cached_property
    def is_copc(self) -> bool:
        """True when the first record is COPC's."""
        return bool(self.vlrs) and self.vlrs[0].key == (b"copc", 1)

    @cached_property
    def point_bytes(self) -> int:
        """Bytes per point, extra bytes included."""
        return int(self._get("H", 105)[0])

    @cached_property
    def points_start(self) -> int:
        """File position of the first point."""
        return int(self._get("I", 96)[0])

    @cached_property
    def count(self) -> int:
        """Points the header promises."""
        return int(self._get("Q", 247)[0] if self.minor >= 4 else self._get("I", 107)[0])

    @cached_property
    def scale(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """(3,) file units per integer step."""
        return np.array(self._get("3d", 131))

    @cached_property
    def offset(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """(3,) file coordinates of integer 0."""
        return np.array(self._get("3d", 155))

    @cached_property
    def extent(self) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """(2, 3) low and high corner as the header claims them, file units."""
        high_low = np.array(self._get("6d", 179)).reshape(3, 2)
        return high_low[:, ::-1].T.copy()

    @cached_property
    def has_box(self) -> bool:
        """True where `extent` can be the box of points at all, right or wrong."""
        low, high = self.extent
        return bool(np.isfinite(self.extent).all() and (low <= high).all())

    @cached_property
    def evlr_place(self) -> tuple[int, int]:
        """File position of the first extended record, and how many there are."""
        if self.minor < 4:
            return 0, 0
        return int(self._get("Q", 235)[0]), int(self._get("I", 243)[0])

    @cached_property
    def waveforms_start(self) -> int:
        """File position of the waveforms behind the points; 0 where the file has none."""
        return int(self._get("Q", 227)[0]) if self.minor >= 3 else 0

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Layout of one point: the standard fields, then the extra dimensions."""
        fields: list[tuple[str, str]] = list(POINT_FORMATS[self.point_format])
        standard = np.dtype(fields).itemsize
        left = self.point_bytes - standard
        taken = {name for name, _ in fields} | set(bits_of(self.point_format))
        for name, layout in self._described_extras():
            size = np.dtype(layout).itemsize
            if size > left:
                break
            unique = name or "extra"
            while unique in taken:
                unique += "_"
            taken.add(unique)
            fields.append((unique, layout))
            left -= size
        if left:
            fields.append(("undescribed_bytes", f"V{left}"))
        return np.dtype(fields)

    def _described_extras(self) -> list[tuple[str, str]]:
        data = b"".join(vlr.data for vlr in self.vlrs if vlr.key == EXTRA_BYTES)
        found = []
        for start in range(0, len(data) - 191, 192):
            kind, options = data[start + 2], data[start + 3]
            name = data[start + 4 : start + 36].split(b"\0")[0].decode("utf-8", "replace")
            if kind == 0:
                found.append((name, f"V{options}"))
            elif kind <= 30:
                count, base = divmod(kind - 1, 10)
                layout = EXTRA_TYPES[base]
                found.append((name, layout if count == 0 else f"({count + 1},){layout}"))
        return found

    def patched(self, layout: str, offset: int, *values: float) -> LasHeader:
        """Return the header with `values` packed into the raw bytes at `offset`."""
        raw = bytearray(self.raw)
        struct.pack_into("<" + layout, raw, offset, *values)
        return replace(self, raw=bytes(raw))

    def with_scaling(self, scale: np.ndarray, offset: np.ndarray) -> LasHeader:
        """Return the header with another scale and offset (3,)."""
        return self.patched("6d", 131, *scale, *offset)


def new_header(point_format: int) -> LasHeader:
    """Return an empty LAS 1.4 header of point format 6, 7 or 8, without a creation date.

    No date: the same cloud gives the same bytes on every day.
    """
    raw = bytearray(375)
    struct.pack_into("<4sHH", raw, 0, b"LASF", 0, 0b10001)
    struct.pack_into("<BB32s32s", raw, 24, 1, 4, b"dougong", b"dougong")
    struct.pack_into("<HHHII", raw, 90, 1, 1970, 375, 375, 0)
    size = np.dtype(POINT_FORMATS[point_format]).itemsize
    struct.pack_into("<BH", raw, 104, point_format, size)
    struct.pack_into("<3d", raw, 131, 1.0, 1.0, 1.0)
    return LasHeader(raw=bytes(raw))


def _take(file: IO[bytes], count: int, name: str, what: str) -> bytes:
    data = file.read(count)
    if len(data) < count:
        msg = f"{name}: the file ends inside its {what}. It is truncated; copy it again."
        raise FormatError(msg)
    return data


def _read_vlrs(file: IO[bytes], count: int, name: str, *, is_extended: bool) -> tuple[Vlr, ...]:
    layout = struct.Struct("<2s16sHQ32s" if is_extended else "<2s16sHH32s")
    found = []
    for _ in range(count):
        head = _take(file, layout.size, name, "records")
        reserved, user_id, record_id, size, description = layout.unpack(head)
        data = _take(file, size, name, "records")
        found.append(Vlr(user_id, record_id, data, description, reserved))
    return tuple(found)


def read_header(file: IO[bytes], path: Path) -> LasHeader:
    """Read the header and every record of an open LAS, LAZ or COPC file.

    Raises
    ------
    FormatError
        Not a LAS file, a version or point format that does not exist, or it ends too early.
    """
    name = path.name
    raw, vlr_count, points_start = _read_fixed(file, name)
    header = LasHeader(raw=raw, source=path)
    if header.point_format not in POINT_FORMATS:
        msg = f"{name} has point format {header.point_format}; 0 to 10 exist. Export it again."
        raise FormatError(msg)
    vlrs = _read_vlrs(file, vlr_count, name, is_extended=False)
    gap = points_start - file.tell()
    if gap < 0:
        msg = f"{name}: its records run {-gap} bytes into its points. Export it again."
        raise FormatError(msg)
    padding = _take(file, gap, name, "header")
    header = replace(header, vlrs=vlrs, padding=padding)
    _refuse_odd_values(header, name)
    start, count = header.evlr_place
    if count:
        size = file.seek(0, 2)
        if start > size:
            msg = (
                f"{name}: header says {header.count:,} points and records at byte {start:,}, file "
                f"ends at {size:,}. It is truncated; copy it again."
            )
            raise FormatError(msg)
        file.seek(start)
        header = replace(header, evlrs=_read_vlrs(file, count, name, is_extended=True))
    return header


def _read_fixed(file: IO[bytes], name: str) -> tuple[bytes, int, int]:
    """Return the header's own bytes, how many records follow it, and where the points begin."""
    head = file.read(227)
    if head[:4] != b"LASF":
        msg = f"{name} is not a LAS or LAZ file: it starts with {head[:4]!r}, expected b'LASF'."
        raise FormatError(msg)
    if len(head) < 227:
        raise FormatError(f"{name}: the file ends inside its header. Copy it again.")
    major, minor = head[24], head[25]
    if major != 1 or minor > 4:
        msg = f"{name} is LAS {major}.{minor}; versions 1.0 to 1.4 can be read. Export it as 1.4."
        raise FormatError(msg)
    header_size, points_start, vlr_count = struct.unpack_from("<HII", head, 94)
    least = HEADER_BYTES.get(minor, 227)
    if header_size < least or points_start < header_size:
        msg = (
            f"{name} has a damaged header: it says {header_size} bytes, points from "
            f"{points_start}; LAS 1.{minor} needs at least {least}. Export it again."
        )
        raise FormatError(msg)
    return head + _take(file, header_size - 227, name, "header"), vlr_count, points_start


def _refuse_odd_values(header: LasHeader, name: str) -> None:
    """Refuse records that are too short, and steps or an offset that are no numbers to use."""
    least = np.dtype(POINT_FORMATS[header.point_format]).itemsize
    if header.point_bytes < least:
        msg = (
            f"{name} says {header.point_bytes} bytes per point; point format "
            f"{header.point_format} needs {least}. Export it again."
        )
        raise FormatError(msg)
    if not (np.isfinite(header.scale).all() and (header.scale > 0).all()):
        msg = f"{name} has scale {header.scale.tolist()}; it must be positive. Export it again."
        raise FormatError(msg)
    if not np.isfinite(header.offset).all():
        msg = f"{name} has offset {header.offset.tolist()}; it must be finite. Export it again."
        raise FormatError(msg)
