"""Which attribute of another format belongs into which LAS field, and as what number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud, Records

_SAME = {
    "gpstime": "gps_time",
    "r": "red", "g": "green", "b": "blue",
    "diffuse_red": "red", "diffuse_green": "green", "diffuse_blue": "blue",
    "returnnumber": "return_number",
    "numberofreturns": "number_of_returns",
    "pointsourceid": "point_source_id",
    "userdata": "user_data",
    "near_infrared": "nir",
}  # fmt: skip
_COORDINATES = {
    "x", "y", "z", "X", "Y", "Z", "cartesianX", "cartesianY", "cartesianZ",
    "sphericalRange", "sphericalAzimuth", "sphericalElevation",
}  # fmt: skip
_WHOLE = {
    "classification": 255, "user_data": 255, "point_source_id": 65535,
    "return_number": 15, "number_of_returns": 15,
}  # fmt: skip
_COLOURS = ("red", "green", "blue", "nir")
_FIELDS = {*_COLOURS, "gps_time", "intensity", *_WHOLE}


def canonical(name: str) -> str:
    """Return the LAS name of an attribute; CloudCompare's "scalar_" is looked through."""
    lower = name.lower().removeprefix("scalar_")
    return _SAME.get(lower, lower)


def coordinate_fields(cloud: Cloud) -> set[str]:
    """Return the names of record fields that only repeat the coordinates."""
    return _COORDINATES & set(cloud.attributes)


@dataclass(frozen=True, slots=True)
class Facts:
    """What must be known of all values of an attribute before a LAS field can take it."""

    low: float
    high: float
    is_whole: bool
    """Every value is a finite integer."""

    def fits(self, most: int) -> bool:
        """Say whether the values are integers in 0..most."""
        return self.is_whole and self.low >= 0 and self.high <= most

    def joined(self, other: Facts) -> Facts:
        """Return the facts of both together."""
        return Facts(
            float(np.minimum(self.low, other.low)),
            float(np.maximum(self.high, other.high)),
            self.is_whole and other.is_whole,
        )


def facts_of(cloud: Cloud) -> dict[str, Facts]:
    """Return the facts of every attribute that LAS may have a field for."""
    found = {}
    for name, values in columns_of(cloud).items():
        is_number = values.ndim == 1 and values.dtype.kind in "iufb" and len(values)
        if canonical(name) in _FIELDS and is_number:
            is_whole = values.dtype.kind != "f" or bool((values == np.rint(values)).all())
            low, high = float(values.min()), float(values.max())
            found[name] = Facts(low, high, is_whole and bool(np.isfinite([low, high]).all()))
    return found


def columns_of(cloud: Cloud) -> dict[str, NDArray[Any]]:
    """Return every attribute by name; small packed ones as uint8 instead of their field's type."""
    found: dict[str, NDArray[Any]] = {}
    for name in cloud.attributes:
        values = cloud.attribute(name)
        if values is None:
            continue
        bit = cloud.bits.get(name)
        is_small = bit is not None and bit.mask >> bit.shift <= 255
        found[name] = values.astype(np.uint8) if is_small else values
    return found


def fill_standard(
    records: Records, cloud: Cloud, notes: list[str], facts: Mapping[str, Facts] | None = None
) -> dict[str, NDArray[Any]]:
    """Fill LAS fields of `records` from `cloud`; return the attributes that found no place.

    Parameters
    ----------
    facts : mapping, optional
        Of the whole cloud, where `cloud` is a piece of it: every piece is then stored alike.
    """
    facts = facts_of(cloud) if facts is None else facts
    left: dict[str, NDArray[Any]] = {}
    columns = columns_of(cloud)
    colours = {canonical(name): values for name, values in columns.items()}
    rgb = [colours[n] for n in ("red", "green", "blue") if n in colours]
    is_eight_bit = bool(rgb) and all(v.dtype.itemsize == 1 for v in rgb)
    taken: set[str] = set()
    for name, values in columns.items():
        target, known = canonical(name), facts.get(name)
        placed = ""
        if known is not None and target not in taken:
            placed = _place(records, target, values, known, is_eight_bit, notes)
        if placed:
            taken.add(target)
        if placed != "whole":
            left[name if name not in (records.dtype.names or ()) else f"{name}_float"] = values
    return left


