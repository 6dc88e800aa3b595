"""Filters applied in turn to one cloud, with a book of what each took and why."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud, chosen_rows
from dougong.errors import InputError
from dougong.filters.cloth_simulation import ClothSimulation, cloth_simulation
from dougong.filters.clutter import Clutter, clutter
from dougong.filters.curvature_weighted import CurvatureWeighted, curvature_weighted
from dougong.filters.lost_places import lost_places
from dougong.filters.low_outliers import LowOutliers, low_outliers
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid
from dougong.filters.pass_through import PassThrough, pass_through
from dougong.filters.radius import Radius, radius
from dougong.filters.selection import (
    NOISE,
    Reason,
    Selection,
    details_of,
)
from dougong.filters.statistical import Statistical, statistical
from dougong.params import Parameters
from dougong.pipeline.progress import Progress
from dougong.typing import Index, Mask, Values

UNKNOWN, NOT_GROUND, GROUND = 0, 1, 2
_MUCH_NOISE = 0.2
"""A filter that takes more than this share of what it sees for noise is doubted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCount:
    """What one filter did."""

    name: str
    points_in: int
    points_out: int
    seconds: float
    found: Mapping[str, int] = field(default_factory=dict)
    """What it found besides, counted (`Selection.found`)."""

    @property
    def reduction(self) -> float:
        """Data reduction rate: 1 - points out / points in (0 when nothing came in)."""
        return 1.0 - self.points_out / self.points_in if self.points_in else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Filtered:
    """A filtered cloud and why each point is in it or not."""

    cloud: Cloud
    """The kept points: the input's own records, selected."""
    codes: NDArray[np.uint8]
    """(n,) `Reason` of every input point."""
    ground_class: NDArray[np.uint8]
    """(n,) of every input point: 0 unknown, 1 not ground, 2 ground (by the cloth)."""
    stages: tuple[StageCount, ...]
    notes: tuple[str, ...] = ()
    details: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """(n,) arrays over every input point that say more than its code: ``dougong_detail`` uint8 and
    ``dougong_margin`` float32 where a filter gave them; 0 for points that it did not judge."""

    @property
    def is_ground(self) -> Mask:
        """(k,) over the kept points: True on the ground."""
        ground: Mask = self.ground_class[self.codes == Reason.KEPT] == GROUND
        return ground


class Step(NamedTuple):
    """One filter of a recipe, in memory or on tiles."""

    name: str
    params: Parameters
    among: Literal["left", "off_ground"] = "left"
    """Which points it judges: all that are left, or of these those that are not ground."""


