"""Pass-through: keep what lies in axis ranges, in a polygon in plan, and in a range of heights.

METHOD.md 1.4: after the cloth filter also by height above ground. Kernels are imported when called.
"""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from dougong._checks import as_points
from dougong._words import counted
from dougong.errors import InputError
from dougong.filters.ranks import ValueBlocks, at_rank, count_finite
from dougong.filters.selection import Selection
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

KIND: Literal["local", "two-pass", "global"] = "two-pass"

Range = tuple[float | None, float | None]
Ring = tuple[tuple[float, float], ...]

_LAYER_POINTS = 3
"""A layer above the building with fewer points than this is air."""
_LAYERS = 1_000_000
_STRAY_SHARE = 0.001


class PassThrough(Parameters):
    """Keep points that meet every condition given; without any, all are kept.

    Coordinates are in the frame of the points (`shifted` brings map coordinates there).
    """

    x_m: Range | None = None
    """Lowest and highest x, metres, inclusive; null leaves a side open."""
    y_m: Range | None = None
    """Lowest and highest y."""
    z_m: Range | None = None
    """Lowest and highest z. Ranges in x, y and z together make a box."""
    polygon: Ring | None = None
    """Corners (x, y) of an area in plan, metres, in either direction; even-odd rule."""
    holes: tuple[Ring, ...] = ()
    """Areas cut out of the polygon."""
    height_m: Range | None = None
    """Lowest and highest height above ground."""
    margin_below_ground_m: Annotated[float, Field(ge=0)] | None = None
    """Keep down to this far below the ground surface (the paper's 0.40 m)."""
    margin_above_top_m: Annotated[float, Field(ge=0)] | None = None
    """Keep up to this far above the building's robust top (the paper: 0.40; `robust_top`)."""

    @model_validator(mode="after")
    def _is_possible(self) -> "PassThrough":
        for name in ("x_m", "y_m", "z_m", "height_m"):
            low, high = getattr(self, name) or (None, None)
            if low is not None and high is not None and not low <= high:
                raise ValueError(f"{name} must ascend, got {low} > {high}. Swap the two.")
        rings = (*((self.polygon,) if self.polygon is not None else ()), *self.holes)
        if any(len(ring) < 3 for ring in rings):
            raise ValueError("a polygon and its holes need at least 3 corners each.")
        if self.holes and self.polygon is None:
            raise ValueError("holes need a polygon around them; give polygon as well.")
        return self

    @property
    def needs_height(self) -> bool:
        """Say whether a condition speaks of the height above ground."""
        given = (self.height_m, self.margin_below_ground_m, self.margin_above_top_m)
        return any(value is not None for value in given)

    def shifted(self, origin: ArrayLike) -> "PassThrough":
        """Return the same conditions in coordinates minus `origin` (3,)."""
        shift = np.asarray(origin, dtype=np.float64).tolist()

        def moved(ring: Ring) -> Ring:
            return tuple((x - shift[0], y - shift[1]) for x, y in ring)

        ranges = {
            name: tuple(None if end is None else end - by for end in given)
            for name, by in zip(("x_m", "y_m", "z_m"), shift, strict=True)
            if (given := getattr(self, name)) is not None
        }
        return self.model_copy(
            update={
                **ranges,
                "polygon": None if self.polygon is None else moved(self.polygon),
                "holes": tuple(moved(hole) for hole in self.holes),
            }
        )


def halo_m(params: PassThrough) -> float:
    """Return 0: every point is judged by itself (and the top, a global number)."""
    del params
    return 0.0


def robust_top(height_m: Values, layer_m: float = 0.4) -> float:
    """Return the height of the top of what stands on the ground, metres; NaN without any height.

    Layers of `layer_m` are climbed from the median height. The first empty one (fewer than three
    points) with at most 0.1 % of all points above it ends the building; an empty layer with more
    above it is a hidden wall under eaves. Finials and antennas count: nothing under them is
    missing.
    """
    return robust_top_of(lambda: (height_m,), layer_m)


