"""Write a cloud as binary PLY: the vertices of a PLY file bit for bit, others converted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dougong.cloud import Cloud, Pieces, Records
from dougong.errors import InputError
from dougong.formats.atomic import Sink
from dougong.formats.las_fields import (
    EIGHT_BIT,
    columns_of,
    coordinate_fields,
    eight_bit_factors,
    shrunk_colours,
)
from dougong.formats.las_header import LasHeader
from dougong.formats.ply import CRS_COMMENT, PlyHeader, has_crs
from dougong.formats.units import las_wkt

_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
    "f4": "float", "f8": "double",
}  # fmt: skip
_ENCODINGS = {"<": "binary_little_endian", ">": "binary_big_endian"}
_PIECE = 1_000_000


@dataclass(frozen=True, slots=True)
class Whole:
    """What is known of a whole cloud while it is written in pieces, so that all come out alike."""

    points: int
    factors: set[int]
    """Of 16-bit colours, see `eight_bit_factors`."""


def whole_of(pieces: Pieces) -> tuple[Whole, Cloud]:
    """Pass over a cloud once; return what is known of it, and a piece with a point if one has."""
    points, factors = 0, set(EIGHT_BIT)
    sample: Cloud | None = None
    for piece in pieces():
        points += len(piece)
        if isinstance(piece.header, LasHeader):
            factors &= eight_bit_factors(columns_of(piece))
        if sample is None or not len(sample):
            sample = piece.select(np.arange(min(1, len(piece))))
    if sample is None:
        raise InputError("a cloud in pieces needs at least one piece, got none.")
    return Whole(points, factors), sample


def ply_parts(cloud: Cloud, whole: Whole) -> tuple[bytes, Records, list[str]]:
    """Return the header of the whole, and vertices and notes that hold a piece of it as PLY."""
    notes: list[str] = []
    comments: list[str] = []
    order = "<"
    if isinstance(cloud.header, PlyHeader):
        header = cloud.header
        order = ">" if header.encoding == "binary_big_endian" else "<"
        comments = list(header.comments)
        if header.encoding == "ascii":
            notes.append("written as binary PLY; the input was ASCII.")
        notes += [
            f"{number} {name} elements of the input are not written (they point at vertices)."
            for name, number in header.elements
            if number
        ]
    if isinstance(cloud.header, PlyHeader) and not cloud.is_moved:
        records = cloud.records
    else:
        records = _converted(cloud, notes, whole)
    records = _storable(records, order, notes)
    if not has_crs(cloud.header, cloud.frame.crs):
        comments = [line for line in comments if not line.lower().startswith("comment crs")]
        if cloud.frame.crs is not None:
            comments.append(f"comment {CRS_COMMENT}{_ascii_crs(cloud.frame.crs)}")
    lines = ["ply", f"format {_ENCODINGS[order]} 1.0", *comments, f"element vertex {whole.points}"]
    for name in records.dtype.names or ():
        kind = records.dtype[name]
        lines.append(f"property {_NAMES[kind.str.lstrip('<>|=')]} {name}")
    return "\n".join([*lines, "end_header", ""]).encode(), records, notes


def _ascii_crs(crs: str) -> str:
    """Return a reference system as one line of WKT 1 in ASCII, which is all that PLY allows.

    Letters beyond ASCII stand in names only, and names do not say which system it is.
    """
    return " ".join(las_wkt(crs).split()).encode("ascii", "replace").decode("ascii")


def _converted(cloud: Cloud, notes: list[str], whole: Whole) -> Records:
    """Return records with double x, y, z in front and every attribute unpacked behind them."""
    coordinates = cloud.frame.to_file(cloud.xyz)
    dropped = coordinate_fields(cloud)
    layout: list[tuple[str, object]] = [(axis, "<f8") for axis in "xyz"]
    columns = {n: v for n, v in columns_of(cloud).items() if n not in dropped}
    if isinstance(cloud.header, LasHeader):
        columns = shrunk_colours(columns, notes, whole.factors)
    for name, values in columns.items():
        layout.append(
            (name, values.dtype if values.ndim == 1 else (values.dtype, values.shape[1:]))
        )
    records = np.empty(len(cloud), dtype=np.dtype(layout))
    for index, axis in enumerate("xyz"):
        records[axis] = coordinates[:, index]
    for name, values in columns.items():
        records[name] = values
    if not isinstance(cloud.header, PlyHeader):
        notes.append("coordinates are written as doubles, as PLY has no scaled integers.")
    return records


def _storable(records: Records, order: str, notes: list[str]) -> Records:
    """Return records of types and names PLY has, in one byte order; as they are when they are."""
    keys, types, columns = [], [], []
    for name in records.dtype.names or ():
        values = records[name]
        parts = {name: values}
        if values.ndim == 2:
            parts = {f"{name}_{k}": values[:, k] for k in range(values.shape[1])}
        for key, column in parts.items():
            kind = column.dtype
            if kind == np.bool_:
                target = "u1"
            elif kind.kind == "f" and kind.itemsize == 2:
                target = "f4"
            elif kind.kind in "iu" and kind.itemsize == 8:
                target = "f8"
                if len(column) and np.abs(column.astype(np.float64)).max() >= 2**53:
                    notes.append(f"{key} has 64-bit integers, which PLY does not: rounded.")
            elif kind.str.lstrip("<>|=") in _NAMES:
                target = kind.str.lstrip("<>|=")
            else:
                notes.append(f"{key} has type {kind}, which PLY does not have: left out.")
                continue
            keys.append(key)
            types.append(target if target in ("i1", "u1") else order + target)
            columns.append(column)
    layout = list(zip(_safe_names(keys, notes), types, strict=True))
    dtype = np.dtype(layout)
    if dtype == records.dtype:
        return records
    stored = np.empty(len(records), dtype=dtype)
    for (name, _), column in zip(layout, columns, strict=True):
        stored[name] = column
    return stored


def _safe_names(keys: Sequence[str], notes: list[str]) -> list[str]:
    """Return names without blanks, each there once; those that are so already stay."""
    taken = {key for key in keys if key.split() == [key]}
    names: list[str] = []
    for key in keys:
        safe = "_".join(key.split()) or "field"
        name, number = safe, 2
        while name in names or (name in taken and name != key):
            name, number = f"{safe}_{number}", number + 1
        if name != key:
            notes.append(
                f"{key!r} is named {name}: PLY names have no blanks, and each is there once."
            )
        names.append(name)
    return names


def write_vertices(sink: Sink, records: Records) -> None:
    """Write vertices behind those that are there."""
    for start in range(0, len(records), _PIECE):
        sink.write(np.ascontiguousarray(records[start : start + _PIECE]).view(np.uint8).data)
