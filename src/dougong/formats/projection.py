"""What a map projection does to lengths, and whether coordinates lie where it applies.

A projected cloud is measured in grid metres, a scanner in ground metres. Lengths in plan differ by
the combined factor k * R / (R + h): the point scale of the projection at the place, and the
reduction from the height of the site to the ellipsoid. Heights are not projected.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dougong.formats.units import is_same_crs, parse_crs, units_of

_STEP_M = 100.0
"""Half the length that is measured on the ellipsoid and on the map, per axis."""
_MARGIN_DEG = 1.0
"""Surveys go a little beyond the area a system was made for."""
_PLAIN = 0.002
"""Point scales of survey projections lie within this of 1."""
CONFORMAL = 1e-4
"""Scales along meridian and parallel that differ by more are no survey projection's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridScale:
    """Lengths in plan on a map / the same lengths on the ground, at one place."""

    factor: float
    """Combined factor: point scale x height factor."""
    point_scale: float
    """Of the projection: map / ellipsoid."""
    height_factor: float
    """R / (R + h): ellipsoid / ground."""
    distortion: float
    """Relative difference of the scales along the meridian and the parallel; 0: conformal."""
    longitude: float
    latitude: float
    height_m: float
    system: str

    @property
    def ppm(self) -> float:
        """(factor - 1) x 1e6: negative where the map is shorter than the ground."""
        return 1e6 * (self.factor - 1.0)


@lru_cache(maxsize=64)
def _projection(wkt: str | None) -> Any:
    """Return the projected (horizontal) part of a reference system, None where it has none."""
    crs = parse_crs(wkt) if wkt else None
    if crs is None:
        return None
    part = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    part = part.source_crs if part.is_bound else part
    return part if part.is_projected else None


def _to_degrees(crs: Any, x: float, y: float) -> tuple[float, float]:
    from pyproj import Transformer

    inverse = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    longitude, latitude = inverse.transform(x, y)
    return float(longitude), float(latitude)


def _point_scales(crs: Any, longitude: float, latitude: float) -> tuple[float, float]:
    """Return map / ellipsoid along the meridian and along the parallel, over 200 m each.

    Measured, not taken from the projection's formulas: those of pseudo-Mercator pretend that the
    earth is a sphere.
    """
    from pyproj import Transformer

    geod = crs.get_geod()
    project = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True)
    unit = float(crs.axis_info[0].unit_conversion_factor)
    scales = []
    for azimuth in (0.0, 90.0):
        ends = [geod.fwd(longitude, latitude, azimuth + turn, _STEP_M)[:2] for turn in (0.0, 180.0)]
        first, second = (np.array(project.transform(*end)) for end in ends)
        scales.append(float(np.linalg.norm(first - second)) * unit / (2.0 * _STEP_M))
    return scales[0], scales[1]


def _mean_radius(crs: Any, latitude: float) -> float:
    """Return Gauss's mean radius of curvature, sqrt(M N), metres."""
    a, b = crs.ellipsoid.semi_major_metre, crs.ellipsoid.semi_minor_metre
    e2 = 1.0 - (b / a) ** 2
    sine = np.sin(np.radians(latitude))
    return float(a * np.sqrt(1.0 - e2) / (1.0 - e2 * sine * sine))


def grid_scale(wkt: str | None, place: ArrayLike) -> GridScale | None:
    """Return the combined factor of a map projection at a place.

    Parameters
    ----------
    wkt : str or None
        Reference system of the cloud, compound ones included.
    place : array_like, shape (3,)
        x (easting), y (northing), z in file units, as point clouds are stored: whatever the order
        of the system's own axes. A height above the geoid in place of one above the ellipsoid
        changes the factor by 16 ppm per 100 m.

    Returns
    -------
    GridScale or None
        None: no projection, or the place is not where it applies.
    """
    crs = _projection(wkt)
    x, y, z = (float(value) for value in np.asarray(place, dtype=float))
    if crs is None or not is_in_use(wkt, x, y):
        return None
    longitude, latitude = _to_degrees(crs, x, y)
    along, across = _point_scales(crs, longitude, latitude)
    point_scale = float(np.sqrt(along * across))
    height = z * units_of(wkt).unit_m[2]
    radius = _mean_radius(crs, latitude)
    height_factor = radius / (radius + height)
    return GridScale(
        factor=point_scale * height_factor,
        point_scale=point_scale,
        height_factor=height_factor,
        distortion=abs(along / across - 1.0),
        longitude=longitude,
        latitude=latitude,
        height_m=height,
        system=str(crs.name),
    )


def is_in_use(wkt: str | None, x: float, y: float) -> bool:
    """Say whether x (easting) and y (northing) lie where a projection is meant to be used.

    By its area of use (one degree of grace), else by a plausible point scale.
    """
    crs = _projection(wkt)
    if crs is None:
        return False
    longitude, latitude = _to_degrees(crs, x, y)
    if not np.isfinite([longitude, latitude]).all():
        return False
    area = crs.area_of_use
    if area is None:
        scales = np.array(_point_scales(crs, longitude, latitude))
        return bool(np.isfinite(scales).all() and np.abs(scales - 1.0).max() <= _PLAIN)
    east = (longitude - area.west + 180.0) % 360.0 - 180.0
    width = (area.east - area.west) % 360.0 or 360.0
    return bool(
        (-_MARGIN_DEG <= east <= width + _MARGIN_DEG or width > 358.0)
        and area.south - _MARGIN_DEG <= latitude <= area.north + _MARGIN_DEG
    )


def is_same_plan(one: str, other: str) -> bool:
    """Say whether two systems have one map, whatever their heights are counted from."""
    plans = _projection(one), _projection(other)
    if plans[0] is None or plans[1] is None:
        return False
    return is_same_crs(plans[0].to_wkt(), plans[1].to_wkt())


def axes_swapped(wkt: str | None, x: float, y: float) -> bool:
    """Say whether x holds the northing and y the easting: a mirror image of the site."""
    return _projection(wkt) is not None and not is_in_use(wkt, x, y) and is_in_use(wkt, y, x)


def projection_problem(wkt: str | None, place: ArrayLike, name: str) -> str | None:
    """Return why coordinates on this map cannot be registered, or None.

    Parameters
    ----------
    place : array_like, shape (3,)
        The middle of the cloud in file units.
    """
    x, y = (float(value) for value in np.asarray(place, dtype=float)[:2])
    if axes_swapped(wkt, x, y):
        return (
            f"{name} has its axes swapped: x = {x:.0f} is a northing and y = {y:.0f} an easting of "
            f"{units_of(wkt).name}, which mirrors the site. Export it with easting first, then "
            "northing."
        )
    scale = grid_scale(wkt, place)
    if scale is not None and scale.distortion > CONFORMAL:
        return (
            f"{name} is in {scale.system}, whose lengths depend on their direction (by "
            f"{100 * scale.distortion:.2g} %) and are {scale.point_scale:.4g} times the true ones. "
            "Reproject it to the survey projection of the site, such as its UTM zone."
        )
    return None
