"""Ground and non-ground by a cloth laid under the cloud (CSF; Zhang et al. 2016).

The cloud is turned upside down and a grid of particles, tied by springs, falls on it; points
close to where the cloth comes to rest are ground. The cloud enters only through a raster of
heights and leaves through a height difference, so two passes over the points and one cloth do.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt

from dougong._checks import as_points
from dougong._words import of_all
from dougong.errors import InputError
from dougong.filters.extent import plan_box_of
from dougong.filters.low_outliers import LowOutliers, find_levels, is_low_outlier
from dougong.filters.selection import Selection
from dougong.kernels import cloth as cloth_kernels
from dougong.kernels import raster
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Blocks, Mask, Points, Values

KIND: Literal["local", "two-pass", "global"] = "two-pass"

UNKNOWN, NON_GROUND, GROUND = 0, 1, 2
"""Values of the attribute ``ground_class``."""

MAX_PARTICLES = 50_000_000
"""Largest cloth: about 2.5 GB while it falls."""

_GRAVITY = 0.2
_START_HEIGHT_M = 0.05  # above the highest point of the inverted cloud
_BUFFER = 2  # particles round the cloud
_SMALLEST_MOVE_M = 0.005
_SMALLEST_PATCH = 50  # hanging patches up to this many particles are left alone
_SINGLE_MOVE = (0.3, 0.51, 0.657)  # of rigidness 1, 2, 3: one end free
_DOUBLE_MOVE = (0.3, 0.42, 0.468)  # both ends free
_BLOCK = 1 << 18


class ClothSimulation(Parameters):
    """A cloth on the upside-down cloud (Zhang et al. 2016).

    `class_threshold_m` must exceed three times the sensor's noise plus slope x half of
    `cloth_resolution_m`, or good ground falls out of it: on a 20 % slope and 0.5 m cloth that is
    0.05 m before any noise. A terrestrial scanner (noise 2-5 mm) does with 0.1 m, a drone's
    photogrammetry (10-30 mm) wants 0.15-0.3 m. A flat roof wider than about 80 x
    `cloth_resolution_m` and 4 m high is reached by the cloth and becomes ground, wall to wall
    where slopes are smoothed: take a coarser cloth, or set `height_threshold_m`.
    """

    cloth_resolution_m: Annotated[float, Field(gt=0)] = 0.5
    """Distance between particles, metres. Smaller follows steps and podium edges more closely,
    costs 1/resolution^2, and sinks into large roofs' middles sooner."""
    rigidness: Annotated[int, Field(ge=1, le=3)] = 1
    """Stiffness of the springs: 1 relief, terraces, courtyards, moats; 3 flat ground with large
    buildings. On 15 labelled sites 1 misses least, and roofs are found as well as with 3."""
    time_step: Annotated[float, Field(gt=0)] = 0.65
    """Length of a step in the simulation's own unit; gravity moves a particle 0.2 time_step^4
    metres more in each."""
    iterations: Annotated[int, Field(ge=1)] = 500
    """Most steps made; fewer when nothing moves by 5 mm any more."""
    class_threshold_m: Annotated[float, Field(gt=0)] = 0.5
    """Points closer to the cloth than this are ground (the paper's H), metres."""
    slope_smoothing: bool = True
    """Lay hanging parts of the cloth down where the ground beside them goes on in small steps."""
    smooth_threshold_m: Annotated[float, Field(gt=0)] = 0.3
    """Slope smoothing: the largest step between neighbouring particles that it follows, metres."""
    height_threshold_m: Annotated[float, Field(gt=0)] = 9999.0
    """Slope smoothing: particles hanging higher than this stay where they are, metres. Set it to
    the lowest eave height where large roofs are reached by ramps or slopes."""
    particle_height: Literal["nearest", "lowest"] = "nearest"
    """What a particle collides with: the point nearest to it in plan (the published
    implementation), or the lowest point of its cell."""
    support_distance_m: Annotated[float, Field(gt=0)] | None = 30.0
    """Points farther in plan than this from any particle that rests on data are `unknown`:
    the cloth under them is a guess. None: no limit."""
    guard: LowOutliers | None = LowOutliers()
    """Points that this finds below the ground do not carry the cloth. None: every point does, and
    one stray point below the ground lifts it (the published implementation)."""
    keep: Literal["all", "ground", "non_ground"] = "all"
    """Which points the selection keeps; `unknown` ones stay with "all" only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloth:
    """A cloth at rest: the surface of the ground, particle by particle."""

    origin: Values
    """(3,), local metres: where particle (0, 0) stands, and the zero of `height`."""
    resolution_m: float
    """Distance between particles."""
    height: NDArray[np.float64]
    """(rows along y, columns along x), upright heights above origin[2], metres."""
    is_supported: NDArray[np.bool_]
    """(rows, columns), True within `support_distance_m` of a particle that rests on data."""
    steps: int
    """Simulation steps made."""

    def height_above(self, points: Points) -> Values:
        """Return the height of `points` (n, 3) above the cloth: (n,), metres.

        Positive above, negative below; NaN outside the cloth and where it has no support.
        """
        out = np.empty(len(points))

        def block(start: int, stop: int) -> None:
            cloth_kernels.heights_above(
                points[start:stop], self.origin, self.resolution_m, self.height, out[start:stop]
            )
            if not self.is_supported.all():
                raster.blank_unsupported(
                    points[start:stop],
                    self.origin,
                    self.resolution_m,
                    self.is_supported,
                    out[start:stop],
                )

        for_blocks(len(points), _BLOCK, block)
        return out


def halo_m(params: ClothSimulation) -> float:
    """Return 0: the cloth is global, and classification needs no neighbours."""
    del params
    return 0.0


def cloth_simulation(points: Points, params: ClothSimulation | None = None) -> Selection:
    """Tell ground from everything else.

    Parameters
    ----------
    points
        (n, 3), metres, z up, in a local frame.
    params
        See `ClothSimulation`.

    Returns
    -------
    Selection
        Attributes: ``is_ground`` (uint8, 0 or 1); ``height_above_ground`` (float64, metres above
        the cloth, negative below it, NaN where the cloth is outside or unsupported);
        ``ground_class`` (uint8: 0 unknown, 1 non-ground, 2 ground).

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite, the cloth would have more than `MAX_PARTICLES`
        particles, or `guard` would need too many cells.
    """
    params = params or ClothSimulation()
    points = as_points(points)
    if len(points) == 0:
        return _selection(np.empty(0), params, ())
    cloth, low = guarded_cloth(lambda: (points,), len(points), params)
    found = classify(points, cloth, params)
    lost = int((found.attributes["ground_class"] == UNKNOWN).sum())
    return replace(found, notes=cloth_notes(low, lost, len(points)))


def cloth_notes(low: int, lost: int, points: int) -> tuple[str, ...]:
    """Return what is to be said where of all `points` so many are low, and without a height."""
    notes: tuple[str, ...] = ()
    if low:
        said = of_all(low, points, "lies", "lie")
        notes = (f"{said} below the ground, which is laid without them; they stay",)
    if lost:
        said = of_all(lost, points, "is", "are")
        notes += (f"{said} too far from any ground for a height",)
    return notes


def guarded_cloth(blocks: Blocks, points: int, params: ClothSimulation) -> tuple[Cloth, int]:
    """Return the cloth under a cloud of so many `points` (>= 1) that comes in blocks.

    Points that ``params.guard`` finds below the ground do not carry it; they are counted. Some
    passes over the blocks; about 60 bytes per particle.
    """
    if params.guard is None:
        return lay_cloth_under(blocks, points, params), 0
    levels = find_levels(blocks, points, params.guard)
    # A bit per point spares the passes below from asking again.
    bits_of = [np.packbits(is_low_outlier(block, levels)) for block in blocks()]
    low = sum(int(np.bitwise_count(bits).sum()) for bits in bits_of)

    def carriers() -> Iterator[Points]:
        for block, bits in zip(blocks(), bits_of, strict=True):
            is_carrier = ~np.unpackbits(bits, count=len(block)).view(np.bool_)
            yield block[is_carrier] if bits.any() else block

    return lay_cloth_under(carriers if low else blocks, points - low, params), low


def classify(points: Points, cloth: Cloth, params: ClothSimulation) -> Selection:
    """Return the class of some `points` (n, 3) of the cloud that `cloth` lies under."""
    return _selection(cloth.height_above(points), params, ())


def _selection(heights: Values, params: ClothSimulation, notes: tuple[str, ...]) -> Selection:
    is_known = ~np.isnan(heights)
    is_ground = np.zeros(len(heights), np.bool_)
    is_ground[is_known] = np.abs(heights[is_known]) < params.class_threshold_m
    kept: dict[str, Mask] = {
        "all": np.ones(len(heights), np.bool_),
        "ground": is_ground,
        "non_ground": is_known & ~is_ground,
    }
    ground_class = np.where(is_known, np.where(is_ground, GROUND, NON_GROUND), UNKNOWN)
    return Selection(
        is_kept=kept[params.keep],
        attributes={
            "is_ground": is_ground.astype(np.uint8),
            "height_above_ground": heights,
            "ground_class": ground_class.astype(np.uint8),
        },
        notes=notes,
    )


def lay_cloth(points: Points, params: ClothSimulation) -> Cloth:
    """Return the cloth that comes to rest under `points` (n >= 1, 3); all of them carry it.

    Raises
    ------
    InputError
        The cloth would have more than `MAX_PARTICLES` particles.
    """
    return lay_cloth_under(lambda: (points,), len(points), params)


def lay_cloth_under(blocks: Blocks, points: int, params: ClothSimulation) -> Cloth:
    """Return the cloth of `lay_cloth` under a cloud of so many `points` that comes in blocks."""
    cell = params.cloth_resolution_m
    low, high, lowest = plan_box_of(blocks, points)
    shape = _shape(low, high, cell)
    origin = np.append(low - _BUFFER * cell, lowest)
    heights, best = np.full(shape, np.nan), np.full(shape, np.inf)
    for block in blocks():
        if params.particle_height == "nearest":
            raster.nearest_heights(block, origin, cell, best, heights)
        else:
            raster.lowest_heights(block, origin, cell, heights)
    has_data = ~np.isnan(heights)
    surface = -_filled(heights, has_data)
    height = np.empty(shape)
    is_landed = np.empty(shape, np.bool_)
    steps = cloth_kernels.drop_cloth(
        surface,
        _START_HEIGHT_M,
        _GRAVITY * params.time_step**4,
        _SINGLE_MOVE[params.rigidness - 1],
        _DOUBLE_MOVE[params.rigidness - 1],
        params.iterations,
        _SMALLEST_MOVE_M,
        height,
        is_landed,
    )
    if params.slope_smoothing:
        cloth_kernels.smooth_slopes(
            surface,
            params.smooth_threshold_m,
            params.height_threshold_m,
            _SMALLEST_PATCH,
            height,
            is_landed,
        )
    return Cloth(
        origin=origin,
        resolution_m=cell,
        height=-height,
        is_supported=_supported(is_landed & has_data, params),
        steps=steps,
    )


def _shape(low: Values, high: Values, cell: float) -> tuple[int, int]:
    """Return (rows, columns) of the cloth over a plan box, or refuse a cloth too large."""
    columns, rows = (np.floor((high - low) / cell) + 2 * _BUFFER).astype(np.int64)
    # In floats, since a product of two absurd sizes must not wrap round.
    if float(rows) * float(columns) > MAX_PARTICLES:
        width, depth = high - low
        advised = cell * np.sqrt(float(rows) * float(columns) / MAX_PARTICLES)
        msg = (
            f"the cloth would have {float(rows) * float(columns):.3g} particles for "
            f"{width:.0f} x {depth:.0f} m at {cell:g} m; at most {MAX_PARTICLES:.3g} are possible. "
            f"Set cloth_resolution_m to {advised * 1.01:.2g} or more, or crop the cloud; "
            "name the unit of coordinates in millimetres (--crs mm)."
        )
        raise InputError(msg)
    return int(rows), int(columns)


def _filled(heights: NDArray[np.float64], has_data: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return `heights` with empty cells filled along row or column, corners from the nearest."""
    out = np.empty_like(heights)
    cloth_kernels.fill_empty(heights, out)
    is_empty = np.isnan(out)
    if is_empty.any():
        nearest = distance_transform_edt(~has_data, return_distances=False, return_indices=True)
        out[is_empty] = heights[tuple(nearest)][is_empty]
    return out


def _supported(rests_on_data: NDArray[np.bool_], params: ClothSimulation) -> NDArray[np.bool_]:
    if params.support_distance_m is None:
        return np.ones_like(rests_on_data)
    if not rests_on_data.any():
        return np.zeros_like(rests_on_data)
    distance = distance_transform_edt(~rests_on_data, sampling=params.cloth_resolution_m)
    return np.asarray(distance <= params.support_distance_m)
