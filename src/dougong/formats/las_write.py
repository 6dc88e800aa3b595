"""Write LAS and LAZ from a header and records, in any number of pieces."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Records
from dougong.errors import OutputError
from dougong.formats.atomic import Sink
from dougong.formats.las_header import POINT_FORMATS, LasHeader, Vlr

_PIECE = 1_000_000
_WAVEFORMS = (b"LASF_Spec", 65535)
_STALE = {b"copc", b"laszip encoded"}


class Totals:
    """Count, extent and returns of the points written so far."""

    def __init__(self) -> None:
        self.count = 0
        self.low = np.full(3, 2**31, dtype=np.int64)
        self.high = np.full(3, -(2**31) - 1, dtype=np.int64)
        self.returns: NDArray[np.int64] = np.zeros(16, dtype=np.int64)

    def add(self, records: Records, point_format: int) -> None:
        """Count records in."""
        if not len(records):
            return
        self.count += len(records)
        for axis, name in enumerate("XYZ"):
            self.low[axis] = min(self.low[axis], int(records[name].min()))
            self.high[axis] = max(self.high[axis], int(records[name].max()))
        mask = 0b1111 if point_format >= 6 else 0b111
        self.returns += np.bincount(records["bit_fields"] & mask, minlength=16)

    def into(self, header: LasHeader) -> LasHeader:
        """Return the header with these totals in all the places that hold them."""
        low, high = np.zeros(3), np.zeros(3)
        if self.count:
            low = self.low * header.scale + header.offset
            high = self.high * header.scale + header.offset
        header = header.patched("6d", 179, *np.stack([high, low], axis=1).ravel())
        returns = [int(count) for count in self.returns[1:]]
        is_legacy = header.point_format < 6 and self.count < 2**32
        if header.minor < 4 and not is_legacy:
            msg = f"LAS 1.{header.minor} cannot hold {self.count:,} points. Write to COPC."
            raise OutputError(msg)
        short = [self.count, *returns[:5]] if is_legacy else [0] * 6
        header = header.patched("6I", 107, *short)
        if header.minor >= 4:
            header = header.patched("16Q", 247, self.count, *returns)
        return header


def head_bytes(header: LasHeader, *, is_compressed: bool) -> tuple[LasHeader, bytes]:
    """Return the header patched for its own records, and the bytes up to the first point."""
    body = b"".join(vlr.packed() for vlr in header.vlrs) + header.padding
    start = len(header.raw) + len(body)
    header = header.patched("II", 96, start, len(header.vlrs))
    header = header.patched("B", 104, header.point_format | (0x80 if is_compressed else 0))
    return header, header.raw + body


def write_evlrs(sink: Sink, header: LasHeader) -> LasHeader:
    """Append the extended records and return the header that points to them."""
    if header.minor < 4:
        return header
    sink.seek(0, 2)
    start = sink.tell() if header.evlrs else 0
    for vlr in header.evlrs:
        if vlr.key == _WAVEFORMS:
            header = header.patched("Q", 227, sink.tell())
        sink.write(vlr.packed(is_extended=True))
    return header.patched("QI", 235, start, len(header.evlrs))


def as_bytes(records: Records) -> NDArray[np.uint8]:
    """Return the (n x point bytes,) bytes of packed records."""
    flat: NDArray[np.uint8] = np.ascontiguousarray(records).view(np.uint8).reshape(-1)
    return flat


class LasWriter:
    """Write records piece by piece; the header is completed by `close`.

    The header's scale, offset, records and point layout are final when writing starts.
    """

    def __init__(self, sink: Sink, header: LasHeader, *, is_compressed: bool) -> None:
        import lazrs

        self._sink = sink
        self._totals = Totals()
        vlrs = tuple(vlr for vlr in header.vlrs if vlr.key[0] not in _STALE)
        evlrs = tuple(vlr for vlr in header.evlrs if vlr.key[0] not in _STALE)
        laszip: Any = None
        if is_compressed:
            extra = header.point_bytes - _standard_bytes(header.point_format)
            laszip = lazrs.LazVlr.new_for_compression(header.point_format, extra, False)
            vlrs = (*vlrs, Vlr(b"laszip encoded", 22204, bytes(laszip.record_data())))
        self._header, head = head_bytes(
            replace(header, vlrs=vlrs, evlrs=evlrs), is_compressed=is_compressed
        )
        self._head_size = len(head)
        sink.write(head)
        self._encoder = lazrs.ParLasZipCompressor(sink, laszip) if is_compressed else None

    def append(self, records: Records) -> None:
        """Write `records`, laid out as the header says."""
        if records.dtype.itemsize != self._header.point_bytes:
            msg = (
                f"records have {records.dtype.itemsize} bytes, the header says "
                f"{self._header.point_bytes}. Build both with las_parts."
            )
            raise OutputError(msg)
        for start in range(0, len(records), _PIECE):
            piece = records[start : start + _PIECE]
            self._totals.add(piece, self._header.point_format)
            if self._encoder is None:
                self._sink.write(as_bytes(piece).data)
            else:
                self._encoder.compress_many(as_bytes(piece))

    def close(self) -> int:
        """Finish the file and return how many points it holds."""
        if self._encoder is not None:
            self._encoder.done()
        header = write_evlrs(self._sink, self._totals.into(self._header))
        self._sink.seek(0)
        self._sink.write(header.raw)
        self._sink.flush()
        return self._totals.count


def _standard_bytes(point_format: int) -> int:
    return np.dtype(POINT_FORMATS[point_format]).itemsize