def robust_top_of(height_m: ValueBlocks, layer_m: float = 0.4) -> float:
    """Return the `robust_top` of heights that come in blocks, passed over seven times."""
    known = count_finite(height_m)
    if known == 0:
        return float("nan")
    start = at_rank(height_m, known // 2)
    held = np.zeros(_LAYERS + 1, np.int64)
    for block in height_m():
        held += np.bincount(_layers(block, start, layer_m)[1], minlength=len(held))
    held = held[: int(np.flatnonzero(held)[-1]) + 1]
    beyond = held.sum() - np.cumsum(held)
    is_end = (held < _LAYER_POINTS) & (beyond <= _STRAY_SHARE * known)
    last = int(np.argmax(is_end)) if is_end.any() else len(held)
    top = start
    for block in height_m():
        above, layer = _layers(block, start, layer_m)
        top = max(top, float(above[layer < last].max(initial=start)))
    return top


def _layers(height_m: Values, start: float, layer_m: float) -> tuple[Values, Index]:
    """Return the known heights from `start` up and the layer that each lies in."""
    above = height_m[np.isfinite(height_m) & (height_m >= start)]
    return above, np.minimum((above - start) / layer_m, _LAYERS).astype(np.int64)


def _in_range(values: Values, ends: Range | None) -> Mask:
    low, high = ends or (None, None)
    is_in = np.ones(len(values), bool)
    if low is not None:
        is_in &= values >= low
    if high is not None:
        is_in &= values <= high
    return is_in


def _in_polygon(xyz: Points, polygon: Ring, holes: tuple[Ring, ...]) -> Mask:
    from dougong.kernels import polygons

    rings = [np.array(ring, dtype=np.float64) for ring in (polygon, *holes)]
    starts = np.cumsum([0, *(len(ring) for ring in rings)])
    corners = np.concatenate(rings)
    is_in = np.empty(len(xyz), bool)

    def task(start: int, stop: int) -> None:
        polygons.inside_rings(xyz, corners, starts, start, stop, is_in)

    for_blocks(len(xyz), 1 << 16, task)
    return is_in


def pass_through(
    points: ArrayLike,
    params: PassThrough | None = None,
    *,
    height_above_ground: ArrayLike | None = None,
    top_m: float | None = None,
) -> Selection:
    """Choose the points that meet every condition of `params`.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Metres.
    params : PassThrough
    height_above_ground : array_like, shape (n,), optional
        Metres, from the cloth filter; needed by conditions on height. Points where it is unknown
        (NaN) meet those conditions.
    top_m : float, optional
        The `robust_top` of the whole cloud, where `points` are a part of it.

    Returns
    -------
    Selection

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite, or a condition on height is asked for without a
        height of each.

    Notes
    -----
    Tile class: local, but for ``margin_above_top_m``, whose top is one number for the cloud.
    """
    p = params or PassThrough()
    xyz = as_points(points)
    is_kept = np.ones(len(xyz), bool)
    for axis, ends in enumerate((p.x_m, p.y_m, p.z_m)):
        is_kept &= _in_range(xyz[:, axis], ends)
    if p.polygon is not None:
        is_kept &= _in_polygon(xyz, p.polygon, p.holes)
    if not p.needs_height:
        return Selection(is_kept=is_kept)
    if height_above_ground is None:
        msg = (
            "a condition on the height above ground needs heights, got none. "
            "Run cloth_simulation first, or crop by z_m."
        )
        raise InputError(msg)
    height = np.asarray(height_above_ground, dtype=np.float64)
    if height.shape != (len(xyz),):
        raise InputError(f"height_above_ground must have shape ({len(xyz)},), got {height.shape}.")
    is_unknown = np.isnan(height)
    is_kept &= _in_heights(height, p, top_m) | is_unknown
    return Selection(is_kept=is_kept, notes=unknown_notes(int(is_unknown.sum())))


def unknown_notes(unknown: int) -> tuple[str, ...]:
    """Return what is to be said of so many points without a height."""
    have, were = ("has", "was") if unknown == 1 else ("have", "were")
    note = f"{counted(unknown)} {have} no known ground below and {were} not cropped by height"
    return (note,) if unknown else ()


def _in_heights(height: Values, p: PassThrough, top_m: float | None) -> Mask:
    is_in = _in_range(height, p.height_m)
    if p.margin_below_ground_m is not None:
        is_in &= height >= -p.margin_below_ground_m
    if p.margin_above_top_m is not None:
        top = robust_top(height) if top_m is None else top_m
        if not np.isnan(top):
            is_in &= height <= top + p.margin_above_top_m
    return is_in
