"""How well a fit fixes its pose: block jackknife, and the directions nothing holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import count_rows, grouped, keys_of_rows
from dougong.registration.icp_solve import FREE, normal_equations, plane_rows, solve
from dougong.registration.overlap import Pairs
from dougong.typing import Index, Points, Values

_BLOCK_GROWTH = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
_LEAST_BLOCKS = 14
# A surface holds a motion when it faces it by more than this (sine of 17 degrees): less is
# what scattered normals and slightly bent planes show along any direction.
_FACING = 0.3
# In so many blocks surface must face a motion for it to be held, by this share of what a block
# weighs. Round towers and lone walls, on grass too, face a turn and a slide in none or one; where
# two things or more stood about, the fit ended within 30 mm, beside them up to 0.4 m off.
_FACING_BLOCKS = 5
_FACING_OF_BLOCK = 0.02
# Fewer are enough where this share of all the weight does.
_LEAST_FACING_SHARE = 0.004
_LEAST_FACING_BLOCKS = 3
_BEFORE = np.array([0.25, 0.25, 0.0])
_DRAWS = 1000
_DRAWN_POINTS = 400


def blocks_of(points: Points, size_m: float) -> tuple[Index, int]:
    """Return the block (n,) each point lies in, numbered in space, and how many there are."""
    cells = _cells(points, size_m)
    keys = keys_of_rows(tuple(cells.T))
    if keys is None:
        held, place = np.unique(cells, axis=0, return_inverse=True)
        return place.reshape(-1), len(held)
    blocks = grouped(keys)
    return blocks.place, len(blocks.keys)


def count_blocks(points: Points, size_m: float) -> int:
    """Return how many blocks `points` (n, 3), n > 0, lie in."""
    return count_rows(_cells(points, size_m))


def _cells(points: Points, size_m: float) -> NDArray[np.int64]:
    """Return the cell (n, 3), of edge `size_m`, that each point lies in.

    Counted from the points themselves, not from where a file has its origin: with a dozen blocks
    sigma differed tenfold by that. In plan the first begins a quarter of an edge before them, else
    borders run along the walls at the corner.
    """
    cells: NDArray[np.int64] = np.floor((points - points.min(axis=0)) / size_m + _BEFORE).astype(
        np.int64
    )
    return cells


class Jackknife(NamedTuple):
    """What leaving out blocks of the surface says about a fit's unknowns."""

    covariance: NDArray[np.float64] | None
    """(k, k), widened; None: too few blocks."""
    blocks: int
    widening: float
    """What the covariance was multiplied with for being known from so few blocks only."""


