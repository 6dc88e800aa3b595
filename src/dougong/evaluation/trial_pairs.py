"""Cheap pairs of thinned clouds with a known answer, many of them without one.

What a verdict's probability is measured on: a building of some kind on level ground, a scanner's
cloud (walls, no roofs) and a drone's (roofs, ground, rougher and slowly bent walls). Symmetry,
what stands around, how much is shared, noise and density are drawn anew for every pair; one pair
in six is of two places or mirrored. A few thousand points: one registration takes about two
CPU seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.drone import smooth_field
from dougong.evaluation.metrics import Truth, fit_rigid
from dougong.evaluation.survey import rotation
from dougong.typing import Mask, Points

Plan = NDArray[np.float64]
"""Outline (k, 2) in metres, counter-clockwise, about the origin."""
Draw = Callable[[np.random.Generator], list[Plan]]

_GROUND_M = 22.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialPair:
    """Two clouds in their own frames, and what is true about them."""

    source: Points
    target: Points
    truth: Truth | None
    """None: no motion is true (two places, or the source is mirrored)."""
    kind: str
    is_unique: bool
    """One pose is true and nothing repeats it."""


def _regular(sides: int, radius: float) -> Plan:
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _box(x: float, y: float, at: tuple[float, float] = (0.0, 0.0)) -> Plan:
    return np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) / 2.0 + at


def _l(rng: np.random.Generator) -> list[Plan]:
    a, b = rng.uniform(9, 16, 2)
    c, d = rng.uniform(3, 6, 2)
    return [np.array([[0, 0], [a, 0], [a, c], [d, c], [d, b], [0, b]]) - [a / 3, b / 3]]


def _u(rng: np.random.Generator) -> list[Plan]:
    a, b, c = rng.uniform(12, 18), rng.uniform(7, 12), rng.uniform(2.5, 4)
    e = rng.uniform(0.5, 0.9) * b
    outline = [[0, 0], [a, 0], [a, b], [a - c, b], [a - c, c], [c, c], [c, e], [0, e]]
    return [np.array(outline) - [a / 2, b / 2]]


def _cross(rng: np.random.Generator) -> list[Plan]:
    a, c = rng.uniform(6, 9), rng.uniform(1.5, 3)
    arm = np.array([[a, -c], [a, c], [c, c]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    turned = [arm @ np.linalg.matrix_power(turn, k).T for k in range(4)]
    return [np.concatenate(turned)]


def _row(rng: np.random.Generator) -> list[Plan]:
    x, y, gap = rng.uniform(5, 7), rng.uniform(5, 9), rng.uniform(1.5, 3)
    count = int(rng.integers(2, 4))
    return [_box(x, y, ((k - (count - 1) / 2) * (x + gap), 0.0)) for k in range(count)]


KINDS: dict[str, tuple[Draw, int]] = {
    "l": (_l, 1),
    "rectangle": (lambda r: [_box(r.uniform(11, 18), r.uniform(6, 10))], 2),
    "square": (lambda r: [_box(side := r.uniform(8, 14), side)], 4),
    "octagon": (lambda r: [_regular(8, r.uniform(5, 9))], 8),
    "row": (_row, 2),
    "u": (_u, 1),
    "cross": (_cross, 4),
    "hexagon": (lambda r: [_regular(6, r.uniform(5, 9))], 6),
    "round": (lambda r: [_regular(28, r.uniform(6, 10))], 28),
    "wall": (lambda r: [_box(2.0 * _GROUND_M + 8.0, r.uniform(1.0, 2.5))], 2),
}
"""Every kind: draws its outlines, and how often its plan repeats in a full turn."""
TRAINED = ("l", "rectangle", "octagon", "row", "wall")
"""Kinds the probability is fitted on; the others are only measured."""


def _quad(rng: np.random.Generator, corner: Points, u: Points, v: Points, per_m2: float) -> Points:
    count = int(np.linalg.norm(np.cross(u, v)) * per_m2)
    at: Points = np.asarray(corner) + rng.random((count, 1)) * u + rng.random((count, 1)) * v
    return at


def _is_inside(plan: NDArray[np.float64], outline: Plan) -> Mask:
    x, y = plan.T
    inside: Mask = np.zeros(len(plan), dtype=bool)
    for (x1, y1), (x2, y2) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y1 != y2:
            crosses = ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
            inside ^= crosses
    return inside


@dataclass(frozen=True, slots=True)
class _House:
    outline: Plan
    height: float
    is_around: bool = False


def _walls(rng: np.random.Generator, house: _House, per_m2: float) -> Points:
    up = np.array([0.0, 0.0, house.height])
    parts = []
    for a, b in zip(house.outline, np.roll(house.outline, -1, axis=0), strict=True):
        parts.append(_quad(rng, np.append(a, 0.0), np.append(b - a, 0.0), up, per_m2))
    return np.vstack(parts)


def _roof(rng: np.random.Generator, house: _House, per_m2: float) -> Points:
    low, size = house.outline.min(axis=0), np.ptp(house.outline, axis=0)
    flat = _quad(
        rng,
        np.append(low, house.height),
        np.array([size[0], 0.0, 0.0]),
        np.array([0.0, size[1], 0.0]),
        per_m2,
    )
    return flat[_is_inside(flat[:, :2], house.outline)]


def _ground(rng: np.random.Generator, houses: list[_House], per_m2: float) -> Points:
    size = 2.0 * _GROUND_M
    ground = _quad(
        rng,
        np.array([-_GROUND_M, -_GROUND_M, 0.0]),
        np.array([size, 0.0, 0.0]),
        np.array([0.0, size, 0.0]),
        per_m2,
    )
    for house in houses:
        ground = ground[~_is_inside(ground[:, :2], house.outline)]
    return ground


def _around(rng: np.random.Generator, count: int) -> list[_House]:
    """Return small buildings about the main one."""
    houses = []
    for angle in rng.uniform(0, 2 * np.pi) + 2 * np.pi * rng.random(count):
        at = rng.uniform(13, 16) * np.array([np.cos(angle), np.sin(angle)])
        corner = np.array([np.cos(turn := rng.uniform(0, np.pi)), np.sin(turn)])
        turned = np.column_stack([corner, [-corner[1], corner[0]]])
        plan = _box(rng.uniform(1.5, 6.0), rng.uniform(1.5, 6.0)) @ turned.T + at
        houses.append(_House(plan, float(rng.uniform(1.5, 5)), is_around=True))
    return houses


def _site(rng: np.random.Generator, kind: str) -> list[_House]:
    """Return a site's buildings."""
    draw, _ = KINDS[kind]
    height = rng.uniform(3.5, 7)
    houses = [_House(outline, float(height)) for outline in draw(rng)]
    context = int(rng.choice([0, 1, 3, 5, 8], p=[0.3, 0.03, 0.14, 0.24, 0.29]))
    return [*houses, *_around(rng, context)]


