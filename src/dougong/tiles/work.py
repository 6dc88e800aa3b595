"""The tasks: what a filter does on one tile. Each reads files, writes none and returns arrays.

A task is a function of a module and its job is small, so any process that sees the folder can do
it. Of the points of a tile and its halo only those that a stage is asked about are read.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import are_within, corners_of
from dougong.errors import InputError
from dougong.filters import clutter_search
from dougong.filters.cloth_simulation import UNKNOWN, Cloth, ClothSimulation, classify
from dougong.filters.clutter import Clutter, clutter
from dougong.filters.clutter import halo_m as clutter_halo_m
from dougong.filters.curvature_weighted import (
    CurvatureWeighted,
    curvature_weighted,
    own_totals,
)
from dougong.filters.curvature_weighted import halo_m as curvature_halo_m
from dougong.filters.curvature_weighted import judge_protective as judge_rule
from dougong.filters.low_outliers import Levels, is_low_outlier
from dougong.filters.neighbourhood import build_index, knn
from dougong.filters.pass_through import PassThrough, pass_through
from dougong.filters.protective import Whole
from dougong.filters.protective import halo_m as protective_halo_m
from dougong.filters.radius import Radius, radius
from dougong.filters.selection import DETAILS, Reason, Selection, details_of
from dougong.filters.statistical import (
    Statistical,
    mean_and_largest,
    mean_distances,
    nearest_distances,
    select_near,
)
from dougong.filters.totals import Totals
from dougong.params import Parameters
from dougong.tiles.cloud import (
    INDEX,
    POINTS,
    Arrays,
    Record,
    Tile,
    TiledCloud,
    load_tiles,
    read_arrays,
    read_file,
)
from dougong.tiles.folder import Folder
from dougong.typing import Mask, Points, Values

Among = Literal["left", "off_ground"]
_STATE = ("code", "ground", "height", *DETAILS)
_GROUND = 2


@dataclass(frozen=True, slots=True)
class Job:
    """A stage on one tile."""

    folder: Folder
    tile: Tile
    before: str
    """Key of the stage whose state it starts from; empty: every point is left."""
    params: Parameters
    among: Among = "left"
    asked: int = 0
    """Points of the whole cloud that the stage is asked about."""
    known: Any = None
    """What the stage knows of the whole cloud, or the file where it is."""


class Part(NamedTuple):
    """The points of a tile that a stage is asked about, and its halo."""

    points: Points
    own: int
    """The first so many are the tile's own."""
    voxel_count: NDArray[np.int32] | None
    height: Values | None
    """Above the ground, where the cloth has been."""


def state_of(folder: Folder, tile: Tile, stage: str) -> Arrays:
    """Return the codes of a tile's points and what else is known of them after a stage."""
    if not stage:
        zeros = np.zeros(tile.points, np.uint8)
        return {"code": zeros, "ground": zeros.copy()}
    held = read_arrays(folder, tile, stage)
    return {name: held[name] for name in _STATE if name in held}


def is_asked(state: Arrays, among: Among) -> Mask:
    """Return which points of a tile a stage is asked about."""
    asked: Mask = state["code"] == Reason.KEPT
    return asked if among == "left" else asked & (state["ground"] != _GROUND)


def asked_points(job: Job, tile: Tile) -> Points:
    """Return the points of a tile that the stage is asked about."""
    xyz: Points = read_arrays(job.folder, tile, POINTS, "xyz")["xyz"]
    chosen = is_asked(state_of(job.folder, tile, job.before), job.among)
    return xyz if chosen.all() else xyz[chosen]


def _cloud(job: Job) -> TiledCloud:
    return _read_tiles(job.folder, job.folder.stamp(INDEX))


@lru_cache(4)
def _read_tiles(folder: Folder, stamp: Hashable) -> TiledCloud:
    """Return the tiles of a folder, read once: a cloud may have thousands."""
    del stamp
    cloud = load_tiles(folder)
    assert cloud is not None
    return cloud


