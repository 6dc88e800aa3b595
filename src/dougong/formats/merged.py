"""Write several clouds of one frame as one LAS, LAZ or COPC file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud, Records
from dougong.errors import FrameError, InputError, OutputError
from dougong.formats.atomic import refuse_bad_target
from dougong.formats.las_header import POINT_FORMATS, LasHeader, Vlr, new_header
from dougong.formats.las_records import (
    describe_extras,
    descriptions_of,
    extra_type,
    las_parts,
    scaling_for,
    set_integers,
    upgraded,
    with_crs,
)
from dougong.formats.model import Written
from dougong.formats.registry import family_of, write_las_parts
from dougong.formats.units import is_same_crs

_HISTORY = {b"LASF_Projection", b"LASF_Spec", b"copc", b"laszip encoded"}


def write_merged(
    clouds: Sequence[Cloud],
    path: Path | str,
    *,
    source_ids: Sequence[int],
    overwrite: bool = False,
) -> Written:
    """Write clouds that share a reference system as one file of point format 6, 7 or 8.

    Every attribute of every cloud is kept, 0 where a cloud has none; the extra dimension
    `source_id` tells the clouds apart. Each axis has the finest step of all clouds. Memory: the
    records of all clouds once more.

    Parameters
    ----------
    clouds : sequence of Cloud
        At least one; empty ones are passed over.
    source_ids : sequence of int
        One per cloud, 0..65535; `source_id` is uint8 where all are below 256, else uint16.

    Raises
    ------
    FrameError
        The clouds have different reference systems or units.
    OutputError
        As `write`.
    """
    path = Path(path)
    family = family_of(path)
    if family in (".ply", ".e57"):
        raise OutputError(f"{path.name}: merged clouds are written as .las, .laz or .copc.laz.")
    if len(source_ids) != len(clouds) or not clouds:
        msg = f"write_merged needs one source id per cloud, got {len(source_ids)}, {len(clouds)}."
        raise InputError(msg)
    if min(source_ids) < 0 or max(source_ids) > 65535:
        raise InputError(f"source ids must lie in 0..65535, got {list(source_ids)}.")
    for cloud in clouds:
        refuse_bad_target(path, overwrite=overwrite, source=getattr(cloud.header, "source", None))
    _refuse_mixed_frames(clouds)
    filled = [(cloud, ident) for cloud, ident in zip(clouds, source_ids, strict=True) if len(cloud)]
    if not filled:
        raise OutputError(f"no cloud has a point left, so {path.name} was not written.")
    notes: list[str] = []
    header, records = _joined(filled, notes)
    write_las_parts(path, family, header, records)
    return Written(
        path=path, points=len(records), bytes=path.stat().st_size, notes=tuple(dict.fromkeys(notes))
    )


def _refuse_mixed_frames(clouds: Sequence[Cloud]) -> None:
    first = clouds[0]
    for other in clouds[1:]:
        if not is_same_crs(other.frame.crs, first.frame.crs) or not np.allclose(
            other.frame.unit_m, first.frame.unit_m, rtol=1e-12
        ):
            msg = (
                f"{other.name} and {first.name} are in different reference systems or units. "
                "Move them into one frame before merging."
            )
            raise FrameError(msg)


def _joined(filled: Sequence[tuple[Cloud, int]], notes: list[str]) -> tuple[LasHeader, Records]:
    parts = []
    for cloud, ident in filled:
        header, records, said = las_parts(cloud, modern=True)
        if header.point_format not in (6, 7, 8):
            header, records = upgraded(header, records, said)
        notes += [f"{cloud.name}: {note}" for note in said]
        parts.append((header, records, ident))
    point_format = max(header.point_format for header, _, _ in parts)
    scale = np.min([header.scale for header, _, _ in parts], axis=0)
    bounds = np.concatenate([_corners(header, records) for header, records, _ in parts])
    scale, offset = scaling_for(bounds, scale, "the merged cloud")
    if all(np.array_equal(part[0].offset, parts[0][0].offset) for part in parts):
        offset = _kept_offset(parts[0][0].offset, bounds, scale, offset)
    wide = max(ident for _, _, ident in parts) > 255
    extras = _union([records.dtype for _, records, _ in parts], notes)
    extras["source_id"] = np.dtype("<u2" if wide else "u1")
    known = _descriptions([header for header, _, _ in parts], extras, notes)
    header = describe_extras(_base(parts[0][0], point_format), extras, known)
    header = with_crs(header, filled[0][0].frame.crs, notes).with_scaling(scale, offset)
    merged = np.zeros(sum(len(records) for _, records, _ in parts), dtype=header.dtype)
    at = 0
    while parts:
        own, records, ident = parts.pop(0)
        _fill(merged[at : at + len(records)], own, records, header)
        merged["source_id"][at : at + len(records)] = ident
        at += len(records)
    return header, merged


def _base(first: LasHeader, point_format: int) -> LasHeader:
    """Return a fresh header that carries on the first cloud's foreign records."""
    header = new_header(point_format)
    kept: tuple[Vlr, ...] = tuple(vlr for vlr in first.vlrs if vlr.key[0] not in _HISTORY)
    # The kind of GPS time (week or standard) is one flag for the file.
    flags = 0b10000 | (first.raw[6] & 1)
    return replace(header, vlrs=kept).patched("H", 6, flags)


