"""How fast the fine fit brings an object's first coarse pose to the truth, method by method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from dougong.evaluation.modelnet import Ladder, Level, Motion, draw_pair
from dougong.evaluation.object_methods import METHODS, TOLD
from dougong.evaluation.object_symmetry import (
    CORRECT_DEG,
    CORRECT_RADII,
    Shape,
    pose_error,
)
from dougong.filters import neighbourhood
from dougong.registration import object_fit as fitting
from dougong.registration.free_rotation import object_pair
from dougong.registration.pose_search import Poses, to_transform
from dougong.typing import Transform

ITERATIONS = (1, 2, 5, 10, 20, 40, 75)
"""Most iterations of the fine fit at each of its two reaches."""


def converging_object(
    shape: Shape,
    level: Level,
    motion: Motion,
    ladder: Ladder,
    steps: Sequence[int] = ITERATIONS,
) -> Iterator[dict[str, Any]]:
    """Yield the errors after more and more iterations from the pose that each method puts first.

    For shapes without symmetry: the error is that from the one true pose. The axes of improved PCA
    have no order: of its proposals the one of least median distance both ways is the first.
    """
    source, target, truth = draw_pair(shape, level, motion, 0, ladder)
    pair = object_pair(source, target, ladder.settings)
    one, two = (fitting.body_of(view) for view in pair.views)
    spacing = max(view.spacing_m for view in pair.views)
    reaches = (max(0.1 * pair.views[1].radius_m, 3.0 * spacing), 2.5 * spacing)
    for method in ladder.methods:
        if method == TOLD:
            continue
        poses = METHODS[method](pair, ladder.settings)
        start = _nearest(one, two, poses if method == "improved-pca" else poses[:1])
        for most in steps:
            row: dict[str, Any] = {"shape": shape.name, "level": level, "motion": motion}
            row |= {"method": method, "most_iterations_per_level": most}
            row |= {"rre_deg": None, "is_correct": False}
            if start is not None:
                fitted = fitting.fit(one, two, start, reaches, iterations=most)
                pose = to_transform(_flat(fitted), *pair.views)
                angle, shift = pose_error(pose, truth)
                row |= {"rre_deg": angle}
                row |= {"is_correct": angle < CORRECT_DEG and shift < CORRECT_RADII}
            yield row


def _nearest(source: fitting.Body, target: fitting.Body, poses: Poses) -> Transform | None:
    """Return the proposal (4, 4) that lays the clouds nearest to each other; None without any."""
    best, least = None, np.inf
    for pose in poses:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = pose[:9].reshape(3, 3), pose[9:]
        there = neighbourhood.nearest(target.index, source.view.points @ T[:3, :3].T + T[:3, 3])[1]
        back = neighbourhood.nearest(source.index, (target.view.points - T[:3, 3]) @ T[:3, :3])[1]
        distance = float(np.median(there) + np.median(back))
        if distance < least:
            best, least = T, distance
    return best


def _flat(T: Transform) -> Any:
    return np.concatenate([T[:3, :3].ravel(), T[:3, 3]])
