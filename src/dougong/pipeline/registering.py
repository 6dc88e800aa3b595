"""Registration of two clouds with what their reference systems say about it."""

from dataclasses import replace
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import FrameError, RegistrationError
from dougong.formats import has_metric_format, is_same_crs, require_metric, units_of
from dougong.formats.faults import coordinate_hashes
from dougong.formats.projection import is_same_plan, projection_problem
from dougong.pipeline.axes import mirrored_axes, upside_down
from dougong.pipeline.ground import pair_on_ground, to_file
from dougong.registration import Register
from dougong.registration import register as search
from dougong.registration.checks import checks_document
from dougong.registration.control import Control
from dougong.registration.control_solve import ControlPoints
from dougong.registration.file_coordinates import unit_of
from dougong.registration.free_scale import ScaleSearch, Side
from dougong.registration.free_scale_control import find_scale
from dougong.registration.picked_pairs import PickedPairs
from dougong.registration.result import Registration
from dougong.typing import Kind

_SAME_PLAN_M = 10.0
_LEAST_M = 2.0
_GEOID_M = 115.0


def register(
    source: Cloud,
    target: Cloud,
    params: Register | None = None,
    *,
    source_kind: Kind = "lidar",
    target_kind: Kind = "photogrammetry",
    pairs: PickedPairs | None = None,
    control: ControlPoints | None = None,
    scale: ScaleSearch | None = None,
    is_declared: bool = False,
) -> Registration:
    """Register two clouds, with what their reference systems say of units, maps and heights.

    Parameters and result are those of `dougong.registration.register`; pairs and control points
    are in file coordinates. Photogrammetry that declares no unit is `unscaled` there, unless
    `is_declared`: the user says that both clouds are in known units.

    Raises
    ------
    FrameError
        A cloud is in degrees or earth-centred coordinates, its heights have another unit than its
        plan, its easting and northing are swapped, or its map distorts the site.
    InputError
        A grid scale is given, and neither cloud is in a map projection; or the pairs or control
        points do not belong to these clouds.
    RegistrationError
        A cloud has too few points, or is not levelled.
    """
    for cloud in (source, target):
        require_metric(cloud)
        require_registrable(cloud)
    mirrored = mirrored_axes(source, target)
    if mirrored is not None:
        raise FrameError(mirrored)
    params = params or Register()
    undeclared = undeclared_side(source, target, (source_kind, target_kind))
    one, two = without_copies(source), without_copies(target)
    pair, notes = pair_on_ground(one, two, params.grid_scale)
    if pair is not None:
        one, two = pair.source.cloud, pair.target.cloud
        pairs = None if pairs is None else pair.on_ground(pairs)
        control = None if control is None else pair.on_ground(control)
    result = search(
        one,
        two,
        params,
        source_kind=source_kind,
        target_kind=target_kind,
        pairs=pairs,
        control=control,
        unscaled=None if scale is not None or is_declared else undeclared,
        scale=scale,
    )
    is_rigid = params.dof not in (5, 7)
    if result.status == "failed" and is_rigid and params.coarse in ("auto", "plan"):
        turned = upside_down(one, two, result, params, source_kind, target_kind)
        result = result if turned is None else replace(result, reason=turned)
    if pair is not None:
        result = to_file(result, pair, source, target)
    notes = (*notes, *height_note(result, source, target))
    if is_declared and undeclared is not None and result.status != "ok":
        name = (source if undeclared == "source" else target).name
        notes = (*notes, _undeclared_note(name))
    if control is not None and result.checks is None:
        result = replace(result, checks=_unmeasured(control))
    return replace(result, notes=(*different_systems(source, target), *notes, *result.notes))


def impossible(
    error: RegistrationError, params: Register, control: ControlPoints | None
) -> Registration:
    """Return the answer for a pair whose search cannot even start."""
    return Registration(
        status="failed",
        matrix=None,
        reason=str(error),
        probability=0.0,
        scale=1.0,
        dof=params.dof if isinstance(params.dof, int) else 6,
        coarse_method=params.coarse,
        hypotheses=(),
        margin=0.0,
        fine=None,
        parameters=params.model_dump(mode="json"),
        checks=None if control is None else _unmeasured(control),
    )


def _unmeasured(control: ControlPoints) -> dict[str, Any]:
    """Return what is said of control and check points that have no pose to be measured at."""
    points = Control(points=control, used=~control.is_check, T_target_source=None)
    return checks_document(points, None, None)


