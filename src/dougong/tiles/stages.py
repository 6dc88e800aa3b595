"""A recipe on a tiled cloud, stage by stage: map over the tiles, a small reduce, map again.

What a stage leaves is known by the hash of everything before it and of its parameters, so a run
goes on where it was and a changed parameter reruns only what depends on it.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

import dougong
from dougong.filters import FILTERS
from dougong.filters.cloth_simulation import ClothSimulation, cloth_notes, guarded_cloth
from dougong.filters.clutter import Clutter, clutter_notes
from dougong.filters.concentration import note_of, tally, together
from dougong.filters.curvature_weighted import CurvatureWeighted
from dougong.filters.lost_places import lost_places
from dougong.filters.low_outliers import LowOutliers, find_levels, low_notes
from dougong.filters.octree_voxel_grid import robust_box_of
from dougong.filters.pass_through import PassThrough, robust_top_of, unknown_notes
from dougong.filters.protective import ease_notes, ease_of, is_too_few
from dougong.filters.radius import Radius
from dougong.filters.ranks import ValueBlocks, count_finite, median
from dougong.filters.selection import NOISE, Reason
from dougong.filters.statistical import (
    Statistical,
    cut_distance,
    spared_notes,
    sparing_reach,
    stray_notes,
    takes_places,
)
from dougong.filters.surroundings import REACH_M, middle_rank, reach_of
from dougong.filters.totals import Totals
from dougong.filters.wires import are_rows
from dougong.params import Parameters
from dougong.tiles import nearest, protective, things, work
from dougong.tiles.cloud import (
    POINTS,
    Arrays,
    Record,
    Tile,
    TiledCloud,
    name_of,
    read_arrays,
    read_record,
    write_arrays,
)
from dougong.tiles.engine import Engine, Task
from dougong.tiles.parts import Among, Job, asked_of, asked_points, is_asked, state_of
from dougong.typing import Mask, Points, Values

Work = Callable[[Job], tuple[Arrays, Record]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StageDone:
    """What one filter did to all tiles."""

    name: str
    left: int
    """Points that there were."""
    asked: int
    """Of these, those that it judged."""
    taken: int
    notes: tuple[str, ...]
    seconds: float
    found: Mapping[str, int] = field(default_factory=dict)
    """What it found besides, counted (`Selection.found`)."""


@dataclass(slots=True)
class TileBench:
    """The tiles, and the key of the state that they are in."""

    cloud: TiledCloud
    engine: Engine
    state: str = ""
    done: list[StageDone] = field(default_factory=list)

    def apply(self, name: str, params: Parameters, among: Among = "left") -> StageDone:
        """Run one filter on the points left.

        Raises
        ------
        TileError, OutputError
            Some tiles failed, or the disk is full.
        """
        start = time.perf_counter()
        asked = sum(
            int(asked_of(self.cloud.folder, tile, self.state, among).sum())
            for tile in self.cloud.tiles
        )
        stage = _Stage(self.cloud, self.engine, self.state, params, among, asked)
        records, notes, self.state = _RUN[name](stage)
        totals = {key: sum(r[key] for r in records) for key in ("left", "asked", "taken")}
        if FILTERS[name].reason in NOISE:
            notes = (*notes, *stage.lost_places(self.state))
        done = StageDone(
            name=name,
            notes=notes,
            seconds=time.perf_counter() - start,
            found=_found(records),
            **totals,
        )
        self.done.append(done)
        return done


@dataclass(frozen=True, slots=True)
class _Stage:
    """One filter on its way: the tiles as they were before it."""

    cloud: TiledCloud
    engine: Engine
    before: str
    params: Parameters
    among: Among
    asked: int
    """How many points it is asked about."""

    def key(self, name: str, known: Any = None) -> str:
        """Return the name of a step of this stage: a hash of all that its result depends on."""
        told = self.params.model_dump(mode="json")
        facts = [dougong.__version__, self.before, name, told, self.among, known]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]

    def map(self, name: str, do: Work, known: Any = None) -> tuple[list[Record], str]:
        """Run `do` on every tile; return the records and the key of the step."""
        key = self.key(name, repr(known))
        job = partial(
            Job,
            before=self.before,
            params=self.params,
            among=self.among,
            asked=self.asked,
            known=known,
        )
        folder = self.cloud.folder
        tasks = [
            Task(tile.name, folder, name_of(tile, key), do, job(folder, tile))
            for tile in self.cloud.tiles
        ]
        return self.engine.run(tasks), key

    def of_all_left(self) -> "_Stage":
        """Return the stage asked about every point that is left."""
        if self.among == "left":
            return self
        masks = (asked_of(self.cloud.folder, t, self.before, "left") for t in self.cloud.tiles)
        return replace(self, among="left", asked=sum(int(mask.sum()) for mask in masks))

    def mask(self, tile: Tile) -> Mask:
        """Return which points of a tile are asked about."""
        return asked_of(self.cloud.folder, tile, self.before, self.among)

    def mask_in_left(self, tile: Tile) -> Mask:
        """Return which of a tile's points that are left are asked about."""
        return self.mask(tile)[asked_of(self.cloud.folder, tile, self.before, "left")]

    def blocks(self) -> Any:
        """Yield the points that the stage is asked about, tile by tile."""
        for tile in self.cloud.tiles:
            job = Job(self.cloud.folder, tile, self.before, self.params, self.among)
            yield asked_points(job, tile)

    def low(self) -> list[float]:
        """Return where cells begin that tiles and the whole share: the cloud's `robust_low`."""
        low: list[float] = robust_box_of(self.blocks, self.asked)[0].tolist()
        return low

    def lost_places(self, after: str) -> tuple[str, ...]:
        """Return what is to be said where this stage, which left the state `after`, took places."""
        origin = np.array(self.cloud.facts["origin"])
        note = lost_places(partial(self.taken, after), self.blocks, origin)
        return () if note is None else (note,)

    def taken(self, after: str) -> Iterator[Points]:
        """Yield the points that this stage, which left the state `after`, took, tile by tile."""
        folder = self.cloud.folder
        for tile in self.cloud.tiles:
            code = read_arrays(folder, tile, after, "code")["code"]
            is_taken = self.mask(tile) & (code != Reason.KEPT)
            if is_taken.any():
                yield read_arrays(folder, tile, POINTS, "xyz")["xyz"][is_taken]

    def values(self, stage: str, name: str) -> ValueBlocks:
        """Return the blocks of an array of an earlier step."""
        folder, tiles = self.cloud.folder, self.cloud.tiles
        return lambda: (read_arrays(folder, tile, stage, name)[name] for tile in tiles)

    def kept(self, name: str, make: Callable[[int], tuple[Arrays, Record]]) -> tuple[str, Record]:
        """Return the file, and the record, of what `make` finds of the whole cloud."""
        file, folder = f"whole.{self.key(name)}.npz", self.cloud.folder
        record = read_record(folder, file)
        if record is None:
            arrays, record = make(self.asked)
            write_arrays(folder, file, arrays, record)
        return file, record


