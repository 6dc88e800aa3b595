"""Fine registration: multi-scale robust ICP on what both clouds show (METHOD.md 3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dougong._checks import as_transform
from dougong.errors import RegistrationError
from dougong.params import Parameters
from dougong.registration.covariance import Jackknife, count_blocks, jackknife, unobservable
from dougong.registration.icp_solve import (
    Robust,
    gravity_prior,
    levelled,
    moved_by,
    normal_equations,
    robust_weights,
    robust_widening,
    solve,
    weighted_median,
    with_prior,
)
from dougong.registration.overlap import (
    Pairs,
    Rung,
    find_pairs,
    inverse,
    overlap_share,
    rung,
)
from dougong.registration.prepare import Prepared
from dougong.registration.result import FineResult
from dougong.threads import each
from dougong.typing import Index, Transform, Values

_LEAST_PAIRS = 60
_NO_COMMON_UP_DEG = 10.0
_MOST_SEARCHED = 300_000
_SECTORS = 6
"""Of half a turn: walls that face within 15 degrees of each other are one kind of surface."""
_UPWARD = 0.7
"""The rise of a normal from which on it is no wall's."""


class Icp(Parameters):
    """Iterative closest points, coarse to fine."""

    method: Literal["point-to-plane", "point-to-point"] = "point-to-plane"
    """What is made small: distances along normals, or between points."""
    dof: Literal[4, 6] = 6
    """4: turn about the vertical and shift (both clouds levelled); 6: rigid."""
    levels: Annotated[int, Field(ge=1, le=10)] = 4
    """Steps from the first to the last distance bound, geometric."""
    first_distance_m: Annotated[float, Field(gt=0)] | None = None
    """Widest bound of a correspondence; by default 10 working spacings."""
    last_distance_m: Annotated[float, Field(gt=0)] | None = None
    """Tightest bound; by default 1.5 working spacings, or 4 sigma of the sensors if wider."""
    points_per_level: Annotated[int, Field(ge=100)] = 30_000
    """At most so many points of each cloud, evenly spread, look for a partner on one level."""
    max_iterations: Annotated[int, Field(ge=1)] = 40
    """Per level."""
    tolerance_m: Annotated[float, Field(gt=0)] = 5e-5
    """A level ends when a step moves the overlap by less; wider levels end at 20 times this."""
    normal_angle_deg: Annotated[float, Field(gt=0, lt=90)] = 40.0
    """Normals of a pair differ by less."""
    robust: Robust = "tukey"
    """Weight function of residuals; its scale follows the median residual of the level."""
    gravity_sigma_deg: Annotated[float, Field(gt=0)] = 1.0
    """How far the two verticals may differ: 0.005 for a compensated scanner, 1 when unknown."""
    block_m: Annotated[float, Field(gt=0)] = 5.0
    """Edge of the blocks within which errors count once."""
    both_ways: bool = True
    """Pairs from source to target and from target to source."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One step of the ladder: both clouds thinned, and the bound of a correspondence."""

    source: Rung
    target: Rung
    bound_m: float
    up_source: NDArray[np.float64]
    """(3,) the vertical in each cloud's own frame."""
    up_target: NDArray[np.float64]
    has_common_up: bool


def build_levels(source: Prepared, target: Prepared, params: Icp) -> tuple[Level, ...]:
    """Return the levels, widest first; they serve every pose that is refined."""
    for name, prepared in (("source", source), ("target", target)):
        if len(prepared.xyz) < _LEAST_PAIRS:
            msg = (
                f"the {name} cloud has {len(prepared.xyz)} usable points; a fit needs at least "
                f"{_LEAST_PAIRS}. Filter less, or check the units."
            )
            raise RegistrationError(msg)
    spacing = max(source.spacing_m, target.spacing_m)
    first = params.first_distance_m or 10.0 * spacing
    sigma = float(np.hypot(source.sigma_m, target.sigma_m))
    last = params.last_distance_m or max(1.5 * spacing, 4.0 * sigma)
    last = min(last, first)
    bounds = np.geomspace(first, last, params.levels) if params.levels > 1 else [last]

    def rungs(prepared: Prepared) -> list[Rung]:
        few = params.points_per_level
        return [rung(prepared, bound / 4.0, _MOST_SEARCHED, few) for bound in bounds]

    return tuple(
        Level(
            source=one,
            target=other,
            bound_m=float(bound),
            up_source=source.up,
            up_target=target.up,
            # One vertical from the walls and one from the instrument are not comparable.
            has_common_up=source.is_relevelled == target.is_relevelled,
        )
        for one, other, bound in zip(*each(rungs, (source, target)), bounds, strict=True)
    )


