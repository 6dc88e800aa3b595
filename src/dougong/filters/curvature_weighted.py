"""Curvature-weighted adaptive statistical filter (CWASF): noise out, brackets and eaves kept.

METHOD.md 1.3, equations 1 to 6, in the readings that can work. Kernels are imported when called.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from dougong._checks import as_points
from dougong._sorting import Scalar, unsorted
from dougong.errors import InputError
from dougong.filters import protective
from dougong.filters.balls import BLUR, Balls, CellBalls, ExactBalls, Lattice, build_lattice
from dougong.filters.concentration import concentration_note
from dougong.filters.selection import Selection, spare
from dougong.filters.surroundings import Tests
from dougong.filters.totals import Totals
from dougong.params import Parameters
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Values

KIND: Literal["local", "two-pass", "global"] = "local"

_BLOCK = 1 << 16
"""Points per task."""
_LEAVES = 1 << 10
"""Leaves per task."""
_STATISTIC_STEPS = 1 << 20
"""Steps that the largest possible statistic is divided into before it is summed."""


class CurvatureWeighted(Parameters):
    """Remove points whose nearest weighted neighbour is unusually far, for their curvature."""

    rule: Literal["protective", "paper", "global"] = "protective"
    """What "unusual" is measured against: ``protective``, the spacing of the surface near each
    point, with gaps excused along surfaces and lines (docs/denoising.md); ``paper``, the statistics
    of the points in the ball round each point; ``global``, those of the whole cloud. ``protective``
    uses alpha, gamma, surface_loss and reach_m; radii, beta, curvature_0 and tau are the others'.
    """
    surface_loss: Annotated[float, Field(gt=0, lt=0.5)] = 0.015
    """``protective``: share of the points of a randomly sampled surface that each of its distance
    tests would take if nothing excused them. More removes more."""
    reach_m: Annotated[float, Field(gt=0)] | None = None
    """``protective``: nothing farther is a neighbour; tiles read 5 times this beyond their borders.
    None: 0.5 m, doubled or halved until it is 5 to 100 median spacings of the cloud."""
    radius_init_m: Annotated[float, Field(gt=0)] = 0.3
    """Radius of the ball that curvature and local statistics are taken from."""
    radius_min_m: Annotated[float, Field(gt=0)] = 0.05
    """Search radius far below curvature_0 (never reached: at 0 it is 0.096 m by default)."""
    radius_max_m: Annotated[float, Field(gt=0)] = 0.3
    """Search radius at high curvature."""
    beta: Annotated[float, Field(ge=0)] = 30.0
    """Steepness of the change between the two radii (eq. 4)."""
    curvature_0: float = 0.05
    """Surface variation at which the search radius is half way (eq. 4)."""
    alpha: Annotated[float, Field(ge=0)] = 1.8
    """How much curvature inflates distances (eq. 5)."""
    gamma: Annotated[float, Field(ge=0)] = 12.0
    """How fast it does so (eq. 5)."""
    balls: Literal["exact", "fast"] = "exact"
    """How ``paper`` and ``global`` take the ball of radius_init_m: ``exact``, or ``fast``, made of
    cells of a sixteenth of the radius or less, one for all points of a cell: it holds every point
    within 0.89 radii and none beyond 1.11."""
    tau_min: float = 1.2
    """Standard deviations above the mean at which the cut lies, at least (eq. 6, printed as c)."""
    tau_max: float = 1.8
    """The same, at most."""
    tau_period: float = 4.0
    """The k of eq. 6: tau swings with cos(2 pi k curvature)."""
    solid_voxel_count: Annotated[int, Field(ge=2)] | None = None
    """Keep a decimated point whose voxel held at least this many, whatever the rule says: it was
    not alone. None: never. Needs `voxel_count`."""

    @model_validator(mode="after")
    def _ranges_ascend(self) -> "CurvatureWeighted":
        for name, low, high in (
            ("radius_min_m", self.radius_min_m, self.radius_max_m),
            ("tau_min", self.tau_min, self.tau_max),
        ):
            if low > high:
                msg = f"{name} must not exceed {name.replace('min', 'max')}, got {low} > {high}."
                raise ValueError(msg)
        return self

    @property
    def tests(self) -> Tests:
        """What rule ``protective`` tests by."""
        return Tests(self.alpha, self.gamma, self.surface_loss)

    def weight(self, curvature: Values) -> Values:
        """Return w (n,) of eq. 5, at least 1."""
        weight: Values = 1.0 + self.alpha * np.tanh(self.gamma * curvature)
        return weight

    def radius_m(self, curvature: Values) -> Values:
        """Return the search radius (n,) of eq. 4."""
        rise = 1.0 + np.exp(-self.beta * (curvature - self.curvature_0))
        radius: Values = self.radius_min_m + (self.radius_max_m - self.radius_min_m) / rise
        return radius

    def tau(self, curvature: Values) -> Values:
        """Return tau (n,) of eq. 6."""
        swing = (1.0 - np.cos(2.0 * math.pi * self.tau_period * curvature)) / 2.0
        tau: Values = self.tau_min + (self.tau_max - self.tau_min) * swing
        return tau


def halo_m(params: CurvatureWeighted) -> float:
    """Return how far the rule reaches: the curvature of the neighbours of the neighbours."""
    if params.rule == "protective":
        return protective.halo_m(params.reach_m)
    blur = BLUR if params.balls == "fast" else 0.0
    return 2.0 * params.radius_init_m * (1.0 + blur) + params.radius_max_m


def least_weighted_steps(lattice: Lattice, curvature: Values, p: CurvatureWeighted) -> Index:
    """Return the statistic m (n,), eq. 5's least one, in sorted order; -1 where there is none.

    In whole steps: a `_STATISTIC_STEPS`-th of the largest that is possible.
    """
    from dougong.kernels.least_weighted import least_weighted

    points, _, boxes, lattice_step_m = lattice
    n, leaves = len(points), len(boxes) // 2
    weight = in_blocks(p.weight, curvature)
    scale = lattice_step_m * _STATISTIC_STEPS / (p.radius_max_m * (1.0 + p.alpha))
    steps = np.empty(n, np.int64)

    def task(first_leaf: int, last_leaf: int) -> None:
        first, last = first_leaf * n // leaves, last_leaf * n // leaves
        radii = p.radius_m(curvature[first:last]) / lattice_step_m
        least = np.empty(last - first)
        least_weighted(points, boxes, weight, radii, first_leaf, last_leaf, least)
        steps[first:last] = np.where(least < np.inf, np.rint(least * scale), -1.0)

    if n:
        for_blocks(leaves, _LEAVES, task)
    return steps


def in_blocks(function: Callable[[Values], Values], values: Values) -> Values:
    """Return function(values) (n,), where each depends on its own value only, on the threads."""
    found = np.empty_like(values)

    def task(start: int, stop: int) -> None:
        found[start:stop] = function(values[start:stop])

    for_blocks(len(values), _BLOCK, task)
    return found


class _Judged(NamedTuple):
    """What eq. 1 to 5 say of n points, in sorted order, and what is usual round each."""

    order: Index
    """(n,) place in the caller's array of each."""
    curvature: Values
    steps: Index
    """(n,) the statistic m in whole steps; -1 where alone."""
    mean: Values | float
    deviation: Values | float

    @property
    def is_alone(self) -> Mask:
        """Which (n,) have no other point in reach."""
        return self.steps < 0

    def unsorted(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return `values` (n,), given in sorted order, in the caller's order."""
        return unsorted(values, self.order)

    def verdict(self, p: CurvatureWeighted) -> tuple[Mask, Values]:
        """Return the verdict (n,) of eq. 6 and its margin (n,), m as a share of the cut.

        An empty neighbourhood is an outlier, its margin infinite.
        """
        n = len(self.steps)
        mean, deviation = np.broadcast_to(self.mean, n), np.broadcast_to(self.deviation, n)
        is_outlier, margin = np.empty(n, bool), np.empty(n)

        def task(start: int, stop: int) -> None:
            part = slice(start, stop)
            steps = self.steps[part]
            cut = mean[part] + p.tau(self.curvature[part]) * deviation[part]
            is_outlier[part] = (steps < 0) | (steps > cut)
            # Half a step holds up a cut of zero, where all points are duplicates.
            margin[part] = np.where(steps < 0, np.inf, steps / np.maximum(cut, 0.5))

        for_blocks(n, _BLOCK, task)
        return is_outlier, margin


class Whole(NamedTuple):
    """What must be known of a cloud to judge a part of it."""

    low: NDArray[np.float64]
    """(3,) where its cells and steps begin: the `robust_low` of all its points."""
    totals: Totals | None = None
    """What ``global`` knows of it."""


def _judge(points: ArrayLike, p: CurvatureWeighted, whole: Whole | None = None) -> _Judged:
    """Return curvature, statistic and reference population of `points` (n, 3), eq. 1 to 5."""
    low, totals = whole or (None, None)
    lattice = build_lattice(points, max(p.radius_init_m, p.radius_max_m), low)
    kind = CellBalls if p.balls == "fast" else ExactBalls
    balls: Balls = kind(lattice, p.radius_init_m)
    curvature = balls.variation()
    steps = least_weighted_steps(lattice, curvature, p)
    if p.rule == "global":
        totals = totals or Totals.of(steps[steps >= 0])
        return _Judged(lattice.order, curvature, steps, totals.mean, totals.deviation)
    return _Judged(lattice.order, curvature, steps, *balls.statistics(steps))


def own_totals(points: ArrayLike, p: CurvatureWeighted, own: int, whole: Whole) -> Totals:
    """Return what the first `own` of `points` add to the statistics of rule ``global``."""
    found = _judge(points, p, whole)
    return Totals.of(found.steps[(found.order < own) & ~found.is_alone])


def excess(points: ArrayLike, params: CurvatureWeighted | None = None) -> Values:
    """Return how far points (n, 3) lie above the mean, in units of eq. 6's tau deviations.

    Above 1 the rules ``paper`` and ``global`` remove a point; inf for a point alone. For curves.
    """
    p = params or CurvatureWeighted()
    found = _judge(points, p)
    swing = np.maximum(p.tau(found.curvature) * found.deviation, 1e-9)
    above = np.where(found.is_alone, np.inf, (found.steps - found.mean) / swing)
    return found.unsorted(above)


def curvature_weighted(
    points: ArrayLike,
    params: CurvatureWeighted | None = None,
    *,
    voxel_count: ArrayLike | None = None,
    whole: Whole | None = None,
    beside: ArrayLike | None = None,
) -> Selection:
    """Choose the points that have a neighbour about as near as their surroundings do.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Metres, local frame; non-ground points of a laser scan.
    params : CurvatureWeighted
    voxel_count : array_like, shape (n,), optional
        How many points each point stands for after decimation; used by `solid_voxel_count`.
    whole : Whole, optional
        Where the points are a part of a cloud: what must be known of it.
    beside : array_like, shape (m, 3), optional
        Points that are there too and are not judged, such as the ground: to the rule
        ``protective`` a gravestone without it hovers. The other rules do not look at them.

    Returns
    -------
    Selection
        ``removal_margin`` (n,), above 1 for removed points, at most 1 for kept ones, and
        ``curvature`` (n,): surface variation, 0 .. 1/3, of the 12 nearest (``protective``) or in
        the ball of radius_init_m.
        ``protective`` adds ``removal_reason`` (n,) uint8 (`protective.Taken`) and ``spacing_m``
        (n,), and a note where removal concentrates on fine geometry.

    Raises
    ------
    InputError
        `points` or `beside` is not (n, 3) or not finite; points lie too far apart for the balls of
        ``paper`` and ``global``; `solid_voxel_count` is set and there is not one `voxel_count` per
        point.

    Notes
    -----
    ``paper`` and ``global`` round coordinates to 2**-18 m (for 0.3 m) and sum exact integers;
    steps and cells begin at the low corner of the cloud without far points. So nothing depends on
    the order of the points or the origin of their frame. The cost of an exact ball grows with the
    square root of the points in it, that of a fast one does not.
    Tile class: local, with the halo of `halo_m` (``paper``: 2 radius_init_m + radius_max_m, fast
    0.22 radius_init_m more); ``global`` is two-pass. ``protective`` reaches 17 reach_m far, but
    tiles read 5 (`surroundings.HALO`): groups are joined across their borders.
    """
    p = params or CurvatureWeighted()
    if p.rule == "protective":
        return _protective(points, p, voxel_count, beside, None if whole is None else whole.low)
    found = _judge(points, p, whole)
    is_outlier, margin = found.verdict(p)
    chosen = Selection(
        is_kept=found.unsorted(~is_outlier),
        attributes={
            "curvature": found.unsorted(found.curvature),
            "removal_margin": found.unsorted(margin),
        },
    )
    return _with_solid(chosen, p, voxel_count)


def _protective(
    points: ArrayLike,
    p: CurvatureWeighted,
    voxel_count: ArrayLike | None,
    beside: ArrayLike | None,
    low: NDArray[np.float64] | None,
) -> Selection:
    own = as_points(points)
    seen = own if beside is None else np.concatenate([own, as_points(beside)])
    found = protective.judge(seen, p.tests, p.reach_m, low)
    ease = protective.ease_of(lambda: (found.curvature,), len(seen), p.reach_m)
    verdict = found.of_first(len(own))
    chosen = protective_choice(verdict.margin, verdict.reason, p, voxel_count)
    note = None
    if len(chosen.is_kept):
        spacing_m = float(np.median(verdict.spacing_m))
        note = concentration_note(own, chosen.is_kept, verdict.curvature, spacing_m)
    more = {"curvature": verdict.curvature, "spacing_m": verdict.spacing_m}
    return Selection(
        is_kept=chosen.is_kept,
        attributes={**chosen.attributes, **more},
        notes=(*protective.ease_notes(ease), *(() if note is None else (note,))),
    )


def protective_choice(
    margin: Values, reason: NDArray[np.uint8], p: CurvatureWeighted, voxel_count: ArrayLike | None
) -> Selection:
    """Return the choice of rule ``protective``, solid voxels spared where that is asked."""
    chosen = Selection(
        is_kept=reason == protective.Taken.KEPT, attributes={"removal_margin": margin}
    )
    chosen = _with_solid(chosen, p, voxel_count)
    reason = np.where(chosen.is_kept, protective.Taken.KEPT, reason).astype(np.uint8)
    return replace(chosen, attributes={**chosen.attributes, "removal_reason": reason})


def _with_solid(
    chosen: Selection, p: CurvatureWeighted, voxel_count: ArrayLike | None
) -> Selection:
    """Return the choice with the points that stand for many, where `p` asks for that."""
    n, at_least = len(chosen.is_kept), p.solid_voxel_count
    if at_least is None or not n:
        return chosen
    if voxel_count is None:
        msg = (
            f"solid_voxel_count is {at_least} but no voxel_count came with the points. "
            "Decimate with octree_voxel_grid first, or leave solid_voxel_count out."
        )
        raise InputError(msg)
    counts = np.asarray(voxel_count)
    if counts.shape != (n,):
        raise InputError(f"voxel_count must have shape ({n},), got {counts.shape}.")
    return spare(chosen, counts >= at_least)
