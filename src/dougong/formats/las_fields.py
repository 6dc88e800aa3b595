"""Which attribute of another format belongs into which LAS field, and as what number."""

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


def canonical(name: str) -> str:
    """Return the LAS name of an attribute; CloudCompare's "scalar_" is looked through."""
    lower = name.lower().removeprefix("scalar_")
    return _SAME.get(lower, lower)


def coordinate_fields(cloud: Cloud) -> set[str]:
    """Return the names of record fields that only repeat the coordinates."""
    return _COORDINATES & set(cloud.attributes)


def _whole(values: NDArray[Any], most: int) -> NDArray[np.uint64] | None:
    """Return `values` as integers in 0..most, or None where one of them is not."""
    if values.ndim != 1 or values.dtype.kind not in "iufb":
        return None
    with np.errstate(invalid="ignore"):
        fits = (values >= 0) & (values <= most) & (values == np.rint(values))
    return values.astype(np.uint64) if fits.all() else None


def _colour(values: NDArray[Any], *, is_eight_bit: bool) -> NDArray[np.uint64] | None:
    whole = _whole(values, 65535)
    # LAS colours fill 16 bits; x257 maps 0..255 onto 0..65535 and can be undone exactly.
    return whole if whole is None or not is_eight_bit else whole * np.uint64(257)


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


def fill_standard(records: Records, cloud: Cloud, notes: list[str]) -> dict[str, NDArray[Any]]:
    """Fill LAS fields of `records` from `cloud`; return the attributes that found no place."""
    left: dict[str, NDArray[Any]] = {}
    columns = columns_of(cloud)
    colours = {canonical(name): values for name, values in columns.items()}
    rgb = [colours[n] for n in ("red", "green", "blue") if n in colours]
    is_eight_bit = bool(rgb) and all(v.dtype.itemsize == 1 for v in rgb)
    taken: set[str] = set()
    for name, values in columns.items():
        target = canonical(name)
        placed = target not in taken and _place(records, target, values, is_eight_bit, notes)
        if placed:
            taken.add(target)
        if placed != "whole":
            left[name if name not in (records.dtype.names or ()) else f"{name}_float"] = values
    return left


def _place(
    records: Records, target: str, values: NDArray[Any], is_eight_bit: bool, notes: list[str]
) -> str:
    """Put one attribute into its field; "whole": nothing is lost, "part": keep it besides, ""."""
    if target in ("red", "green", "blue", "nir") and target in (records.dtype.names or ()):
        colour = _colour(values, is_eight_bit=is_eight_bit)
        if colour is None:
            return ""
        records[target] = colour
        if is_eight_bit and target == "red":
            notes.append("8-bit colours are written times 257, as LAS has 16-bit ones.")
        return "whole"
    if target == "gps_time" and values.ndim == 1 and values.dtype.kind == "f":
        records["gps_time"] = values
        return "whole"
    if target == "intensity" and values.ndim == 1:
        return _place_intensity(records, values, notes)
    if target in _WHOLE:
        whole = _whole(values, _WHOLE[target])
        if whole is None:
            return ""
        if target == "return_number":
            records["bit_fields"] = (records["bit_fields"] & 0xF0) | whole.astype("u1")
        elif target == "number_of_returns":
            records["bit_fields"] = (records["bit_fields"] & 0x0F) | (whole.astype("u1") << 4)
        else:
            records[target] = whole
        return "whole"
    return ""


def _place_intensity(records: Records, values: NDArray[Any], notes: list[str]) -> str:
    whole = _whole(values, 65535)
    if whole is not None:
        records["intensity"] = whole
        return "whole"
    if values.dtype.kind == "f" and np.isfinite(values).all() and values.min() >= 0:
        most = 65535.0 if values.max() <= 1.0 else 1.0
        if values.max() * most <= 65535.0:
            records["intensity"] = np.rint(values * most)
            notes.append(
                "intensity is fractional: LAS intensity holds it "
                f"{'times 65535, ' if most > 1 else ''}rounded; the exact values are kept in "
                "the extra dimension intensity_float."
            )
            return "part"
    notes.append("intensity does not fit LAS's 0..65535: kept in extra dimension intensity_float.")
    return ""