def refine(
    source: Prepared, target: Prepared, T_initial: Transform, params: Icp | None = None
) -> FineResult:
    """Return the pose near `T_initial` that lays `source` on `target`.

    Parameters
    ----------
    source, target : Prepared
        In their local frames, metres, z up.
    T_initial : ndarray, shape (4, 4)
        Rigid, source local -> target local; within about `first_distance_m` of the answer.
    params : Icp, optional

    Returns
    -------
    FineResult
        With a 6x6 covariance and the directions that the overlap does not hold.

    Raises
    ------
    RegistrationError
        A cloud has too few points.
    """
    params = params or Icp()
    return refine_levels(build_levels(source, target, params), T_initial, params)


def refine_levels(levels: tuple[Level, ...], T_initial: Transform, params: Icp) -> FineResult:
    """Return `refine` on levels built before."""
    history: list[Mapping[str, float]] = []
    T, stopped = _climbed(levels, T_initial, params, history)
    return _result(levels[-1], T, params, stopped, history)


def refined_pose(levels: tuple[Level, ...], T_initial: Transform, params: Icp) -> Transform:
    """Return the pose of `refine` alone, on levels built before: a third of the work is figures."""
    return _climbed(levels, T_initial, params, None)[0]


def _climbed(
    levels: tuple[Level, ...],
    T_initial: Transform,
    params: Icp,
    history: list[Mapping[str, float]] | None,
) -> tuple[Transform, str]:
    """Return the pose at the top of the levels, and why its last level ended.

    What every step found is added to `history`, if there is one.
    """
    T = as_transform(T_initial, "T_initial")
    if params.dof == 4:
        T = levelled(T, levels[-1].target.xyz.mean(axis=0))
    for number, level in enumerate(levels):
        T, _ = _run_level(level, T, params, number, 20.0 * params.tolerance_m, history)
    # Every kind of surface lies on the other cloud now: the exact fit is by the sharpest of all.
    last = len(levels) - 1
    return _run_level(levels[-1], T, params, last, params.tolerance_m, history, by_facing=False)


def _run_level(
    level: Level,
    T: Transform,
    params: Icp,
    number: int,
    tolerance_m: float,
    history: list[Mapping[str, float]] | None,
    *,
    by_facing: bool = True,
) -> tuple[Transform, str]:
    cosine = float(np.cos(np.radians(params.normal_angle_deg)))
    for _ in range(params.max_iterations):
        pairs = find_pairs(
            level.source, level.target, T, level.bound_m, cosine, both_ways=params.both_ways
        )
        if len(pairs.residuals) < _LEAST_PAIRS:
            return T, f"fewer than {_LEAST_PAIRS} correspondences within {level.bound_m:.3g} m"
        weights, scale = _weights(pairs, level, params, by_facing=by_facing)
        centre, length = centre_and_length(pairs, weights)
        step = _step(pairs, weights, T, centre, length, scale, level, params)
        T = moved_by(T, step, centre)
        motion = float(np.linalg.norm(step[:3]) * length + np.linalg.norm(step[3:]))
        if history is not None:
            history.append(
                {
                    "level": float(number),
                    "max_distance_m": level.bound_m,
                    "inlier_rmse_m": _inlier_rmse_m(pairs, weights, params),
                    "fitness": _asked_share(pairs.source, level),
                    "step_m": motion,
                }
            )
        if motion < tolerance_m:
            return T, f"the last step moved the overlap by less than {1e3 * tolerance_m:.3g} mm"
    return T, f"{params.max_iterations} iterations at {level.bound_m:.3g} m without coming to rest"


def _distance(pairs: Pairs, params: Icp) -> Values:
    if params.method == "point-to-plane":
        return pairs.residuals
    lengths: Values = np.linalg.norm(pairs.offsets, axis=1)
    return lengths


def _weights(
    pairs: Pairs, level: Level, params: Icp, *, by_facing: bool = False
) -> tuple[Values, float]:
    """Return weight per pair and the robust sigma of the residuals, metres.

    With `by_facing` surfaces that face another way have a sigma of their own.
    """
    distance = np.abs(_distance(pairs, params))
    # Never stricter than the sensors: what bends by a noise's width stays in.
    floor = max(float(np.hypot(level.source.sigma_m, level.target.sigma_m)), 1e-3 * level.bound_m)
    scale = max(1.4826 * weighted_median(distance, pairs.weights), floor)
    if by_facing and params.method == "point-to-plane":
        distance = distance * (scale / _scale_by_facing(pairs, distance, scale))
    return pairs.weights * robust_weights(distance, scale, params.robust), scale


def _scale_by_facing(pairs: Pairs, distance: Values, scale: float) -> Values:
    """Return the robust sigma (n,) of each pair: that of the walls that face as it does.

    Ground and most walls may lie on each other to millimetres while the few walls that hold one
    direction are decimetres off: by one sigma for all they would be outliers, and stay so. What
    faces up has the one of all: roofs seen from either side are a thickness apart, and stay out.
    """
    is_wall = np.abs(pairs.normals[:, 2]) <= _UPWARD
    turn = np.arctan2(pairs.normals[:, 1], pairs.normals[:, 0])
    sector = np.floor((turn / np.pi % 1.0) * _SECTORS + 0.5).astype(np.int64) % _SECTORS
    own = np.full(len(distance), scale)
    for one in range(_SECTORS):
        is_one = is_wall & (sector == one)
        if int(is_one.sum()) >= _LEAST_PAIRS:
            of_one = weighted_median(distance[is_one], pairs.weights[is_one])
            own[is_one] = max(scale, 1.4826 * of_one)
    return own


