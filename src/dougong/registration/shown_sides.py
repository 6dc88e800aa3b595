"""Which sides of what stands there a cloud shows.

The front of a gate fits its back, a corner the corner across. A cloud that shows one of two
opposite sides leaves open which; one taken from all round does not. Scans tell by the ground: what
stands there hides the ground behind it. A flight sees ground over the roofs, so its walls are
asked: a wall was seen from the side on which there is ground at its foot.
"""

from __future__ import annotations

import numpy as np

from dougong.registration.evidence import Witness
from dougong.typing import Index, Mask, Points, Values

_BEARINGS, _FEW = 36, 0.002
_BEARING_DEG = 360.0 / _BEARINGS
_HIDDEN_DEG = 100.0
"""No ground in so wide an arc: 150 to 210 degrees before corners and fronts, all round 0 to 20."""
_UPRIGHT = 0.5
"""The rise of a normal up to which it is a wall's."""
_BESIDE_M = (1.0, 1.5, 2.0, 2.5, 3.0)
"""Ground at the foot of a wall is looked for so far before it: farther lies that of other walls."""
_AT_LEAST_M = 0.5
_OPPOSITE = 0.5
"""An opposite side is shown where so much of it is, of a side: eaves and gateways show ground
behind a front, where up to 0.3 of it then seem to face back."""
_LACKING = 0.25
"""Of all the walls that a cloud shows, those whose opposite it does not. A gate from before, with
its sides: 0.3; corners: 0.9; from all round: none."""


def are_walls(witness: Witness) -> Mask:
    """Say which points (n,) of a witness are walls."""
    walls: Mask = witness.is_structure & (np.abs(witness.normals[:, 2]) < _UPRIGHT)
    return walls


def are_beside(points: Points, walls: Points) -> Mask:
    """Say which points (n, 3) lie in the box of walls (m, 3) in plan, or no farther than its side.

    A building is hardly deeper than its front is long.
    """
    low, high = np.quantile(walls[:, :2], [0.02, 0.98], axis=0)
    side = float((high - low).max())
    beside: Mask = np.all((points[:, :2] >= low - side) & (points[:, :2] <= high + side), axis=1)
    return beside


def has_ground_on_one_side(ground: Points, walls: Points) -> bool:
    """Say whether a scan shows ground (n, 3) on one side only of walls (m, 3).

    What stands there hides the ground behind it from a scan of a corner or of a front. Stations all
    round, or within a room or a court, show ground in every bearing from the middle of the walls.
    """
    if not len(walls) or not len(ground):
        return False
    low, high = np.quantile(walls[:, :2], [0.02, 0.98], axis=0)
    off = ground[:, :2] - (low + high) / 2.0
    held = np.bincount(_bearing(off), minlength=_BEARINGS)
    shown = np.flatnonzero(held > _FEW * len(ground))
    empty = np.diff([*shown, shown[0] + _BEARINGS]) - 1
    return bool(empty.max() * _BEARING_DEG >= _HIDDEN_DEG)


def lacks_opposite_sides(
    ground: Points, walls: Points, normals: Points, square_metres: Values
) -> bool:
    """Say whether much of the walls that a cloud shows has no opposite that it shows too.

    Parameters
    ----------
    ground : ndarray, shape (n, 3)
    walls, normals : ndarray, shape (m, 3)
        Normals of either sign.
    square_metres : ndarray, shape (m,)
        Of wall that each point stands for.
    """
    if not len(walls) or not len(ground):
        return False
    faces = normals[:, :2] / np.linalg.norm(normals[:, :2], axis=1, keepdims=True)
    before, behind = (_ground_before(ground, walls, side * faces) for side in (1, -1))
    held = np.zeros(_BEARINGS)
    # Between two like counts, as of a free-standing wall, both sides are taken for shown.
    for side, is_open in ((1, before >= behind), (-1, behind >= before)):
        is_seen = is_open & (before + behind > 0)
        held += np.bincount(_bearing(side * faces[is_seen]), square_metres[is_seen], _BEARINGS)
    facing: Values = np.sum([np.roll(held, k) for k in (-1, 0, 1)], axis=0)
    is_lacking = np.roll(facing, _BEARINGS // 2) < _OPPOSITE * facing
    return bool(facing[is_lacking].sum() > _LACKING * facing.sum())


def _ground_before(ground: Points, walls: Points, faces: Points) -> Index:
    """Return at how many distances before walls (m, 3) there is ground, along `faces` (m, 2)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(ground[:, :2])
    apart = np.median(tree.query(ground[:: max(1, len(ground) // 1000), :2], k=2)[0][:, 1])
    within = max(_AT_LEAST_M, 1.5 * float(apart))
    places = (walls[:, :2] + off * faces for off in _BESIDE_M)
    found = [tree.query(at, distance_upper_bound=within)[0] <= within for at in places]
    held: Index = np.sum(found, axis=0)
    return held


def _bearing(directions: Points) -> Index:
    degrees = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0
    bearing: Index = (degrees / _BEARING_DEG).astype(np.int64) % _BEARINGS
    return bearing
