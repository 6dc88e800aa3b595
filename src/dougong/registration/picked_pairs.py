"""Pairs of points that a person picked in two clouds: one more hypothesis, never a verdict.

The pose that fits the pairs best enters the same proof as every pose of the search. What the
pairs then say is compared with what the clouds say: where the two disagree, neither is believed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.registration.icp_solve import levelled, orthonormal
from dougong.registration.overlap import apply
from dougong.registration.result import Registration, Status
from dougong.registration.rivals import is_same
from dougong.registration.sanity import UNIT_RATIOS
from dougong.typing import Points, Transform, Values

if TYPE_CHECKING:
    from dougong.registration.verdict import Ruling

FEWEST = 3
_THIN = 0.03
"""Pairs whose second spread is below this share of their first lie on a line."""
_FAR_M = 0.5
_SCALE_OFF = 1.1
"""Distances that differ by more than this between the clouds are no two surveys of one place."""
_BAD_RATIO = 3.0
_BAD_M = 0.05
_LEVEL_DEG = 3.0
_RATIOS = {**UNIT_RATIOS, 3.280840: "feet", 39.37008: "inches"}


@dataclass(frozen=True, slots=True, kw_only=True)
class PickedPairs:
    """The same places in two clouds, in *file* coordinates and units."""

    names: tuple[str, ...]
    source: Points
    """(n, 3)"""
    target: Points
    """(n, 3)"""
    where: str = "the pairs"
    """What to call them in messages: the file's name."""
    record: dict[str, Any] = field(default_factory=dict)
    """What the result says of where they came from (path, SHA-256)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairFit:
    """The best rigid pose of the pairs; metres, local frames of both clouds."""

    pairs: PickedPairs
    source: Points
    target: Points
    T_target_source: Transform
    residuals: Values
    """(n,) metres: the distance that stays between the two points of each pair."""
    scale: float
    """Target length / source length, where a similarity fits best; 1 is expected."""
    bad: int | None
    """The pair that the others contradict; None: none, or too few pairs to tell."""
    unit_m: float = 1.0
    """Metres per unit of the target's file."""

    @property
    def rms_m(self) -> float:
        """Root mean square residual, metres; a measure of picking, not of accuracy."""
        return float(np.sqrt(np.mean(np.square(self.residuals))))


def fit_rigid(source: Points, target: Points) -> Transform:
    """Return the rigid (4, 4) that takes `source` (n, 3) to `target` (n, 3) best (Kabsch 1976)."""
    low, high = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - high).T @ (source - low))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    T = np.eye(4)
    T[:3, :3] = orthonormal((u * sign) @ vt)
    T[:3, 3] = high - T[:3, :3] @ low
    return T


def fit_pairs(pairs: PickedPairs, source: Cloud, target: Cloud) -> PairFit:
    """Check the pairs against the clouds and return their best rigid pose.

    Raises
    ------
    InputError
        Fewer than three pairs, pairs on one line, a point that is not in its cloud, or lengths
        that differ between the clouds (another unit).
    """
    count = len(pairs.names)
    if count < FEWEST:
        msg = (
            f"{pairs.where} holds {count} pair{'s' if count != 1 else ''}; at least {FEWEST}, not "
            "on one line, are needed to fix a pose. Pick more with `dougong view SOURCE TARGET`."
        )
        raise InputError(msg)
    one, two = source.frame.to_local(pairs.source), target.frame.to_local(pairs.target)
    _refuse_outside(pairs, one, two, source, target)
    for points, cloud in ((one, source), (two, target)):
        _refuse_line(pairs, points, cloud.name)
    bad = bad_pair(one, two)
    scale = _scale(one, two, bad)
    _refuse_units(pairs, scale, source, target)
    T = fit_rigid(one, two)
    residuals = np.linalg.norm(apply(T, one) - two, axis=1)
    return PairFit(
        pairs=pairs,
        source=one,
        target=two,
        T_target_source=T,
        residuals=residuals,
        scale=scale,
        bad=bad,
        unit_m=float(target.frame.unit_m[0]),
    )


