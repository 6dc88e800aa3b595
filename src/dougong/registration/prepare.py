"""Make a cloud ready for registration: the same few facts about every cloud, raw or filtered."""

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from dougong._checks import as_points
from dougong._sorting import distinct
from dougong._words import counted, of_all
from dougong.cloud import Cloud
from dougong.errors import RegistrationError
from dougong.filters.cloth_simulation import ClothSimulation, cloth_simulation
from dougong.filters.curvature_weighted import curvature_weighted
from dougong.filters.low_outliers import low_outliers
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid
from dougong.params import Parameters
from dougong.registration.cleaning import extent, far_points, isolated_points, sensor_noise
from dougong.registration.levelling import Levelling, levelling, rotation_to_vertical
from dougong.registration.orientation import sides, sights
from dougong.registration.surface import surface
from dougong.typing import Index, Kind, Mask, Points, Values

MIN_POINTS = 100
FEW_STRAYS = 0.05
"""So few of the thinned points off every surface are not dropped: they outvote nothing."""


class Prepare(Parameters):
    """How a cloud is cleaned, thinned and described before it is registered."""

    min_spacing_m: Annotated[float, Field(gt=0)] = 0.05
    """The working spacing is the cloud's own median spacing, but not finer than this."""
    max_points: Annotated[int, Field(ge=10_000)] = 600_000
    """The working spacing grows until at most this many points remain."""
    normal_neighbours: Annotated[int, Field(ge=4)] = 16
    """Points per local plane."""
    is_filtered: bool = False
    """True: the cloud is clean already; nothing is dropped as far, isolated or below the ground."""
    tilt_tolerance_deg: Annotated[float, Field(gt=0)] = 0.6
    """Tilts up to this are left to the fine registration; larger ones that the walls prove are
    taken out before the ground is looked for."""
    max_tilt_deg: Annotated[float, Field(gt=0)] = 6.0
    """A cloud tilted by more than this is refused: z is not up."""
    ground_threshold_m: Annotated[float, Field(gt=0)] | None = None
    """Distance from the cloth that still is ground; by default 0.15 m plus 4 sigma of noise."""
    min_ground_share: Annotated[float, Field(ge=0, le=1)] = 0.03
    """Less ground than this share of the occupied plan area: heights are counted from the
    lowest points instead, and a note says so."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thinned:
    """A cloud cleaned and thinned, before anything is said of its surfaces."""

    cloud: Cloud
    kept: Index
    """(n,) which of its points are left."""
    sigma_m: float
    """Noise of one measured point across its surface (one standard deviation)."""
    notes: tuple[str, ...]

    def without_strays(self) -> "Thinned":
        """Return the cloud without points off every surface; itself where these are few.

        Thinning keeps a stray alone in its voxel and one of the many points of a surface, so it
        gathers strays, also those that a filter left: 4 % of a flight were 11 % of its thinned
        cloud and half of what the verdict heard. Where strays are few, the rule takes as much that
        holds the pose (a gate, steps): asked of every pair, it made one in ten of the right answers
        ambiguous.
        """
        points = as_points(self.cloud.xyz)
        strays = ~curvature_weighted(points[self.kept]).is_kept
        count, left = len(self.kept), len(self.kept) - int(strays.sum())
        if left >= (1.0 - FEW_STRAYS) * count or left < MIN_POINTS:
            return self
        said = of_all(int(strays.sum()), count, "stands", "stand", "thinned point")
        note = f"{said} off every surface: dropped"
        return replace(self, kept=self.kept[~strays], notes=(*self.notes, note))


@dataclass(frozen=True, slots=True, weakref_slot=True, kw_only=True, eq=False)
class Prepared:
    """A cloud as the registration sees it: thinned, with normals, ground and noise."""

    xyz: Points
    """(n, 3) metres, in the local frame of the cloud it was made from."""
    normals: Points
    """(n, 3) unit."""
    normal_is_oriented: Mask | bool
    """(n,), or one for all. True: the normal points to the side that was seen, see `orientation`;
    False: its sign means nothing."""
    planarity: Values
    """(n,) 1 - 3 l3 / (l1 + l2 + l3) of the local plane: 1 is a plane."""
    is_ground: Mask
    """(n,)"""
    height_above_ground: Values
    """(n,) metres; from the lowest points where no ground was found (`has_ground` False)."""
    weights_area: Values
    """(n,) square metres that each point stands for."""
    spacing_m: float
    """Median distance to the nearest neighbour."""
    sigma_m: float
    """Noise of one measured point across its surface (one standard deviation)."""
    kind: Kind
    may_be_underside: Mask | bool = False
    """(n,), or one for all: a roof overhead of which nobody knows the side, see `orientation`."""
    side_is_unknown: Mask | bool = False
    """(n,), or one for all: the same, and also where nothing tells that it may be an underside."""
    seen_from: Points | None = None
    """(n, 3) where the scanner of each point stood, NaN where unknown; None: unknown for all."""
    has_ground: bool = True
    levelling: Levelling = field(default_factory=Levelling)
    """What the walls say about z; `levelling.up` is trusted only where `is_relevelled`."""
    is_relevelled: bool = False
    """True: the walls proved a tilt, heights were measured along `up` instead of z."""
    notes: tuple[str, ...] = ()

    @property
    def up(self) -> Values:
        """Return the vertical (3,) to search with: z, or what the walls proved."""
        return self.levelling.up if self.is_relevelled else np.array([0.0, 0.0, 1.0])

    @property
    def is_unsure_roof(self) -> Mask:
        """Return `side_is_unknown` (n,) of every point."""
        is_unsure: Mask = np.broadcast_to(self.side_is_unknown, len(self.xyz))
        return is_unsure

    def chosen(self, is_chosen: Mask) -> "Prepared":
        """Return the cloud with the chosen (n,) of its points only."""
        per_point: dict[str, Any] = {
            item.name: value[is_chosen]
            for item in fields(self)
            if isinstance(value := getattr(self, item.name), np.ndarray)
        }
        return replace(self, **per_point)


def prepare(cloud: Cloud, kind: Kind, params: Prepare | None = None) -> Prepared:
    """Clean, thin and describe `cloud`; its own coordinates and records stay as they are.

    Drops points far from all others and isolated ones, thins to the working spacing (original
    points, never averages), then finds noise, normals, the vertical and the ground.

    Raises
    ------
    RegistrationError
        Fewer than 100 points remain, or the walls prove that z is not up.

    Notes
    -----
    Deterministic; independent of the order of the points and of the origin of the frame.
    """
    params = params or Prepare()
    return describe(thin(cloud, params), kind, params)


def thin(cloud: Cloud, params: Prepare) -> Thinned:
    """Clean and thin `cloud`, the first half of `prepare`."""
    points = as_points(cloud.xyz)
    _check_count(len(points), cloud.name)
    notes: list[str] = []
    kept = _clean(points, params, notes)
    _check_count(len(kept), cloud.name)
    sigma = sensor_noise(points[kept])
    kept = kept[_thin(points[kept], params)]
    return Thinned(cloud=cloud, kept=kept, sigma_m=sigma, notes=tuple(notes))


def describe(thinned: Thinned, kind: Kind, params: Prepare) -> Prepared:
    """Find normals, the vertical and the ground of a thinned cloud, the other half of `prepare`."""
    cloud, kept, sigma, notes = thinned.cloud, thinned.kept, thinned.sigma_m, [*thinned.notes]
    xyz = as_points(cloud.xyz)[kept]
    _check_count(len(xyz), cloud.name)
    plane = surface(xyz, params.normal_neighbours)
    spacing = plane.spacing_m
    is_flat = plane.planarity > 0.9
    # Thin far ground must not outvote what was measured well.
    area = np.minimum(plane.area_m2, (4.0 * spacing) ** 2)
    upright = levelling(xyz, plane.normals, np.where(is_flat, area, 0.0))
    is_relevelled = _check_tilt(upright, params, cloud.name, notes)
    level = xyz @ rotation_to_vertical(upright.up).T if is_relevelled else xyz
    ground = _ground(level, sigma, params, notes)
    stays = ground.stays
    up = upright.up if is_relevelled else np.array([0.0, 0.0, 1.0])
    seen_from = sights(cloud, kept)
    seen = sides(
        plane.normals,
        xyz,
        plane.planarity,
        ground.height if ground.is_found else np.full(len(xyz), np.nan),
        ground.is_ground,
        up,
        kind,
        spacing,
        seen_from,
    )
    return Prepared(
        xyz=np.ascontiguousarray(xyz[stays]),
        normals=seen.normals[stays],
        normal_is_oriented=seen.is_sure[stays],
        may_be_underside=seen.may_be_underside[stays],
        side_is_unknown=seen.is_unknown[stays],
        planarity=plane.planarity[stays],
        is_ground=ground.is_ground[stays],
        height_above_ground=ground.height[stays],
        weights_area=area[stays],
        spacing_m=spacing,
        sigma_m=sigma,
        kind=kind,
        seen_from=None if seen_from is None else seen_from[stays],
        has_ground=ground.is_found,
        levelling=upright,
        is_relevelled=is_relevelled,
        notes=tuple(notes),
    )


def _check_count(count: int, name: str) -> None:
    if count < MIN_POINTS:
        msg = (
            f"{name} has too few usable points ({count}); at least {MIN_POINTS} are needed to look "
            "for a pose. Check that the right file was given (`dougong info`)."
        )
        raise RegistrationError(msg)


def _clean(points: Points, params: Prepare, notes: list[str]) -> Index:
    """Return which points are neither far away nor alone."""
    everything = np.arange(len(points), dtype=np.int64)
    if params.is_filtered:
        return everything
    kept = everything[~far_points(points)]
    if len(kept) < len(points):
        far = of_all(len(points) - len(kept), len(points), "lies", "lie")
        notes.append(f"{far} far off: dropped")
    is_alone = isolated_points(points[kept])
    if is_alone.any():
        alone = of_all(int(is_alone.sum()), len(points), "stands", "stand")
        notes.append(f"{alone} alone: dropped")
    return kept[~is_alone]


def _thin(points: Points, params: Prepare) -> Index:
    """Return the points nearest the centres of voxels of the working spacing."""
    voxel = params.min_spacing_m
    while True:
        chosen = octree_voxel_grid(points, OctreeVoxelGrid(voxel_m=voxel)).is_kept
        count = int(chosen.sum())
        if count <= params.max_points:
            return np.flatnonzero(chosen).astype(np.int64)
        # Points lie on surfaces: their number falls with the square of the spacing.
        voxel *= max(1.05, 1.02 * np.sqrt(count / params.max_points))


def _check_tilt(upright: Levelling, params: Prepare, name: str, notes: list[str]) -> bool:
    """Say whether to level by the walls; refuse what cannot be levelled."""
    if upright.is_tilted(params.max_tilt_deg):
        msg = (
            f"{name} is not levelled: its walls lean {upright.tilt_deg:.1f} deg from z, at most "
            f"{params.max_tilt_deg:g} deg can be handled. Level the scan, or export it with z up."
        )
        raise RegistrationError(msg)
    if upright.is_tilted(params.tilt_tolerance_deg):
        notes.append(
            f"z leans {upright.tilt_deg:.2f} +- {upright.sigma_deg:.2f} deg from the walls: "
            "levelled by the walls"
        )
        return True
    return False


class _Ground(NamedTuple):
    is_ground: Mask
    height: Values
    stays: Mask
    """False for points below the ground that no surface explains."""
    is_found: bool


def _ground(level: Points, sigma_m: float, params: Prepare, notes: list[str]) -> _Ground:
    """Lay the cloth under the levelled cloud, without what lies impossibly low."""
    stays = np.ones(len(level), dtype=bool)
    if not params.is_filtered:
        stays = low_outliers(level).is_kept
        if not stays.all():
            below = counted(int((~stays).sum()), "thinned point")
            notes.append(f"{below} below the ground: dropped")
    threshold = params.ground_threshold_m or 0.15 + 4.0 * sigma_m
    found = cloth_simulation(level[stays], ClothSimulation(class_threshold_m=threshold))
    is_ground = np.zeros(len(level), dtype=bool)
    height = np.full(len(level), np.nan)
    is_ground[stays] = found.attributes["is_ground"].astype(bool)
    height[stays] = found.attributes["height_above_ground"]
    cell = np.floor((level[:, :2] - extent(level)[0][:2]) / 1.0).astype(np.int64)
    flat = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    share = len(distinct(flat[is_ground])) / len(distinct(flat))
    is_known = np.isfinite(height)
    if share < params.min_ground_share or not is_known.any():
        notes.append(
            f"ground covers only {100 * share:.1f} % of the plan: heights counted from the lowest "
            "points"
        )
        low = float(np.quantile(level[stays, 2], 0.01))
        return _Ground(np.zeros(len(level), dtype=bool), level[:, 2] - low, stays, False)
    # Where the cloth hangs without support the typical ground is the best guess.
    low = float(np.median((level[:, 2] - height)[is_known]))
    return _Ground(is_ground, np.where(is_known, height, level[:, 2] - low), stays, True)