def _with_halo(job: Job, halo_m: float) -> Part:
    points, counts, heights = [], [], []
    for tile in (job.tile, *_cloud(job).near(job.tile, halo_m)):
        held = read_arrays(job.folder, tile, POINTS)
        state = state_of(job.folder, tile, job.before)
        chosen = is_asked(state, job.among)
        if tile != job.tile:
            chosen &= _in_box(held["xyz"], job.tile, halo_m)
        points.append(held["xyz"][chosen])
        if "voxel_count" in held:
            counts.append(held["voxel_count"][chosen])
        if "height" in state:
            heights.append(state["height"][chosen])
    return Part(
        points=np.ascontiguousarray(np.concatenate(points)),
        own=len(points[0]),
        voxel_count=np.concatenate(counts) if counts else None,
        height=np.concatenate(heights) if heights else None,
    )


def _in_box(xyz: Points, tile: Tile, wider_m: float) -> Mask:
    return are_within(xyz, np.array(tile.low) - wider_m, np.array(tile.high) + wider_m)


def _own(selection: Selection, own: int) -> Selection:
    """Return the part of a selection that is not halo."""
    return Selection(
        is_kept=selection.is_kept[:own],
        attributes={name: values[:own] for name, values in selection.attributes.items()},
    )


def _booked(
    job: Job, selection: Selection, reason: Reason, **more: NDArray[Any]
) -> tuple[Arrays, Record]:
    """Return the state of the tile after a stage, and its counts."""
    state = state_of(job.folder, job.tile, job.before)
    left = int((state["code"] == Reason.KEPT).sum())
    places = np.flatnonzero(is_asked(state, job.among))
    state["code"][places[~selection.is_kept]] = reason
    for name, values in details_of(selection).items():
        state.setdefault(name, np.zeros(job.tile.points, values.dtype))[places] = values
    taken = int(np.count_nonzero(~selection.is_kept))
    return {**state, **more}, {"left": left, "asked": len(places), "taken": taken}


def judge_low(job: Job) -> tuple[Arrays, Record]:
    """Low outliers; known: the file of the levels."""
    is_low = is_low_outlier(asked_points(job, job.tile), load_levels(job.folder, job.known))
    return _booked(job, Selection(is_kept=~is_low), Reason.LOW_OUTLIER)


def judge_cloth(job: Job) -> tuple[Arrays, Record]:
    """Ground or not; known: the file of the cloth."""
    assert isinstance(job.params, ClothSimulation)
    found = classify(asked_points(job, job.tile), load_cloth(job.folder, job.known), job.params)
    arrays, record = _booked(job, found, Reason.CLOTH)
    places = np.flatnonzero(is_asked(state_of(job.folder, job.tile, job.before), job.among))
    arrays["ground"][places] = found.attributes["ground_class"]
    arrays["height"] = np.full(job.tile.points, np.nan)
    arrays["height"][places] = found.attributes["height_above_ground"]
    lost = int((found.attributes["ground_class"] == UNKNOWN).sum())
    return arrays, {**record, "lost": lost}


def judge_radius(job: Job) -> tuple[Arrays, Record]:
    """Too few neighbours in a ball."""
    assert isinstance(job.params, Radius)
    part = _with_halo(job, job.params.radius_m)
    return _booked(job, _own(radius(part.points, job.params), part.own), Reason.RADIUS)


def count_lines(job: Job) -> tuple[Arrays, Record]:
    """Count the high points of a tile, and those of them on thin lines."""
    assert isinstance(job.params, Clutter)
    part = _with_halo(job, clutter_search.LINES_HALO_M + job.params.gap_most_m)
    high, on_lines = clutter_search.count_lines(part.points, _height(part), job.params, part.own)
    return {}, {"high": high, "on_lines": on_lines}


