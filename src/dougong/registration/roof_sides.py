"""Whether the height rests on roofs of which nobody knows the side.

A scan without its stations shows a roof, and nothing beneath it: a roof that was seen from a tower,
or a soffit over a closed room. The drone shows the top. Both readings fit, apart by the roof's
thickness, and every block of the building agrees about the wrong one. Ground that both clouds show
decides: no instrument sees it from below. Where it is missing, the pose is held against itself,
raised and lowered, by all that is not such a roof: sills, ledges, walls.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from dougong.filters import neighbourhood
from dougong.registration.covariance import blocks_of
from dougong.registration.evidence import Court, Witness, hear
from dougong.registration.overlap import apply, inverse
from dougong.registration.prepare import Prepared
from dougong.typing import Mask, Points, Transform, Values

_HEIGHTS_M = (0.15, -0.15, 0.25, -0.25, 0.4, -0.4)
"""How thick roofs are."""
_REACH_M = 0.7
_BLOCK_M = 5.0
_LEAST_BLOCKS = 5
"""Ground in fewer places may be a terrace, a floor or a parked car."""
_AGREES_M = 0.05
"""A third of the thinnest roof: ground as far apart as this is on the same side of it."""


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
        Metres along the vertical; None where all else prefers `T`, or where both clouds come from
        instruments that show roofs from the same side.
    """
    unknown = (_is_unknown(source, court.source), _is_unknown(target, court.target))
    if source.kind == target.kind or not (unknown[0].any() or unknown[1].any()):
        return None
    if ground_agrees(court, source, target, T):
        return None
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


def ground_agrees(court: Court, source: Prepared, target: Prepared, T: Transform) -> bool:
    """Say whether the ground of both clouds is at one height: by the medians of 5 m blocks."""
    points = apply(T, court.source.points[_is_ground(source, court.source)])
    target_is_ground = target.is_ground[court.target.everything.index]
    index, _ = neighbourhood.nearest(court.target.everything.neighbours, points, _REACH_M)
    pairs = (index >= 0) & target_is_ground[np.maximum(index, 0)]
    points, index = points[pairs], index[pairs]
    if not len(points):
        return False
    normals = court.target.everything.normals[index]
    tilt = normals @ target.up
    offset = np.einsum("ij,ij->i", normals, points - court.target.everything.xyz[index])
    # Along the vertical; a normal far from it is no ground's.
    is_level = np.abs(tilt) > 0.5
    heights = _block_medians(points[is_level], (offset / np.where(tilt, tilt, 1.0))[is_level])
    if len(heights) < _LEAST_BLOCKS:
        return False
    middle = float(np.median(heights))
    spread = 1.4826 * float(np.median(np.abs(heights - middle))) / np.sqrt(len(heights))
    return bool(abs(middle) + 2.0 * spread <= _AGREES_M)


def _block_medians(points: Points, values: Values) -> Values:
    """Return the median of `values` (n,) in every block that holds three of `points` or more."""
    if not len(points):
        return np.zeros(0)
    block, count = blocks_of(points, _BLOCK_M)
    order = np.argsort(block, kind="stable")
    parts = np.split(values[order], np.searchsorted(block[order], np.arange(1, count)))
    return np.array([np.median(part) for part in parts if len(part) >= 3])


def _is_ground(cloud: Prepared, witness: Witness) -> Mask:
    heard = witness.everything.index[witness.everything.asked]
    is_ground: Mask = cloud.is_ground[heard]
    return is_ground


def weigh_height(reason: str, left_open_m: float | None) -> tuple[Literal["ok", "ambiguous"], str]:
    """Return the status of a pose that is proven but for its height, and why."""
    if left_open_m is None:
        return "ok", reason
    way = "higher" if left_open_m > 0.0 else "lower"
    return "ambiguous", (
        "the height rests on roofs of which nobody knows whether they were seen from above or from "
        f"below: all else fits {abs(left_open_m):.2g} m {way} as well. Give the scan with its "
        "stations (E57, PTX), ground in both clouds, or a control point."
    )


def _is_unknown(cloud: Prepared, witness: Witness) -> Mask:
    """Say which heard points are of a roof of unknown side."""
    heard = witness.everything.index[witness.everything.asked]
    is_unknown: Mask = np.broadcast_to(cloud.side_is_unknown, len(cloud.xyz))[heard]
    return is_unknown


def _silenced(
    from_: Witness, to: Witness, T: Transform, is_unknown: Mask, other: Prepared
) -> Witness:
    """Return the witness without roofs of unknown side, its own and those it lies next to."""
    index, _ = neighbourhood.nearest(to.everything.neighbours, apply(T, from_.points), _REACH_M)
    others = np.broadcast_to(other.side_is_unknown, len(other.xyz))[to.everything.index]
    meets = (index >= 0) & others[np.maximum(index, 0)]
    return replace(from_, weights=np.where(is_unknown | meets, 0.0, from_.weights))
