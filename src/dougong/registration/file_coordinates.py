"""A pose between local frames as the result between the *file* coordinates of two clouds."""

from __future__ import annotations

import numpy as np

from dougong._checks import as_transform
from dougong.cloud import Cloud, Frame
from dougong.errors import FrameError
from dougong.registration.decision import Found
from dougong.registration.laps import Laps
from dougong.registration.result import Hypothesis, Registration
from dougong.registration.settings import Register
from dougong.typing import Transform


def unit_of(cloud: Cloud) -> float:
    """Return the metres per unit of a cloud's file.

    Raises
    ------
    FrameError
        Heights have another unit than the plan: no similarity joins such a file to another.
    """
    unit = cloud.frame.unit_m
    if max(unit) - min(unit) > 1e-12:
        msg = (
            f"{cloud.name} has heights in units of {unit[2]:.6g} m and plan coordinates in units "
            f"of {unit[0]:.6g} m; one unit is needed. Convert the heights first."
        )
        raise FrameError(msg)
    return float(unit[0])


def to_file_transform(T_local: Transform, source: Frame, target: Frame) -> Transform:
    """Return the motion between *file* coordinates of a motion between local frames.

    T_file = F_target T_local F_source^-1, with F the affine map local -> file.
    """
    unit_s, unit_t = float(source.unit_m[0]), float(target.unit_m[0])
    result = np.eye(4)
    result[:3, :3] = T_local[:3, :3] * (unit_s / unit_t)
    result[:3, 3] = (T_local[:3, 3] + target.origin - T_local[:3, :3] @ source.origin) / unit_t
    return as_transform(result)


def in_file_coordinates(
    found: Found,
    source: Cloud,
    target: Cloud,
    scale: float,
    params: Register,
    clock: Laps,
    notes: list[str],
) -> Registration:
    """Return what was found in local frames as a `Registration`; `scale` is that of the units."""

    def to_file(T: Transform) -> Transform:
        return to_file_transform(T, source.frame, target.frame)

    listed = tuple(
        Hypothesis(T_target_source=to_file(h.T_target_source), score=h.score, method=h.method)
        for h in found.hypotheses
    )
    if scale != 1.0:
        notes.append(f"units differ: the matrix scales by {scale:.9g}")
    return Registration(
        status=found.status,
        matrix=None if found.T is None else to_file(found.T),
        reason=found.reason,
        probability=found.probability,
        scale=scale,
        scale_source="none" if scale == 1.0 else "units",
        dof=6 if params.dof == "auto" else params.dof,
        coarse_method="plan" if params.coarse == "auto" else params.coarse,
        hypotheses=listed,
        margin=found.margin,
        fine=found.fine,
        notes=tuple(notes),
        seconds=dict(clock.seconds),
        parameters=params.model_dump(mode="json"),
    )
