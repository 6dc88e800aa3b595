"""What each point of two clouds says about a pose: how badly the other cloud contradicts it.

One number per point, 0 (explained) to 1 (contradicted), worked out on the same points for every
pose, so that poses can be compared pair by pair (METHOD.md 2.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import cells_in_plan
from dougong.filters import neighbourhood
from dougong.registration.free_space import FreeSpace, free_space
from dougong.registration.overlap import (
    Rung,
    apply,
    do_agree,
    inverse,
    rung,
)
from dougong.registration.prepare import Prepared
from dougong.threads import each
from dougong.typing import Mask, Points, Transform, Values

_JUDGED_POINTS = 15_000
_SEARCHED_POINTS = 250_000
# Bending and roughness of a drone cloud that no rigid pose can take away.
_BENDING_M = 0.03
_RAMP_M = 0.3
_GROUND_SHARE = 0.1
# Nearly as bad as contradicted: else a pose could win by moving the clouds apart.
_OUTSIDE = 0.8
_AWAY_M = 0.5
_AWAY_UP_M = 0.3
_AWAY_SPACINGS = 2.0
# A surface is left by a shift that it faces within 60 degrees ...
_FACING_COSINE = 0.5
# ... and a direction that less than this share of the structure faces is not asked about:
# whether it is held at all is what `covariance.unobservable` says.
_LEAST_FACING = 0.02
_VIOLATION = 1.5
# Of so many neighbours more than half must lie within about 26 degrees of the same plane.
_NEIGHBOURS, _MOST_NEIGHBOURS = 12, 64
_FIRM_COSINE = 0.9
# So do as many again as a surface has around a point within this, in dense clouds: planes of the
# nearest share their points, and agree by that alone in a crown or among strays. Under a true pose
# of 2e6 points with 10 % strays 10 % of the "structure" violated free space, 2 % with this.
_FIRM_M = 0.4
# No roof or floor is thicker: what lies deeper below a top is not its underside.
_THICKEST_M = 0.4
_ABOVE_TOP_M = 0.75
# Less of the structure than this, seen by chance, says nothing about free space.
_LEAST_VISIBLE = 0.02
_NORMAL_COSINE = float(np.cos(np.radians(45.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """Which cells in plan a cloud covers, and the highest surface over each (its DSM)."""

    low: NDArray[np.float64]
    cell_m: float
    covered: NDArray[np.bool_]
    """Cells with points in them or beside them."""
    within: NDArray[np.bool_]
    """Cells whose neighbours are all covered by points: a cell's width and more from the edge."""
    top: NDArray[np.float64]

    def at(self, points: Points) -> tuple[Mask, Mask, Values]:
        """Return is_inside, is_within and the top (-inf outside) for `points` (n, 3)."""
        is_on, i, j = cells_in_plan(points, self.low, self.cell_m, self.covered.shape)
        is_inside: Mask = is_on & self.covered[i, j]
        is_within: Mask = is_on & self.within[i, j]
        return is_inside, is_within, np.where(is_on, self.top[i, j], -np.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class Witness:
    """One cloud: the points that are heard, and all that others are compared with."""

    points: Points
    normals: Points
    is_oriented: Mask
    """(n,) the normal's sign is sure."""
    is_top: Mask
    """(n,) surely seen from above."""
    may_be_underside: Mask
    """(n,) of a roof of which nobody knows the side."""
    weights: Values
    """(n,) square metres, flat ones more, ground a tenth: flat ground agrees with any pose."""
    is_structure: Mask
    """(n,) flat and standing above the ground."""
    is_firm: Mask
    """(n,) of a surface that goes on: leaves may be flat too, but not as those beside them are."""
    everything: Rung
    slack: Values
    """Half-distance between neighbours of `everything`: what a gap between points may add."""
    plan: _Plan
    sees_tops: bool
    """Taken from above: what stands higher than its surface contradicts it."""
    free: FreeSpace | None = None
    """What its scanner saw through; None where it is not one scan, or from an unknown place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Court:
    """Both clouds and the distance at which a point counts as explained."""

    source: Witness
    target: Witness
    tolerance_m: float

    @property
    def weights(self) -> Values:
        """Weights of source points, then target points."""
        return np.concatenate([self.source.weights, self.target.weights])


@dataclass(frozen=True, slots=True, kw_only=True)
class Testimony:
    """What all points, source's then target's, say about one pose."""

    T: Transform
    loss: Values
    """(m,) 0 explained .. 1 contradicted, 1.5 where free space is violated; 0.8 outside the
    other cloud's plan, where nothing can be said."""
    is_explained: Mask
    is_comparable: Mask
    """(m,) the other cloud shows something near."""
    is_inside: Mask
    """(m,) inside the other cloud's plan."""
    is_within: Mask
    """(m,) inside it and not at its edge."""
    is_visible: Mask
    """(m,) where the other sensor would have seen a surface: inside its plan, or in front of what
    its scanner saw."""
    total: float
    """Weighted mean loss."""


def summon(source: Prepared, target: Prepared) -> Court:
    """Return the court in which all poses of a pair are heard."""
    spacing = max(source.spacing_m, target.spacing_m)
    sigma = float(np.hypot(source.sigma_m, target.sigma_m))
    witnesses = each(_witness, (source, target))
    return Court(
        source=witnesses[0],
        target=witnesses[1],
        tolerance_m=min(3.0 * sigma + _BENDING_M, 0.15) + 0.1 * spacing,
    )


def _witness(prepared: Prepared) -> Witness:
    everything = rung(prepared, prepared.spacing_m, _SEARCHED_POINTS, _JUDGED_POINTS)
    heard = everything.index[everything.asked]
    planarity = np.clip(prepared.planarity[heard], 0.0, 1.0)
    is_ground = prepared.is_ground[heard]
    area = prepared.weights_area[heard]
    area = np.minimum(area / max(float(np.median(area)), 1e-12), 3.0)
    return Witness(
        points=prepared.xyz[heard],
        normals=prepared.normals[heard],
        is_oriented=everything.is_oriented[everything.asked],
        is_top=everything.is_top[everything.asked],
        may_be_underside=everything.may_be_underside[everything.asked],
        weights=area * np.square(planarity) * np.where(is_ground, _GROUND_SHARE, 1.0),
        is_structure=(planarity > 0.7) & ~is_ground,
        is_firm=_goes_on(everything),
        everything=everything,
        slack=0.75 * np.sqrt(prepared.weights_area[everything.index]),
        plan=_plan(prepared),
        sees_tops=prepared.kind == "photogrammetry",
        free=_free_space(prepared, everything),
    )


def _goes_on(everything: Rung) -> Mask:
    """Say of which heard points the planes of most neighbours, near and next, lie as theirs do."""
    asked = everything.asked
    around = np.pi * (_FIRM_M / everything.spacing_m) ** 2
    count = int(np.clip(round(around), _NEIGHBOURS, _MOST_NEIGHBOURS))
    near, _ = neighbourhood.knn(everything.neighbours, everything.xyz[asked], count + 1)
    own, others = everything.normals[asked], everything.normals[np.maximum(near, 0)]
    alike = np.abs(np.einsum("ij,ikj->ik", own, others)) > _FIRM_COSINE
    alike &= near >= 0
    # The point itself is among them.
    nearest, next_ones = np.hsplit(alike, [1 + _NEIGHBOURS])
    is_even = nearest.sum(axis=1) > 1 + _NEIGHBOURS // 2
    goes_on: Mask = is_even & (2 * next_ones.sum(axis=1) >= next_ones.shape[1])
    return goes_on


def _free_space(prepared: Prepared, everything: Rung) -> FreeSpace | None:
    if prepared.kind != "lidar":
        return None
    seen_from = None if prepared.seen_from is None else prepared.seen_from[everything.index]
    return free_space(everything.xyz, seen_from)


def _plan(prepared: Prepared) -> _Plan:
    cell = max(1.0, 4.0 * prepared.spacing_m)
    low = prepared.xyz[:, :2].min(axis=0) - 2.0 * cell
    ij = np.floor((prepared.xyz[:, :2] - low) / cell).astype(np.int64)
    size = ij.max(axis=0) + 3
    top = np.full(tuple(size), -np.inf)
    np.maximum.at(top, (ij[:, 0], ij[:, 1]), prepared.xyz[:, 2])
    wide = _widest(top)
    covered = np.isfinite(wide)
    # Gaps of a cell are closed, then the border is taken off twice: once what closing added.
    within = ~np.isfinite(_widest(_widest(np.where(covered, -np.inf, 0.0))))
    return _Plan(low=low, cell_m=cell, covered=covered, within=within, top=wide)


def _widest(raster: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the highest value (nx, ny) of every cell and its eight neighbours."""
    wide = raster.copy()
    for axis in (0, 1):
        wide = np.maximum(wide, np.maximum(np.roll(wide, 1, axis), np.roll(wide, -1, axis)))
    return wide


def hear(court: Court, T: Transform) -> Testimony:
    """Return what both clouds' points say about `T` (source -> target)."""
    one = _hear_one(court.source, court.target, T, court.tolerance_m)
    two = _hear_one(court.target, court.source, inverse(T), court.tolerance_m)
    loss, explained, comparable, inside, within, visible = (
        np.concatenate([a, b]) for a, b in zip(one, two, strict=True)
    )
    weights = court.weights
    return Testimony(
        T=T,
        loss=loss,
        is_explained=explained,
        is_comparable=comparable,
        is_inside=inside,
        is_within=within,
        is_visible=visible,
        total=float(weights @ loss / max(float(weights.sum()), 1e-300)),
    )


def _hear_one(
    from_: Witness, to: Witness, T: Transform, tolerance_m: float
) -> tuple[Values, Mask, Mask, Mask, Mask, Mask]:
    moved = apply(T, from_.points)
    normals = from_.normals @ T[:3, :3].T
    reach = tolerance_m + _RAMP_M
    index, distance = neighbourhood.nearest(to.everything.neighbours, moved, 2.0 * reach)
    is_near = index >= 0
    index = np.where(is_near, index, 0)
    other = to.everything.normals[index]
    offset = moved - to.everything.xyz[index]
    across = np.abs(np.einsum("ij,ij->i", other, offset))
    along = np.abs(np.einsum("ij,ij->i", normals, offset))
    # Either plane may be the noisy one: the smaller distance is the fairer.
    error = np.maximum(np.minimum(across, along), distance - to.slack[index] - tolerance_m)
    # An underside lies below its top by the roof's thickness, whatever that is.
    for is_slab, up, sign in (
        (from_.may_be_underside & to.everything.is_top[index], other, 1.0),
        (from_.is_top & to.everything.may_be_underside[index], normals, -1.0),
    ):
        above = sign * np.einsum("ij,ij->i", up, offset)
        aside = np.sqrt(np.clip(distance**2 - above**2, 0.0, None))
        apart = np.maximum(above, -above - _THICKEST_M)
        slab = np.maximum(apart, aside - to.slack[index] - tolerance_m)
        error = np.where(is_slab, np.clip(slab, 0.0, None), error)
    is_oriented = from_.is_oriented & to.everything.is_oriented[index]
    is_alike = do_agree(normals, other, is_oriented, _NORMAL_COSINE)
    error = np.where(is_near & is_alike, error, np.inf)
    is_inside, is_within, top = to.plan.at(moved)
    loss = np.where(is_inside, np.clip((error - tolerance_m) / _RAMP_M, 0.0, 1.0), _OUTSIDE)
    if to.sees_tops:
        loss[is_inside & (moved[:, 2] > top + _ABOVE_TOP_M)] = _VIOLATION
    is_explained = is_inside & (error <= tolerance_m)
    is_visible = is_inside
    # A drone's cloud bulges into the air under eaves: it is no witness against a scanner.
    if to.free is not None and not from_.sees_tops:
        through, is_visible = to.free.look(moved)
        loss[through & ~is_explained] = _VIOLATION
    return loss, is_explained, is_near & is_inside, is_inside, is_within, is_visible


def structure_weights(court: Court) -> Values:
    """Return the weights (m,) of flat points above the ground, 0 for all others."""
    return np.concatenate([w.weights * w.is_structure for w in (court.source, court.target)])


def support(court: Court, testimony: Testimony) -> float:
    """Return the share of structure near the other cloud that a pose explains.

    Among structure points that have some of the other cloud within about 0.7 m. The better of
    the two clouds counts: one may see what the other cannot.
    """
    weights, split = structure_weights(court), len(court.source.points)
    best = 0.0
    for part in (slice(0, split), slice(split, None)):
        domain = float(weights[part] @ testimony.is_comparable[part])
        # A cloud that has next to nothing in common cannot vouch for the pose.
        if domain > 0.1 * float(weights[part].sum()):
            best = max(best, float(weights[part] @ testimony.is_explained[part]) / domain)
    return best


def violation(court: Court, testimony: Testimony) -> float:
    """Return the share of visible structure that stands in the other sensor's free space.

    Of surfaces that go on: crowns of trees grow, move, and are lost by photogrammetry. The larger
    of both clouds' shares; one of which the other could see next to nothing is not asked.
    """
    is_firm = np.concatenate([court.source.is_firm, court.target.is_firm])
    weights, split = structure_weights(court) * is_firm, len(court.source.points)
    total, worst = float(weights.sum()), 0.0
    for part in (slice(0, split), slice(split, None)):
        visible = float(weights[part] @ testimony.is_visible[part])
        if visible > _LEAST_VISIBLE * total:
            worst = max(worst, float(weights[part] @ (testimony.loss[part] > 1.0)) / visible)
    return worst


def sharpness(court: Court, testimony: Testimony) -> float:
    """Return how many times more structure a pose explains than the poses 0.6 m around it.

    The least of eight ratios, one per neighbour half a metre away in plan and 0.3 m up or down
    (less for small objects, more for clouds whose points lie farther apart than 0.25 m). Each
    counts only the structure that faces the way to that neighbour: a wall slid along itself is
    explained as before, and says nothing. Two clouds of different places fit equally badly
    everywhere: about 1. Sensors that show little in common lower what is explained at the pose
    and beside it alike.
    """
    weights = structure_weights(court)
    total = float(weights.sum())
    normals = np.vstack([court.source.normals @ testimony.T[:3, :3].T, court.target.normals])

    def ratio(offset: NDArray[np.float64]) -> float:
        facing = np.abs(normals @ offset) > _FACING_COSINE * np.linalg.norm(offset)
        asked = weights * facing
        # Chance explains a few percent anywhere: ratios of less mean nothing.
        floor = 0.02 * float(asked.sum())
        if floor <= 0.02 * _LEAST_FACING * total:
            return np.inf
        away = testimony.T.copy()
        away[:3, 3] += offset
        beside = float(asked @ hear(court, away).is_explained)
        return float(asked @ testimony.is_explained) / max(beside, floor)

    least = min(each(ratio, _offsets(court)))
    return least if np.isfinite(least) else 0.0


def _offsets(court: Court) -> list[NDArray[np.float64]]:
    """Return the ways (3,) to the eight poses that a pose is held against."""
    size = float(np.ptp(court.source.points, axis=0).max())
    scale = min(1.0, max(size / 20.0, 6.0 * court.tolerance_m) / _AWAY_M)
    # What a thin cloud shows reaches as far as its points lie apart: look beyond that.
    spacing = max(court.source.everything.spacing_m, court.target.everything.spacing_m)
    scale = max(scale, _AWAY_SPACINGS * spacing / _AWAY_M)
    turns = np.arange(8) * (np.pi / 4.0)
    return [
        scale * np.array([_AWAY_M * np.cos(t), _AWAY_M * np.sin(t), _AWAY_UP_M * (-1.0) ** k])
        for k, t in enumerate(turns)
    ]
