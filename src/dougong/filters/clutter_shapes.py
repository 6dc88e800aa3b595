"""What a compact cluster looks like: its size, its stand, and the outline of its body.

Points come sorted by content, so every number is the same however the cloud was cut or ordered.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dougong.typing import Points, Values

STRAY = 0.02
"""This share of a cluster's points, the farthest from its middle in plan, does not count."""
LAYER_M = 0.25
"""Heights are looked at in layers so thick."""
HEAD_M, FOOT_M = 0.25, 0.36
"""The head is the uppermost so many metres, the foot the lowest."""
SOLE_M = 0.12
"""The foot is looked at in layers so thin: a plinth may be low."""
STEP, STEP_POINTS = 0.25, 12
"""A layer of the foot with a gap this share of its length is two feet, not a plinth; one of fewer
points than this is taken for a plinth."""


class Shape(NamedTuple):
    """A cluster, metres; heights are above the ground."""

    points: int
    low_m: float
    top_m: float
    length_m: float
    """Longer side of the least rectangle in plan."""
    width_m: float
    head_m: float
    """Root mean square distance in plan from the middle of the head: half its width, about."""
    body_m: float
    """The same of the widest layer of the upper half, the head apart."""
    foot_m: float
    """The same of the widest thin layer of the foot; 0 where all of them are two feet."""
    median_m: float
    """The same, of the layer that half of the layers are thinner than."""
    girth_m: float
    """How far from the middle of a layer nine in ten of its points lie, in the layer that half are
    thinner than: the radius of a shaft, about, whether it is seen from all sides or from one."""
    pitch_m: float
    """Side of the square of its longest face that each point stands for."""
    per_layer: float
    """Points per layer, on average."""
    filled: float
    """Share of the layers from low to top that hold points."""


def shape_of(points: Points, height: Values) -> Shape:
    """Describe a cluster of points (n, 3) with known heights (n,) above the ground."""
    from dougong.kernels import clusters as kernels

    plan = points[:, :2] - points[0, :2]
    off = plan - plan.mean(axis=0)
    distance2 = off[:, 0] ** 2 + off[:, 1] ** 2
    most = np.sort(distance2)[max(0, int(np.ceil((1.0 - STRAY) * len(points))) - 1)]
    is_in = distance2 <= most
    plan, h = np.ascontiguousarray(plan[is_in]), height[is_in]
    hull = np.empty(2 * len(plan), np.int64)
    length, width = kernels.least_rectangle(plan, hull[: kernels.plan_hull(plan, hull)])
    low, top = float(h.min()), float(h.max())
    layers = _layers(plan, h, low, top)
    spread = np.array([_spread(layer) for layer in layers])
    girth = [_reach(layer) for layer in layers if len(layer)]
    upper = spread[len(spread) // 2 : max(len(spread) - 1, 1)]
    return Shape(
        points=len(points),
        low_m=low,
        top_m=top,
        length_m=length,
        width_m=width,
        head_m=_spread(plan[h >= top - HEAD_M]),
        body_m=float(np.nanmax(upper)) if np.isfinite(upper).any() else 0.0,
        foot_m=_foot(plan, h - low),
        median_m=float(np.nanmedian(spread)),
        girth_m=float(np.median(girth)),
        pitch_m=float(np.sqrt(length * (top - low) / len(points))),
        per_layer=len(points) / len(layers),
        filled=float(np.isfinite(spread).mean()),
    )


def _spread(plan: Values) -> float:
    """Return the root mean square distance of places (n, 2) from their mean."""
    if not len(plan):
        return float("nan")
    off = plan - plan.mean(axis=0)
    return float(np.sqrt((off * off).sum(axis=1).mean()))


def _reach(plan: Values) -> float:
    """Return how far from their mean nine in ten of some places (n, 2) lie at most."""
    off = plan - plan.mean(axis=0)
    distance2 = np.sort((off * off).sum(axis=1))
    return float(np.sqrt(distance2[int(np.ceil(0.9 * len(plan))) - 1]))


def _foot(plan: Values, above: Values) -> float:
    """Return the spread of the widest thin layer of the lowest `FOOT_M` that is one piece."""
    is_foot = above < FOOT_M
    layer = (above[is_foot] / SOLE_M).astype(np.int64)
    parts = [plan[is_foot][layer == k] for k in np.unique(layer)]
    return max((_spread(part) for part in parts if not _is_parted(part)), default=0.0)


def _is_parted(plan: Values) -> bool:
    """Say whether places (n, 2) leave a wide gap along their longer axis."""
    if len(plan) < STEP_POINTS:
        return False
    off = plan - plan.mean(axis=0)
    xx, yy, xy = (off[:, 0] ** 2).sum(), (off[:, 1] ** 2).sum(), (off[:, 0] * off[:, 1]).sum()
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    along = np.sort(off[:, 0] * np.cos(turn) + off[:, 1] * np.sin(turn))
    return bool(np.diff(along).max() > STEP * (along[-1] - along[0]))


def _layers(plan: Values, height: Values, low: float, top: float) -> list[Values]:
    """Return the places of every layer from the lowest up."""
    count = max(1, int(np.ceil((top - low) / LAYER_M)))
    layer = np.minimum(((height - low) / LAYER_M).astype(np.int64), count - 1)
    return [plan[layer == k] for k in range(count)]
