"""The poses a registration starts from: of the chosen coarse method, and those it is told."""

from __future__ import annotations

import numpy as np

from dougong.cloud import Frame
from dougong.registration import hypotheses as ranking
from dougong.registration.congruent_sets import four_pcs
from dougong.registration.picked_pairs import PairFit, starts_of
from dougong.registration.plan_search import plan_search
from dougong.registration.prepare import Prepared
from dougong.registration.principal_axes import improved_pca, traditional_pca
from dougong.registration.result import Hypothesis
from dougong.registration.sample_consensus import sac_ia
from dougong.registration.settings import Register
from dougong.typing import Transform


def picked_poses(fit: PairFit, source: Prepared, target: Prepared) -> list[Hypothesis]:
    """Return the poses that picked pairs propose, scored."""
    return [heard(T, "pairs", source, target) for T in starts_of(fit)]


def heard(T: Transform, method: str, source: Prepared, target: Prepared) -> Hypothesis:
    """Return a pose that no search found, scored as theirs are."""
    return Hypothesis(T_target_source=T, score=ranking.score(T, source, target), method=method)


_DELIVERED_SHARE = 0.5
"""The pose that two clouds come with is heard where it scores this much of the search's best."""


def with_delivered(
    found: list[Hypothesis],
    source: Prepared,
    target: Prepared,
    source_frame: Frame,
    target_frame: Frame,
) -> list[Hypothesis]:
    """Return the found poses and, second, the one that the files' own coordinates say.

    Scanners write the poses of their own registration (E57, PTX), and surveyors deliver clouds in
    one system: where that is nearly true it should not depend on a search. It is one start among
    others, and proven as they are.
    """
    pose = as_delivered(source, target, source_frame, target_frame, "delivered")
    best = max((hypothesis.score for hypothesis in found), default=0.0)
    is_heard = pose.score > 0.0 and pose.score >= _DELIVERED_SHARE * best
    return [*found[:1], pose, *found[1:]] if is_heard else found


def as_delivered(
    source: Prepared, target: Prepared, source_frame: Frame, target_frame: Frame, method: str
) -> Hypothesis:
    """Return the pose that takes the files' own coordinates for one system."""
    T = np.eye(4)
    T[:3, 3] = source_frame.origin - target_frame.origin
    return heard(T, method, source, target)


def coarse_poses(
    source: Prepared, target: Prepared, source_frame: Frame, target_frame: Frame, params: Register
) -> list[Hypothesis]:
    """Return the starting poses of the chosen method, best first, in local frames."""
    if params.coarse == "none":
        return [as_delivered(source, target, source_frame, target_frame, "none")]
    if params.coarse == "improved-pca":
        return list(improved_pca(source, target, params.improved_pca))
    if params.coarse == "pca":
        return list(traditional_pca(source, target))
    if params.coarse == "sac-ia":
        return sac_ia(source, target, params.sac_ia)
    if params.coarse == "4pcs":
        return four_pcs(source, target, params.congruent_sets)
    plan = params.plan.model_copy(update={"yaw_hint_deg": params.yaw_hint_deg})
    return plan_search(source, target, plan)
