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
    """The same of the widest thin layer of the foot."""
    median_m: float
    """The same, of the layer that half of the layers are thinner than."""
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
    spread, filled = _layers(plan, h, low, top)
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
        filled=filled,
    )


def _spread(plan: Values) -> float:
    """Return the root mean square distance of places (n, 2) from their mean."""
    if not len(plan):
        return float("nan")
    off = plan - plan.mean(axis=0)
    return float(np.sqrt((off * off).sum(axis=1).mean()))


def _foot(plan: Values, above: Values) -> float:
    """Return the spread of the widest thin layer of the lowest `FOOT_M`."""
    is_foot = above < FOOT_M
    layer = (above[is_foot] / SOLE_M).astype(np.int64)
    return max(_spread(plan[is_foot][layer == k]) for k in np.unique(layer))


def _layers(plan: Values, height: Values, low: float, top: float) -> tuple[Values, float]:
    """Return the spread of every layer from the lowest up, NaN where empty, and those filled."""
    count = max(1, int(np.ceil((top - low) / LAYER_M)))
    layer = np.minimum(((height - low) / LAYER_M).astype(np.int64), count - 1)
    spread = np.array([_spread(plan[layer == k]) for k in range(count)])
    return spread, float(np.isfinite(spread).mean())