def _height(part: Part) -> Values:
    if part.height is None:
        msg = "clutter needs heights above the ground; run cloth_simulation before it."
        raise InputError(msg)
    return part.height


def judge_clutter(job: Job) -> tuple[Arrays, Record]:
    """Offer what stands about, or take it out; known: whether thin lines are the scanner's rows."""
    assert isinstance(job.params, Clutter)
    part = _with_halo(job, clutter_halo_m(job.params))
    whole = clutter_search.Whole(part.own, job.known)
    found = clutter(part.points, job.params, height_above_ground=_height(part), whole=whole)
    arrays, record = _booked(job, _own(found, part.own), Reason.CLUTTER)
    return arrays, {**record, "found": dict(found.found)}


def judge_statistical(job: Job) -> tuple[Arrays, Record]:
    """Too far from the neighbours; known: the stage of the mean distances, and the cut."""
    stage, cut = job.known
    mean_m = read_arrays(job.folder, job.tile, stage, "mean")["mean"]
    return _booked(job, select_near(mean_m, cut), Reason.STATISTICAL)


def judge_pass_through(job: Job) -> tuple[Arrays, Record]:
    """Ranges, polygons and heights; known: the robust top of the whole cloud or None."""
    assert isinstance(job.params, PassThrough)
    state = state_of(job.folder, job.tile, job.before)
    height = state["height"][is_asked(state, job.among)] if "height" in state else None
    found = pass_through(
        asked_points(job, job.tile), job.params, height_above_ground=height, top_m=job.known
    )
    arrays, record = _booked(job, found, Reason.PASS_THROUGH)
    is_needed = job.params.needs_height and height is not None
    unknown = int(np.isnan(state["height"][is_asked(state, job.among)]).sum()) if is_needed else 0
    return arrays, {**record, "unknown": unknown}


def judge_curvature(job: Job) -> tuple[Arrays, Record]:
    """CWASF, rules paper and global; known: the totals of rule global, or None."""
    assert isinstance(job.params, CurvatureWeighted)
    part = _with_halo(job, curvature_halo_m(job.params))
    found = curvature_weighted(
        part.points,
        job.params,
        voxel_count=part.voxel_count,
        whole=None if job.known is None else Totals(*job.known),
    )
    return _booked(job, _own(found, part.own), Reason.CURVATURE_WEIGHTED)


def count_curvature(job: Job) -> tuple[Arrays, Record]:
    """Count what a tile adds to the statistics of CWASF's rule global."""
    assert isinstance(job.params, CurvatureWeighted)
    part = _with_halo(job, curvature_halo_m(job.params))
    totals = own_totals(part.points, job.params, part.own)
    return {}, {"totals": [totals.count, totals.total, totals.squares]}


def judge_protective(job: Job) -> tuple[Arrays, Record]:
    """CWASF, rule protective; known: a `Whole`, whose own is not filled in."""
    assert isinstance(job.params, CurvatureWeighted)
    assert isinstance(job.known, Whole)
    part = _with_halo(job, protective_halo_m(job.known.reach_m))
    whole = job.known._replace(own=part.own)
    found, groups = judge_rule(part.points, job.params, part.voxel_count, whole)
    own = _own(found, part.own)
    arrays, record = _booked(
        job,
        own,
        Reason.CURVATURE_WEIGHTED,
        curvature=own.attributes["curvature"],
        spacing=own.attributes["spacing_m"],
    )
    return arrays, {**record, "has_large": groups.has_large, "most": groups.most}


def mean_within(job: Job) -> tuple[Arrays, Record]:
    """Mean distance of a tile's points to the neighbours in a radius."""
    assert isinstance(job.params, Statistical)
    assert job.params.radius_m is not None
    part = _with_halo(job, job.params.radius_m)
    return {"mean": mean_distances(part.points, job.params)[: part.own]}, {}