def _place(
    records: Records,
    target: str,
    values: NDArray[Any],
    facts: Facts,
    is_eight_bit: bool,
    notes: list[str],
) -> str:
    """Put one attribute into its field; "whole": nothing is lost, "part": keep it besides, ""."""
    if target in _COLOURS and target in (records.dtype.names or ()):
        if not facts.fits(65535):
            return ""
        # LAS colours fill 16 bits; x257 maps 0..255 onto 0..65535 and can be undone exactly.
        records[target] = values.astype(np.uint64) * np.uint64(257 if is_eight_bit else 1)
        if is_eight_bit and target == "red":
            notes.append("8-bit colours are written times 257, as LAS has 16-bit ones.")
        return "whole"
    if target == "gps_time" and values.dtype.kind == "f":
        records["gps_time"] = values
        return "whole"
    if target == "intensity":
        return _place_intensity(records, values, facts, notes)
    if target in _WHOLE:
        if not facts.fits(_WHOLE[target]):
            notes.append(
                f"{target} does not fit LAS's 0..{_WHOLE[target]}: kept in an extra dimension."
            )
            return ""
        whole = values.astype(np.uint64)
        if target == "return_number":
            records["bit_fields"] = (records["bit_fields"] & 0xF0) | whole.astype("u1")
        elif target == "number_of_returns":
            records["bit_fields"] = (records["bit_fields"] & 0x0F) | (whole.astype("u1") << 4)
        else:
            records[target] = whole
        return "whole"
    return ""


def _place_intensity(records: Records, values: NDArray[Any], facts: Facts, notes: list[str]) -> str:
    if facts.fits(65535):
        records["intensity"] = values.astype(np.uint64)
        return "whole"
    most = 65535.0 if facts.high <= 1.0 else 1.0
    if values.dtype.kind == "f" and facts.low >= 0 and facts.high * most <= 65535.0:
        records["intensity"] = np.rint(values * most)
        notes.append(
            "intensity is fractional: LAS intensity holds it "
            f"{'times 65535, ' if most > 1 else ''}rounded; the exact values are kept in "
            "the extra dimension intensity_float."
        )
        return "part"
    notes.append("intensity does not fit LAS's 0..65535: kept in extra dimension intensity_float.")
    return ""


EIGHT_BIT = (257, 256, 1)
"""What 16-bit colours may be multiples of that are 8-bit ones; the first that fits counts."""


def _wide_colours(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    colours = {n: columns[n] for n in ("red", "green", "blue") if n in columns}
    return colours if all(values.dtype.itemsize == 2 for values in colours.values()) else {}


def eight_bit_factors(columns: Mapping[str, NDArray[Any]]) -> set[int]:
    """Return those of `EIGHT_BIT` by which no bit of 16-bit colours is lost."""
    colours = _wide_colours(columns).values()
    return {
        factor
        for factor in EIGHT_BIT
        if all(not (v % factor).any() and not (v > 255 * factor).any() for v in colours)
    }


def shrunk_colours(
    columns: dict[str, NDArray[Any]], notes: list[str], factors: set[int] | None = None
) -> dict[str, NDArray[Any]]:
    """Return columns whose 16-bit colours are the 8-bit ones viewers expect, if no bit is lost.

    `factors` are those of `eight_bit_factors` of a whole cloud, where this is a piece of it.
    """
    colours = _wide_colours(columns)
    if not colours:
        return columns
    factors = eight_bit_factors(columns) if factors is None else factors
    factor = next((factor for factor in EIGHT_BIT if factor in factors), None)
    if factor is not None:
        return columns | {n: (v // factor).astype(np.uint8) for n, v in colours.items()}
    notes.append("colours stay 16-bit, as they use more than 8; some viewers expect 8.")
    return columns
