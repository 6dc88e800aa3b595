"""Before a pose is believed: mirror images and wrong units (METHOD.md 7)."""

from dataclasses import dataclass, replace

import numpy as np

from dougong.cloud import Cloud
from dougong.registration.cleaning import extent, far_points
from dougong.registration.plan_search import PlanSearch, plan_search
from dougong.registration.prepare import Prepared
from dougong.registration.result import Hypothesis
from dougong.typing import Points, Values

UNIT_RATIOS = {1000.0: "millimetres", 304.8: "millimetres and the other one in feet"}
"""Ratios of two lengths that betray two units, and what the larger number is likely in."""

_MIRROR_LEAD = 1.25
_MIRROR_MIN = 0.4
_WILD = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorCheck:
    """What the search says about the source and about its mirror image."""

    is_mirrored: bool
    score: float
    """Best score of the source as it is."""
    mirrored_score: float
    """Best score of its mirror image."""
    sentence: str
    """What is wrong and what to do; empty when nothing is."""


def is_mirrored(
    source: Prepared,
    target: Prepared,
    hypotheses: list[Hypothesis],
    params: PlanSearch | None = None,
) -> MirrorCheck:
    """Say whether the mirror image of `source` fits clearly better than `source` itself.

    A left-handed export has one horizontal axis negated or two axes swapped; in plan these
    differ by a turn only, so one mirrored search (about the cost of the first one) decides.
    Many buildings equal their own mirror image: both scores are high then, and nothing is said.

    Parameters
    ----------
    hypotheses : list of Hypothesis
        What `plan_search` found for the source as it is.
    """
    plain = max((hypothesis.score for hypothesis in hypotheses), default=0.0)
    found = plan_search(mirrored(source), target, params)
    other = max((hypothesis.score for hypothesis in found), default=0.0)
    is_worse = other >= _MIRROR_MIN and other > _MIRROR_LEAD * plain
    sentence = (
        f"the mirror image of the source fits better than the source (score {other:.2f} against "
        f"{plain:.2f}): one file is left-handed (export it again with x and y in the right order "
        "and sign: negate x, or swap x and y), or the clouds show two parts that mirror each other."
        if is_worse
        else ""
    )
    return MirrorCheck(is_mirrored=is_worse, score=plain, mirrored_score=other, sentence=sentence)


def mirrored(cloud: Prepared) -> Prepared:
    """Return `cloud` with its x axis negated."""
    flip = np.array([-1.0, 1.0, 1.0])
    levelling = replace(cloud.levelling, up=cloud.levelling.up * flip)
    return replace(
        cloud,
        xyz=cloud.xyz * flip,
        normals=cloud.normals * flip,
        seen_from=None if cloud.seen_from is None else cloud.seen_from * flip,
        levelling=levelling,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleProposal:
    """A unit error that would explain why two clouds differ wildly in size."""

    factor: float
    """Multiply the source's coordinates by this."""
    ratio: float
    """Size of the target / size of the source, as found."""
    sentence: str


def propose_scale(source: Cloud, target: Cloud) -> ScaleProposal | None:
    """Compare the sizes of two clouds with the ratios of common units; never applied silently.

    Sizes are the heights and widths of the boxes without far points. One site surveyed twice
    can differ a lot (one facade against a whole site), so only wild differences speak: above 20
    in width *and* height. A ratio of 3.28 hides within what partial overlap does to sizes;
    where nothing declares a unit the search with a free scale finds it.
    """
    one, other = _size(source.xyz), _size(target.xyz)
    if min(*one, *other) <= 0.0:
        return None
    ratios = other / one
    if not ((ratios > _WILD).all() or (ratios < 1.0 / _WILD).all()):
        return None
    ratio = float(np.sqrt(ratios[0] * ratios[1]))
    size = max(ratio, 1.0 / ratio)
    # Heights differ less between two surveys of one building than widths do.
    height = max(float(ratios[1]), 1.0 / float(ratios[1]))
    unit = min(UNIT_RATIOS, key=lambda known: abs(np.log(height / known)))
    if abs(np.log(height / unit)) > np.log(3.0):
        return None
    larger = "target" if ratio > 1.0 else "source"
    shown = float(f"{size:.3g}")
    sentence = (
        f"the {larger} is about {shown:,g} times as large as the other cloud (roughly, by their "
        f"extents), as if it were in {UNIT_RATIOS[unit]}; expected the same unit. Export it in the "
        f"other one's, 1/{unit:g} of these numbers, or name its unit (crs), and register again."
    )
    return ScaleProposal(factor=unit if ratio > 1.0 else 1.0 / unit, ratio=ratio, sentence=sentence)


def _size(points: Points) -> Values:
    """Return (width in plan, height) of the box without far points, metres."""
    if len(points) < 2:
        return np.zeros(2)
    low, high = extent(points[~far_points(points)])
    return np.array([float((high - low)[:2].max()), float((high - low)[2])])