def _scale(source: Points, target: Points, bad: int | None) -> float:
    """Return target length / source length over all pairs but the bad one."""
    kept = np.arange(len(source)) != (-1 if bad is None else bad)
    sizes = [np.square(p[kept] - p[kept].mean(axis=0)).sum() for p in (source, target)]
    return float(np.sqrt(sizes[1] / sizes[0]))


def _refuse_outside(
    pairs: PickedPairs, one: Points, two: Points, source: Cloud, target: Cloud
) -> None:
    trees = [cKDTree(cloud.xyz) for cloud in (source, target)]
    for points, tree, cloud, side in (
        (one, trees[0], source, "source"),
        (two, trees[1], target, "target"),
    ):
        far = np.asarray(tree.query(points)[0])
        limit = max(_FAR_M, 5.0 * _spacing(cloud, tree))
        if (far <= limit).all():
            continue
        swapped = trees[1].query(source.frame.to_file(one) - target.frame.origin)[0]
        if (np.asarray(swapped) <= limit).all() and not (far <= limit).any():
            msg = (
                f"{pairs.where} is the other way round: its source points lie in {target.name}. "
                "Give the clouds in the order in which they were picked."
            )
            raise InputError(msg)
        worst = int(far.argmax())
        msg = (
            f"{pairs.where}: the {side} point of {pairs.names[worst]} lies {far[worst]:.4g} m from "
            f"the nearest point of {cloud.name} (at most {limit:.2g} m expected). Give the "
            "coordinates of the file itself, in its units, and the clouds in the right order."
        )
        raise InputError(msg)


def _spacing(cloud: Cloud, tree: Any) -> float:
    """Return the median distance (metres) from a point to its nearest, over 500 of them."""
    sample = cloud.xyz[:: max(1, len(cloud) // 500)]
    return float(np.median(tree.query(sample, 2)[0][:, 1])) if len(cloud) > 1 else 0.0


def _refuse_line(pairs: PickedPairs, points: Points, name: str) -> None:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[0] > 0.0 and spread[1] > _THIN * spread[0]:
        return
    msg = (
        f"{pairs.where}: the {len(pairs.names)} points in {name} lie on one line (or in one "
        "place), so the turn about it stays free. Pick at least one pair well beside the line."
    )
    raise InputError(msg)


def _refuse_units(pairs: PickedPairs, scale: float, source: Cloud, target: Cloud) -> None:
    size = max(scale, 1.0 / scale)
    if size < _SCALE_OFF:
        return
    larger, other = (target, source) if scale > 1.0 else (source, target)
    near = min(_RATIOS, key=lambda ratio: abs(np.log(size / ratio)))
    if abs(np.log(size / near)) < np.log(1.1):
        msg = (
            f"{pairs.where}: lengths in {larger.name} are {size:.5g} times those in {other.name}, "
            f"as if it were in {_RATIOS[near]}; the same unit is expected. Scale it by "
            f"1/{near:g} (or give the file its unit) and pick again."
        )
        raise InputError(msg)
    msg = (
        f"{pairs.where}: lengths in {larger.name} are {size:.4g} times those in {other.name}; 1 is "
        "expected. Either pairs are mixed up, or one cloud is not in metres: check them."
    )
    raise InputError(msg)


def bad_pair(source: Points, target: Points) -> int | None:
    """Return the pair that the others contradict: without it they fit three times better.

    It must also miss where the others put it by five centimetres. Needs at least 4 pairs: any
    three can be bad together.
    """
    count = len(source)
    if count < FEWEST + 1:
        return None
    every = np.arange(count)
    rest = np.empty(count)
    miss = np.empty(count)
    for index in every:
        T = fit_rigid(source[every != index], target[every != index])
        off = np.linalg.norm(apply(T, source) - target, axis=1)
        rest[index] = np.sqrt(np.mean(np.square(off[every != index])))
        miss[index] = off[index]
    worst = int(rest.argmin())
    is_bad = miss[worst] > _BAD_M and miss[worst] > _BAD_RATIO * rest[worst]
    return worst if is_bad else None


def starts_of(fit: PairFit) -> list[Transform]:
    """Return the starting poses (local frames) that the pairs propose, best first.

    All pairs; without the bad one; and each of them levelled, where it is nearly level anyway
    (heights of a few near points tell little about the tilt).
    """
    poses = [fit.T_target_source]
    if fit.bad is not None:
        rest = np.arange(len(fit.source)) != fit.bad
        poses.insert(0, fit_rigid(fit.source[rest], fit.target[rest]))
    middle = fit.target.mean(axis=0)
    return poses + [levelled(T, middle) for T in poses if 0.05 < tilt_deg(T) < _LEVEL_DEG]


def tilt_deg(T: Transform) -> float:
    """Return the angle between the vertical and where `T` turns the vertical to."""
    return float(np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0))))


