"""What a coordinate reference system says about units, and which systems cannot be worked in."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import FrameError, InputError

METRES = (1.0, 1.0, 1.0)
LOCAL_UNITS = {
    "mm": ("millimetre", 0.001),
    "cm": ("centimetre", 0.01),
    "m": ("metre", 1.0),
    "in": ("inch", 0.0254),
    "ft": ("foot", 0.3048),
    "ftUS": ("US survey foot", 1200 / 3937),
}
"""Units that stand for a system of their own: local coordinates in that unit, z up."""
_LOCAL = "local coordinates in"
KNOWN_SYSTEMS = (
    "an EPSG code such as EPSG:32650, WKT, or the unit of local coordinates: "
    f"{', '.join(list(LOCAL_UNITS)[:-1])} or {list(LOCAL_UNITS)[-1]}"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Units:
    """Units and kind of a coordinate reference system."""

    name: str
    unit_m: tuple[float, float, float]
    """Metres per file unit; 1 along axes that are not lengths."""
    names: tuple[str, str, str]
    is_geographic: bool = False
    """Longitude and latitude: degrees, no lengths."""
    is_geocentric: bool = False
    """Earth-centred: metres, but z does not point up."""
    is_projected: bool = False
    """A map: easting and northing, lengths in plan scaled by the projection."""
    is_local: bool = False
    """Only a unit is known: the same text for two files does not mean the same place."""
    has_vertical: bool = False
    """The system itself says what z is measured in."""


@lru_cache(maxsize=64)
def parse_crs(text: str) -> Any:
    """Return the pyproj CRS of WKT or "EPSG:n" `text`, None where it is not understood."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return CRS.from_user_input(text.strip("\0 \n\r\t"))
    except CRSError:
        return None


@lru_cache(maxsize=64)
def as_wkt(text: str) -> str | None:
    """Return `text` (WKT of any version, "EPSG:n", "mm") as WKT 2, None where not understood.

    A unit of `LOCAL_UNITS` alone is local coordinates in that unit.

    A system that names its own EPSG code, and is what that code stands for, is written as the
    EPSG database words it: the same system then is the same text, whichever file it came from.
    """
    unit = text.strip()
    crs = parse_crs(_local_system(*LOCAL_UNITS[unit]) if unit in LOCAL_UNITS else text)
    if crs is None:
        return None
    registered = _registered(crs)
    return str((crs if registered is None else registered).to_wkt())


def _local_system(unit: str, metres: float) -> str:
    return (
        f'ENGCRS["{_LOCAL} {unit}",EDATUM["local"],CS[Cartesian,3],'
        'AXIS["x",unspecified],AXIS["y",unspecified],AXIS["z",up],'
        f'LENGTHUNIT["{unit}",{metres!r}]]'
    )


def _codes(crs: Any) -> tuple[int, ...] | None:
    """Return the EPSG codes a system gives itself (horizontal, vertical), None without."""
    idents = [part.to_json_dict().get("id", {}) for part in crs.sub_crs_list or [crs]]
    if any(ident.get("authority") != "EPSG" for ident in idents):
        return None
    return tuple(int(ident["code"]) for ident in idents)


def epsg_of(wkt: str) -> tuple[int, ...] | None:
    """Return the EPSG code of a system, or those of its parts, None where it names none."""
    crs = parse_crs(wkt)
    return _codes(crs) if crs is not None else None


def _registered(crs: Any) -> Any:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    codes = _codes(crs)
    if codes is None:
        return None
    try:
        found = CRS.from_user_input("EPSG:" + "+".join(map(str, codes)))
    except CRSError:
        return None
    return found if _means_the_same(found, crs) else None


def _means_the_same(one: Any, other: Any) -> bool:
    """Say whether two systems are one, whatever the order they name easting and northing in.

    Point clouds hold the easting first in any case, and WKT 1 as LAS holds it names no order.
    """
    if one.equals(other, ignore_axis_order=True):
        return True
    return bool(_easting_first(one).equals(_easting_first(other), ignore_axis_order=True))


def _easting_first(crs: Any) -> Any:
    """Return a system whose projected part names its easting, then its northing."""
    from pyproj import CRS

    document = crs.to_json_dict()
    for part in document.get("components", [document]):
        inner = part.get("source_crs", part)
        if inner.get("type") != "ProjectedCRS":
            continue
        axes = inner["coordinate_system"]["axis"]
        by_way = {axis["direction"]: axis for axis in axes}
        if not {"east", "north"} <= set(by_way):
            continue
        named = (("east", "Easting", "E"), ("north", "Northing", "N"))
        plan = [{**by_way[way], "name": name, "abbreviation": short} for way, name, short in named]
        inner["coordinate_system"]["axis"] = plan + axes[2:]
        part.pop("id", None)
        inner.pop("id", None)
    document.pop("id", None)
    return CRS.from_json_dict(document)