def centre_and_length(pairs: Pairs, weights: Values) -> tuple[NDArray[np.float64], float]:
    """Return the centre (3,) of the paired surface and its root-mean-square radius, metres."""
    total = max(float(weights.sum()), 1e-300)
    centre = weights @ pairs.points / total
    spread = np.einsum("ij,ij->i", pairs.points - centre, pairs.points - centre)
    return centre, max(float(np.sqrt(weights @ spread / total)), 1e-3)


def _step(
    pairs: Pairs,
    weights: Values,
    T: Transform,
    centre: NDArray[np.float64],
    length: float,
    scale: float,
    level: Level,
    params: Icp,
) -> NDArray[np.float64]:
    """Return the motion (6,) of one Gauss-Newton step."""
    blocks = count_blocks(pairs.points, params.block_m)
    block = np.zeros(len(weights), dtype=np.int64)
    arms = pairs.points - centre
    if params.method == "point-to-plane":
        H, g = normal_equations(arms, pairs.normals, pairs.residuals, weights, block, 1)
    else:
        H, g = np.zeros((1, 6, 6)), np.zeros((1, 6))
        for axis, unit in enumerate(np.eye(3)):
            normals = np.broadcast_to(unit, arms.shape)
            parts = normal_equations(arms, normals, pairs.offsets[:, axis], weights, block, 1)
            H, g = H + parts[0], g + parts[1]
    sigma_deg = params.gravity_sigma_deg if level.has_common_up else _NO_COMMON_UP_DEG
    sigma_rad = float(np.radians(sigma_deg))
    H_all, g_all = with_prior(
        H.sum(axis=0),
        g.sum(axis=0),
        gravity_prior(T[:3, :3] @ level.up_source, level.up_target, sigma_rad),
        weight_sum=float(weights.sum()),
        scale_m=scale,
        blocks=blocks,
    )
    return solve(H_all, g_all, params.dof, length)


def _asked_share(source: Index, level: Level) -> float:
    """Return the share of the asked source points among the paired points `source`."""
    return float(np.isin(level.source.asked, source).mean())


def _inlier_rmse_m(pairs: Pairs, weights: Values, params: Icp) -> float:
    """Return the root mean square distance of the pairs with robust `weights` above 0.

    Each by the surface that it stands for: robust weights would tell the middle of a distribution.
    """
    surface = pairs.weights * (weights > 0.0)
    square = np.square(_distance(pairs, params))
    return float(np.sqrt(surface @ square / max(float(surface.sum()), 1e-300)))


def _result(
    level: Level, T: Transform, params: Icp, stopped: str, history: list[Mapping[str, float]]
) -> FineResult:
    """Return the fit's figures, worked out at the final pose."""
    cosine = float(np.cos(np.radians(params.normal_angle_deg)))
    pairs = find_pairs(
        level.source, level.target, T, level.bound_m, cosine, both_ways=params.both_ways
    )
    is_enough = len(pairs.residuals) >= _LEAST_PAIRS
    centre = level.target.xyz.mean(axis=0)
    found, rmse, fitness = Jackknife(None, 0, 1.0), float("nan"), 0.0
    loose: tuple[Mapping[str, Any], ...] = ()
    if is_enough:
        weights, scale = _weights(pairs, level, params)
        centre, length = centre_and_length(pairs, weights)
        found = jackknife(pairs, weights, centre, params.dof, length, params.block_m)
        if found.covariance is not None:
            distance = np.abs(_distance(pairs, params))
            robust = robust_widening(distance, pairs.weights, scale, params.robust)
            found = found._replace(covariance=robust * found.covariance)
        loose = unobservable(pairs, weights, centre, params.dof, length, params.block_m)
        is_inlier = weights > 0.0
        rmse = _inlier_rmse_m(pairs, weights, params)
        fitness = _asked_share(pairs.source[is_inlier], level)
    return FineResult(
        T_target_source=T,
        method=params.method,
        iterations=len(history),
        stopped=stopped,
        fitness=fitness,
        inlier_rmse_m=rmse,
        max_distance_m=level.bound_m,
        overlap_source=overlap_share(level.source, level.target, T, level.bound_m),
        overlap_target=overlap_share(level.target, level.source, inverse(T), level.bound_m),
        covariance=found.covariance,
        covariance_about=centre,
        covariance_blocks=found.blocks,
        covariance_widening=found.widening,
        unobservable=loose,
        history=tuple(history),
    )
