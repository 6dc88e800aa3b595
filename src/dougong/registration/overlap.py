"""Views of a prepared cloud at several spacings, and which of its points meet the other cloud.

A pair is made only where two points can lie on the same side of the same surface: their normals
agree. Otherwise a roof's top pairs with its underside, which shifts the height by the roof's
thickness.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from dougong._sorting import by_coordinates, first_places, keys_of_rows, sorted_places
from dougong.filters import neighbourhood
from dougong.filters.neighbourhood import Neighbourhood, build_index
from dougong.kernels import partners
from dougong.registration.prepare import Prepared
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Transform, Values

_SEARCHES = 4096
"""Searches per task: fixed, so results do not depend on the thread count."""
_GROWTH = 1.3
_FEWEST = 1000
_TOP = 0.5
"""A surface seen from above faces within 60 degrees of the vertical."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rung:
    """A prepared cloud thinned to one spacing, in canonical order, with its search index."""

    xyz: Points
    normals: Points
    weights: Values
    """(n,) square metres of surface that each point stands for, less where it is not flat."""
    area: Values
    """(n,) square metres of surface that each point stands for."""
    index: Index
    """(n,) which points of the prepared cloud these are."""
    is_oriented: Mask
    """(n,) the normal's sign is sure."""
    is_top: Mask
    """(n,) surely seen from above."""
    may_be_underside: Mask
    """(n,) of a roof of which nobody knows the side."""
    spacing_m: float
    sigma_m: float
    neighbours: Neighbourhood
    asked: Index
    """(m,) the evenly spread part of the points that look for a partner."""

    @property
    def side(self) -> partners.Side:
        """Return what kernels ask of a pair's end."""
        return partners.Side(
            self.xyz, self.normals, self.is_oriented, self.is_top, self.may_be_underside
        )

    @property
    def tree(self) -> partners.Tree:
        """Return the search index as kernels take it."""
        return partners.Tree(self.neighbours.points, self.neighbours.boxes, self.neighbours.order)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Correspondences between two rungs, in the target's frame, source moved there."""

    source: Index
    target: Index
    points: Points
    """(k, 3) moved source points."""
    normals: Points
    """(k, 3) direction of the residual: both normals, the more exact one counting more."""
    residuals: Values
    """(k,) metres, signed, from target surface to moved source point along `normals`."""
    offsets: Points
    """(k, 3) moved source point minus target point."""
    weights: Values
    """(k,) area and flatness of both ends."""


def thin(points: Points, spacing_m: float) -> Index:
    """Return which points stay when each voxel keeps the one nearest its centre.

    Sorted by voxel. Ties go to the earlier point, so with `points` (n, 3) in canonical order the
    choice does not depend on the order of the input.
    """
    cell = np.floor(points / spacing_m)
    off = points / spacing_m - cell - 0.5
    key = keys_of_rows(tuple(cell.astype(np.int64).T))
    if key is None:
        # Points strewn over more cells than a number counts, as strays at 1e6 m do.
        _, place = np.unique(cell, axis=0, return_inverse=True)
        key = place.reshape(-1).astype(np.int64)
    # Numbers that are not negative are in the order of their bits.
    by_distance = sorted_places(np.einsum("ij,ij->i", off, off).view(np.uint64))
    return by_distance[first_places(key[by_distance])]


@dataclass(frozen=True, slots=True)
class _Thinned:
    spacing_m: float
    index: Index


_ladders: WeakKeyDictionary[Prepared, tuple[_Thinned, ...]] = WeakKeyDictionary()
_rungs: WeakKeyDictionary[Prepared, dict[tuple[float, float], Rung]] = WeakKeyDictionary()
"""Rungs built before, by their spacing and that of their asked points: fit, search for rivals and
proof all climb the same ladder, and its indices are the dearest part of it."""


def _ladder(prepared: Prepared) -> tuple[_Thinned, ...]:
    """Return ever thinner choices of the prepared points, each one taken from the one before."""
    known = _ladders.get(prepared)
    if known is not None:
        return known
    xyz = prepared.xyz
    index = by_coordinates(xyz)
    steps = [_Thinned(prepared.spacing_m, index)]
    while len(steps[-1].index) > _FEWEST:
        spacing = steps[-1].spacing_m * _GROWTH
        index = np.sort(thin(xyz[steps[-1].index], spacing))
        steps.append(_Thinned(spacing, steps[-1].index[index]))
    _ladders[prepared] = tuple(steps)
    return _ladders[prepared]


