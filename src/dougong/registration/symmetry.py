"""What poses that fit equally well have in common, in words, and what would decide between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.registration.overlap import apply
from dougong.typing import Transform

_TURNED_DEG = 5.0
_ON_GRID_DEG = 2.0
_MOST_FOLDS = 12
_SAME_CENTRE_M = 1.5
_UPRIGHT = 0.9
_STILL_M = 0.05
"""A pose whose middle moves less than this differs by a small turn, not by a shift."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """How one pose differs from another, seen in the target's frame."""

    turn_deg: float
    """About the vertical, -180 to 180."""
    shift: NDArray[np.float64]
    """(3,) metres, of the middle of the source."""
    centre: NDArray[np.float64]
    """(2,) the place in plan that stays where it is, for turns."""

    @property
    def is_turn(self) -> bool:
        """Say whether the poses differ by more than a shift."""
        return abs(self.turn_deg) >= _TURNED_DEG

    @property
    def is_slight(self) -> bool:
        """Say whether they differ by a small turn, the middle staying where it is."""
        return not self.is_turn and float(np.linalg.norm(self.shift)) < _STILL_M


def move_between(winner: Transform, rival: Transform, middle: NDArray[np.float64]) -> Move:
    """Return the motion from `winner`'s to `rival`'s pose; `middle` (3,) of the source."""
    turn = rival[:3, :3] @ winner[:3, :3].T
    angle = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    at, to = apply(winner, middle[None])[0], apply(rival, middle[None])[0]
    centre = at[:2].copy()
    if abs(np.degrees(angle)) >= _TURNED_DEG:
        cosine, sine = np.cos(angle), np.sin(angle)
        about = np.eye(2) - np.array([[cosine, -sine], [sine, cosine]])
        centre = at[:2] + np.linalg.solve(about, (to - at)[:2])
    return Move(turn_deg=float(np.degrees(angle)), shift=to - at, centre=centre)


def folds(turns_deg: Sequence[float]) -> int:
    """Return n when all turns are multiples of 360 / n degrees, the least n up to 12; else 0.

    Within 2 degrees: what bending and a rough fit leave.
    """
    for n in range(2, _MOST_FOLDS + 1):
        step = 360.0 / n
        off = [abs((turn + step / 2.0) % step - step / 2.0) for turn in turns_deg]
        if max(off) <= _ON_GRID_DEG:
            return n
    return 0


def in_words(moves: Sequence[Move]) -> str:
    """Return what `moves`, from the best pose to its undecided rivals, have in common."""
    turns = [move for move in moves if move.is_turn]
    slight = [move for move in moves if move.is_slight]
    shifts = [move for move in moves if not (move.is_turn or move.is_slight)]
    upright = [move for move in shifts if _is_upright(move.shift)]
    level = [move for move in shifts if not _is_upright(move.shift)]
    said, deciding = [], []
    if turns:
        said.append(_turns_in_words(turns))
        deciding.append("a yaw hint")
    if slight:
        degrees = ", ".join(f"{m.turn_deg:+.1f} deg" for m in slight[:4])
        said.append(f"turned by only {degrees} about the middle they fit as well")
    if level:
        said.append(_shifts_in_words(level))
    if upright:
        heights = ", ".join(f"{m.shift[2]:+.2f} m" for m in upright[:4])
        said.append(
            f"in height they differ by {heights} (a storey, or a roof's top and its underside)"
        )
        deciding.append("ground in both clouds, the scanner's position in the file (E57)")
    deciding += ["control points", "more of the site around"]
    ways = ", ".join(deciding[:-1]) + f" or {deciding[-1]}"
    return (
        f"{len(moves) + 1} poses explain the clouds about equally well: {'; '.join(said)}. "
        f"{ways[0].upper()}{ways[1:]} would decide."
    )


def in_short(move: Move) -> str:
    """Return one move in a few words."""
    if move.is_turn:
        return f"turned by {move.turn_deg:+.0f} deg"
    if move.is_slight:
        return f"turned by {move.turn_deg:+.1f} deg"
    return f"shifted by {float(np.linalg.norm(move.shift)):.2g} m"


def _turns_in_words(turns: Sequence[Move]) -> str:
    degrees = sorted({round(move.turn_deg) for move in turns}, key=abs)
    listed = ", ".join(f"{turn:+d} deg" for turn in degrees[:7])
    spread = np.ptp([move.centre for move in turns], axis=0)
    if np.linalg.norm(spread) > _SAME_CENTRE_M:
        return f"the others are turned by {listed}, about different places"
    n = folds([move.turn_deg for move in turns])
    if n:
        found = "all" if len(turns) == n - 1 else f"{len(turns) + 1}"
        return (
            f"this plan repeats every {360.0 / n:.3g} degrees, so {n} poses fit alike, {found} of "
            f"them found (turned by {listed})"
        )
    if len(turns) >= 3:
        return (
            f"this plan is round, or nearly: it fits itself at any turn, such as {listed}, about "
            "its middle"
        )
    return f"the others are turned by {listed}"


def _shifts_in_words(shifts: Sequence[Move]) -> str:
    longest = max(shifts, key=lambda move: float(np.linalg.norm(move.shift)))
    way = longest.shift[:2] / np.linalg.norm(longest.shift[:2])
    along = np.array([move.shift[:2] @ way for move in shifts])
    aside = [abs(float(move.shift[0] * way[1] - move.shift[1] * way[0])) for move in shifts]
    bearing = np.degrees(np.arctan2(way[1], way[0])) % 180.0
    listed = ", ".join(f"{value:+.2f} m" for value in sorted(along, key=abs)[:6])
    if max(aside) > 0.3 * float(np.abs(along).max()):
        lengths = ", ".join(f"{np.linalg.norm(move.shift):.2f} m" for move in shifts[:6])
        return f"the others are shifted by {lengths} in different directions"
    return f"the others are shifted by {listed} along {bearing:.0f} deg from +x towards +y"


def _is_upright(shift: NDArray[np.float64]) -> bool:
    return bool(abs(shift[2]) > _UPRIGHT * max(float(np.linalg.norm(shift)), 1e-12))