def jackknife(
    pairs: Pairs,
    weights: Values,
    centre: NDArray[np.float64],
    dof: int,
    length_m: float,
    block_m: float,
) -> Jackknife:
    """Return the (6, 6) covariance of (omega, v) about `centre`, see `leave_blocks_out`."""
    arms = pairs.points - centre

    def equations(block: Index, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return normal_equations(arms, pairs.normals, pairs.residuals, weights, block, count)

    unit = np.array([length_m] * 3 + [1.0] * 3)
    return leave_blocks_out(
        pairs.points, equations, lambda H, g: solve(H, g, dof, length_m), unit, block_m
    )


def leave_blocks_out(
    points: Points,
    equations: Callable[[Index, int], tuple[NDArray[np.float64], NDArray[np.float64]]],
    solved: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
    unit: NDArray[np.float64],
    block_m: float,
) -> Jackknife:
    """Return the covariance of a fit's k unknowns from what blocks of the surface say.

    Blocks are left out one by one.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Of the correspondences.
    equations : callable
        Normal equations H (b, k, k) and g (b, k) of each of b blocks, from the block (n,) of each
        point.
    solved : callable
        The step (k,) that H and g lead to.
    unit : ndarray, shape (k,)
        What turns each unknown into metres of motion.
    block_m : float

    Notes
    -----
    Errors of neighbouring points, and of a bending cloud, go together: what a whole block pulls
    is one observation. Blocks of 1, 2 and 4 times `block_m` are tried where at least 14 of them
    hold points, and the largest answer counts, since bending is slower than any one block; for
    small objects the block shrinks instead. What blocks of an edge h miss of errors that reach over
    their sides falls as 1 / h: where twice the edge shows more, V(2h) is raised to
    2 V(2h) - V(h), at most twice. Widened by `widening_of`, for a covariance that so few blocks
    tell is itself uncertain.
    """
    best, best_size = Jackknife(None, 0, 1.0), 0.0
    halves: dict[float, float] = {}
    for growth in _growths(points, block_m):
        block, count = blocks_of(points, block_m * growth)
        H, g = equations(block, count)
        H_all, g_all = H.sum(axis=0), g.sum(axis=0)
        steps = np.array([solved(H_all - H[b], g_all - g[b]) for b in range(count)])
        steps -= steps.mean(axis=0)
        covariance = (count - 1) / count * steps.T @ steps
        size = halves[growth] = float(np.trace(covariance * np.outer(unit, unit)))
        missing = 2.0 - min(1.0, halves.get(growth / 2.0, np.inf) / max(size, 1e-300))
        widening = widening_of(_leverages(H, solved))
        if best.covariance is None or missing * widening * size > best_size:
            best_size = missing * widening * size
            best = Jackknife(missing * widening * covariance, count, widening)
    return best


def _leverages(
    H: NDArray[np.float64],
    solved: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
) -> Values:
    """Return the share (b,) of the unknowns that each block decides; they add up to the unknowns.

    H (b, k, k): the blocks' normal matrices.
    """
    H_all = H.sum(axis=0)
    inverse = np.column_stack([-solved(H_all, unit) for unit in np.eye(len(H_all))])
    shares: Values = np.maximum(np.einsum("ij,bji->b", inverse, H), 0.0)
    return shares


def widening_of(leverages: Values) -> float:
    """Return what a covariance from blocks is multiplied with, so that its ellipsoid holds 95 %.

    Squared errors in units of a covariance of p unknowns that is known from nu + 1 equal
    observations follow Hotelling's T2, not chi2: the ratio of their 95 % quantiles. Blocks of
    unequal weight count like fewer equal ones (Kish): (sum of the leverages)^2 over the sum of
    their squares. A dozen blocks make the ellipsoid's axes half as long again; fewer than p + 2
    say next to nothing.
    """
    from scipy.stats import chi2, f

    total = float(leverages.sum())
    unknowns = max(1, round(total))
    equal = total**2 / max(float(leverages @ leverages), 1e-300)
    freedom = max(equal - 1.0, unknowns + 1.0)
    rest = freedom - unknowns + 1.0
    hotelling = unknowns * freedom / rest * f.ppf(0.95, unknowns, rest)
    return float(hotelling / chi2.ppf(0.95, unknowns))


def _growths(points: Points, block_m: float) -> list[float]:
    """Return the sizes of blocks to try, in units of `block_m`, ascending.

    All from 1 on that leave enough blocks; where there is none, the largest that does.
    """
    enough = [g for g in _BLOCK_GROWTH if count_blocks(points, g * block_m) >= _LEAST_BLOCKS]
    return sorted(g for g in enough if g >= 1.0) or enough[:1]


def unobservable(
    pairs: Pairs,
    weights: Values,
    centre: NDArray[np.float64],
    dof: int,
    length_m: float,
    block_m: float,
) -> tuple[Mapping[str, Any], ...]:
    """Return the motions that the shared surface does not hold, in words.

    The information's eigenvectors (rotation scaled to motion at `length_m`) are tested one by
    one: how much surface, in how many blocks, faces the motion? A plane slides along itself, a
    cylinder turns about its axis: there nothing faces it.
    """
    total = float(weights.sum())
    if total <= 0.0:
        return ()
    arms = pairs.points - centre
    rows = plane_rows(arms / length_m, pairs.normals)
    free = list(FREE[dof])
    values, vectors = np.linalg.eigh((rows[:, free] * weights[:, None]).T @ rows[:, free])
    block, count = blocks_of(pairs.points, block_m)
    found = []
    for k in range(len(values)):
        vector = np.zeros(6)
        vector[free] = vectors[:, k]
        motion = np.cross(vector[:3] / length_m, arms) + vector[3:]
        along = np.abs(rows @ vector)
        facing = along > _FACING * np.maximum(np.linalg.norm(motion, axis=1), 0.3)
        share = float(weights[facing].sum()) / total
        in_block = np.bincount(block[facing], weights[facing], count)
        held = int((in_block > _FACING_OF_BLOCK * total / count).sum())
        is_loud = share >= _LEAST_FACING_SHARE and held >= min(_LEAST_FACING_BLOCKS, count)
        if held < _FACING_BLOCKS and not is_loud:
            found.append(_described(vector, length_m))
    return tuple(found)


def _described(vector: NDArray[np.float64], length_m: float) -> Mapping[str, Any]:
    """Return {"vector": (omega rad, v m) of 1 m motion, "text": words}."""
    turn, shift = vector[:3], vector[3:]
    if np.linalg.norm(shift) >= np.linalg.norm(turn):
        text = f"slides {_direction(shift)}"
        if np.linalg.norm(turn) > 0.35:
            text += f", turning about {_axis(turn)}"
    else:
        text = f"turns about {_axis(turn)} near the middle of the overlap"
        if np.linalg.norm(shift) > 0.35:
            text += f", sliding {_direction(shift)}"
    scaled = vector.copy()
    scaled[:3] /= length_m
    return {"vector": scaled.tolist(), "text": text}


def _direction(vector: NDArray[np.float64]) -> str:
    unit = vector / np.linalg.norm(vector)
    if abs(unit[2]) > 0.9:
        return "up and down"
    bearing = np.degrees(np.arctan2(unit[1], unit[0])) % 180.0
    text = f"along the direction {bearing:.0f} deg from +x towards +y"
    if abs(unit[2]) > 0.2:
        text += f", rising {np.degrees(np.arcsin(abs(unit[2]))):.0f} deg"
    return text


def _axis(vector: NDArray[np.float64]) -> str:
    unit = vector / np.linalg.norm(vector)
    return "the vertical" if abs(unit[2]) > 0.9 else f"an axis {_direction(vector)}"


def displacement95(
    covariance: NDArray[np.float64],
    centre: NDArray[np.float64],
    points: Points,
    blocks: int,
    widening: float,
    of_control: NDArray[np.float64] | None = None,
) -> float:
    """Return the TRE95 that 95 % of the poses stay below which the data allow, metres.

    What the blocks of surface say is drawn from the jackknife's own distribution, Student's t with
    `blocks` - 1 degrees of freedom (`covariance` without its `widening`). `of_control` (6, 6), the
    part of `covariance` that comes from control points of known sigma, is drawn as normal and is
    not widened to begin with. TRE95 is the 95 % displacement of `points` (n, 3). The draws are the
    same for every call, so that the answer is a function of the data.
    """
    rng = np.random.default_rng(0)
    known = np.zeros((6, 6)) if of_control is None else of_control
    draws = _drawn(rng, (covariance - known) / widening)
    draws /= np.sqrt(rng.chisquare(blocks - 1, (_DRAWS, 1)) / (blocks - 1))
    if of_control is not None:
        draws += _drawn(rng, known)
    arms = (points - centre)[:: max(1, len(points) // _DRAWN_POINTS)]
    motion = np.cross(draws[:, None, :3], arms[None]) + draws[:, None, 3:]
    tre95 = np.quantile(np.linalg.norm(motion, axis=2), 0.95, axis=1)
    return float(np.quantile(tre95, 0.95))


def _drawn(rng: np.random.Generator, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return normal draws (k, 6) of a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    normal = rng.normal(size=(_DRAWS, len(covariance)))
    drawn: NDArray[np.float64] = normal * np.sqrt(np.clip(values, 0.0, None)) @ vectors.T
    return drawn
