"""Coarse methods on surveyed buildings: what each proposes, and where a fine fit takes it from."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import DougongError
from dougong.evaluation.metrics import pose_errors
from dougong.evaluation.survey import Scene
from dougong.registration import Icp, Register, register
from dougong.registration.congruent_sets import CongruentSets, four_pcs
from dougong.registration.icp import Level, build_levels, refine_levels
from dougong.registration.plan_search import plan_search
from dougong.registration.prepare import Prepared, prepare
from dougong.registration.principal_axes import improved_pca, traditional_pca
from dougong.registration.result import Hypothesis
from dougong.registration.sample_consensus import SacIa, sac_ia
from dougong.typing import Transform

METHODS: Mapping[str, Callable[[Prepared, Prepared], list[Hypothesis]]] = {
    "plan": plan_search,
    "improved-pca": improved_pca,
    "pca": traditional_pca,
    "sac-ia": sac_ia,
    "4pcs": four_pcs,
}
RIGHT_DEG, RIGHT_M = 2.0, 0.5
"""A coarse pose this near to the true one (yaw; place in plan at the source's middle) is right."""
LISTED = 8
FINE_ITERATIONS = (1, 2, 5, 10, 20, 40, 75)
"""Most iterations of the fine fit per level."""
SAC_TRIALS = (1000, 10_000, 50_000, 200_000)
CONGRUENT_BASES = (1, 5, 15, 30, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """A surveyed pair, prepared once for all methods."""

    scene: Scene
    source: Prepared
    target: Prepared
    levels: tuple[Level, ...]
    """Of the fine fit."""


def made_ready(scene: Scene) -> Ready:
    """Prepare both clouds of a scene."""
    source = prepare(scene.lidar, "lidar")
    target = prepare(scene.photogrammetry, "photogrammetry")
    levels = build_levels(source, target, Icp())
    return Ready(scene=scene, source=source, target=target, levels=levels)


def local_pose(pose: Transform, source: Cloud, target: Cloud) -> Transform:
    """Return a pose between file coordinates as one between the local frames of two clouds."""
    local = np.array(pose)
    local[:3, 3] += pose[:3, :3] @ source.frame.origin - target.frame.origin
    return local


def file_pose(pose: Transform, source: Cloud, target: Cloud) -> Transform:
    """Return a pose between local frames as one between the file coordinates of two clouds."""
    moved = np.array(pose)
    moved[:3, 3] += target.frame.origin - pose[:3, :3] @ source.frame.origin
    return moved


def coarse_errors(ready: Ready, found: list[Hypothesis]) -> list[tuple[float, float, float]]:
    """Return the errors of poses in yaw (deg), plan (m) and height (m) at the source's middle."""
    scene, centre = ready.scene, ready.source.xyz.mean(axis=0)
    truth = local_pose(scene.truth.T_target_source, scene.lidar, scene.photogrammetry)
    errors = []
    for hypothesis in found:
        T = hypothesis.T_target_source
        turn = T[:3, :3] @ truth[:3, :3].T
        offset = (T[:3, :3] - truth[:3, :3]) @ centre + T[:3, 3] - truth[:3, 3]
        yaw = abs(float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))))
        errors.append((yaw, float(np.hypot(*offset[:2])), abs(float(offset[2]))))
    return errors


def proposed(ready: Ready, method: str) -> tuple[dict[str, Any], list[Hypothesis]]:
    """Return what a coarse method proposes, and how far its poses are from the true one."""
    start = time.perf_counter()
    found = METHODS[method](ready.source, ready.target)
    seconds = time.perf_counter() - start
    errors = coarse_errors(ready, found)
    right = _right(errors)
    best = errors[right[0]] if right else (None, None, None)
    row = {
        "poses": len(found),
        "is_first_right": 0 in right,
        "is_listed": bool(right) and right[0] < LISTED,
        **dict(zip(("yaw_error_deg", "plan_error_m", "height_error_m"), best, strict=True)),
        "coarse_s": seconds,
    }
    return row, found


def _right(errors: list[tuple[float, float, float]]) -> list[int]:
    return [i for i, (yaw, plan, _) in enumerate(errors) if yaw < RIGHT_DEG and plan < RIGHT_M]


def judged(scene: Scene, method: str) -> dict[str, Any]:
    """Return what the whole registration says that starts from a coarse method."""
    start = time.perf_counter()
    try:
        params = Register.model_validate({"coarse": method})
        result = register(scene.lidar, scene.photogrammetry, params)
    except DougongError as error:
        return {"status": "failed", "reason": str(error), "is_correct": False}
    row: dict[str, Any] = {"status": result.status, "is_correct": False}
    row["register_s"] = time.perf_counter() - start
    if result.matrix is not None:
        errors = pose_errors(result.matrix, scene.truth)
        row |= {"pose95_mm": 1e3 * errors.tre95_m, "is_correct": errors.is_correct}
    return row


def converging(
    ready: Ready, found: list[Hypothesis], steps: Iterable[int] = FINE_ITERATIONS
) -> Iterator[dict[str, Any]]:
    """Yield the error after more and more fine iterations from a method's first pose."""
    if not found:
        return
    scene = ready.scene
    for most in steps:
        fine = refine_levels(ready.levels, found[0].T_target_source, Icp(max_iterations=most))
        pose = file_pose(fine.T_target_source, scene.lidar, scene.photogrammetry)
        errors = pose_errors(pose, scene.truth)
        yield {
            "most_iterations_per_level": most,
            "iterations": fine.iterations,
            "pose95_mm": 1e3 * errors.tre95_m,
            "is_correct": errors.is_correct,
        }


def sampling(ready: Ready, seed: int) -> Iterator[dict[str, Any]]:
    """Yield whether the two sampling methods find the pose with more and more samples."""
    pair = ready.source, ready.target
    searches: list[tuple[str, int, Callable[[], list[Hypothesis]]]] = [
        *(
            ("sac-ia", trials, partial(sac_ia, *pair, SacIa(trials=trials, seed=seed)))
            for trials in SAC_TRIALS
        ),
        *(
            ("4pcs", bases, partial(four_pcs, *pair, CongruentSets(bases=bases, seed=seed)))
            for bases in CONGRUENT_BASES
        ),
    ]
    for method, samples, search in searches:
        start = time.perf_counter()
        right = _right(coarse_errors(ready, search()))
        yield {
            "method": method,
            "samples": samples,
            "is_first_right": 0 in right,
            "is_listed": bool(right) and right[0] < LISTED,
            "coarse_s": time.perf_counter() - start,
        }