def levelling_turn(fit: PairFit) -> NDArray[np.float64] | None:
    """Return the rotation (3, 3) that levels the source, where the pairs say that it lies askew.

    None where the pairs leave the source's z axis within three degrees of the vertical.
    """
    T = starts_of(fit)[0]
    if tilt_deg(T) < _LEVEL_DEG:
        return None
    yaw = np.eye(4)
    yaw[:3, :3] = levelled(T, np.zeros(3))[:3, :3]
    turn: NDArray[np.float64] = orthonormal(yaw[:3, :3].T @ T[:3, :3])
    return turn


def weigh(
    status: Status, reason: str, T: Transform | None, fit: PairFit, ruling: Ruling | None
) -> tuple[Status, str]:
    """Return status and reason of the proof once more, now with what the pairs say.

    Parameters
    ----------
    status, reason : str
        The verdict of the proof, which the pairs can make less sure but never surer.
    T : ndarray, shape (4, 4), optional
        The pose of the verdict; local frames.
    fit : PairFit
    ruling : Ruling, optional
        None where the clouds were refused before any pose was heard.
    """
    if ruling is None:
        return status, reason
    at = fit.source.mean(axis=0)
    poses = starts_of(fit)

    def is_theirs(pose: Transform) -> bool:
        return any(is_same(pose, own, at) for own in poses)

    if T is None or status == "failed":
        if is_theirs(ruling.winner.T):
            return status, f"{reason} This is the pose of the picked pairs."
        return status, f"{reason} The pose of the picked pairs was heard too and explains less."
    miss = np.linalg.norm(apply(T, fit.source) - fit.target, axis=1)
    held = np.delete(miss, fit.bad) if fit.bad is not None else miss
    off = float(np.sqrt(np.mean(np.square(held))))
    spread = float(np.sqrt(np.square(fit.target - fit.target.mean(axis=0)).sum(axis=1).mean()))
    limit = float(np.clip(0.1 * spread, 0.1, 1.0))
    if off <= limit:
        return status, f"{reason} The picked pairs lie {off:.2g} m (root mean square) from it."
    for rival in ruling.undecided:
        if is_theirs(rival.T):
            yaw = float(np.degrees(np.arctan2(rival.T[1, 0], rival.T[0, 0])))
            return "ambiguous", (
                f"{reason} The pose of the picked pairs is one of the others: the clouds alone "
                f"cannot tell; --yaw-hint {yaw:.0f} takes it."
            )
    worst = int(miss.argmax())
    return "ambiguous", (
        "the clouds and the picked pairs disagree: the pose that explains the clouds best leaves "
        f"the pairs {off:.2g} m apart (root mean square, {fit.pairs.names[worst]} "
        f"{miss[worst]:.2g} m; at most {limit:.2g} m expected). Check the pairs, or register "
        f"without them. Of the clouds alone: {reason}"
    )


