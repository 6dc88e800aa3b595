"""Whether the height rests on roofs of which nobody knows the side, and the clouds without them.

A scan without its stations shows a roof, and nothing beneath it: a roof that was seen from a tower,
or a soffit over a closed room. The drone shows the top. Both readings fit, apart by the roof's
thickness, and every block of the building agrees about the wrong one. Ground that both clouds show
decides: no instrument sees it from below. Where it is missing, the pair is heard by the inside of
all other surfaces (`without_unsure_roofs`): battered walls, plinths and buttresses hold the height
within millimetres where there are some. Where these prove no pose by themselves, the pose is held
against itself, raised and lowered, by all that is no such roof (`height_left_open`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np

from dougong.filters import neighbourhood
from dougong.filters.neighbourhood import build_index
from dougong.registration.covariance import blocks_of
from dougong.registration.evidence import Court, Witness, hear
from dougong.registration.overlap import Rung, apply, inverse
from dougong.registration.prepare import MIN_POINTS, Prepared
from dougong.typing import Mask, Points, Transform, Values

_HEIGHTS_M = (0.15, -0.15, 0.25, -0.25, 0.4, -0.4)
"""How thick roofs are."""
_REACH_M = 0.7
_staying: WeakKeyDictionary[Prepared, Mask] = WeakKeyDictionary()
"""What may stay of a cloud under any pose: a pair is asked twice."""
_FLAT, _LEVEL = 0.7, 0.9
"""Planarity, and the rise of the normal, of ground that tells a height."""
_NEIGHBOURS = 16
"""As many as planes are fitted to."""
_ALIKE_COSINE = 0.93
"""Within 21 degrees: noisy planes of one surface are, those about an edge are not."""
_BLOCK_M = 5.0
_LEAST_BLOCKS = 5
"""Ground in fewer places may be a terrace, a floor or a parked car."""
_AGREES_M = 0.05
"""A third of the thinnest roof: ground as far apart as this is on the same side of it."""

LEFT_OUT = (
    " Roofs of which nobody knows the side were left out: all else holds the height without them."
)


def are_roofs_unsure(source: Prepared, target: Prepared) -> bool:
    """Say whether two clouds may show the two sides of one roof, and nothing tells which."""
    are_there = source.is_unsure_roof.any() or target.is_unsure_roof.any()
    return source.kind != target.kind and bool(are_there)


def without_unsure_roofs(
    source: Prepared, target: Prepared, T: Transform
) -> tuple[Prepared, Prepared] | None:
    """Return of two clouds the inside of every surface that no roof of unknown side speaks for.

    Without such roofs, without what lies near them in either cloud, and without edges: where two
    surfaces meet, planes are of both. A wall's corner with its roof holds the roof's height, and
    one with the ground the height at which the other cloud's wall ends.

    Parameters
    ----------
    T : ndarray, shape (4, 4)
        Source to target, local frames: under which what lies near what is asked.

    Returns
    -------
    tuple of Prepared, or None
        None where too little is left.
    """
    of_source = _may_stay(source) & _is_off(target, apply(T, source.xyz))
    of_target = _may_stay(target) & _is_off(source, apply(inverse(T), target.xyz))
    if min(int(of_source.sum()), int(of_target.sum())) < MIN_POINTS:
        return None
    return source.chosen(of_source), target.chosen(of_target)


def _may_stay(cloud: Prepared) -> Mask:
    """Return which points (n,) lie inside a surface and off the cloud's own roofs in doubt."""
    if cloud not in _staying:
        _staying[cloud] = _is_inside(cloud) & _is_off(cloud, cloud.xyz)
    return _staying[cloud]


def _is_inside(cloud: Prepared) -> Mask:
    """Return which points (n,) lie inside a surface: the planes of all about them are as theirs."""
    near, _ = neighbourhood.knn(build_index(cloud.xyz), cloud.xyz, _NEIGHBOURS + 1)
    alike = np.einsum("ij,ikj->ik", cloud.normals, cloud.normals[np.maximum(near, 0)])
    is_inside: Mask = np.all((np.abs(alike) > _ALIKE_COSINE) | (near < 0), axis=1)
    return is_inside


def _is_off(cloud: Prepared, points: Points) -> Mask:
    """Return which points (n, 3), in the frame of a cloud, are near none of its roofs in doubt."""
    roofs = cloud.xyz[cloud.is_unsure_roof]
    if not len(roofs):
        return np.ones(len(points), bool)
    near, _ = neighbourhood.nearest(build_index(roofs), points, _REACH_M)
    is_off: Mask = near < 0
    return is_off


