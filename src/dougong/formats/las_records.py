"""From any cloud to a LAS header and its point records: kept, upgraded or built anew.

Three cases, cheapest first. An unmoved cloud from a LAS file keeps its records; attributes that
filters added become extra dimensions. A moved one gets new integers, all other bits stay. A
cloud from another format is fitted into LAS 1.4: known attributes go to their LAS fields, the
rest become extra dimensions, and what cannot be held is said.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud, Records
from dougong.errors import OutputError
from dougong.formats.las import frame_of, has_mixed_channels
from dougong.formats.las_fields import Facts, canonical, coordinate_fields, fill_standard
from dougong.formats.las_header import (
    EXTRA_BYTES,
    EXTRA_TYPES,
    HEADER_BYTES,
    POINT_FORMATS,
    PROJECTION,
    LasHeader,
    Vlr,
    new_header,
)
from dougong.formats.las_system import with_system
from dougong.formats.units import units_of
from dougong.typing import Points

FINEST_M = 1e-4
"""Step for coordinates that had none of their own: 0.1 mm."""
MOVED_M = 1e-3
"""A moved point leaves its file's lattice; its new step is this or finer."""
_DEGREES = 1e-7
_MOST_STEPS = 2**31 - 1
_NAME_BYTES = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class Whole:
    """What is known of a whole file while it is converted in pieces, so that all come out alike."""

    corners: Points
    """(k, 3) file coordinates of the output between which all points lie."""
    facts: Mapping[str, Facts]
    has_mixed_channels: bool = False


def las_parts(
    cloud: Cloud, *, modern: bool = False, packed: bool = False, whole: Whole | None = None
) -> tuple[LasHeader, Records, list[str]]:
    """Return header, records and notes that hold `cloud` as LAS.

    Parameters
    ----------
    modern : bool
        Ask for point format 6, 7 or 8 (COPC); a file that has another one is upgraded.
    packed : bool
        The records will be compressed: waveforms that this would damage are left out.
    whole : Whole, optional
        Of the file that `cloud` is a piece of.

    Raises
    ------
    OutputError
        The coordinates do not fit 32-bit integers at the step they need.
    """
    notes: list[str] = []
    if isinstance(cloud.header, LasHeader):
        header, records = _kept(cloud, cloud.header, whole)
        is_mixed = has_mixed_channels(records) if whole is None else whole.has_mixed_channels
        is_unsafe = packed and is_mixed
        if is_unsafe or (modern and header.point_format not in (6, 7, 8)):
            header, records = upgraded(header, records, notes)
        header, records = _with_extras(header, records, notes)
    else:
        header, records = _built(cloud, notes, whole)
    header = with_system(header, cloud.frame, notes, is_moved=cloud.is_moved)
    return header, records, notes


def _kept(cloud: Cloud, header: LasHeader, whole: Whole | None) -> tuple[LasHeader, Records]:
    if not cloud.is_moved:
        return header, cloud.records
    coordinates = cloud.frame.to_file(cloud.xyz)
    step = np.minimum(
        np.asarray(cloud.frame.step or header.scale), MOVED_M / np.asarray(cloud.frame.unit_m)
    )
    bounds = coordinates if whole is None else whole.corners
    scale, offset = scaling_for(bounds, _decimal_at_most(step), cloud.name)
    records = cloud.records.copy()
    set_integers(records, coordinates, scale, offset)
    return header.with_scaling(scale, offset), records


