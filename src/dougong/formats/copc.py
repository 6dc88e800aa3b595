"""Write COPC 1.0: a LAZ file whose chunks are the nodes of an octree.

Source: copc.io specification 1.0. Points come in pieces and are held while they are few; more are
kept on disk and worked on node by node (`copc_parts`). The file is the same either way.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Records, chosen_rows
from dougong.formats.atomic import Sink
from dougong.formats.copc_nodes import (
    GRID_BITS,
    LEAF_CAPACITY,
    Cube,
    Nodes,
    codes_of,
    cube_of,
    nodes_of,
)
from dougong.formats.copc_parts import RecordFile, cut
from dougong.formats.las_header import POINT_FORMATS, LasHeader, Vlr
from dougong.formats.las_write import Totals, as_bytes, head_bytes, write_evlrs

HELD_POINTS = 20_000_000
"""Points that are held before they go to disk, where no other number is given."""
_NODES_AT_ONCE = 64
_INFO_BYTES = 160


@dataclass(frozen=True, slots=True)
class _Chunk:
    """One node as it lies, compressed, in a file."""

    level: int
    key: int
    points: int
    bytes: int
    place: int


class CopcWriter:
    """Write records piece by piece; the file is made by `close`.

    Memory: about 100 bytes for each of `most_points`, however many points are written.

    Parameters
    ----------
    sink : Sink
    header : LasHeader
        LAS 1.4, point format 6, 7 or 8.
    scratch : Path
        A folder of its own; made where there are more than `most_points`, and gets twice the
        records. Whoever named it removes it.
    most_points : int
        Points that are held at once, at least `LEAF_CAPACITY`.
    """

    def __init__(
        self, sink: Sink, header: LasHeader, *, scratch: Path, most_points: int = HELD_POINTS
    ) -> None:
        self._sink = sink
        self._header = header
        self._scratch = scratch
        self._most = max(most_points, LEAF_CAPACITY)
        self._totals = Totals()
        self._times = [np.inf, -np.inf]
        self._held: list[Records] = []
        self._file: RecordFile | None = None

    def append(self, records: Records) -> None:
        """Take `records`, laid out as the header says."""
        if not len(records):
            return
        self._totals.add(records, self._header.point_format)
        times = records["gps_time"][np.isfinite(records["gps_time"])]
        if len(times):
            self._times[0] = min(self._times[0], float(times.min()))
            self._times[1] = max(self._times[1], float(times.max()))
        if self._file is None and self._totals.count > self._most:
            self._scratch.mkdir()
            self._file = RecordFile(self._scratch / "points", records.dtype)
            for piece in self._held:
                self._file.append(piece)
            self._held.clear()
        if self._file is None:
            self._held.append(records)
        else:
            self._file.append(records)

    def close(self) -> int:
        """Write the file and return how many points it holds, at least one."""
        import lazrs

        header = self._header
        extra = header.point_bytes - np.dtype(POINT_FORMATS[header.point_format]).itemsize
        laszip = lazrs.LazVlr.new_for_compression(header.point_format, extra, True)
        header = _prepared(header, bytes(laszip.record_data()))
        header, head = head_bytes(self._totals.into(header), is_compressed=True)
        self._sink.write(head)
        cube = cube_of(self._totals, header)
        if self._file is None:
            records = self._held[0] if len(self._held) == 1 else np.concatenate(self._held)
            self._held.clear()
            nodes = nodes_of(records, codes_of(records, header, cube))
            chunks = _compressed(self._sink, laszip, len(head), _ordered(records, nodes))
        else:
            chunks = self._written_in_parts(header, cube, laszip, len(head))
        self._finish(header, cube, chunks, len(head) + 8)
        return self._totals.count

    def _written_in_parts(
        self, header: LasHeader, cube: Cube, laszip: Any, start: int
    ) -> list[_Chunk]:
        """Compress part by part into a file of its own, then copy the nodes in their order."""
        assert self._file is not None
        with (self._scratch / "packed").open("w+b") as file:
            nodes = _nodes_in_parts(self._file, header, cube, self._most, self._scratch)
            chunks = _compressed(Sink(file), laszip, 0, nodes)
            chunks.sort(key=lambda chunk: (chunk.level, chunk.key))
            return _copied(file, self._sink, laszip, start, chunks)

    def _finish(self, header: LasHeader, cube: Cube, chunks: list[_Chunk], first: int) -> None:
        sink = self._sink
        page_start = _end(sink) + 60  # behind the head of the hierarchy's own record
        page = _hierarchy(chunks, first)
        header = replace(header, evlrs=(Vlr(b"copc", 1000, page), *header.evlrs))
        header = write_evlrs(sink, header)
        sink.seek(0)
        sink.write(header.raw)
        sink.seek(len(header.raw) + 54)
        low, high = self._times if self._times[0] <= self._times[1] else (0.0, 0.0)
        sink.write(_info(header, cube, (low, high), (page_start, len(page))))
        sink.flush()


def _nodes_in_parts(
    file: RecordFile, header: LasHeader, cube: Cube, most: int, folder: Path
) -> Iterator[tuple[int, int, Records]]:
    """Yield level, key and points of every node: those inside each part, then the larger ones."""
    larger: dict[tuple[int, int], RecordFile] = {}
    for part in cut(file, header, cube, most, folder):
        records = part.file.read()
        part.file.remove()
        nodes = nodes_of(
            records,
            codes_of(records, header, cube),
            part_level=part.level,
            shown_above=part.shown_above,
        )
        for level, key, points in _ordered(records, nodes):
            if level >= part.level:
                yield level, key, points
                continue
            if (level, key) not in larger:
                path = folder / f"above-{level}-{key}"
                larger[level, key] = RecordFile(path, records.dtype)
            # Parts come along the curve, so a node's points stay sorted.
            larger[level, key].append(points)
    for (level, key), points_file in larger.items():
        yield level, key, points_file.read()
        points_file.remove()


def _ordered(records: Records, nodes: Nodes) -> Iterator[tuple[int, int, Records]]:
    """Yield level, key and points of each node."""
    for number in range(len(nodes.level)):
        place = nodes.order[nodes.starts[number] : nodes.starts[number + 1]]
        yield int(nodes.level[number]), int(nodes.key[number]), chosen_rows(records, place)


def _compressed(
    sink: Sink, laszip: Any, start: int, nodes: Iterator[tuple[int, int, Records]]
) -> list[_Chunk]:
    """Compress each node as a chunk of its own from `start` of the sink on."""
    import lazrs

    encoder = lazrs.ParLasZipCompressor(sink, laszip)
    encoder.reserve_offset_to_chunk_table()
    names: list[tuple[int, int]] = []
    batch: list[NDArray[np.uint8]] = []
    for level, key, records in nodes:
        names.append((level, key))
        batch.append(as_bytes(records))
        if len(batch) == _NODES_AT_ONCE:
            encoder.compress_chunks(batch)
            batch = []
    if batch:
        encoder.compress_chunks(batch)
    encoder.done()
    sink.flush()
    sink.seek(start)
    chunks, place = [], start + 8
    for (level, key), (points, size) in zip(
        names, lazrs.read_chunk_table(sink, laszip), strict=True
    ):
        chunks.append(_Chunk(level, key, points, size, place))
        place += size
    return chunks


def _copied(
    file: IO[bytes], sink: Sink, laszip: Any, start: int, chunks: list[_Chunk]
) -> list[_Chunk]:
    """Copy compressed chunks behind `start` of the sink, in the order given, and their table."""
    import lazrs

    sink.write(bytes(8))
    for chunk in chunks:
        file.seek(chunk.place)
        sink.write(file.read(chunk.bytes))
    table = sink.tell()
    lazrs.write_chunk_table(sink, [(chunk.points, chunk.bytes) for chunk in chunks], laszip)
    sink.flush()
    sink.seek(start)
    sink.write(struct.pack("<q", table))
    return chunks


def _coordinates_of(key: int) -> tuple[int, int, int]:
    """Return the x, y, z of a node from its Morton code."""
    found = [0, 0, 0]
    for bit in range(key.bit_length()):
        found[bit % 3] |= ((key >> bit) & 1) << (bit // 3)
    return found[0], found[1], found[2]


def _hierarchy(chunks: list[_Chunk], first: int) -> bytes:
    """Return the hierarchy page: every node, and an empty entry for each missing ancestor."""
    entries, position = [], first
    present: set[tuple[int, int, int, int]] = set()
    for chunk in chunks:
        node = (chunk.level, *_coordinates_of(chunk.key))
        present.add(node)
        entries.append(struct.pack("<4iQii", *node, position, chunk.bytes, chunk.points))
        position += chunk.bytes
    for level, x, y, z in list(present):
        for up in range(1, level + 1):
            ancestor = (level - up, x >> up, y >> up, z >> up)
            if ancestor in present:
                break
            present.add(ancestor)
            entries.append(struct.pack("<4iQii", *ancestor, 0, 0, 0))
    return b"".join(entries)


def _info(
    header: LasHeader, cube: Cube, times: tuple[float, float], page: tuple[int, int]
) -> bytes:
    half = cube.edge / 2
    center = cube.low * header.scale + header.offset + half
    return struct.pack(
        "<5d2Q2d88x", *center, half, cube.edge / 2**GRID_BITS, page[0], page[1], *times
    )


def _prepared(header: LasHeader, laszip: bytes) -> LasHeader:
    """Return the header with COPC's record first, as its readers look for it at byte 375."""
    stale = {b"copc", b"laszip encoded"}
    others = [vlr for vlr in header.vlrs if vlr.key[0] not in stale]
    evlrs = tuple(vlr for vlr in header.evlrs if vlr.key[0] not in stale)
    first = Vlr(b"copc", 1, bytes(_INFO_BYTES))
    second = Vlr(b"laszip encoded", 22204, laszip)
    raw = header.raw[:375]
    header = replace(header, raw=raw, vlrs=(first, second, *others), evlrs=evlrs, padding=b"")
    return header.patched("H", 94, 375)


def _end(sink: Sink) -> int:
    sink.flush()
    return sink.seek(0, 2)
