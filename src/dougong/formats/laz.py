"""Unpack LAZ points through lazrs, and count what is left of a damaged file."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dougong.errors import FormatError
from dougong.formats.las_header import LasHeader

LASZIP = (b"laszip encoded", 22204)
_STEP = 10_000


class _WithTable(io.RawIOBase):
    """A LAZ file seen with an empty chunk table behind its last byte.

    The table's place is written before the points; a truncated file has none there, and decoders
    then refuse the points that are whole. The table itself is only needed to skip ahead.
    """

    def __init__(self, file: IO[bytes], points_start: int, laszip: Any) -> None:
        import lazrs

        table = io.BytesIO()
        lazrs.write_chunk_table(table, [], laszip)
        self._file = file
        self._size = file.seek(0, 2)
        self._patches = (
            (points_start, struct.pack("<q", self._size)),
            (self._size, table.getvalue()),
        )
        self._at = points_start

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, position: int, whence: int = 0) -> int:
        end = self._size + len(self._patches[1][1])
        self._at = position + (0, self._at, end)[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        wanted = len(buffer)
        self._file.seek(min(self._at, self._size))
        data = bytearray(self._file.read(wanted))
        if len(data) < wanted and self._at + len(data) >= self._size:
            table = self._patches[1][1]
            skip = self._at + len(data) - self._size
            data += table[skip : skip + wanted - len(data)]
        place, patch = self._patches[0]
        for k, byte in enumerate(patch):
            if 0 <= place + k - self._at < len(data):
                data[place + k - self._at] = byte
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def _laszip_of(header: LasHeader, path: Path) -> bytes:
    found = next((vlr.data for vlr in header.vlrs if vlr.key == LASZIP), None)
    if found is None:
        msg = f"{path.name} is compressed but has no laszip record. Export it again."
        raise FormatError(msg)
    return found


class Undecodable(Exception):
    """lazrs cannot go on with these bytes."""


@contextmanager
def _lazrs_errors() -> Iterator[None]:
    """Turn whatever lazrs raises over damaged bytes into `Undecodable`.

    Its Rust code panics over some, which arrives as a BaseException of a class without a module.
    """
    import lazrs

    try:
        yield
    except (lazrs.LazrsError, OSError, ValueError) as error:
        raise Undecodable from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise Undecodable from error


def decode(decoder: Any, buffer: bytearray | NDArray[np.uint8]) -> None:
    """Fill `buffer` with the next points, or raise Undecodable."""
    with _lazrs_errors():
        decoder.decompress_many(buffer)


def open_decoder(file: IO[bytes], header: LasHeader, path: Path) -> Any:
    """Return a decoder at the first point; one without the chunk table where that is missing."""
    import lazrs

    laszip = _laszip_of(header, path)
    file.seek(header.points_start)
    try:
        with _lazrs_errors():
            return lazrs.ParLasZipDecompressor(file, laszip)
    except Undecodable:
        decoder = _sequential(file, header, laszip)
    if decoder is None:
        raise damaged(path, header, 0)
    return decoder


def _sequential(file: IO[bytes], header: LasHeader, laszip: bytes) -> Any:
    """Return a decoder that goes point by point, None where even that is impossible."""
    import lazrs

    file.seek(header.points_start)
    try:
        with _lazrs_errors():
            return lazrs.LasZipDecompressor(file, laszip)
    except Undecodable:
        pass
    try:
        with _lazrs_errors():
            vlr = lazrs.LazVlr(laszip)
            if vlr.uses_variable_size_chunks():
                return None  # only the table knows where one chunk ends (COPC)
            return lazrs.LasZipDecompressor(_WithTable(file, header.points_start, vlr), laszip)
    except Undecodable:
        return None


def packed_points(path: Path, header: LasHeader) -> int:
    """Return how many points the chunk table holds at least; 0 where there is no table.

    Chunks of one size are told by their number alone, so the last may hold a single point.
    """
    import lazrs

    laszip = lazrs.LazVlr(_laszip_of(header, path))
    try:
        with path.open("rb") as file, _lazrs_errors():
            file.seek(header.points_start)
            table = lazrs.read_chunk_table(file, laszip)
    except Undecodable:
        return 0
    counts = [points for points, _ in table]
    if counts and not laszip.uses_variable_size_chunks():
        counts[-1] = 1
    return sum(counts)


def readable_points(path: Path, header: LasHeader) -> int:
    """Return about how many points can be unpacked before a LAZ file breaks."""
    with path.open("rb") as file:
        decoder = _sequential(file, header, _laszip_of(header, path))
        done = 0
        try:
            while decoder is not None and done < header.count:
                count = min(_STEP, header.count - done)
                decode(decoder, bytearray(count * header.point_bytes))
                done += count
        except Undecodable:
            return done
    return done


def damaged(path: Path, header: LasHeader, found: int, *, about: bool = True) -> FormatError:
    """Return the error that says how many points are promised and how many there are."""
    return FormatError(
        f"{path.name}: header says {header.count:,} points, file ends after "
        f"{'about ' if about else ''}{found:,} or is damaged there. Copy it again."
    )
