"""Fine registration with the scale of one cloud as a seventh unknown, and how well it is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from dougong.filters.neighbourhood import build_index
from dougong.registration.covariance import Jackknife, blocks_of, count_blocks, leave_blocks_out
from dougong.registration.icp import Icp, Level, build_levels, centre_and_length
from dougong.registration.icp_solve import (
    gravity_prior,
    grown_by,
    levelled,
    plane_rows,
    robust_weights,
    robust_widening,
    weighted_median,
    with_prior,
)
from dougong.registration.overlap import Pairs, Rung, find_pairs
from dougong.registration.prepare import MIN_POINTS, Prepared
from dougong.typing import Index, Mask, Transform, Values

FREE_WITH_SCALE = {5: (2, 3, 4, 5, 6), 7: (0, 1, 2, 3, 4, 5, 6)}
"""Which of (omega, v, ln s) move, by degrees of freedom."""
_LEAST_PAIRS = 60
_FLOOR = 1e-5
_FACING = 0.3
_LEAST_FACING_SHARE = 0.02
_LEAST_FACING_BLOCKS = 3
_sure: WeakKeyDictionary[Prepared, Prepared] = WeakKeyDictionary()
"""Clouds without unsure roofs: a search fits many scales, and their search indices are kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimilarityFit:
    """A pose and a factor of scale, fitted together."""

    T_target_source: Transform
    """Rigid, with the free cloud already multiplied by `factor`."""
    factor: float
    """Multiply the free cloud's lengths by this."""
    covariance: NDArray[np.float64] | None
    """(7, 7) of (omega rad, v m, ln s) about `centre`, block jackknife; None: too few blocks.
    For x' = c + s Exp(omega)(x - c) + v; s scales the *source*, whichever cloud is free."""
    blocks: int
    """Blocks of surface behind `covariance`; 0 where it is None."""
    centre: NDArray[np.float64]
    """(3,), local target coordinates, metres."""
    length_m: float
    """Root-mean-square radius of the paired surface: what ln s moves by."""
    holds_scale: bool
    """False: growing, with whatever motion goes best with it, leaves the surface in itself."""


def fit_similarity(
    source: Prepared,
    target: Prepared,
    T: Transform,
    side: Literal["source", "target"],
    icp: Icp,
    dof: int,
) -> SimilarityFit | None:
    """Fit pose and scale near `T`; distances are measured in metres of the cloud that stays.

    Parameters
    ----------
    source, target : Prepared
        The free one of them within about 3 % of its size.
    T : ndarray, shape (4, 4)
        Rigid, source local -> target local.
    side : {"source", "target"}
        Which cloud is free.
    icp : Icp
    dof : int
        5 (levelled) or 7.

    Returns
    -------
    SimilarityFit or None
        None: the clouds have too little in common near `T`.

    Notes
    -----
    Roofs of which nobody knows the side are left out where the rest holds the scale: the undersides
    that a scanner saw, laid on the tops that a flight saw, made a pagoda 0.8 % too small.
    """
    sure = _without_unsure_roofs(source), _without_unsure_roofs(target)
    if sure != (source, target):
        fit = _fit(*sure, T, side, icp, dof)
        if fit is not None and fit.holds_scale:
            return fit
    return _fit(source, target, T, side, icp, dof)


def _without_unsure_roofs(cloud: Prepared) -> Prepared:
    """Return the cloud without roofs of unknown side; itself where there are none, or all are."""
    is_sure = ~cloud.is_unsure_roof
    if is_sure.all() or int(is_sure.sum()) < MIN_POINTS:
        return cloud
    if cloud not in _sure:
        _sure[cloud] = cloud.chosen(is_sure)
    return _sure[cloud]