def _decimal_at_most(step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest powers of ten not above `step`."""
    exponents = np.floor(np.log10(step) + 1e-9).astype(int)
    return np.array([float(f"1e{exponent}") for exponent in exponents])


def scaling_for(
    coordinates: Points, scale: NDArray[np.float64], name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `scale` and an offset (3,) in whole units that lets int32 hold `coordinates`.

    Raises
    ------
    OutputError
        An axis spans more steps than int32 has.
    """
    if not len(coordinates):
        return scale, np.zeros(3)
    low, high = coordinates.min(axis=0), coordinates.max(axis=0)
    offset = np.where(
        np.maximum(np.abs(low), np.abs(high)) / scale < 2**31 - 1, 0.0, np.floor((low + high) / 2)
    )
    reach = np.maximum(np.abs(low - offset), np.abs(high - offset)) / scale
    for axis in np.flatnonzero(reach >= 2**31 - 1):
        msg = (
            f"{name} spans {high[axis] - low[axis]:.6g} units along {'xyz'[axis]}, and LAS holds "
            f"{2**32 * scale[axis]:.6g} at its step of {scale[axis]:g}. "
            "Crop far points off (`dougong check` counts them; pass_through.x_m), or write PLY."
        )
        raise OutputError(msg)
    return scale, offset


class OutsideLattice(OutputError):
    """A coordinate is more steps from the offset than 32 bits hold."""


def set_integers(
    records: Records, coordinates: Points, scale: NDArray[np.float64], offset: NDArray[np.float64]
) -> None:
    """Fill X, Y, Z of `records` with `coordinates` (n, 3) rounded to the lattice.

    Raises
    ------
    OutsideLattice
        One of them does not fit.
    """
    for axis, name in enumerate("XYZ"):
        steps = (coordinates[:, axis] - offset[axis]) / scale[axis]
        np.rint(steps, out=steps)
        if len(steps) and max(-steps.min(), steps.max()) > _MOST_STEPS:
            msg = (
                f"a {'xyz'[axis]} of {coordinates[np.abs(steps).argmax(), axis]:.6g} does not fit "
                f"LAS at a step of {scale[axis]:g} about {offset[axis]:g}. "
                "Crop far points off (`dougong check` counts them; pass_through.x_m), or write PLY."
            )
            raise OutsideLattice(msg)
        records[name] = steps


def step_for(cloud: Cloud) -> NDArray[np.float64]:
    """Return the (3,) LAS scale for a cloud that has no LAS header, in its file units."""
    units = units_of(cloud.frame.crs)
    step = FINEST_M / np.asarray(cloud.frame.unit_m)
    if cloud.frame.step is not None:
        step = np.minimum(step, cloud.frame.step)
    if units.is_geographic:
        step[:2] = np.minimum(step[:2], _DEGREES)
    return _decimal_at_most(step)


def _built(cloud: Cloud, notes: list[str], whole: Whole | None) -> tuple[LasHeader, Records]:
    coordinates = cloud.frame.to_file(cloud.xyz)
    bounds = coordinates if whole is None else whole.corners
    scale, offset = scaling_for(bounds, step_for(cloud), cloud.name)
    names = {canonical(name) for name in cloud.attributes}
    has_colour = {"red", "green", "blue"} <= names
    header = new_header(8 if "nir" in names else 7 if has_colour else 6)
    header = header.with_scaling(scale, offset)
    records = np.zeros(len(cloud), dtype=header.dtype)
    set_integers(records, coordinates, scale, offset)
    records["bit_fields"] = 0b00010001  # return 1 of 1
    left = fill_standard(records, cloud, notes, whole.facts if whole is not None else None)
    dropped = coordinate_fields(cloud)
    columns = {name: values for name, values in left.items() if name not in dropped}
    return _with_columns(header, records, columns, notes)


def _with_extras(
    header: LasHeader, records: Records, notes: list[str]
) -> tuple[LasHeader, Records]:
    """Turn fields that the header does not know into extra dimensions."""
    known = header.dtype.names or ()
    names = records.dtype.names or ()
    if names == known:
        return header, records
    base = np.empty(len(records), dtype=header.dtype)
    for name in known:
        base[name] = records[name]
    columns = {name: records[name] for name in names if name not in known}
    return _with_columns(header, base, columns, notes)


def _with_columns(
    header: LasHeader, records: Records, columns: dict[str, NDArray[np.generic]], notes: list[str]
) -> tuple[LasHeader, Records]:
    """Append `columns` to records and header as extra dimensions."""
    held: dict[str, NDArray[np.generic]] = {}
    for name, values in columns.items():
        for end, column in _as_extra(name, values, notes):
            fitted = _fitted(name, end, {*held, *(records.dtype.names or ())})
            if fitted != name + end:
                notes.append(
                    f"{name}{end} is named {fitted}: LAS names hold {_NAME_BYTES} bytes, each once."
                )
            held[fitted] = column
    if not held:
        return header, records
    layout = [(name, records.dtype[name]) for name in records.dtype.names or ()]
    joined = np.empty(
        len(records), dtype=[*layout, *((name, values.dtype) for name, values in held.items())]
    )
    for name, _ in layout:
        joined[name] = records[name]
    for name, values in held.items():
        joined[name] = values
    return describe_extras(header, {name: held[name].dtype for name in held}), joined


def _fitted(name: str, end: str, taken: set[str]) -> str:
    """Return `name` and `end` in 32 bytes of whole characters, numbered if that is `taken`."""
    number = 1
    while True:
        tail = end if number == 1 else f"_{number}{end}"
        start = name.encode()[: _NAME_BYTES - len(tail)].decode("utf-8", "ignore")
        if start + tail not in taken:
            return start + tail
        number += 1


def _as_extra(
    name: str, values: NDArray[np.generic], notes: list[str]
) -> list[tuple[str, NDArray[np.generic]]]:
    """Return `values` as columns of types LAS has, with the ends of their names; note the rest."""
    if values.ndim == 2 and values.shape[1] <= 3:
        parts = [(f"_{k}", values[:, k]) for k in range(values.shape[1])]
    elif values.ndim == 1:
        parts = [("", values)]
    else:
        notes.append(f"{name} holds {values[:1].size} numbers per point, LAS at most 3: left out.")
        return []
    found = []
    for end, column in parts:
        kind = column.dtype
        if kind.kind == "b":
            column = column.astype("u1")
        elif kind == np.float16:
            column = column.astype("<f4")
        elif kind.newbyteorder("<").str.lstrip("|") not in EXTRA_TYPES:
            notes.append(f"{name} has type {kind}, which LAS does not have: left out.")
            continue
        found.append((end, column.astype(column.dtype.newbyteorder("<"), copy=False)))
    return found


def extra_type(dtype: np.dtype[Any]) -> int:
    """Return the LAS number of an extra dimension's type, pairs and triples included."""
    count = dtype.shape[0] if dtype.shape else 1
    return EXTRA_TYPES.index(dtype.base.str.lstrip("|")) + 1 + 10 * (count - 1)


def descriptions_of(header: LasHeader) -> dict[str, bytes]:
    """Return the 192 bytes that describe each extra dimension, by the name of its field."""
    data = b"".join(vlr.data for vlr in header.vlrs if vlr.key == EXTRA_BYTES)
    fields = (header.dtype.names or ())[len(POINT_FORMATS[header.point_format]) :]
    whole = [data[start : start + 192] for start in range(0, len(data) - 191, 192)]
    return {name: text for name, text in zip(fields, whole, strict=False) if text[2]}


def describe_extras(
    header: LasHeader, added: dict[str, np.dtype[Any]], known: Mapping[str, bytes] | None = None
) -> LasHeader:
    """Add descriptions of `added` fields to the header's extra-bytes record.

    Descriptions that are `known` (with scale, offset and words) are taken over.
    """
    data = b"".join(vlr.data for vlr in header.vlrs if vlr.key == EXTRA_BYTES)
    names = header.dtype.names or ()
    if "undescribed_bytes" in names:
        # Fields are found by position: nameless bytes must be named before others follow them.
        size = header.dtype["undescribed_bytes"].itemsize
        data += struct.pack("<2xBB32s156x", 0, size, b"undescribed_bytes")
    for name, dtype in added.items():
        text = (known or {}).get(name)
        data += text or struct.pack("<2xBB32s156x", extra_type(dtype), 0, name.encode())
    others = [vlr for vlr in header.vlrs if vlr.key != EXTRA_BYTES]
    record = Vlr(EXTRA_BYTES[0], EXTRA_BYTES[1], data)
    size = header.point_bytes + sum(dtype.itemsize for dtype in added.values())
    return replace(header, vlrs=(*others, record)).patched("H", 105, size)


def upgraded(
    header: LasHeader, records: Records, notes: list[str], point_format: int | None = None
) -> tuple[LasHeader, Records]:
    """Return header and records as LAS 1.4 of point format 6, 7 or 8, extra dimensions kept."""
    names = set(records.dtype.names or ())
    if point_format is None:
        point_format = 8 if "nir" in names else 7 if "red" in names else 6
    frame = frame_of(header)
    raw = bytearray(header.raw[:227].ljust(375, b"\0"))
    struct.pack_into("<BB", raw, 24, 1, 4)
    struct.pack_into("<HI", raw, 94, HEADER_BYTES[4], 375)
    standard = np.dtype(POINT_FORMATS[point_format])
    old = {name for name, _ in POINT_FORMATS[header.point_format]}
    extras = [(name, records.dtype[name]) for name in records.dtype.names or () if name not in old]
    known = [(name, dtype) for name, dtype in extras if name in (header.dtype.names or ())]
    added = [pair for pair in extras if pair not in known]
    size = standard.itemsize + sum(dtype.itemsize for _, dtype in known)
    struct.pack_into("<BH", raw, 104, point_format, size)
    result = np.zeros(
        len(records),
        dtype=[*((n, standard[n]) for n in standard.names or ()), *known, *added],
    )
    for name in result.dtype.names or ():
        if name in names and name not in ("bit_fields", "classification"):
            result[name] = records[name]
    if header.point_format < 6:
        _unpack_legacy(records, result)
    else:
        for name in ("bit_fields", "classification"):
            result[name] = records[name]
    if "wavepacket_index" in names:
        notes.append(
            "waveform data is left out, as COPC cannot hold it and LAZ not that of several "
            "scanner channels; write .las to keep it."
        )
    vlrs = tuple(v for v in header.vlrs if v.key[0] != PROJECTION)
    evlrs = tuple(
        v for v in header.evlrs if v.key[0] != PROJECTION and v.key != (b"LASF_Spec", 65535)
    )
    modern = LasHeader(bytes(raw), vlrs, evlrs, source=header.source)
    encoding = struct.unpack_from("<H", raw, 6)[0]
    modern = modern.patched("H", 6, (encoding & ~0b110) | 0b10000)
    return with_system(modern, frame, notes), result


def _unpack_legacy(records: Records, result: Records) -> None:
    """Spread the packed bits of point formats 0-5 over those of 6-8."""
    bits, packed = records["bit_fields"], records["raw_classification"]
    result["bit_fields"] = (bits & 0b111) | ((bits & 0b111000) << 1)
    result["classification_flags"] = (packed >> 5) | (bits & 0b11000000)
    kind = packed & 0b11111
    # Class 12 of the old formats is the overlap flag of the new ones (LAS 1.4 R15, table 17).
    is_overlap = kind == 12
    result["classification"] = np.where(is_overlap, 1, kind)
    result["classification_flags"] |= is_overlap.astype("u1") << 3
    # Whole degrees become steps of 0.006 degrees.
    result["scan_angle"] = np.rint(records["scan_angle_rank"] / 0.006)