@dataclass(slots=True)
class Bench:
    """The work piece: which points are left, and why the others went."""

    cloud: Cloud
    progress: Progress
    codes: NDArray[np.uint8] = field(init=False)
    ground_class: NDArray[np.uint8] = field(init=False)
    height_above_ground: Values | None = None
    voxel_count: NDArray[np.int32] | None = None
    stages: list[StageCount] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: dict[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.codes = np.zeros(len(self.cloud), dtype=np.uint8)
        self.ground_class = np.zeros(len(self.cloud), dtype=np.uint8)

    def left(self) -> Index:
        """Return the positions of the points still kept, in input order."""
        return np.flatnonzero(self.codes == Reason.KEPT)

    def apply(
        self,
        name: str,
        reason: Reason,
        verb: Callable[[Index], Selection],
        among: Index | None = None,
    ) -> Selection:
        """Run one filter on the points left (or on those `among` them) and book what it took."""
        self.progress.stage(f"{self.cloud.name}: {name.replace('_', ' ')}")
        start = time.perf_counter()
        left = self.left()
        asked = left if among is None else among
        selection = verb(asked)
        self.codes[asked[~selection.is_kept]] = reason
        self._book_details(selection, asked)
        taken = int(np.count_nonzero(~selection.is_kept))
        self.stages.append(
            StageCount(
                name=name,
                points_in=len(left),
                points_out=len(left) - taken,
                seconds=time.perf_counter() - start,
                found=dict(selection.found),
            )
        )
        said = [*selection.notes, *doubts(reason, taken, len(asked))]
        if reason in NOISE:
            said += self._lost_places(asked, selection.is_kept)
        self.notes += [f"{name}: {note}" for note in said]
        return selection

    def _lost_places(self, asked: Index, is_kept: Mask) -> list[str]:
        xyz = self.cloud.xyz
        origin = self.cloud.frame.origin
        note = lost_places(lambda: (xyz[asked[~is_kept]],), lambda: (xyz[asked],), origin)
        return [] if note is None else [note]

    def _book_details(self, selection: Selection, asked: Index) -> None:
        for name, values in details_of(selection).items():
            if name not in self.details:
                self.details[name] = np.zeros(len(self.cloud), values.dtype)
            self.details[name][asked] = values

    def result(self) -> Filtered:
        """Close the books.

        Raises
        ------
        InputError
            No point is left.
        """
        left = self.left()
        if len(left) == 0:
            raise InputError(nothing_kept(self.cloud.name, len(self.cloud), self.stages))
        return Filtered(
            cloud=self.cloud.select(left),
            codes=self.codes,
            ground_class=self.ground_class,
            stages=tuple(self.stages),
            notes=tuple(self.notes),
            details=self.details,
        )


def nothing_kept(name: str, points: int, stages: Sequence[StageCount]) -> str:
    """Return what is said where no point is left."""
    return (
        f"{name}: the filters kept none of {points:,} points. "
        "Look at the stage that took them all and loosen it: "
        + ", ".join(f"{stage.name} {stage.points_out}" for stage in stages)
        + "."
    )


def doubts(reason: Reason, taken: int, asked: int) -> list[str]:
    """Return what is to be said where more was taken for noise than a survey ever holds."""
    if reason not in NOISE or taken <= _MUCH_NOISE * asked:
        return []
    return [
        f"took {taken:,} of {asked:,} points ({100 * taken / asked:.0f} %) for noise, far more "
        "than surveys hold: the cloud may be too sparse for its radii. Look at them with --mark "
        "and loosen it."
    ]


def run_octree_voxel_grid(bench: Bench, params: OctreeVoxelGrid) -> None:
    """Decimate; remember how many points each kept one stands for."""
    cloud = bench.cloud
    left = bench.left()
    chosen = bench.apply(
        "octree_voxel_grid",
        Reason.DECIMATED,
        lambda index: octree_voxel_grid(
            cloud.xyz[index], params, records=chosen_rows(cloud.records, index)
        ),
    )
    bench.voxel_count = np.zeros(len(cloud), dtype=np.int32)
    bench.voxel_count[left] = chosen.attributes["voxel_count"]


def run_low_outliers(bench: Bench, params: LowOutliers) -> None:
    """Take out what lies below the ground, so that it cannot hold the cloth up."""
    bench.apply(
        "low_outliers",
        Reason.LOW_OUTLIER,
        lambda index: low_outliers(bench.cloud.xyz[index], params),
    )


def run_cloth(bench: Bench, params: ClothSimulation) -> None:
    """Tell ground from the rest; remember heights above it."""
    left = bench.left()
    found = bench.apply(
        "cloth_simulation",
        Reason.CLOTH,
        lambda index: cloth_simulation(bench.cloud.xyz[index], params),
    )
    bench.ground_class[left] = found.attributes["ground_class"]
    bench.height_above_ground = np.full(len(bench.cloud), np.nan)
    bench.height_above_ground[left] = found.attributes["height_above_ground"]


def run_curvature_weighted(
    bench: Bench, params: CurvatureWeighted, among: Index | None = None
) -> None:
    """Take out isolated points while edges and brackets stay (CWASF)."""
    counts = bench.voxel_count
    beside = None
    if among is not None:
        is_beside = bench.codes == Reason.KEPT
        is_beside[among] = False
        beside = bench.cloud.xyz[is_beside]
    bench.apply(
        "curvature_weighted",
        Reason.CURVATURE_WEIGHTED,
        lambda index: curvature_weighted(
            bench.cloud.xyz[index],
            params,
            voxel_count=None if counts is None else counts[index],
            beside=beside,
        ),
        among,
    )


def run_statistical(bench: Bench, params: Statistical) -> None:
    """Take out points far from their neighbours, by a statistic of the whole cloud (SOR)."""
    bench.apply(
        "statistical",
        Reason.STATISTICAL,
        lambda index: statistical(bench.cloud.xyz[index], params),
    )


def run_radius(bench: Bench, params: Radius) -> None:
    """Take out points with too few neighbours in a ball (ROR)."""
    bench.apply("radius", Reason.RADIUS, lambda index: radius(bench.cloud.xyz[index], params))


def run_clutter(bench: Bench, params: Clutter, among: Index | None = None) -> None:
    """Offer people, vehicles, poles and wires, or take them out."""
    heights = bench.height_above_ground
    if heights is None:
        msg = "clutter needs heights above the ground; run cloth_simulation before it."
        raise InputError(msg)
    bench.apply(
        "clutter",
        Reason.CLUTTER,
        lambda index: clutter(bench.cloud.xyz[index], params, height_above_ground=heights[index]),
        among,
    )


def run_pass_through(bench: Bench, params: PassThrough) -> None:
    """Crop by axis range, box, polygon (all in the file's coordinates, metres) and height."""
    heights = bench.height_above_ground
    local = params.shifted(bench.cloud.frame.origin)
    bench.apply(
        "pass_through",
        Reason.PASS_THROUGH,
        lambda index: pass_through(
            bench.cloud.xyz[index],
            local,
            height_above_ground=None if heights is None else heights[index],
        ),
    )


_RUN: dict[str, Callable[[Bench, Any], None]] = {
    "octree_voxel_grid": run_octree_voxel_grid,
    "low_outliers": run_low_outliers,
    "cloth_simulation": run_cloth,
    "curvature_weighted": run_curvature_weighted,
    "statistical": run_statistical,
    "radius": run_radius,
    "clutter": run_clutter,
    "pass_through": run_pass_through,
}


def run_step(bench: Bench, step: Step) -> None:
    """Run one filter of a recipe."""
    if step.among == "left":
        _RUN[step.name](bench, step.params)
        return
    left = bench.left()
    off_ground = left[bench.ground_class[left] != GROUND]
    if isinstance(step.params, Clutter):
        run_clutter(bench, step.params, off_ground)
        return
    assert isinstance(step.params, CurvatureWeighted)
    run_curvature_weighted(bench, step.params, off_ground)