def nearest(job: Job) -> tuple[Arrays, Record]:
    """Mean and largest distance of a tile's points to the k nearest others; known: k.

    No halo is safe for a number of neighbours. A short one serves nearly all points; whose k-th
    lies beyond it asks the other tiles that can have nearer ones, one by one.
    """
    k = min(job.known, max(1, job.asked - 1))
    edge = max(high - low for low, high in zip(job.tile.low, job.tile.high, strict=True))
    halo = 2.0 * edge * float(np.sqrt(k / job.tile.points))
    part = _with_halo(job, halo)
    mean, largest = (values[: part.own] for values in nearest_distances(part.points, k))
    own = part.points[: part.own]
    to_edge = np.minimum(own - job.tile.low, np.array(job.tile.high) - own).min(axis=1) + halo
    # A hair less, for the rounding of the border itself.
    unsure = np.flatnonzero(~(largest < to_edge * (1.0 - 1e-9)))
    if len(unsure) and part.own < job.asked:
        nearer = _nearest_of_all(job, part.points, own[unsure], halo, k)
        mean[unsure], largest[unsure] = mean_and_largest(nearer)
    return {"mean": mean, "largest": largest}, {"unsure": len(unsure)}


def _nearest_of_all(
    job: Job, read: Points, queries: Points, halo_m: float, k: int
) -> NDArray[np.float64]:
    """Return the distances (m, k) of `queries`, which are in `read`, to the k nearest others."""
    # The nearest of itself is the point itself, or one at the same place.
    nearest_m = knn(build_index(read), queries, k + 1)[1][:, 1:]
    others = [tile for tile in _cloud(job).tiles if tile != job.tile]
    gaps = [_gap(queries, tile) for tile in others]
    for number in np.argsort([gap.min() for gap in gaps], kind="stable"):
        rows = np.flatnonzero(gaps[number] <= nearest_m[:, -1])
        if not len(rows):
            continue
        points = asked_points(job, others[number])
        points = points[~_in_box(points, job.tile, halo_m)]
        for some in _of_like_reach(nearest_m[rows, -1]):
            asked = rows[some]
            near = _about(points, queries[asked], float(nearest_m[asked, -1].max()))
            if len(near):
                more = knn(build_index(near), queries[asked], k)[1]
                both = np.concatenate([nearest_m[asked], more], axis=1)
                nearest_m[asked] = np.sort(both, axis=1)[:, :k]
    return nearest_m


def _of_like_reach(reach_m: Values) -> list[NDArray[np.int64]]:
    """Return the places of reaches (n,) that are alike within a factor of two, group by group.

    One stray that looks far then does not make all the others look at everything.
    """
    octave = np.frexp(reach_m)[1]
    octave[~np.isfinite(reach_m)] = np.iinfo(octave.dtype).max
    return [np.flatnonzero(octave == one) for one in np.unique(octave)]


def _about(points: Points, queries: Points, reach_m: float) -> Points:
    """Return the points within `reach_m` of the box of the queries."""
    low, high = corners_of(queries)
    return points[are_within(points, low - reach_m, high + reach_m)]


def _gap(points: Points, tile: Tile) -> Values:
    """Return no more than the distance (n,) from each point to the box of a tile."""
    outside = np.maximum(np.array(tile.low) - points, points - np.array(tile.high))
    gap: Values = np.sqrt((np.maximum(outside, 0.0) ** 2).sum(axis=1)) * (1.0 - 1e-9)
    return gap


def load_levels(folder: Folder, name: str) -> Levels:
    """Return the levels of a cloud, from a file."""
    levels: Levels = _loaded(folder, name, Levels)
    return levels


def load_cloth(folder: Folder, name: str) -> Cloth:
    """Return a cloth, from a file."""
    cloth: Cloth = _loaded(folder, name, Cloth)
    return cloth


def _loaded(folder: Folder, name: str, make: Callable[..., Any]) -> Any:
    held = read_file(folder, name)
    # Numbers were written as arrays without axes.
    return make(**{name: a if a.ndim else a.item() for name, a in held.items()})
