"""Where a generated site lies on a map: rigid for the default system, exact for any projection."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from pydantic import Field

from dougong.params import Parameters
from dougong.typing import Points, Transform

EPSG_MAP = 4549
"""CGCS2000 / 3-degree Gauss-Kruger, central meridian 120 E. Near the meridian and near sea level
its map scale is 1 within a few ppm, so that a rigid truth is also what the CRS says."""
_REACH_M = 50.0


class Map(Parameters):
    """The map of the drone cloud."""

    epsg: int = EPSG_MAP
    """The default one is taken to be true to scale; any other is computed point by point."""
    easting_m: float | None = None
    """Of the site; by default as drawn, near the central meridian of a transverse Mercator."""
    northing_m: float | None = None
    height_m: float | None = Field(default=None, ge=-500, le=9000)
    """Of the site's ground above the ellipsoid; by default as drawn, 4 to 60 m."""
    heights_raised_m: float = 0.0
    """Added to the heights in the file, as by those above another surface (the geoid)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """From site coordinates (metres on the ground, z up) to map coordinates."""

    crs: str
    T_map_site: Transform
    """The similarity nearest to the map at the site's middle; rigid for the default map."""
    projection: Any = None
    """From (east, north, up) about the site's middle to the map; None: the map is rigid."""
    yaw_rad: float = 0.0

    @property
    def scale(self) -> float:
        """Lengths in plan on the map / on the ground."""
        return float(np.cbrt(np.linalg.det(self.T_map_site[:3, :3])))

    def at(self, points: Points) -> Points:
        """Return where site `points` (n, 3) lie on the map, exactly."""
        if self.projection is None:
            moved: Points = points @ self.T_map_site[:3, :3].T + self.T_map_site[:3, 3]
            return moved
        mapped: Points = self.projection(_turned(points, self.yaw_rad))
        return mapped


def _turned(points: Points, yaw_rad: float) -> Points:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned: Points = points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    return turned


def chart_of(wanted: Map, drawn: Transform) -> Chart:
    """Return the chart of a site whose place and turn were `drawn` (4, 4), rigid."""
    shift = np.array([wanted.easting_m, wanted.northing_m, wanted.height_m], dtype=float)
    rigid = drawn.copy()
    rigid[:3, 3] = np.where(np.isnan(shift), drawn[:3, 3], shift)
    if wanted.epsg == EPSG_MAP:
        rigid[2, 3] += wanted.heights_raised_m
        return Chart(crs=_wkt(wanted.epsg), T_map_site=rigid)
    place = (float(rigid[0, 3]), float(rigid[1, 3]), float(rigid[2, 3]))
    chart = Chart(
        crs=_wkt(wanted.epsg),
        T_map_site=np.eye(4),
        projection=_topocentric(wanted.epsg, place, wanted.heights_raised_m),
        yaw_rad=float(np.arctan2(rigid[1, 0], rigid[0, 0])),
    )
    return Chart(
        crs=chart.crs,
        T_map_site=_nearest_similarity(chart),
        projection=chart.projection,
        yaw_rad=chart.yaw_rad,
    )


def _topocentric(epsg: int, place: tuple[float, float, float], raised_m: float) -> Any:
    """Return the exact map from (east, north, up) metres about `place` to the system `epsg`."""
    from pyproj import CRS, Transformer

    crs = CRS.from_epsg(epsg)
    to_degrees = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    longitude, latitude = to_degrees.transform(place[0], place[1])
    shape = crs.get_geod()
    assert shape is not None  # every projected system has an ellipsoid
    ellipsoid = f"+a={shape.a!r} +b={shape.b!r}"
    site = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric {ellipsoid} +lon_0={longitude!r} "
        f"+lat_0={latitude!r} +h_0={place[2]!r} +step +inv +proj=cart {ellipsoid} "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    to_map = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True)

    def project(points: Points) -> Points:
        east, north, height = site.transform(points[:, 0], points[:, 1], points[:, 2])
        x, y = to_map.transform(east, north)
        return np.column_stack([x, y, height + raised_m])

    return project


def _nearest_similarity(chart: Chart) -> Transform:
    """Return the similarity with the chart's scale in plan and its turn, at the site's middle."""
    ends = np.vstack([np.eye(3), -np.eye(3), np.zeros((1, 3))]) * _REACH_M
    mapped = chart.at(ends)
    plan = ((mapped[:3] - mapped[3:6]) / (2.0 * _REACH_M)).T[:2, :2]
    turn = np.arctan2(plan[1, 0] - plan[0, 1], plan[0, 0] + plan[1, 1])
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = np.sqrt(np.linalg.det(plan)) * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    matrix[:3, 3] = mapped[6]
    return matrix


@cache
def _wkt(epsg: int) -> str:
    from pyproj import CRS

    return str(CRS.from_epsg(epsg).to_wkt())
