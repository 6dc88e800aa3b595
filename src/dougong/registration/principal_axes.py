"""Coarse registration by principal axes: the paper's improved PCA, and the traditional one.

Known weakness (METHOD.md 2.2): a plan with three- or more-fold symmetry has no axes, and two
sensors that see different parts of a building have different ones. Kept for comparison; the
default is the plan search.
"""

import itertools
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dougong.params import Parameters
from dougong.registration.contour import Contour, contour_points
from dougong.registration.hypotheses import rank
from dougong.registration.levelling import rotation_to_vertical
from dougong.registration.prepare import Prepared
from dougong.registration.result import Hypothesis
from dougong.typing import Points, Transform


class ImprovedPca(Parameters):
    """How improved PCA finds and pairs the axes."""

    contour: Contour = Contour()
    gravity_known: bool = True
    """True: axes in plan only, up stays up. False: axes in space."""
    exchange_ratio: Annotated[float, Field(ge=1)] = 1.1
    """Neighbouring eigenvalues closer than this ratio may be exchanged between the clouds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Axes:
    """Where a cloud's axes start and where they point."""

    origin: NDArray[np.float64]
    """(3,) local frame."""
    vectors: NDArray[np.float64]
    """(3, 3) columns, right-handed, longest axis first (gravity known: z last)."""
    values: NDArray[np.float64]
    """(3,) variances along them, in units of the squared RMS radius."""


def improved_pca(
    source: Prepared, target: Prepared, params: ImprovedPca | None = None
) -> list[Hypothesis]:
    """Pair the axes of both clouds' contour points in every proper way, best score first.

    R = W_f S M_e^T with eigenvector columns W_f (target) and M_e (source), t = c_f - R c_e
    (METHOD.md 2). S runs over the sign triples that are rotations: 2 when gravity is known (yaw
    and yaw + 180 degrees), 4 otherwise; with exchanges where eigenvalues are close, 4 and up
    to 24.
    """
    params = params or ImprovedPca()
    one, other = _contour_axes(source, params), _contour_axes(target, params)
    pairings = _pairings(one.values, other.values, params)
    return rank([_hypothesis(one, S, other, "improved-pca") for S in pairings], source, target)


def traditional_pca(source: Prepared, target: Prepared) -> list[Hypothesis]:
    """Align centroids and principal axes of all points: one pose, no sign correction."""
    one, other = (
        _axes(source.xyz, source.xyz.mean(axis=0)),
        _axes(target.xyz, target.xyz.mean(axis=0)),
    )
    return rank([_hypothesis(one, np.eye(3), other, "pca")], source, target)


def _hypothesis(one: Axes, pairing: NDArray[np.float64], other: Axes, method: str) -> Hypothesis:
    transform: Transform = np.eye(4)
    transform[:3, :3] = other.vectors @ pairing @ one.vectors.T
    transform[:3, 3] = other.origin - transform[:3, :3] @ one.origin
    return Hypothesis(T_target_source=transform, score=0.0, method=method)


def _contour_axes(cloud: Prepared, params: ImprovedPca) -> Axes:
    """Return the axes of the contour points about the centre of their minimum bounding box."""
    chosen = contour_points(cloud, params.contour)
    rotation = rotation_to_vertical(cloud.up)
    level = cloud.xyz[chosen] @ rotation.T
    # Two sensors see different heights of a building, but the same ground.
    ground = float(np.median(level[:, 2] - cloud.height_above_ground[chosen]))
    origin = np.array([*_box_centre(level[:, :2]), ground])
    axes = _axes(level, origin, in_plan=params.gravity_known)
    return Axes(origin=rotation.T @ origin, vectors=rotation.T @ axes.vectors, values=axes.values)


def _box_centre(plan: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centre (2,) of the smallest oriented rectangle round the points."""
    middle = plan.mean(axis=0)
    hull = cv2.convexHull(np.ascontiguousarray(plan - middle, dtype=np.float32))
    (x, y), _, _ = cv2.minAreaRect(hull)
    centre: NDArray[np.float64] = middle + np.array([x, y])
    return centre


def _axes(points: Points, origin: NDArray[np.float64], *, in_plan: bool = False) -> Axes:
    """Return the principal axes of `points` about `origin` (not about their mean)."""
    centred = points - origin
    if in_plan:
        centred = centred * [1.0, 1.0, 0.0]
    radius = float(np.sqrt((centred**2).sum(axis=1).mean()))
    centred = centred / max(radius, 1e-12)
    values, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
    values, vectors = values[::-1], vectors[:, ::-1].copy()
    if in_plan:
        # z has no variance left, so it comes last; it must point up.
        vectors[:, 2] = [0.0, 0.0, 1.0]
        vectors[:, 1] = np.cross(vectors[:, 2], vectors[:, 0])
    else:
        vectors[:, 2] = np.cross(vectors[:, 0], vectors[:, 1])
    return Axes(origin=origin, vectors=vectors, values=values)


def _pairings(
    one: NDArray[np.float64], other: NDArray[np.float64], params: ImprovedPca
) -> list[NDArray[np.float64]]:
    """Return the signed permutations S (3, 3), determinant +1, that the eigenvalues allow."""

    def may_swap(a: int, b: int) -> bool:
        return any(
            max(values[a], values[b]) < params.exchange_ratio * min(values[a], values[b])
            for values in (one, other)
        )

    found = []
    for order in itertools.permutations(range(3)):
        if not all(a == b or may_swap(a, b) for a, b in enumerate(order)):
            continue
        for signs in itertools.product((1.0, -1.0), repeat=3):
            pairing = np.zeros((3, 3))
            pairing[range(3), order] = signs
            if np.linalg.det(pairing) < 0 or (params.gravity_known and pairing[2, 2] != 1.0):
                continue
            found.append(pairing)
    return found