def make_pair(kind: str, seed: int) -> TrialPair:
    """Return the pair of a kind and a seed; the same for the same arguments."""
    rng = np.random.default_rng([seed, *kind.encode()])
    houses = _site(rng, kind)
    fate = rng.choice(["same", "other place", "mirrored"], p=[0.84, 0.1, 0.06])
    shown = houses
    if fate == "other place":
        other = str(rng.choice([name for name in KINDS if name != kind]))
        shown = _site(rng, other)
    pair = _seen(rng, houses, shown, kind)
    if fate == "other place":
        return replace(pair, truth=None, is_unique=False)
    # A site that is its own mirror image would be found again, rightly.
    if fate == "mirrored" and sum(house.is_around for house in houses) >= 2:
        return replace(pair, source=pair.source * [-1, 1, 1], truth=None, is_unique=False)
    return pair


def _seen(
    rng: np.random.Generator, houses: list[_House], shown: list[_House], kind: str
) -> TrialPair:
    """Return what a scanner sees of `houses` and a drone of `shown`, in frames of their own."""
    density = rng.uniform(3.5, 7.0)
    rough, bend = rng.uniform(0.008, 0.03), rng.uniform(0.0, 0.012)
    share = float(rng.choice([1.0, 0.7, 0.5, 0.3], p=[0.6, 0.15, 0.15, 0.1]))
    parts = [_walls(rng, house, density) for house in houses]
    walls = np.vstack(parts)
    is_around = np.repeat([house.is_around for house in houses], [len(part) for part in parts])
    scan = np.vstack([walls, _ground(rng, houses, density / 3)])
    flown = np.vstack(
        [
            *(_walls(rng, house, density) for house in shown),
            *(_roof(rng, house, density) for house in shown),
            _ground(rng, shown, density / 3),
        ]
    )
    # Each cloud has its own edge, and both end along one direction: `share` of the length is in
    # both. Where clouds end says nothing about the pose.
    turn = rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(turn), np.sin(turn)])
    centres, radii = rng.uniform(-1.5, 1.5, (2, 2)), rng.uniform(16.0, 21.0, 2)

    def is_seen(points: Points, number: int) -> Mask:
        side = (points[:, :2] @ way) * (1 - 2 * number)
        kept: Mask = np.linalg.norm(points[:, :2] - centres[number], axis=1) < radii[number]
        return kept & (side < share * _GROUND_M) if share < 1.0 else kept

    scan, flown = scan[is_seen(scan, 0)], flown[is_seen(flown, 1)]
    is_shared = is_seen(walls, 0) & is_seen(walls, 1)
    surface = walls[is_shared]
    # A building beside the main one counts as a cue only where both clouds show it.
    is_unique = KINDS[kind][1] == 1 or bool(is_shared[is_around].any())
    up = np.array([0.0, 0.0, bend])
    field = smooth_field(np.vstack([flown, surface]), rng)[:, None] * up
    bent = surface + field[len(flown) :]
    target = flown + field[: len(flown)] + rng.normal(0.0, rough, flown.shape)
    scan = scan + rng.normal(0.0, rng.uniform(0.002, 0.008), scan.shape)
    T = np.eye(4)
    lean = np.radians(rng.uniform(0, 0.4)) * np.append(way, 0.0)
    T[:3, :3] = rotation(lean) @ rotation((0.0, 0.0, rng.uniform(0, 2 * np.pi)))
    T[:3, 3] = rng.uniform(-15, 15, 3) * [1, 1, 0.2]
    own = (surface - T[:3, 3]) @ T[:3, :3]
    truth = None
    if len(surface) > 50:
        best = fit_rigid(own, bent)
        truth = Truth(T_target_source=T, T_best=best, surface_points=own, surface_bent=bent)
    source = (scan - T[:3, 3]) @ T[:3, :3]
    return TrialPair(
        source=source,
        target=target,
        truth=truth,
        kind=kind,
        is_unique=is_unique and truth is not None,
    )
