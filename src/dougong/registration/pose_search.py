"""Many rigid poses at once: proposed, scored against a field of closest points, improved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import by_coordinates
from dougong.filters import neighbourhood
from dougong.kernels import poses as kernels
from dougong.threads import for_blocks
from dougong.typing import Index, Points, Transform, Values

Poses = NDArray[np.float64]
"""(k, 12): rotation by rows, then translation."""

_BLOCK = 64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One cloud as a search sees it: few points in canonical order, about their own middle."""

    points: Points
    """(n, 3) metres, centred."""
    normals: Points
    """(n, 3) unit; their signs mean nothing."""
    centre: Values
    """(3,) what was subtracted."""
    spacing_m: float
    """Median distance to the nearest neighbour."""

    @property
    def radius_m(self) -> float:
        """Return the root-mean-square distance from the centre."""
        return float(np.sqrt((self.points**2).sum(axis=1).mean()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Field:
    """A view that poses are compared with: a grid of closest points."""

    view: View
    cells: NDArray[np.int32]
    low: Values
    cell_m: float


def view_of(points: Points, normals: Points, spacing_m: float) -> View:
    """Return `points` and `normals` (n, 3) as a view."""
    order = by_coordinates(points)
    centre = points[order].mean(axis=0)
    return View(
        points=np.ascontiguousarray(points[order] - centre),
        normals=np.ascontiguousarray(normals[order]),
        centre=centre,
        spacing_m=spacing_m,
    )


def build_field(view: View, reach_m: float, most_cells: int = 56) -> Field:
    """Return the closest points within `reach_m` of `view` on a grid of `most_cells` a side."""
    low, high = view.points.min(axis=0) - reach_m, view.points.max(axis=0) + reach_m
    cell = float((high - low).max()) / most_cells
    shape = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
    axes = [low[a] + (np.arange(shape[a]) + 0.5) * cell for a in range(3)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = neighbourhood.build_index(view.points)
    places, _ = neighbourhood.nearest(index, centres, reach_m + cell)
    return Field(
        view=view, cells=places.astype(np.int32).reshape(tuple(shape)), low=low, cell_m=cell
    )


def spread(view: View, count: int) -> Index:
    """Return `count` places of `view` spread evenly (farthest point first), ascending cost n k."""
    count = min(count, len(view.points))
    chosen = np.empty(count, np.int64)
    distance = np.full(len(view.points), np.inf)
    at = int(np.argmax((view.points**2).sum(axis=1)))
    for step in range(count):
        chosen[step] = at
        distance = np.minimum(distance, ((view.points - view.points[at]) ** 2).sum(axis=1))
        at = int(np.argmax(distance))
    return chosen


def score_poses(
    poses: Poses, points: Points, normals: Points, field: Field, reach_m: float
) -> Values:
    """Return the score (k,) of each pose: 0 nowhere near, 1 a perfect fit (`kernels.poses`)."""
    out = np.zeros(len(poses))

    def task(start: int, stop: int) -> None:
        rows = slice(start, stop)
        kernels.score_poses(
            poses[rows],
            points,
            normals,
            field.view.points,
            field.view.normals,
            field.cells,
            field.low,
            field.cell_m,
            reach_m,
            out[rows],
        )

    for_blocks(len(poses), _BLOCK, task)
    return out


def score_both_ways(
    poses: Poses, source: Field, target: Field, places: tuple[Index, Index], reach_m: float
) -> Values:
    """Return the mean score (k,) of source points on the target and target points on the source."""
    one, two = places
    forward = score_poses(poses, source.view.points[one], source.view.normals[one], target, reach_m)
    backward = score_poses(
        inverted(poses), target.view.points[two], target.view.normals[two], source, reach_m
    )
    return 0.5 * (forward + backward)


def shift_poses(poses: Poses, points: Points, field: Field, reach_m: float, steps: int) -> Poses:
    """Return `poses` moved, without turning, to where the points meet the field."""
    moved = poses.copy()

    def task(start: int, stop: int) -> None:
        kernels.shift_poses(
            moved[start:stop],
            points,
            field.view.points,
            field.cells,
            field.low,
            field.cell_m,
            reach_m,
            steps,
        )

    for_blocks(len(poses), _BLOCK, task)
    return moved


def settle_poses(poses: Poses, points: Points, field: Field, reach_m: float, steps: int) -> Poses:
    """Return `poses` improved by `steps` of point-to-plane ICP on the field."""
    moved = poses.copy()

    def task(start: int, stop: int) -> None:
        kernels.settle_poses(
            moved[start:stop],
            points,
            field.view.points,
            field.view.normals,
            field.cells,
            field.low,
            field.cell_m,
            reach_m,
            steps,
        )

    for_blocks(len(poses), _BLOCK, task)
    return moved


def fit_rigid_many(source: NDArray[np.float64], target: NDArray[np.float64]) -> Poses:
    """Return the least-squares rigid motions (k, 12) of paired points (k, m, 3) (Kabsch 1976)."""
    centre_s, centre_t = source.mean(axis=1), target.mean(axis=1)
    spread_ = np.einsum("kmi,kmj->kij", target - centre_t[:, None], source - centre_s[:, None])
    u, _, vt = np.linalg.svd(spread_)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    turn = u @ vt
    shift = centre_t - np.einsum("kij,kj->ki", turn, centre_s)
    return np.concatenate([turn.reshape(-1, 9), shift], axis=1)


def inverted(poses: Poses) -> Poses:
    """Return the inverse of every pose (k, 12)."""
    turn = poses[:, :9].reshape(-1, 3, 3).transpose(0, 2, 1)
    shift = -np.einsum("kij,kj->ki", turn, poses[:, 9:])
    return np.concatenate([turn.reshape(-1, 9), shift], axis=1)


def distinct(poses: Poses, scores: Values, most: int, angle_deg: float, shift_m: float) -> Index:
    """Return the places of the best poses that are apart by the angle *or* the shift.

    Best first; ties go to the earlier pose. The shift is measured at the source's centre.
    """
    order = np.argsort(-scores, kind="stable")
    least_trace = 1.0 + 2.0 * np.cos(np.radians(angle_deg))
    kept: list[int] = []
    for place in order:
        if len(kept) == most:
            break
        others = poses[kept]
        trace = others[:, :9] @ poses[place, :9]
        apart = np.linalg.norm(others[:, 9:] - poses[place, 9:], axis=1)
        if not ((trace > least_trace) & (apart < shift_m)).any():
            kept.append(int(place))
    return np.array(kept, np.int64)


def rotation_grid(count: int) -> NDArray[np.float64]:
    """Return `count` rotations (count, 3, 3) spread evenly over SO(3).

    Super-Fibonacci spirals (Alexa 2022): 4,000 leave no rotation farther off than about 15 deg.
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / np.sqrt(2.0), 2.0 * np.pi * s / 1.533751168755204288118041
    quaternions = np.column_stack(
        [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    )
    return rotations_of(quaternions)


def rotations_of(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations (k, 3, 3) of unit quaternions (k, 4), scalar part last."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.array(rows).transpose(2, 0, 1))


def poses_of(rotations: NDArray[np.float64], shifts: NDArray[np.float64]) -> Poses:
    """Return poses (k, 12) of rotations (k, 3, 3) and translations (k, 3)."""
    return np.concatenate([rotations.reshape(-1, 9), shifts], axis=1)


def to_transform(pose: NDArray[np.float64], source: View, target: View) -> Transform:
    """Return a pose (12,) between centred views as a transform between the clouds' own frames."""
    T = np.eye(4)
    T[:3, :3] = pose[:9].reshape(3, 3)
    T[:3, 3] = pose[9:] + target.centre - T[:3, :3] @ source.centre
    return T


def from_transform(T: Transform, source: View, target: View) -> NDArray[np.float64]:
    """Return a transform between the clouds' own frames as a pose (12,) between views."""
    shift = T[:3, 3] - target.centre + T[:3, :3] @ source.centre
    return np.concatenate([T[:3, :3].ravel(), shift])
