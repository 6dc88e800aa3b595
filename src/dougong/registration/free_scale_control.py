"""The scale of a cloud without a unit: by a search, or by control points and clouds together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dougong.cloud import Cloud
from dougong.registration.control import DISAGREE_M, DISAGREE_P, local_control
from dougong.registration.control_solve import (
    SIMILAR,
    ControlPoints,
    information_of,
    joint,
    own_pose,
)
from dougong.registration.free_scale import (
    LEAST,
    MOST,
    ScaleSearch,
    Side,
    free_side,
    scale_near,
    search_scale,
)
from dougong.registration.free_scale_result import in_metres
from dougong.registration.settings import Register
from dougong.registration.similarity_fit import FREE_WITH_SCALE
from dougong.typing import Kind, Transform


def find_scale(
    source: Cloud,
    target: Cloud,
    params: Register,
    *,
    source_kind: Kind,
    target_kind: Kind,
    control: ControlPoints | None = None,
    side: Side | None = None,
) -> ScaleSearch:
    """Find the scale of the cloud that has none: by control points and clouds, or by a search.

    Parameters
    ----------
    source, target : Cloud
        Raw or filtered; one of them in units that nobody knows.
    params : Register
    source_kind, target_kind : {"lidar", "photogrammetry"}
    control : ControlPoints, optional
        Three or more that are not on one line spare the search; any are adjusted with what the
        clouds say.
    side : {"source", "target"}, optional
        Which cloud has no unit; by default see `free_side`.
    """
    side = side or free_side(source, source_kind, target, target_kind)
    dof = 5 if params.dof in (4, 5) else 7
    found = None
    start = None if control is None else scale_of_control(control, source, target, side)
    if start is not None and LEAST <= start[0] <= MOST:
        found = scale_near(
            source,
            target,
            *start,
            source_kind=source_kind,
            target_kind=target_kind,
            icp=params.icp,
            dof=dof,
            side=side,
        )
    if found is None or not found.candidates:
        found = search_scale(
            source,
            target,
            source_kind=source_kind,
            target_kind=target_kind,
            icp=params.icp,
            dof=dof,
            side=side,
        )
    if control is not None and found.candidates:
        found = with_control(found, source, target, control, dof)
    return found


def scale_of_control(
    control: ControlPoints, source: Cloud, target: Cloud, side: Side
) -> tuple[float, Transform] | None:
    """Return metres per unit of the free cloud, and the pose in metres, by control points alone.

    Bad points are left out. None: fewer than three are left, or they are on one line.
    """
    points = replace(
        control,
        source=source.frame.to_local(control.source),
        target=target.frame.to_local(control.target),
    )
    T, _ = own_pose(points, ~points.is_check, SIMILAR)
    if T is None:
        return None
    return _in_metres(T, side)


def _in_metres(T: Transform, side: Side) -> tuple[float, Transform]:
    """Return the unit of the free cloud that makes a similarity rigid, and that rigid motion."""
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    rigid = T.copy()
    rigid[:3, :3] /= scale
    if side == "source":
        return scale, rigid
    rigid[:3, 3] /= scale
    return 1.0 / scale, rigid


def with_control(
    found: ScaleSearch, source: Cloud, target: Cloud, control: ControlPoints, dof: int
) -> ScaleSearch:
    """Adjust the best scale and its pose together with the control points, by their covariances.

    Parameters
    ----------
    found : ScaleSearch
        With a candidate.
    source, target : Cloud
        As they were searched.
    control : ControlPoints
    dof : int
        5 (levelled) or 7.

    Raises
    ------
    InputError
        The points lie far outside their clouds.
    """
    best = found.candidates[0]
    fit = best.fit
    known = local_control(control, *in_metres(found, source, target), SIMILAR)
    used = ~known.points.is_check
    if not used.any() or fit.covariance is None:
        return found
    free = FREE_WITH_SCALE[dof]
    held = free if fit.holds_scale else tuple(place for place in free if place != 6)
    information = information_of(fit.covariance, held)
    both = joint(fit.T_target_source, information, fit.centre, known.points, used, free)
    growth, T = _in_metres(both.T, found.side)
    # In metres of a target that has another unit now, shifts are other numbers.
    target_growth = growth if found.side == "target" else 1.0
    unit = np.array([1.0] * 3 + [target_growth] * 3 + [1.0])
    adjusted = replace(
        fit,
        T_target_source=T,
        covariance=both.covariance * np.outer(unit, unit),
        centre=fit.centre * target_growth,
        holds_scale=fit.holds_scale or int(both.used.sum()) > 1,
    )
    contradiction = None
    if both.p_value < DISAGREE_P and both.disagreement_m > DISAGREE_M:
        contradiction = (
            f"with the scale free the clouds and the control points disagree by "
            f"{both.disagreement_m:.2g} m (root mean square), more than both declare (p = "
            f"{max(both.p_value, 1e-9):.1g}): a point is misnamed or mistaken, a sigma is too "
            "small, or one cloud is bent."
        )
    candidate = replace(
        best,
        metres_per_unit=best.metres_per_unit * growth,
        T_target_source=T,
        fit=adjusted,
    )
    return replace(
        found,
        candidates=(candidate, *found.candidates[1:]),
        # Control points decide between scales.
        undecided=(),
        control_points=int(both.used.sum()),
        contradiction=contradiction,
    )