@lru_cache(maxsize=256)
def is_same_crs(first: str | None, second: str | None) -> bool:
    """Say whether two WKT texts mean the same reference system; two None do."""
    if first == second or first is None or second is None:
        return first == second
    one, other = parse_crs(first), parse_crs(second)
    return one is not None and other is not None and _means_the_same(one, other)


@lru_cache(maxsize=64)
def las_wkt(text: str) -> str:
    """Return `text` as the WKT 1 that LAS 1.4 asks for, or as it is where WKT 1 has no words."""
    from pyproj.exceptions import CRSError

    crs = parse_crs(text)
    if crs is None:
        return text
    try:
        return str(crs.to_wkt("WKT1_GDAL"))
    except CRSError:
        return str(crs.to_wkt())


@lru_cache(maxsize=64)
def units_of(wkt: str | None) -> Units:
    """Return the units of a reference system; metres where there is none or none is understood.

    Where a projected system says nothing of heights, z is taken to be in the horizontal unit:
    that is how feet files without a vertical system are written.
    """
    crs = parse_crs(wkt) if wkt else None
    if crs is None:
        return Units(name="", unit_m=METRES, names=("metre",) * 3)
    # A bound system (WKT 1 with TOWGS84) hides its axes behind its source system.
    parts = [part.source_crs if part.is_bound else part for part in (crs.sub_crs_list or [crs])]
    factors: list[float] = []
    names: list[str] = []
    for part in parts:
        for axis in part.axis_info:
            is_length = "degree" not in axis.unit_name and "rad" not in axis.unit_name
            factors.append(float(axis.unit_conversion_factor) if is_length else 1.0)
            names.append(axis.unit_name)
    has_vertical = len(factors) >= 3
    is_geographic = bool(crs.is_geographic)
    if not has_vertical:
        factors.append(1.0 if is_geographic else factors[0] if factors else 1.0)
        names.append("metre" if is_geographic else names[0] if names else "metre")
    return Units(
        name=crs.name,
        unit_m=(factors[0], factors[1], factors[2]),
        names=(names[0], names[1], names[2]),
        is_geographic=is_geographic,
        is_geocentric=bool(crs.is_geocentric),
        is_projected=bool(crs.is_projected),
        is_local=str(crs.name).startswith(_LOCAL),
        has_vertical=has_vertical,
    )