Outcome = tuple[list[Record], tuple[str, ...], str]


def _sum(records: list[Record], name: str) -> int:
    return sum(record[name] for record in records)


def _found(records: list[Record]) -> dict[str, int]:
    """Return the sums of what the tiles found besides."""
    total: dict[str, int] = {}
    for record in records:
        for name, count in record.get("found", {}).items():
            total[name] = total.get(name, 0) + count
    return total


def _low_outliers(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, LowOutliers)
    params = stage.params

    def make(asked: int) -> tuple[Arrays, Record]:
        return _packed(find_levels(stage.blocks, asked, params)._asdict()), {}

    file, _ = stage.kept("levels", make)
    records, key = stage.map("low_outliers", work.judge_low, file)
    return records, low_notes(_sum(records, "taken"), _sum(records, "asked")), key


def _cloth(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, ClothSimulation)
    params = stage.params

    def make(asked: int) -> tuple[Arrays, Record]:
        cloth, low = guarded_cloth(stage.blocks, asked, params)
        return _packed({name: getattr(cloth, name) for name in cloth.__slots__}), {"low": low}

    file, record = stage.kept("cloth", make)
    records, key = stage.map("cloth_simulation", work.judge_cloth, file)
    notes = cloth_notes(record["low"], _sum(records, "lost"), _sum(records, "asked"))
    return records, notes, key


def _packed(fields: dict[str, Any]) -> Arrays:
    return {name: np.asarray(value) for name, value in fields.items()}


def _radius(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, Radius)
    records, key = stage.map("radius", work.judge_radius)
    return records, (), key


def _clutter(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, Clutter)
    counted, _ = stage.map("thin_lines", work.count_lines)
    has_rows = are_rows(_sum(counted, "high"), _sum(counted, "on_lines"))
    records, key = stage.map("clutter", work.judge_clutter, has_rows)
    is_said = has_rows and "wire" in stage.params.kinds
    return records, clutter_notes(_found(records), is_said), key


def _statistical(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, Statistical)
    if stage.params.radius_m is not None:
        _, means = stage.map("mean_within", work.mean_within)
    else:
        _, means = stage.map("nearest", nearest.nearest, stage.params.neighbours)
    cut, strays = cut_distance(stage.values(means, "mean"), stage.params.multiplier)
    records, key = stage.map("statistical", work.judge_statistical, (means, cut))
    notes = stray_notes(strays)
    taken = partial(stage.taken, key)
    if not stage.params.spare_places or not takes_places(taken, stage.blocks, cut):
        return records, notes, key
    beyond = _sum(records, "taken")
    rule = CurvatureWeighted(reach_m=sparing_reach(cut))
    found = _protective_found(replace(stage, params=rule))
    records, key = stage.map("spared", protective.judge_spared, (means, cut, *found))
    spared = beyond - _sum(records, "taken")
    return records, (*notes, *spared_notes(spared, beyond)), key


