"""What a LAS header says about the reference system and the units of its coordinates."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np

from dougong.cloud import Frame
from dougong.formats.geotiff import key_records, system_keys, unit_keys
from dougong.formats.las import crs_of, unit_of
from dougong.formats.las_header import PROJECTION, LasHeader, Vlr
from dougong.formats.units import is_same_crs, las_wkt

_WKT = 2112
_IS_WKT = 0b10000
"""Of the global encoding."""
_LONGEST = 65535


def with_system(
    header: LasHeader, frame: Frame, notes: list[str], *, is_moved: bool = False
) -> LasHeader:
    """Return the header with the reference system and the units of a frame.

    It is untouched where it says so already. What it says of a system that has no name here (keys
    of a user-defined one) goes where the points are moved: they are not in it any more.
    """
    is_known = is_same_crs(crs_of(header), frame.crs) and np.allclose(
        unit_of(header, frame.crs), frame.unit_m, rtol=1e-12, atol=0.0
    )
    if is_known and (frame.crs is not None or not is_moved):
        return header
    vlrs = tuple(vlr for vlr in header.vlrs if vlr.key[0] != PROJECTION)
    evlrs = tuple(vlr for vlr in header.evlrs if vlr.key[0] != PROJECTION)
    header = replace(header, vlrs=vlrs, evlrs=evlrs)
    keys, doubles = unit_keys(frame.crs, frame.unit_m)
    encoding = struct.unpack_from("<H", header.raw, 6)[0]
    if frame.crs is not None:
        named = system_keys(frame.crs) if header.point_format < 6 else []
        if named:
            keys = named + keys
            header = header.patched("H", 6, encoding & ~_IS_WKT)
        else:
            header = _with_wkt(header, frame.crs, notes)
    return replace(header, vlrs=(*header.vlrs, *key_records(keys, doubles)))


def _with_wkt(header: LasHeader, crs: str, notes: list[str]) -> LasHeader:
    data = las_wkt(crs).encode() + b"\0"
    if len(data) > _LONGEST:
        notes.append("the reference system is longer than a LAS record and was left out.")
        return header
    header = replace(header, vlrs=(*header.vlrs, Vlr(PROJECTION, _WKT, data)))
    encoding = struct.unpack_from("<H", header.raw, 6)[0]
    return header.patched("H", 6, encoding | _IS_WKT) if header.minor >= 4 else header
