"""Climb from each peak of the plan search to its top, on finer rasters."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dougong.kernels.plan import match_at_poses
from dougong.registration.rasters import PlanView, plan_raster, sparse_cells
from dougong.threads import for_blocks

_MOVES = np.array(
    [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanPose:
    """A pose in plan: turn the source by `yaw` about its pivot and put the pivot at x, y."""

    yaw: float
    """Radians."""
    x: float
    """Metres, levelled target frame."""
    y: float
    score: float
    """Masked normalised correlation."""


def suppress(
    poses: Sequence[PlanPose], yaw_deg: float, distance_m: float, most: int | None = None
) -> list[PlanPose]:
    """Keep the best of poses within `yaw_deg` and `distance_m` of each other, best first.

    No more than `most`, if it is given.
    """
    ordered = sorted(poses, key=lambda pose: (-pose.score, pose.yaw, pose.x, pose.y))
    table = np.array([(pose.yaw, pose.x, pose.y) for pose in ordered]).reshape(-1, 3)
    is_left = np.ones(len(ordered), dtype=bool)
    kept: list[PlanPose] = []
    for index, pose in enumerate(ordered):
        if len(kept) == most:
            break
        if is_left[index]:
            kept.append(pose)
            turn = np.abs((table[:, 0] - pose.yaw + np.pi) % (2 * np.pi) - np.pi)
            apart = np.hypot(table[:, 1] - pose.x, table[:, 2] - pose.y)
            is_left &= (np.degrees(turn) >= yaw_deg) | (apart >= distance_m)
    return kept


def refine(
    poses: Sequence[PlanPose],
    source: PlanView,
    target: PlanView,
    cell_m: float,
    yaw_step_deg: float,
    wall_share: float,
    min_overlap: float,
) -> list[PlanPose]:
    """Climb from every pose to the next maximum on rasters of `cell_m`.

    Steps of `yaw_step_deg` / 2 and one cell, halved twice.
    """
    field = plan_raster(target, cell_m, 1.0, wall_share)
    raster = plan_raster(source, cell_m, 0.0, wall_share)
    xy, values = sparse_cells(raster, source, cell_m, thin_free=True)
    floor = min_overlap * min(float(values[:, -2].sum()), float(field[..., -2].sum()))
    xy_cells = xy / cell_m

    def scores(trial: NDArray[np.float64]) -> NDArray[np.float64]:
        sums = np.empty((len(trial), 3))
        match_at_poses(xy_cells, values, field, trial, sums)
        below = np.maximum(sums[:, 1], floor) * np.maximum(sums[:, 2], floor)
        result: NDArray[np.float64] = sums[:, 0] / np.sqrt(below)
        return result

    climbed: list[PlanPose | None] = [None] * len(poses)

    def task(start: int, stop: int) -> None:
        for index in range(start, stop):
            pose = poses[index]
            place = (np.array([pose.x, pose.y]) - target.low) / cell_m - 0.5
            here = np.array([pose.yaw, *place])
            step = np.array([np.radians(0.5 * yaw_step_deg), 1.0, 1.0])
            best = -np.inf
            for _ in range(3):
                for _ in range(20):
                    trial = here + _MOVES * step
                    values_here = scores(trial)
                    top = int(values_here.argmax())
                    best = float(values_here[top])
                    if top == 0:
                        break
                    here = trial[top]
                step = 0.5 * step
            x, y = target.low + (here[1:] + 0.5) * cell_m
            climbed[index] = PlanPose(yaw=float(here[0]), x=float(x), y=float(y), score=best)

    for_blocks(len(poses), 1, task)
    return [pose for pose in climbed if pose is not None]
