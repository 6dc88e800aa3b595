"""Statistical outlier removal: points whose neighbours are farther off than is usual in the cloud.

METHOD.md 1.4 (Rusu et al. 2008). Kernels are imported when called.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from dougong._checks import as_points
from dougong._words import counted
from dougong.filters.lost_places import EDGE_M, Taken, lost_cells
from dougong.filters.ranks import ValueBlocks, at_rank, count_finite
from dougong.filters.selection import Selection, spare
from dougong.filters.totals import LARGEST, Totals
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Index, Points, Values

if TYPE_CHECKING:
    from dougong.filters.neighbourhood import Neighbourhood

KIND: Literal["local", "two-pass", "global"] = "two-pass"

_STEP_M = 2.0**-24
"""Mean distances are rounded to 60 nm before they are summed or meet the cut."""
_PLACE_CUTS = (4.0, 12.0)
"""Edges of a place in cuts: with 20 neighbours some 40 points of a surface at the cut lie in the
smaller one, and of one three times as thin in the larger one."""
_FEWEST_PLACES = 2
_REACH_CUTS = 3.0
"""So far looks the rule that spares: what the cloud's own spacing gives is too short for a facade
three times as thin, and farther it takes more of one (`benchmarks/thin_facades.py`)."""
_STRAY = 1000.0
"""A mean distance beyond this many medians is an outlier for sure and stays out of the sums."""


class Statistical(Parameters):
    """Remove points whose mean distance to their neighbours exceeds mu + multiplier x sigma.

    mu and sigma are those of the whole cloud.
    """

    neighbours: Annotated[int, Field(ge=1, le=1000)] | None = 20
    """How many nearest neighbours are averaged. Left out when `radius_m` is given."""
    radius_m: Annotated[float, Field(gt=0)] | None = None
    """Average over all neighbours within this many metres instead."""
    multiplier: Annotated[float, Field(ge=0)] = 2.0
    """Standard deviations above the mean at which the cut lies."""
    spare_places: bool = False
    """Where whole places lie beyond the cut, take only what the rule ``protective`` of CWASF takes
    too: a facade that a flight shows thinly lies beyond the cut of a cloud of ground and roofs."""

    @model_validator(mode="before")
    @classmethod
    def _radius_replaces_the_default(cls, given: Any) -> Any:
        if (
            isinstance(given, dict)
            and given.get("radius_m") is not None
            and "neighbours" not in given
        ):
            return {**given, "neighbours": None}
        return given

    @model_validator(mode="after")
    def _one_of_both(self) -> "Statistical":
        if (self.neighbours is None) == (self.radius_m is None):
            msg = (
                "give neighbours or radius_m, not both or none, "
                f"got {self.neighbours} and {self.radius_m}."
            )
            raise ValueError(msg)
        return self


def halo_m(params: Statistical) -> float:
    """Return the radius; with a number of neighbours no distance is safe (METHOD.md 1.4)."""
    return params.radius_m if params.radius_m is not None else float("inf")


def mean_distances(points: ArrayLike, params: Statistical) -> Values:
    """Return the mean distance (n,) of every point to its neighbours; inf without any.

    Duplicates of a point are neighbours at distance 0. With fewer than `neighbours` other points
    in the whole cloud, all of them are averaged.
    """
    xyz = as_points(points)
    if params.radius_m is not None:
        return _mean_within(xyz, params.radius_m)
    assert params.neighbours is not None
    return _mean_of_nearest(xyz, min(params.neighbours, max(1, len(xyz) - 1)))


def _mean_of_nearest(xyz: Points, k: int) -> Values:
    from dougong.filters.neighbourhood import build_index

    return nearest_distances(build_index(xyz), k, len(xyz))[0]


def nearest_distances(
    index: "Neighbourhood", k: int, own: int, most_m: float = np.inf
) -> tuple[Values, Values]:
    """Return mean and largest (own,) of the distances to the k nearest others; inf with fewer.

    Of the first `own` points in the caller's order; nothing beyond `most_m` is near.
    """
    from dougong.filters.neighbourhood import over_leaves, self_knn_block

    n = len(index.points)
    mean, largest = np.full(n, np.inf), np.full(n, np.inf)

    def task(first: int, last: int) -> None:
        start, _, distance2 = self_knn_block(index, k, most_m**2, first, last)
        rows = index.order[start : start + len(distance2)]
        mean[rows], largest[rows] = mean_and_largest(np.sqrt(distance2))

    over_leaves(index, index.order < own, task)
    return mean[:own], largest[:own]


def mean_and_largest(distance_m: NDArray[np.float64]) -> tuple[Values, Values]:
    """Return mean (n,) and largest (n,) of (n, k) distances, ascending in every row."""
    # Rows are sorted by distance, so the sum does not depend on the order of the points.
    return distance_m.sum(axis=1) / distance_m.shape[1], distance_m[:, -1]


def _mean_within(xyz: Points, radius_m: float) -> Values:
    from dougong.filters.neighbourhood import build_index
    from dougong.kernels import neighbours

    index = build_index(xyz)
    counts = np.zeros(len(xyz), np.int64)
    sums = np.zeros(len(xyz), np.int64)

    def task(start: int, stop: int) -> None:
        neighbours.sum_distances(
            index.points,
            index.boxes,
            radius_m * radius_m,
            1.0 / _STEP_M,
            start,
            stop,
            counts,
            sums,
        )

    if len(xyz):
        for_blocks(len(xyz), 1 << 14, task)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(counts > 0, sums * _STEP_M / counts, np.inf)
    return index.unsorted(mean)


def cut_distance(mean_m: ValueBlocks, multiplier: float) -> tuple[float, int]:
    """Return the cut mu + multiplier x sigma, metres, and how many points stayed out of the sums.

    Of the mean distances of a whole cloud, which come in blocks. Out of the sums stay points
    without a neighbour, and strays at more than 1000 medians: one point at 1e6 m would otherwise
    raise sigma so far that nothing else is ever removed.
    """
    points = sum(len(block) for block in mean_m())
    counted = count_finite(mean_m)
    if counted == 0:
        return 0.0, points
    median = int(_steps(np.array([at_rank(mean_m, counted // 2)]))[0])
    totals = Totals()
    for block in mean_m():
        steps = _steps(block[np.isfinite(block)])
        totals += Totals.of(steps[steps <= _STRAY * median] if median > 0 else steps)
    return (totals.mean + multiplier * totals.deviation) * _STEP_M, points - totals.count


def _steps(mean_m: Values) -> Index:
    return np.minimum(mean_m / _STEP_M, LARGEST).round().astype(np.int64)


def statistical(points: ArrayLike, params: Statistical | None = None) -> Selection:
    """Choose the points whose neighbours are about as near as usual.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Metres, local frame.
    params : Statistical

    Returns
    -------
    Selection
        ``mean_distance_m`` (n,): inf for a point without a neighbour, which is an outlier;
        ``removal_margin`` (n,): the same as a share of the cut, above 1 for removed points; at
        most 1 for spared ones.

    Raises
    ------
    InputError
        `points` is not (n, 3) or not finite.

    Notes
    -----
    O(n log n). Tile class: two-pass (`Totals` add up over tiles).
    """
    params = params or Statistical()
    xyz = as_points(points)
    mean_m = mean_distances(xyz, params)
    cut, strays = cut_distance(lambda: (mean_m,), params.multiplier)
    chosen = replace(select_near(mean_m, cut), notes=stray_notes(strays))
    taken = xyz[~chosen.is_kept]
    if not params.spare_places or not takes_places(lambda: (taken,), lambda: (xyz,), cut):
        return chosen
    from dougong.filters.curvature_weighted import CurvatureWeighted, curvature_weighted

    surface = curvature_weighted(xyz, CurvatureWeighted(reach_m=sparing_reach(cut)))
    spared = spare(chosen, surface.is_kept)
    count = int(spared.is_kept.sum() - chosen.is_kept.sum())
    return replace(spared, notes=(*chosen.notes, *spared_notes(count, len(taken))))


def select_near(mean_m: Values, cut: float) -> Selection:
    """Choose the points whose mean distance (n,) does not exceed the cut of the whole cloud."""
    # Half a step above: a point exactly at the cut stays, whatever its last digit.
    limit = cut + 0.5 * _STEP_M
    return Selection(
        is_kept=mean_m <= limit,
        attributes={"mean_distance_m": mean_m, "removal_margin": mean_m / limit},
    )


def takes_places(taken: Taken, asked: Taken, cut: float) -> bool:
    """Say whether whole places lie beyond the cut (m), see `lost_places`.

    Their cells grow with the cut, so that thin clouds fill them.
    """
    edges = sorted({max(EDGE_M, cuts * cut) for cuts in _PLACE_CUTS})
    return any(len(lost_cells(taken, asked, edge)[0]) >= _FEWEST_PLACES for edge in edges)


def sparing_reach(cut: float) -> float | None:
    """Return how far the rule that spares looks, metres: thin surfaces lie beyond their cloud's."""
    return _REACH_CUTS * cut or None


def spared_notes(spared: int, beyond: int) -> tuple[str, ...]:
    """Return what is to be said of points that were spared of those beyond the cut."""
    note = (
        f"whole places lie beyond the cut, thinner than the rest: {spared:,} of {beyond:,} points "
        "beyond it are parts of surfaces or lines and stay (spare_places)"
    )
    return (note,) if spared else ()


def stray_notes(strays: int) -> tuple[str, ...]:
    """Return what is to be said of so many strays."""
    lie, do = ("lies", "does") if strays == 1 else ("lie", "do")
    note = f"{counted(strays)} {lie} far from all others and {do} not count for the mean"
    return (note,) if strays else ()