def utm_zone(longitude: float, latitude: float) -> str:
    """Return the UTM zone of a place in degrees, with its EPSG code."""
    zone = int(np.clip((longitude + 180) // 6, 0, 59)) + 1
    south = latitude < 0
    return (
        f"UTM zone {zone}{'S' if south else 'N'} (EPSG:{32700 + zone if south else 32600 + zone})"
    )


def _gauss_kruger_zone(longitude: float) -> str:
    """Return the 3-degree Gauss-Kruger zone of China's CGCS2000 at a longitude."""
    middle = 3 * int(np.clip(np.rint(longitude / 3), 25, 45))
    code = 4534 + (middle - 75) // 3
    return f"CGCS2000 / 3-degree Gauss-Kruger CM {middle}E (EPSG:{code})"


def _place_of(wkt: str, middle: Any) -> tuple[float, float] | None:
    """Return longitude and latitude (degrees) of earth-centred coordinates, None off the earth."""
    from pyproj import CRS, Transformer

    to_degrees = Transformer.from_crs(CRS.from_user_input(wkt), "EPSG:4326", always_xy=True)
    longitude, latitude, _ = to_degrees.transform(*middle)
    is_place = np.isfinite([longitude, latitude]).all() and np.linalg.norm(middle) > 6e6
    return (float(longitude), float(latitude)) if is_place else None


def _metric_zone(name: str, longitude: float, latitude: float) -> str:
    """Return the system in metres to reproject to: the national one where we know it."""
    if "CGCS2000" in name or "China Geodetic" in name:
        return _gauss_kruger_zone(longitude)
    return utm_zone(longitude, latitude)


def metric_problem(
    wkt: str | None, extent_min: Any, extent_max: Any, name: str = "the cloud"
) -> str | None:
    """Return why coordinates in this reference system cannot be worked in, or None.

    Parameters
    ----------
    extent_min, extent_max : array_like, shape (3,)
        Corners in file units; only used to name the zone to reproject to.
    """
    units = units_of(wkt)
    if wkt is None or not (units.is_geographic or units.is_geocentric):
        return None
    middle = (np.asarray(extent_min, dtype=float) + np.asarray(extent_max, dtype=float)) / 2
    if units.is_geographic:
        return (
            f"{name} is in degrees ({units.name}), and distances need metres. "
            f"Reproject it to {_metric_zone(units.name, middle[0], middle[1])} first."
        )
    place = _place_of(wkt, middle)
    zone = "the UTM zone of the site" if place is None else _metric_zone(units.name, *place)
    return (
        f"{name} is in earth-centred coordinates ({units.name}), where z does not point up. "
        f"Reproject it to {zone} first."
    )


@lru_cache(maxsize=64)
def metre_form(wkt: str) -> str:
    """Return a reference system with every length axis in metres: the same projection.

    For formats whose coordinates are metres by definition whatever their system's unit is (E57).
    Angles, and a system that is in metres already or is not understood, stay as they are.
    """
    from pyproj import CRS

    crs = parse_crs(wkt)
    if crs is None or units_of(wkt).unit_m == METRES:
        return wkt
    document = crs.to_json_dict()
    for part in document.get("components", [document]):
        axes = part.get("source_crs", part).get("coordinate_system", {}).get("axis", [])
        lengths = [axis for axis in axes if axis.get("unit") not in ("degree", "metre")]
        for axis in lengths:
            axis["unit"] = "metre"
        if lengths:
            part.pop("id", None)
            part["name"] += " (in metres)"
    document.pop("id", None)
    if "components" in document:
        document["name"] += " (in metres)"
    return str(CRS.from_json_dict(document).to_wkt())


def has_metric_format(cloud: Cloud) -> bool:
    """Say whether a cloud was read from a format whose lengths are metres by definition."""
    from dougong.formats.e57 import E57Header
    from dougong.formats.ptx import PtxHeader

    return isinstance(cloud.header, E57Header | PtxHeader)


def in_system(cloud: Cloud, crs: str | None) -> Cloud:
    """Return `cloud` in the reference system that the user names for it; None: as it is.

    Parameters
    ----------
    cloud : Cloud
        Of a file that names no system; its numbers then are in the units of `crs`, or in metres
        where its format has no other.
    crs : str or None
        WKT, a code such as "EPSG:32650" (compound: "EPSG:32650+5773"), or the unit of local
        coordinates (`LOCAL_UNITS`).

    Raises
    ------
    InputError
        The system is not understood.
    FrameError
        The file names another system itself.
    """
    if crs is None:
        return cloud
    wkt = as_wkt(crs)
    if wkt is None:
        msg = (
            f"the coordinate system {crs!r} of {cloud.name} is not understood; give "
            f"{KNOWN_SYSTEMS}."
        )
        raise InputError(msg)
    if has_metric_format(cloud) and units_of(wkt).unit_m != METRES:
        note = (
            f"the reference system given for it ({units_of(wkt).name}) is in "
            f"{units_of(wkt).names[0]}, but the coordinates of its format are metres by "
            "definition: taken as metres."
        )
        wkt, cloud = metre_form(wkt), replace(cloud, notes=(*cloud.notes, note))
    frame = cloud.frame
    if frame.crs is not None:
        if is_same_crs(frame.crs, wkt):
            return cloud
        msg = (
            f"{cloud.name} names {units_of(frame.crs).name} itself, and {units_of(wkt).name} was "
            "given for it. Leave the setting out, or correct the file."
        )
        raise FrameError(msg)
    units = units_of(wkt)
    ratio = np.asarray(units.unit_m) / np.asarray(frame.unit_m)
    placed = replace(frame, origin=frame.origin * ratio, crs=wkt, unit_m=units.unit_m)
    # Not a motion: the file's numbers stay, only what they mean is known now.
    return cloud.stretched(ratio, placed)


def require_metric(cloud: Cloud) -> None:
    """Raise where lengths and heights cannot be taken from the coordinates of `cloud`.

    Raises
    ------
    FrameError
        The reference system is in degrees or earth-centred; the message names the UTM zone.
    """
    low, high = np.zeros(3), np.zeros(3)
    if len(cloud):
        corners = np.stack([cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)])
        low, high = cloud.frame.to_file(corners)
    problem = metric_problem(cloud.frame.crs, low, high, cloud.name)
    if problem:
        raise FrameError(problem)