def find_unit(
    source: Cloud,
    target: Cloud,
    params: Register,
    *,
    source_kind: Kind,
    target_kind: Kind,
    control: ControlPoints | None = None,
) -> ScaleSearch:
    """Find the unit of a source that has none, in ground metres; see `find_scale`."""
    require_metric(target)
    require_registrable(target)
    one, two = without_copies(source), without_copies(target)
    pair, _ = pair_on_ground(one, two, params.grid_scale)
    if pair is not None:
        one, two = pair.source.cloud, pair.target.cloud
        control = None if control is None else pair.on_ground(control)
    return find_scale(
        one,
        two,
        params,
        source_kind=source_kind,
        target_kind=target_kind,
        control=control,
        side="source",
    )


def _undeclared_note(name: str) -> str:
    return (
        f"{name} names no coordinate system, so nothing in the file says that it is in metres; if "
        "it may not be, write scale_known = false in its [[cloud]] and its scale is searched"
    )


def undeclared_side(source: Cloud, target: Cloud, kinds: tuple[Kind, Kind]) -> Side | None:
    """Return which cloud has a scale that nothing declares; None: neither, or both.

    Photogrammetry has no scale of its own. A reference system gives it one, and so does a format
    whose lengths are metres by definition (E57). Scanners measure metres.
    """
    undeclared = [
        kind == "photogrammetry" and cloud.frame.crs is None and not has_metric_format(cloud)
        for cloud, kind in zip((source, target), kinds, strict=True)
    ]
    if undeclared[0] == undeclared[1]:
        return None
    return "source" if undeclared[0] else "target"


def height_note(result: Registration, source: Cloud, target: Cloud) -> tuple[str, ...]:
    """Return what is to be said where two clouds of one map lie at other heights only.

    Heights above the ellipsoid and above a geoid differ by up to 110 m, and nothing else does.
    """
    one, other = source.frame.crs, target.frame.crs
    is_one_map = one is not None and other is not None and is_same_plan(one, other)
    if result.matrix is None or not is_one_map:
        return ()
    middle = source.frame.to_file(np.median(source.xyz, axis=0)[None])[0]
    linear = result.matrix[:3, :3]
    shift = (linear @ middle + result.matrix[:3, 3] - middle) * np.asarray(target.frame.unit_m)
    if np.linalg.norm(shift[:2]) > _SAME_PLAN_M or not _LEAST_M < abs(shift[2]) < _GEOID_M:
        return ()
    return (
        f"{source.name} and {target.name} agree in plan, and {target.name} lies {shift[2]:+.2f} m "
        "higher: as heights above the ellipsoid and above a geoid differ. The matrix takes it "
        "up; name the vertical system of both where heights are to be handed over",
    )


def require_registrable(cloud: Cloud) -> None:
    """Refuse a cloud whose axes are swapped, whose units are mixed, or whose map distorts.

    Raises
    ------
    FrameError
        Heights have another unit than the plan (no similarity joins such a file to another), x is
        a northing, or lengths on the map depend on their direction.
    """
    unit_of(cloud)
    if not len(cloud):
        return
    middle = cloud.frame.to_file(np.median(cloud.xyz, axis=0)[None])[0]
    problem = projection_problem(cloud.frame.crs, middle, cloud.name)
    if problem is not None:
        raise FrameError(problem)


def without_copies(cloud: Cloud) -> Cloud:
    """Return `cloud` with one point of each heap of exact duplicates.

    A heap would outweigh the site where the search asks what is usual in the cloud.
    """
    _, first = np.unique(coordinate_hashes(cloud.xyz), return_index=True)
    return cloud if len(first) == len(cloud) else cloud.select(np.sort(first))


def different_systems(source: Cloud, target: Cloud) -> tuple[str, ...]:
    """Return what is to be said where two clouds name different reference systems.

    A cloud without one is in a scanner's own coordinates, as expected; nothing is said of it.
    """
    one, other = source.frame.crs, target.frame.crs
    if one is None or other is None or is_same_crs(one, other):
        return ()
    named = (units_of(one).name or "an unnamed system", units_of(other).name or "an unnamed system")
    return (
        f"{source.name} is in {named[0]} and {target.name} in {named[1]}: the motion found stands "
        "in for the change of system.",
    )