def _pass_through(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, PassThrough)
    top = None
    if stage.params.margin_above_top_m is not None:
        top = robust_top_of(lambda: _heights(stage))
    records, key = stage.map("pass_through", work.judge_pass_through, top)
    return records, unknown_notes(_sum(records, "unknown")), key


def _heights(stage: _Stage) -> Any:
    for tile in stage.cloud.tiles:
        state = state_of(stage.cloud.folder, tile, stage.before)
        yield state["height"][is_asked(state, stage.among)] if "height" in state else np.empty(0)


def _curvature_weighted(stage: _Stage) -> Outcome:
    assert isinstance(stage.params, CurvatureWeighted)
    if stage.params.rule == "protective":
        return _protective(stage)
    low, of_all = stage.low(), None
    if stage.params.rule == "global":
        counted, _ = stage.map("totals", work.count_curvature, low)
        totals = sum((Totals(*record["totals"]) for record in counted), Totals())
        of_all = (totals.count, totals.total, totals.squares)
    records, key = stage.map("curvature_weighted", work.judge_curvature, (low, of_all))
    return records, (), key


def _protective(stage: _Stage) -> Outcome:
    # What is not judged, the ground, is seen: without it a gravestone hovers.
    known = _protective_found(stage.of_all_left())
    records, key = stage.map("curvature_weighted", protective.judge, known)
    note = _concentration(stage, known[0], key) if stage.asked else None
    return records, (*ease_notes(known[-1]), *(() if note is None else (note,))), key


def _protective_found(seen: _Stage) -> tuple[str, str | None, float, float]:
    """Return the steps of the tests and of `hovering` of all that is seen, reach and ease."""
    assert isinstance(seen.params, CurvatureWeighted)
    reach_m = seen.params.reach_m
    reach, eighth = _reach(seen, seen.params)
    _, tested = seen.map("surroundings", protective.test_points, (eighth, reach, seen.low()))
    judged = None
    ease = ease_of(seen.values(tested, "curvature"), seen.asked, reach_m)
    if not is_too_few(seen.asked, reach_m):
        judged = _hovering(seen, tested, reach, ease, is_whole=reach_m is None)
    return tested, judged, reach, ease


def _hovering(stage: _Stage, tested: str, reach: float, ease: float, *, is_whole: bool) -> str:
    """Return the step that judges the points in doubt by what they are parts of."""
    cloud = (stage.cloud.folder, stage.cloud.tiles)
    groups, record = stage.kept("groups", lambda _: things.open_groups(*cloud, tested, reach))
    _, linked = stage.map("pieces", things.link_pieces, (tested, groups, reach))
    most = record["most_beside"] if is_whole else None
    file, _ = stage.kept(
        "things", lambda _: (things.things_of(*cloud, groups, linked, reach, most), {})
    )
    _, measured = stage.map("gaps", things.gaps, (tested, file, reach))
    gaps, _ = stage.kept(
        "thing_gaps", lambda _: (things.gaps_of_things(*cloud, file, measured, reach), {})
    )
    known = (tested, measured, file, gaps, reach, ease)
    return stage.map("hovering", protective.hovering, known)[1]


def _reach(stage: _Stage, params: CurvatureWeighted) -> tuple[float, str]:
    """Return the reach, and the step of the distance to the eighth nearest other within it.

    Where it is taken from the cloud, nobody looks farther for that than half of its points need.
    """
    if params.reach_m is not None:
        _, found = stage.map("eighth", protective.eighth_within, params.reach_m)
        return params.reach_m, found
    within = REACH_M
    while True:
        _, found = stage.map("eighth", protective.eighth_within, within)
        eighth = stage.values(found, "largest")
        rank = middle_rank(eighth, stage.asked)
        if rank is None or count_finite(eighth) > rank:
            reach = reach_of(eighth, stage.asked)
            if reach <= within:
                return reach, found
            within = reach
        else:
            within *= 2.0


def _concentration(stage: _Stage, tested: str, key: str) -> str | None:
    """Return what is to be said where removal concentrates on fine geometry."""
    folder, tiles = stage.cloud.folder, stage.cloud.tiles

    def of_judged(tile: Tile, name: str) -> Values:
        # The tests are of every point that is left.
        return read_arrays(folder, tile, tested, name)[name][stage.mask_in_left(tile)]

    spacing_m = median(lambda: (of_judged(tile, "spacing") for tile in tiles))
    if not spacing_m > 0:
        return None
    parts = []
    for tile, points in zip(tiles, stage.blocks(), strict=True):
        if not len(points):
            continue
        code = read_arrays(folder, tile, key, "code")["code"]
        is_kept = code[stage.mask(tile)] == Reason.KEPT
        curvature = of_judged(tile, "curvature")
        parts.append(tally(points, is_kept, curvature, spacing_m))
    return note_of(together(parts)) if parts else None


_RUN: dict[str, Callable[[_Stage], Outcome]] = {
    "low_outliers": _low_outliers,
    "cloth_simulation": _cloth,
    "curvature_weighted": _curvature_weighted,
    "statistical": _statistical,
    "radius": _radius,
    "clutter": _clutter,
    "pass_through": _pass_through,
}