def _corners(header: LasHeader, records: Records) -> NDArray[np.float64]:
    low = np.array([int(records[name].min()) for name in "XYZ"])
    high = np.array([int(records[name].max()) for name in "XYZ"])
    return np.stack([low, high]) * header.scale + header.offset


def _kept_offset(
    shared: NDArray[np.float64],
    bounds: NDArray[np.float64],
    scale: NDArray[np.float64],
    other: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the offset that all clouds share where int32 allows it: integers then stay."""
    reach = np.abs(bounds - shared).max(axis=0) / scale
    return np.where(reach < 2**31 - 1, shared, other)


def _union(layouts: Sequence[np.dtype[np.void]], notes: list[str]) -> dict[str, np.dtype[Any]]:
    """Return every extra dimension, in the wider type where two clouds differ."""
    standard = {name for name, _ in POINT_FORMATS[8]} | {"source_id"}
    found: dict[str, np.dtype[Any]] = {}
    for layout in layouts:
        for name in layout.names or ():
            if name in standard:
                continue
            kind = layout[name]
            if name in found and found[name] != kind:
                try:
                    kind = np.promote_types(found[name], kind)
                except TypeError:
                    notes.append(f"{name} has types that do not go together: left out.")
                    continue
            if kind.kind == "V" and kind.subdtype is None:
                notes.append(f"{name} (bytes without a description) is left out.")
                continue
            found[name] = kind
    return found


def _descriptions(
    headers: Sequence[LasHeader], extras: dict[str, np.dtype[Any]], notes: list[str]
) -> dict[str, bytes]:
    """Return how the inputs describe their extra dimensions; the first description counts."""
    found: dict[str, bytes] = {}
    for header in headers:
        for name, text in descriptions_of(header).items():
            if name not in extras or text[2] != extra_type(extras[name]):
                continue
            first = found.setdefault(name, text)
            # Scale and offset stand behind the options and the statistics (LAS 1.4 R15, table 25).
            if first[112:160] != text[112:160] or first[3] & 0b11000 != text[3] & 0b11000:
                notes.append(f"{name} has different scales in the clouds; the first one's counts.")
    return found


def _fill(out: Records, own: LasHeader, records: Records, header: LasHeader) -> None:
    """Copy one cloud's records into its part of the merged ones, on their lattice."""
    for name in records.dtype.names or ():
        if name in (out.dtype.names or ()) and name not in "XYZ":
            out[name] = records[name]
    is_same = np.array_equal(own.scale, header.scale) and np.array_equal(own.offset, header.offset)
    if is_same:
        for name in "XYZ":
            out[name] = records[name]
        return
    coordinates = np.stack([records[name] for name in "XYZ"], axis=1) * own.scale + own.offset
    set_integers(out, coordinates, header.scale, header.offset)