def _fit(
    source: Prepared,
    target: Prepared,
    T: Transform,
    side: Literal["source", "target"],
    icp: Icp,
    dof: int,
) -> SimilarityFit | None:
    free = FREE_WITH_SCALE[dof]
    if dof == 5:
        T = levelled(T, target.xyz.mean(axis=0))
    factor = 1.0
    fitted = None
    for number, level in enumerate(build_levels(source, target, _settings(icp, source, target))):
        for _ in range(10):
            fitted = _paired(_scaled_level(level, factor, side), T, icp)
            if fitted is None:
                return None
            step, length = _step(fitted, T, level, icp, free)
            T, factor = grown(T, factor, step, fitted.centre, side)
            motion = length * (np.linalg.norm(step[:3]) + abs(step[6])) + np.linalg.norm(step[3:6])
            if motion < (1e-3 if number < 2 else 2e-5):
                break
            if not 0.7 < factor < 1.4:
                return None
    fitted = _paired(_scaled_level(level, factor, side), T, icp)
    return None if fitted is None else _result(fitted, T, factor, icp, free)


def _settings(icp: Icp, source: Prepared, target: Prepared) -> Icp:
    spacing = max(source.spacing_m, target.spacing_m)
    sigma = float(np.hypot(source.sigma_m, target.sigma_m))
    last = icp.last_distance_m or max(1.5 * spacing, 4.0 * sigma)
    return icp.model_copy(
        update={
            "levels": 3,
            "points_per_level": 15_000,
            "first_distance_m": max(1.5, 10 * spacing),
            "last_distance_m": last,
        }
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fitted:
    """The pairs of one pose, linearised."""

    pairs: Pairs
    weights: Values
    rows: NDArray[np.float64]
    """(k, 7) d residual / d (omega, v, ln s)."""
    centre: NDArray[np.float64]
    length: float
    scale_m: float


def _scaled_level(level: Level, factor: float, side: str) -> Level:
    """Return the level with its free cloud multiplied by `factor`."""
    if side == "source":
        return replace(level, source=_scaled_rung(level.source, factor))
    return replace(level, target=_scaled_rung(level.target, factor))


def _scaled_rung(rung: Rung, factor: float) -> Rung:
    xyz = rung.xyz * factor
    return replace(rung, xyz=xyz, neighbours=build_index(xyz))


def _paired(level: Level, T: Transform, icp: Icp) -> _Fitted | None:
    cosine = float(np.cos(np.radians(icp.normal_angle_deg)))
    pairs = find_pairs(level.source, level.target, T, level.bound_m, cosine, both_ways=True)
    if len(pairs.residuals) < _LEAST_PAIRS:
        return None
    distance = np.abs(pairs.residuals)
    floor = max(float(np.hypot(level.source.sigma_m, level.target.sigma_m)), 1e-3 * level.bound_m)
    scale = max(1.4826 * weighted_median(distance, pairs.weights), floor)
    weights = pairs.weights * robust_weights(distance, scale, icp.robust)
    centre, length = centre_and_length(pairs, weights)
    rows = plane_rows(pairs.points - centre, pairs.normals, with_scale=True)
    return _Fitted(
        pairs=pairs, weights=weights, rows=rows, centre=centre, length=length, scale_m=scale
    )


def _step(
    fitted: _Fitted, T: Transform, level: Level, icp: Icp, free: Sequence[int]
) -> tuple[NDArray[np.float64], float]:
    """Return the Gauss-Newton step (7,) and the length that turns angles into metres."""
    H = (fitted.rows * fitted.weights[:, None]).T @ fitted.rows
    g = fitted.rows.T @ (fitted.weights * fitted.pairs.residuals)
    sigma = float(np.radians(icp.gravity_sigma_deg if level.has_common_up else 10.0))
    prior = gravity_prior(T[:3, :3] @ level.up_source, level.up_target, sigma)
    H[:6, :6], g[:6] = with_prior(
        H[:6, :6],
        g[:6],
        prior,
        weight_sum=float(fitted.weights.sum()),
        scale_m=fitted.scale_m,
        blocks=count_blocks(fitted.pairs.points, icp.block_m),
    )
    return _solved(H, g, free, fitted.length), fitted.length


def _solved(
    H: NDArray[np.float64], g: NDArray[np.float64], free: Sequence[int], length_m: float
) -> NDArray[np.float64]:
    """Return the step (7,) over the free unknowns; what has no information stays."""
    chosen = list(free)
    scale = np.array([length_m] * 3 + [1.0] * 3 + [length_m])[chosen]
    values, vectors = np.linalg.eigh(H[np.ix_(chosen, chosen)] / np.outer(scale, scale))
    is_stiff = values > _FLOOR * max(float(values[-1]), 1e-300)
    inverse = np.where(is_stiff, 1.0 / np.where(is_stiff, values, 1.0), 0.0)
    step = np.zeros(7)
    step[chosen] = -(vectors @ (inverse * (vectors.T @ (g[chosen] / scale)))) / scale
    return step


def grown(
    T: Transform, factor: float, step: NDArray[np.float64], centre: NDArray[np.float64], side: str
) -> tuple[Transform, float]:
    """Return pose and factor after x' = c + s Exp(omega)(x - c) + v, one cloud scaled by it.

    With x = T p: a free source takes the s (p grows to s p); for a free target everything is
    divided by s instead, so that the source keeps its metres.
    """
    s = float(np.exp(step[6]))
    result = grown_by(T, step, centre)
    result[:3, :3] /= s
    if side == "source":
        return result, factor * s
    result[:3, 3] /= s
    return result, factor / s


def _result(
    fitted: _Fitted, T: Transform, factor: float, icp: Icp, free: Sequence[int]
) -> SimilarityFit:
    found = _jackknife(fitted, free, icp.block_m)
    pairs = fitted.pairs
    widening = robust_widening(np.abs(pairs.residuals), pairs.weights, fitted.scale_m, icp.robust)
    return SimilarityFit(
        T_target_source=T,
        factor=factor,
        covariance=None if found.covariance is None else widening * found.covariance,
        blocks=found.blocks,
        centre=fitted.centre,
        length_m=fitted.length,
        holds_scale=_holds_scale(fitted, free, icp.block_m),
    )


def _jackknife(fitted: _Fitted, free: Sequence[int], block_m: float) -> Jackknife:
    """Return the (7, 7) covariance."""

    def equations(block: Index, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        H, g = np.zeros((count, 7, 7)), np.zeros((count, 7))
        order = np.argsort(block, kind="stable")
        ends = np.searchsorted(block[order], np.arange(count + 1))
        for b in range(count):
            here = order[ends[b] : ends[b + 1]]
            rows, weights = fitted.rows[here], fitted.weights[here]
            H[b] = (rows * weights[:, None]).T @ rows
            g[b] = rows.T @ (weights * fitted.pairs.residuals[here])
        return H, g

    unit = np.array([fitted.length] * 3 + [1.0] * 3 + [fitted.length])
    return leave_blocks_out(
        fitted.pairs.points,
        equations,
        lambda H, g: _solved(H, g, free, fitted.length),
        unit,
        block_m,
    )


def _holds_scale(fitted: _Fitted, free: Sequence[int], block_m: float) -> bool:
    """Say whether enough surface, in enough places, faces a change of scale.

    The motion that goes best with growing is taken with it (all planes through one point grow
    into themselves): what is left must be faced by surface, as `covariance.unobservable` asks.
    """
    weights, rows = fitted.weights, fitted.rows
    others = [place for place in free if place != 6]
    rigid = rows[:, others]
    H = (rigid * weights[:, None]).T @ rigid
    along = -np.linalg.pinv(H, hermitian=True) @ (rigid.T @ (weights * rows[:, 6]))
    step = np.zeros(7)
    step[others], step[6] = along, 1.0
    arms = fitted.pairs.points - fitted.centre
    motion = np.linalg.norm(np.cross(step[:3], arms) + step[3:6] + arms, axis=1)
    facing: Mask = np.abs(rows @ step) > _FACING * np.maximum(motion, 0.3 * fitted.length)
    block, count = blocks_of(fitted.pairs.points, block_m)
    held = np.bincount(block[facing], weights[facing], count)
    total = float(weights.sum())
    is_spread = int((held > 0.02 * total / count).sum()) >= min(_LEAST_FACING_BLOCKS, count)
    return bool(float(weights[facing].sum()) >= _LEAST_FACING_SHARE * total and is_spread)
