"""Axes that were swapped or turned round on export, told by name where the coordinates show it.

Swapping two axes, or negating one, mirrors a site: no registration can undo it. Between two clouds
of one map the coordinates themselves give it away. Between scanner frames only the search can, and
there every horizontal axis is as good as another: they differ by a turn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.pipeline.ground import MAP_SIZE_M, do_meet, plan_box
from dougong.registration import Register
from dougong.registration.plan_search import plan_search
from dougong.registration.prepare import prepare
from dougong.registration.result import Registration
from dougong.typing import Kind, Values

_MIRRORS: dict[str, tuple[NDArray[np.float64], str]] = {
    "x and y are swapped": (
        np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
        "Export it with easting first, then northing",
    ),
    "x is negated": (np.diag([-1.0, 1, 1]), "Export it with x as it is on the map (negate x)"),
    "y is negated": (np.diag([1.0, -1, 1]), "Export it with y as it is on the map (negate y)"),
}
_LAYER_M = 0.25
_LEAD = 1.25
_LEAST_SCORE = 0.4
_TOO_CLOSE = 0.9
_FLIPS = {
    "it is left-handed, z points down. Export it again with z up (negate z)": (1, 1, -1),
    "it stands on its head. Turn it by 180 deg about the x axis (negate y and z)": (1, -1, -1),
}
_EITHER = (
    "it is left-handed with z down, or stands on its head; the clouds do not tell which. Export it "
    "again with z up (negate z), or turn it by 180 deg about the x axis"
)


def mirrored_axes(source: Cloud, target: Cloud) -> str | None:
    """Return what is wrong with the axes of one of two clouds of map size, or None.

    Spoken only where the two plans lie apart as they are, and meet once one axis is put right:
    among coordinates of hundreds of kilometres that is no accident.
    """
    if not len(source) or not len(target):
        return None
    one, two = plan_box(source), plan_box(target)
    if min(np.abs(box).max() for box in (one, two)) < MAP_SIZE_M or do_meet(one, two):
        return None
    for fault, (matrix, advice) in _MIRRORS.items():
        if not do_meet(np.sort(one @ matrix[:2, :2].T, axis=0), two):
            continue
        guilty, other = (target, source) if source.frame.crs and not target.frame.crs else (
            source, target)  # fmt: skip
        x, y = plan_box(guilty).mean(axis=0)
        return (
            f"{guilty.name} is a mirror image of the site: {fault} (x = {x:.0f}, y = {y:.0f}) "
            f"against {other.name}. {advice}."
        )
    return None


def upside_down(
    source: Cloud,
    target: Cloud,
    result: Registration,
    params: Register,
    source_kind: Kind,
    target_kind: Kind,
) -> str | None:
    """Return what is wrong where a cloud registers only with its z turned round, or None.

    For use when no pose was found. Costs a preparation and a search for each way to turn it, and
    only where a cloud's largest level layer (its ground, as a rule) lies in its upper half.
    """
    clouds = {"source": source, "target": target}
    suspects = [side for side, cloud in clouds.items() if _ground_is_high(cloud.xyz[:, 2])]
    if len(suspects) != 1:
        return None
    side = suspects[0]
    settings = params.prepare.model_copy(update={"is_filtered": params.filtered})
    bar = max(
        _LEAST_SCORE, _LEAD * max((hypothesis.score for hypothesis in result.hypotheses), default=0)
    )
    kinds = {"source": source_kind, "target": target_kind}
    other = "target" if side == "source" else "source"
    fixed = prepare(clouds[other], kinds[other], settings)
    found = []
    for sentence, flip in _FLIPS.items():
        cloud = clouds[side]
        turned = cloud.stretched(np.array(flip, dtype=float), cloud.frame)
        ready = prepare(turned, kinds[side], settings)
        pair = (ready, fixed) if side == "source" else (fixed, ready)
        score = max((h.score for h in plan_search(*pair, params.plan)), default=0.0)
        found.append((score, sentence))
    (second, _), (best, sentence) = sorted(found)
    if best <= bar:
        return None
    said = _EITHER if second > _TOO_CLOSE * best else sentence
    return f"{clouds[side].name} fits only with its z turned round: {said}."


def _ground_is_high(heights: Values) -> bool:
    """Say whether the fullest layer of a cloud lies in the upper half of its heights."""
    low, high = np.quantile(heights, [0.005, 0.995])
    if high - low < 4 * _LAYER_M:
        return False
    counts, edges = np.histogram(heights, np.arange(low, high + _LAYER_M, _LAYER_M))
    return bool(edges[int(counts.argmax())] + _LAYER_M / 2 > (low + high) / 2)