def rung(prepared: Prepared, spacing_m: float, most: int, asked: int) -> Rung:
    """Return `prepared` thinned to about `spacing_m`, or wider where more than `most` would stay.

    At most `asked` of them, evenly spread, look for partners.
    """
    ladder = _ladder(prepared)
    wide = [step for step in ladder if step.spacing_m >= spacing_m / 1.1] or [ladder[-1]]
    chosen = next((step for step in wide if len(step.index) <= most), ladder[-1])
    few = next((step for step in wide if len(step.index) <= asked), ladder[-1])
    known = _rungs.setdefault(prepared, {})
    key = (chosen.spacing_m, few.spacing_m)
    if key not in known:
        known[key] = _build_rung(prepared, chosen, few)
    return known[key]


def _build_rung(prepared: Prepared, chosen: _Thinned, few: _Thinned) -> Rung:
    index, spacing = chosen.index, chosen.spacing_m
    xyz = np.ascontiguousarray(prepared.xyz[index])
    # A voxel's point stands for its voxel's share of surface, whatever the cloud's density.
    area = np.clip(prepared.weights_area[index], 0.0, None)
    area = np.minimum(area / max(float(np.median(area)), 1e-12), 3.0) * spacing**2
    count = len(prepared.xyz)
    is_oriented = np.broadcast_to(prepared.normal_is_oriented, count)[index]
    normals = np.ascontiguousarray(prepared.normals[index])
    return Rung(
        xyz=xyz,
        normals=normals,
        weights=area * np.square(np.clip(prepared.planarity[index], 0.05, 1.0)),
        area=area,
        index=index,
        asked=np.flatnonzero(np.isin(index, few.index)),
        is_oriented=is_oriented,
        is_top=is_oriented & (normals @ prepared.up > _TOP),
        may_be_underside=np.broadcast_to(prepared.may_be_underside, count)[index],
        spacing_m=spacing,
        sigma_m=float(prepared.sigma_m),
        neighbours=build_index(xyz),
    )


def apply(T: Transform, points: Points) -> Points:
    """Return `points` (n, 3) moved by `T`."""
    result: Points = points @ T[:3, :3].T + T[:3, 3]
    return result


def inverse(T: Transform) -> Transform:
    """Return the inverse of the rigid `T`."""
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def do_agree(a: Points, b: Points, is_oriented: Mask, cosine: float) -> Mask:
    """Say whether normals (k, 3) point the same way; or opposite, where not `is_oriented` (k,)."""
    dot = np.einsum("ij,ij->i", a, b)
    agreeing: Mask = np.where(is_oriented, dot, np.abs(dot)) > cosine
    return agreeing


def find_pairs(
    source: Rung, target: Rung, T: Transform, bound_m: float, cosine: float, *, both_ways: bool
) -> Pairs:
    """Return the correspondences under pose `T` closer than `bound_m`.

    Parameters
    ----------
    cosine : float
        Least agreement of the two normals.
    both_ways : bool
        Also look from the target for the nearest source point, so that neither cloud's density
        decides which surface counts.
    """
    to = _partners(source, target, T, bound_m, cosine)
    hit = to >= 0
    s, t = source.asked[hit], to[hit]
    if both_ways:
        to = _partners(target, source, inverse(T), bound_m, cosine)
        hit = to >= 0
        s, t = np.concatenate([s, to[hit]]), np.concatenate([t, target.asked[hit]])
    return _described(source, target, T, s, t)


def _partners(source: Rung, target: Rung, T: Transform, bound_m: float, cosine: float) -> Index:
    """Return the place in `target` (m,) that each asked point of `source` meets; -1 for none."""
    found = np.empty(len(source.asked), np.int64)

    def task(start: int, stop: int) -> None:
        partners.find(
            source.side, source.asked, target.side, target.tree,
            T, bound_m**2, cosine, start, stop, found,
        )  # fmt: skip

    for_blocks(len(found), _SEARCHES, task)
    return found


def _described(source: Rung, target: Rung, T: Transform, s: Index, t: Index) -> Pairs:
    """Return the pairs of the points `s` and `t` (k,).

    A pair's normal is the mean weighted by 1 / sigma^2: a noisy cloud has noisy normals.
    """
    k = len(s)
    points, normals, offsets = np.empty((k, 3)), np.empty((k, 3)), np.empty((k, 3))
    residuals = np.empty(k)
    trust_source, trust_target = (1.0 / max(r.sigma_m, 1e-6) ** 2 for r in (source, target))
    partners.describe(
        source.side, target.side, T, s, t, trust_source, trust_target,
        points, normals, offsets, residuals,
    )  # fmt: skip
    return Pairs(
        source=s,
        target=t,
        points=points,
        normals=normals,
        residuals=residuals,
        offsets=offsets,
        weights=np.sqrt(source.weights[s] * target.weights[t]),
    )


def overlap_share(from_: Rung, to: Rung, T: Transform, bound_m: float) -> float:
    """Return the share of `from_`'s points with a point of `to` within `bound_m` under `T`."""
    found, _ = neighbourhood.nearest(to.neighbours, apply(T, from_.xyz[from_.asked]), bound_m)
    return float(np.mean(found >= 0))
