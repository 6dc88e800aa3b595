"""Write COPC 1.0: a LAZ file whose chunks are the nodes of an octree.

Source: copc.io specification 1.0. Points are sorted along a Morton curve; each level of the
octree shows about one point per cell of a 128-cube of its node, the leaves hold the rest.
Memory: the records, 24 bytes per point, and one batch of nodes.
"""

import struct
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Records, chosen_rows
from dougong.formats.atomic import Sink
from dougong.formats.las_header import POINT_FORMATS, LasHeader, Vlr
from dougong.formats.las_write import Totals, as_bytes, head_bytes, write_evlrs
from dougong.threads import for_blocks

_GRID_BITS = 7
_LEAF_CAPACITY = 65_536
_NODES_AT_ONCE = 64
_INFO_BYTES = 160
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class _Cube:
    low: NDArray[np.int64]
    """(3,) integer coordinates of the low corner."""
    edge: float
    """File units."""


@dataclass(frozen=True, slots=True)
class _Nodes:
    order: NDArray[np.int64]
    """(n,) points, node after node."""
    starts: NDArray[np.int64]
    """(nodes + 1,) where each node begins in `order`."""
    level: NDArray[np.int8]
    key: NDArray[np.uint64]
    """(nodes,) Morton code at the node's level."""


def _cube_of(totals: Totals, header: LasHeader) -> _Cube:
    """Return the octree's cube, its low corner on the header's minimum as readers expect."""
    span = (totals.high - totals.low) * header.scale
    return _Cube(low=totals.low, edge=max(float(span.max()), float(header.scale.max())))


def _nodes_of(records: Records, header: LasHeader, cube: _Cube) -> _Nodes:
    from dougong.kernels.copc_levels import LEVELS, cube_codes, pick_level

    codes = np.empty(len(records), dtype=np.uint64)
    x, y, z = (np.ascontiguousarray(records[name]) for name in "XYZ")
    cells = header.scale * (2.0**LEVELS / cube.edge)
    for_blocks(len(codes), _BLOCK, lambda a, b: cube_codes(x, y, z, cube.low, cells, a, b, codes))
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    level = np.zeros(len(codes), dtype=np.int8)
    left = np.arange(len(codes))
    deepest = LEVELS - _GRID_BITS
    for depth in range(deepest + 1):
        remaining = codes[left]
        is_taken = np.zeros(len(left), dtype=np.bool_)
        node_shift = np.uint64(3 * (LEVELS - depth))
        cell_shift = np.uint64(3 * (deepest - depth))
        pick_level(remaining, node_shift, cell_shift, _LEAF_CAPACITY, depth == deepest, is_taken)
        level[left[is_taken]] = depth
        left = left[~is_taken]
        if not len(left):
            break
    key = codes >> (np.uint64(3) * (LEVELS - level).astype(np.uint64))
    by_level = np.argsort(level, kind="stable")
    level, key = level[by_level], key[by_level]
    is_start = np.ones(len(level), dtype=bool)
    is_start[1:] = (level[1:] != level[:-1]) | (key[1:] != key[:-1])
    starts = np.flatnonzero(is_start)
    return _Nodes(order[by_level], np.append(starts, len(level)), level[starts], key[starts])


def _coordinates_of(key: int) -> tuple[int, int, int]:
    """Return the x, y, z of a node from its Morton code."""
    found = [0, 0, 0]
    for bit in range(key.bit_length()):
        found[bit % 3] |= ((key >> bit) & 1) << (bit // 3)
    return found[0], found[1], found[2]


def _hierarchy(nodes: _Nodes, sizes: list[tuple[int, int]], first: int) -> bytes:
    """Return the hierarchy page: every node, and an empty entry for each missing ancestor."""
    entries, position = [], first
    present: set[tuple[int, int, int, int]] = set()
    for level, key, (count, size) in zip(nodes.level, nodes.key, sizes, strict=True):
        node = (int(level), *_coordinates_of(int(key)))
        present.add(node)
        entries.append(struct.pack("<4iQii", *node, position, size, count))
        position += size
    for level, x, y, z in list(present):
        for up in range(1, level + 1):
            ancestor = (level - up, x >> up, y >> up, z >> up)
            if ancestor in present:
                break
            present.add(ancestor)
            entries.append(struct.pack("<4iQii", *ancestor, 0, 0, 0))
    return b"".join(entries)


def _info(header: LasHeader, cube: _Cube, records: Records, page: tuple[int, int]) -> bytes:
    half = cube.edge / 2
    center = cube.low * header.scale + header.offset + half
    times = records["gps_time"]
    finite = times[np.isfinite(times)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    return struct.pack(
        "<5d2Q2d88x", *center, half, cube.edge / 2**_GRID_BITS, page[0], page[1], low, high
    )


def write_copc(sink: Sink, header: LasHeader, records: Records) -> int:
    """Write all of `records` as COPC and return how many there are.

    Parameters
    ----------
    header : LasHeader
        LAS 1.4, point format 6, 7 or 8.
    records : ndarray, shape (n,)
        At least one, laid out as the header says.
    """
    import lazrs

    totals = Totals()
    totals.add(records, header.point_format)
    cube = _cube_of(totals, header)
    nodes = _nodes_of(records, header, cube)
    extra = header.point_bytes - np.dtype(POINT_FORMATS[header.point_format]).itemsize
    laszip = lazrs.LazVlr.new_for_compression(header.point_format, extra, True)
    header = _prepared(header, bytes(laszip.record_data()))
    header, head = head_bytes(totals.into(header), is_compressed=True)
    sink.write(head)
    sizes = _write_nodes(sink, records, nodes, laszip, len(head))
    page_start = _end(sink) + 60  # behind the head of the hierarchy's own record
    page = _hierarchy(nodes, sizes, len(head) + 8)
    header = replace(header, evlrs=(Vlr(b"copc", 1000, page), *header.evlrs))
    header = write_evlrs(sink, header)
    sink.seek(0)
    sink.write(header.raw)
    sink.seek(len(header.raw) + 54)
    sink.write(_info(header, cube, records, (page_start, len(page))))
    sink.flush()
    return totals.count


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


def _write_nodes(
    sink: Sink, records: Records, nodes: _Nodes, laszip: Any, points_start: int
) -> list[tuple[int, int]]:
    """Compress each node as a chunk of its own; return (points, bytes) of each."""
    import lazrs

    encoder = lazrs.ParLasZipCompressor(sink, laszip)
    encoder.reserve_offset_to_chunk_table()
    count = len(nodes.level)
    for first in range(0, count, _NODES_AT_ONCE):
        places = [
            nodes.order[nodes.starts[i] : nodes.starts[i + 1]]
            for i in range(first, min(first + _NODES_AT_ONCE, count))
        ]
        encoder.compress_chunks([as_bytes(chosen_rows(records, place)) for place in places])
    encoder.done()
    sink.flush()
    sink.seek(points_start)
    sizes: list[tuple[int, int]] = lazrs.read_chunk_table(sink, laszip)
    return sizes