def height_left_open(
    court: Court, source: Prepared, target: Prepared, T: Transform
) -> float | None:
    """Return a change of height that only roofs of unknown side speak against.

    All else need not prove the height, which the fit has done: it must not prefer another one.
    Without ground the ledges that speak are few, and a fit to the wrong side of a roof is seen by
    their preferring its thickness back.

    Parameters
    ----------
    court : Court
        Of `source` and `target`.
    T : ndarray, shape (4, 4)
        The pose that is judged, local frames.

    Returns
    -------
    float or None
        Metres along the vertical; None where all else prefers `T`.
    """
    unknown = (_is_unknown(source, court.source), _is_unknown(target, court.target))
    kept = replace(
        court,
        source=_silenced(court.source, court.target, T, unknown[0], target),
        target=_silenced(court.target, court.source, inverse(T), unknown[1], source),
    )
    loss = hear(kept, T).total
    for height in _HEIGHTS_M:
        raised = T.copy()
        raised[:3, 3] += height * target.up
        if hear(kept, raised).total <= loss:
            return height
    return None


def unheld(left_open_m: float) -> str:
    """Return what is said of a pose that is proven but for its height."""
    way = "higher" if left_open_m > 0.0 else "lower"
    return (
        "the height rests on roofs of which nobody knows whether they were seen from above or from "
        f"below: all else fits {abs(left_open_m):.2g} m {way} as well. Give the scan with its "
        "stations (E57, PTX), ground in both clouds, or a control point."
    )


def _is_unknown(cloud: Prepared, witness: Witness) -> Mask:
    """Say which heard points are of a roof of unknown side."""
    heard = witness.everything.index[witness.everything.asked]
    is_unknown: Mask = cloud.is_unsure_roof[heard]
    return is_unknown


def _silenced(
    from_: Witness, to: Witness, T: Transform, is_unknown: Mask, other: Prepared
) -> Witness:
    """Return the witness without roofs of unknown side, its own and those it lies next to."""
    index, _ = neighbourhood.nearest(to.everything.neighbours, apply(T, from_.points), _REACH_M)
    others = other.is_unsure_roof[to.everything.index]
    meets = (index >= 0) & others[np.maximum(index, 0)]
    return replace(from_, weights=np.where(is_unknown | meets, 0.0, from_.weights))


def ground_says(
    court: Court, source: Prepared, target: Prepared, T: Transform
) -> Literal["agrees", "differs", "nothing"]:
    """Say whether the ground of both clouds is at one height: by the medians of 5 m blocks."""
    first, second = court.source.everything, court.target.everything
    points = apply(T, first.xyz[first.asked][_is_level_ground(source, first)[first.asked]])
    index, _ = neighbourhood.nearest(second.neighbours, points, _REACH_M)
    pairs = (index >= 0) & _is_level_ground(target, second)[np.maximum(index, 0)]
    points, index = points[pairs], index[pairs]
    if not len(points):
        return "nothing"
    normals = second.normals[index]
    # Along the vertical.
    offset = np.einsum("ij,ij->i", normals, points - second.xyz[index]) / (normals @ target.up)
    heights = _block_medians(points, offset)
    if len(heights) < _LEAST_BLOCKS:
        return "nothing"
    middle = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(heights - middle))) / np.sqrt(len(heights))
    return "agrees" if abs(middle) + 2.0 * spread <= _AGREES_M else "differs"


def _block_medians(points: Points, values: Values) -> Values:
    """Return the median of `values` (n,) in every block that holds three of `points` or more."""
    if not len(points):
        return np.zeros(0)
    block, count = blocks_of(points, _BLOCK_M)
    order = np.argsort(block, kind="stable")
    parts = np.split(values[order], np.searchsorted(block[order], np.arange(1, count)))
    return np.array([np.median(part) for part in parts if len(part) >= 3])


def _is_level_ground(cloud: Prepared, everything: Rung) -> Mask:
    """Return which points (n,) of a rung are ground and lie level: the feet of walls are neither.

    Of a flight without ground the cloth takes the lower edges of its walls for it.
    """
    rise = np.abs(everything.normals @ cloud.up)
    is_flat = cloud.planarity[everything.index] > _FLAT
    is_level: Mask = cloud.is_ground[everything.index] & is_flat & (rise > _LEVEL)
    return is_level