def pairs_document(fit: PairFit, matrix: Transform | None) -> dict[str, Any]:
    """Return what ``registration.json`` says of the pairs, lengths in metres.

    ``fit_residual_m`` is what the pairs' own best pose leaves, ``residual_m`` what the pose of
    the verdict (`matrix`, source file -> target file) leaves.
    """
    pairs = fit.pairs
    after: list[float | None] = [None] * len(pairs.names)
    if matrix is not None:
        off = np.linalg.norm(apply(matrix, pairs.source) - pairs.target, axis=1) * fit.unit_m
        after = [float(value) for value in off]
    return {
        **pairs.record,
        "fit_rms_m": fit.rms_m,
        "scale": fit.scale,
        "bad": None if fit.bad is None else pairs.names[fit.bad],
        "pairs": [
            {"name": name, "fit_residual_m": float(own), "residual_m": final}
            for name, own, final in zip(pairs.names, fit.residuals, after, strict=True)
        ],
    }


def levelled_source(source: Cloud, fit: PairFit) -> tuple[Cloud, PickedPairs, Transform] | None:
    """Return the source levelled by the pairs, its pairs, and the matrix that did it.

    None where its z axis is up within three degrees already: the walls do better then. The
    (4, 4) matrix goes from the source's file coordinates to the levelled ones, in metres.
    """
    turn = levelling_turn(fit)
    if turn is None:
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = turn * float(source.frame.unit_m[0])
    pairs = replace(fit.pairs, source=apply(matrix, fit.pairs.source))
    return source.moved(matrix), pairs, matrix


def with_pairs(result: Registration, fit: PairFit) -> Registration:
    """Return `result` with what the pairs say of its pose, and the pairs as one of its methods."""
    notes = list(result.notes)
    if fit.bad is not None:
        notes.append(
            f"pair {fit.pairs.names[fit.bad]} does not fit the others: it was left out of one "
            "starting pose, and the proof decided without it"
        )
    elif len(fit.pairs.names) == FEWEST and fit.rms_m > _BAD_M:
        notes.append(
            f"the pairs fit each other to {fit.rms_m:.2g} m (root mean square); with three pairs a "
            "bad one cannot be told from the others: pick a fourth"
        )
    if abs(fit.scale - 1.0) > 0.01:
        notes.append(
            f"lengths between the target points are {fit.scale:.4g} times those between the source "
            "points; a rigid pose does not scale"
        )
    method = "pairs" if result.coarse_method == "none" else f"pairs, {result.coarse_method}"
    return replace(
        result,
        coarse_method=method,
        notes=tuple(notes),
        pairs=pairs_document(fit, result.matrix),
    )


def from_levelled(
    result: Registration, fit: PairFit, matrix: Transform, source: Cloud, level: Cloud
) -> Registration:
    """Return the result of `level`, which is `source` levelled by `matrix`, as one of `source`."""
    note = (
        f"{source.name} lies askew: its z axis is {tilt_deg(starts_of(fit)[0]):.1f} deg from the "
        "vertical by the pairs, so it was levelled by them before the search"
    )
    listed = tuple(
        replace(h, T_target_source=h.T_target_source @ matrix) for h in result.hypotheses
    )
    final = None if result.matrix is None else result.matrix @ matrix
    turn = np.linalg.inv(level.frame.T_file_local()) @ matrix @ source.frame.T_file_local()
    fine = result.fine
    if fine is not None:
        fine = replace(fine, T_target_source=fine.T_target_source @ turn)
    return replace(
        result,
        matrix=final,
        fine=fine,
        hypotheses=listed,
        scale=result.scale * float(np.cbrt(np.linalg.det(matrix[:3, :3]))),
        notes=(note, *result.notes),
        pairs=pairs_document(fit, final),
    )
