"""Read and write the GeoTIFF keys by which LAS files before 1.4 name their reference system.

Source: OGC 19-008r4 (GeoTIFF 1.1), ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dougong.formats.las_header import PROJECTION, Vlr
from dougong.formats.model import Triple
from dougong.formats.units import as_wkt, epsg_of, units_of

_MODEL, _GEODETIC, _PROJECTED, _LINEAR, _LINEAR_SIZE = 1024, 2048, 3072, 3076, 3077
_VERTICAL, _VERTICAL_UNITS = 4096, 4099
_IS_GEODETIC = (2, 3)
_OWN = 32767
"""User-defined."""
_DOUBLES = 34736
_METRES = {
    9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937, 9005: 0.3047972654, 9036: 1000.0,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class GeoKeys:
    """What the keys say."""

    crs: str | None = None
    """WKT; None where the system has no EPSG code."""
    horizontal_m: float | None = None
    """Metres per unit of x and y, where a key says so."""
    vertical_m: float | None = None


Key = tuple[int, int, int, int]
"""A row of the directory: key, where its value lies (0: here), how many there are, the value."""


def system_keys(crs: str) -> list[Key]:
    """Return the keys that name a reference system; none where it has no EPSG code.

    Older readers of point formats 0-5 know keys only.
    """
    codes = epsg_of(crs)
    if codes is None:
        return []
    is_geographic = units_of(crs).is_geographic
    keys = [(_MODEL, 0, 1, 2 if is_geographic else 1), (1025, 0, 1, 1)]
    keys.append((_GEODETIC if is_geographic else _PROJECTED, 0, 1, codes[0]))
    return keys + [(_VERTICAL, 0, 1, code) for code in codes[1:2]]


def unit_keys(crs: str | None, unit_m: Triple) -> tuple[list[Key], list[float]]:
    """Return the keys, with the doubles they point to, of units (x, y, z) that `crs` does not say.

    Only a system that is not named leaves the unit of x and y open; heights in a unit that has no
    code of its own are in that of x and y.
    """
    keys: list[Key] = []
    doubles: list[float] = []
    known = units_of(crs).unit_m
    if crs is None and unit_m[0] != 1.0:
        code = _unit_code(unit_m[0])
        keys = [(_MODEL, 0, 1, 1), (_PROJECTED, 0, 1, _OWN), (_LINEAR, 0, 1, code or _OWN)]
        if code is None:
            keys.append((_LINEAR_SIZE, _DOUBLES, 1, 0))
            doubles.append(unit_m[0])
        known = (unit_m[0],) * 3
    code = _unit_code(unit_m[2])
    if unit_m[2] != known[2] and code is not None:
        keys.append((_VERTICAL_UNITS, 0, 1, code))
    return keys, doubles


def key_records(keys: list[Key], doubles: list[float]) -> tuple[Vlr, ...]:
    """Return the records that hold keys, which are sorted as GeoTIFF asks for; none without."""
    if not keys:
        return ()
    rows = [(1, 1, 0, len(keys)), *sorted(keys)]
    record = Vlr(PROJECTION, 34735, np.array(rows, dtype="<u2").tobytes())
    if not doubles:
        return (record,)
    return record, Vlr(PROJECTION, _DOUBLES, np.array(doubles, dtype="<f8").tobytes())


def _unit_code(unit_m: float) -> int | None:
    return next(
        (code for code, metres in _METRES.items() if abs(metres / unit_m - 1) < 1e-12), None
    )


def _code(value: int | float | None) -> int | None:
    """Return `value` where it is an EPSG code: 32767 is "user-defined", 0 "undefined"."""
    return int(value) if value is not None and 1024 <= value <= 32766 else None


def read_geokeys(records: Iterable[Vlr]) -> GeoKeys | None:
    """Return what the GeoTIFF keys among `records` say, None where there are none."""
    found = {vlr.record_id: vlr.data for vlr in records if vlr.key[0] == PROJECTION}
    directory = found.get(34735, b"")
    if len(directory) < 16:
        return None
    doubles = np.frombuffer(
        found.get(_DOUBLES, b"")[: len(found.get(_DOUBLES, b"")) // 8 * 8], "<f8"
    )
    values: dict[int, float] = {}
    for key, place, _, value in np.frombuffer(
        directory[: len(directory) // 8 * 8], dtype="<u2"
    ).reshape(-1, 4)[1:]:
        if place == 0:
            values[int(key)] = int(value)
        elif place == _DOUBLES and value < len(doubles):
            values[int(key)] = float(doubles[value])
    linear = _METRES.get(int(values.get(_LINEAR, 0)), values.get(_LINEAR_SIZE))
    return GeoKeys(
        crs=_crs_of(values),
        horizontal_m=linear,
        vertical_m=_METRES.get(int(values.get(_VERTICAL_UNITS, 0))),
    )


def _crs_of(values: dict[int, float]) -> str | None:
    # A user-defined projection often names its geographic base as well; that one's degrees are
    # not the units of the file.
    code = _code(values.get(_PROJECTED))
    if code is None and (values.get(_MODEL) in _IS_GEODETIC or _PROJECTED not in values):
        code = _code(values.get(_GEODETIC))
    if code is None:
        return None
    vertical = _code(values.get(_VERTICAL))
    compound = as_wkt(f"EPSG:{code}+{vertical}") if vertical is not None else None
    return compound or as_wkt(f"EPSG:{code}")
