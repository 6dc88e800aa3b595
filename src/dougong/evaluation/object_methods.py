"""Every coarse method on objects of unknown attitude: what proposes poses for the ladder."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dougong.registration.congruent_sets import CongruentSets, congruent_poses
from dougong.registration.free_rotation import FreeRotation, ObjectPair, starting_poses
from dougong.registration.pose_search import Poses, build_field, poses_of
from dougong.registration.sample_consensus import SacIa, consensus_poses
from dougong.typing import Points, Values

TOLD = "ours-told"
"""Ours with the largest rotation known, as learned methods know it: the ladder tells it."""


def _axes(points: Points) -> NDArray[np.float64]:
    vectors: NDArray[np.float64] = np.linalg.eigh(points.T @ points)[1][:, ::-1].copy()
    vectors[:, 2] = np.cross(vectors[:, 0], vectors[:, 1])
    return vectors


def _pca(pair: ObjectPair, _: FreeRotation) -> Poses:
    """Return traditional PCA's pose: centroids, axes in order, signs as the solver gives them."""
    one, two = pair.views
    return poses_of((_axes(two.points) @ _axes(one.points).T)[None], np.zeros((1, 3)))


def _improved_pca(pair: ObjectPair, _: FreeRotation) -> Poses:
    """Return improved PCA's poses (METHOD.md 2.1, steps 2 to 4; an object has no plan contour).

    Origin in the middle of the box along the axes, all proper signs, and axis exchanges where
    eigenvalues are within a ratio of 1.1.
    """
    axes, middles = [], []
    values: list[Values] = []
    for view in pair.views:
        along = view.points @ _axes(view.points)
        middle = _axes(view.points) @ (0.5 * (along.min(axis=0) + along.max(axis=0)))
        axes.append(_axes(view.points - middle))
        middles.append(middle)
        values.append(np.asarray(np.linalg.eigvalsh(view.points.T @ view.points)[::-1], np.float64))
    turns = []
    for order in itertools.permutations(range(3)):
        if not all(_may_swap(values, a, b) for a, b in enumerate(order)):
            continue
        for signs in itertools.product((1.0, -1.0), repeat=3):
            pairing = np.zeros((3, 3))
            pairing[range(3), order] = signs
            if np.linalg.det(pairing) > 0:
                turns.append(axes[1] @ pairing @ axes[0].T)
    shifts = np.array([middles[1] - turn @ middles[0] for turn in turns])
    return poses_of(np.array(turns), shifts)


def _may_swap(values: Sequence[Values], a: int, b: int) -> bool:
    return a == b or any(max(v[a], v[b]) < 1.1 * min(v[a], v[b]) for v in values)


def _sac_ia(pair: ObjectPair, _: FreeRotation) -> Poses:
    one, two = pair.views
    field = build_field(two, 0.4 * two.radius_m)
    return consensus_poses(one, two, field, SacIa(trials=100_000))[0]


def _four_pcs(pair: ObjectPair, _: FreeRotation) -> Poses:
    one, two = pair.views
    field = build_field(two, 0.4 * two.radius_m)
    return congruent_poses(one, two, field, CongruentSets(sampled=300, bases=30))[0]


def _ours(pair: ObjectPair, settings: FreeRotation) -> Poses:
    return starting_poses(*pair.views, settings)[0]


METHODS: Mapping[str, Callable[[ObjectPair, FreeRotation], Poses]] = {
    "ours": _ours,
    TOLD: _ours,
    "improved-pca": _improved_pca,
    "pca": _pca,
    "sac-ia": _sac_ia,
    "4pcs": _four_pcs,
}
"""Every method proposes poses; thinning, normals, fine fit and verdict are the same for all."""
