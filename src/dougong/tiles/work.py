"""The tasks: what a filter does on one tile. Each reads files, writes none and returns arrays.

A task is a function of a module and its job is small, so any process that sees the folder can do
it. Of the points of a tile and its halo only those that a stage is asked about are read.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.errors import InputError
from dougong.filters import clutter_search
from dougong.filters.cloth_simulation import UNKNOWN, Cloth, ClothSimulation, classify
from dougong.filters.clutter import Clutter, clutter
from dougong.filters.clutter import halo_m as clutter_halo_m
from dougong.filters.curvature_weighted import (
    CurvatureWeighted,
    Whole,
    curvature_weighted,
    own_totals,
)
from dougong.filters.curvature_weighted import halo_m as curvature_halo_m
from dougong.filters.low_outliers import Levels, is_low_outlier
from dougong.filters.pass_through import PassThrough, pass_through
from dougong.filters.radius import Radius, radius
from dougong.filters.selection import Reason, Selection, details_of
from dougong.filters.statistical import Statistical, mean_distances, select_near
from dougong.filters.totals import Totals
from dougong.tiles.cloud import Arrays, Record, read_arrays, read_file
from dougong.tiles.folder import Folder
from dougong.tiles.parts import Job, Part, asked_of, asked_points, is_asked, state_of, with_halo
from dougong.typing import Values


def _own(selection: Selection, own: int) -> Selection:
    """Return the part of a selection that is not halo."""
    return Selection(
        is_kept=selection.is_kept[:own],
        attributes={name: values[:own] for name, values in selection.attributes.items()},
    )


def booked(
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
    return booked(job, Selection(is_kept=~is_low), Reason.LOW_OUTLIER)


def judge_cloth(job: Job) -> tuple[Arrays, Record]:
    """Ground or not; known: the file of the cloth."""
    assert isinstance(job.params, ClothSimulation)
    found = classify(asked_points(job, job.tile), load_cloth(job.folder, job.known), job.params)
    arrays, record = booked(job, found, Reason.CLOTH)
    places = np.flatnonzero(asked_of(job.folder, job.tile, job.before, job.among))
    arrays["ground"][places] = found.attributes["ground_class"]
    arrays["height"] = np.full(job.tile.points, np.nan)
    arrays["height"][places] = found.attributes["height_above_ground"]
    lost = int((found.attributes["ground_class"] == UNKNOWN).sum())
    return arrays, {**record, "lost": lost}


def judge_radius(job: Job) -> tuple[Arrays, Record]:
    """Too few neighbours in a ball."""
    assert isinstance(job.params, Radius)
    part = with_halo(job, job.params.radius_m)
    return booked(job, _own(radius(part.points, job.params), part.own), Reason.RADIUS)


def count_lines(job: Job) -> tuple[Arrays, Record]:
    """Count the high points of a tile, and those of them on thin lines."""
    assert isinstance(job.params, Clutter)
    part = with_halo(job, clutter_search.LINES_HALO_M + job.params.gap_most_m, more=("height",))
    high, on_lines = clutter_search.count_lines(part.points, _height(part), job.params, part.own)
    return {}, {"high": high, "on_lines": on_lines}


def _height(part: Part) -> Values:
    if "height" not in part.more:
        msg = "clutter needs heights above the ground; run cloth_simulation before it."
        raise InputError(msg)
    return part.more["height"]


def judge_clutter(job: Job) -> tuple[Arrays, Record]:
    """Offer what stands about, or take it out; known: whether thin lines are the scanner's rows."""
    assert isinstance(job.params, Clutter)
    part = with_halo(job, clutter_halo_m(job.params), more=("height",))
    whole = clutter_search.Whole(part.own, job.known)
    found = clutter(part.points, job.params, height_above_ground=_height(part), whole=whole)
    arrays, record = booked(job, _own(found, part.own), Reason.CLUTTER)
    return arrays, {**record, "found": dict(found.found)}


def judge_statistical(job: Job) -> tuple[Arrays, Record]:
    """Too far from the neighbours; known: the stage of the mean distances, and the cut."""
    stage, cut = job.known
    mean_m = read_arrays(job.folder, job.tile, stage, "mean")["mean"]
    return booked(job, select_near(mean_m, cut), Reason.STATISTICAL)


def judge_pass_through(job: Job) -> tuple[Arrays, Record]:
    """Ranges, polygons and heights; known: the robust top of the whole cloud or None."""
    assert isinstance(job.params, PassThrough)
    state = state_of(job.folder, job.tile, job.before)
    height = state["height"][is_asked(state, job.among)] if "height" in state else None
    found = pass_through(
        asked_points(job, job.tile), job.params, height_above_ground=height, top_m=job.known
    )
    arrays, record = booked(job, found, Reason.PASS_THROUGH)
    is_needed = job.params.needs_height and height is not None
    unknown = int(np.isnan(state["height"][is_asked(state, job.among)]).sum()) if is_needed else 0
    return arrays, {**record, "unknown": unknown}


def judge_curvature(job: Job) -> tuple[Arrays, Record]:
    """CWASF, rules paper and global; known: the low corner, and the totals of global or None."""
    assert isinstance(job.params, CurvatureWeighted)
    part = with_halo(job, curvature_halo_m(job.params), more=("voxel_count",))
    found = curvature_weighted(
        part.points,
        job.params,
        voxel_count=part.more.get("voxel_count"),
        whole=_whole(*job.known),
    )
    return booked(job, _own(found, part.own), Reason.CURVATURE_WEIGHTED)


def count_curvature(job: Job) -> tuple[Arrays, Record]:
    """Count what a tile adds to the statistics of CWASF's rule global; known: the low corner."""
    assert isinstance(job.params, CurvatureWeighted)
    part = with_halo(job, curvature_halo_m(job.params))
    totals = own_totals(part.points, job.params, part.own, _whole(job.known))
    return {}, {"totals": [totals.count, totals.total, totals.squares]}


def _whole(low: list[float], totals: tuple[int, int, int] | None = None) -> Whole:
    return Whole(np.array(low), None if totals is None else Totals(*totals))


def mean_within(job: Job) -> tuple[Arrays, Record]:
    """Mean distance of a tile's points to the neighbours in a radius."""
    assert isinstance(job.params, Statistical)
    assert job.params.radius_m is not None
    part = with_halo(job, job.params.radius_m)
    return {"mean": mean_distances(part.points, job.params)[: part.own]}, {}


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
