"""Registration of two clouds with what their reference systems say about it."""

from dataclasses import replace

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import FrameError
from dougong.formats import is_same_crs, require_metric, units_of
from dougong.formats.faults import coordinate_hashes
from dougong.formats.projection import is_same_plan, projection_problem
from dougong.pipeline.axes import mirrored_axes, upside_down
from dougong.pipeline.ground import pair_on_ground, to_file
from dougong.registration import Register
from dougong.registration import register as search
from dougong.registration.control_solve import ControlPoints
from dougong.registration.file_coordinates import unit_of
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
) -> Registration:
    """Register two clouds, with what their reference systems say of units, maps and heights.

    Parameters and result are those of `dougong.registration.register`; pairs and control points
    are in file coordinates.

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
    )
    is_rigid = params.dof not in (5, 7)
    if result.status == "failed" and is_rigid and params.coarse in ("auto", "plan"):
        turned = upside_down(one, two, result, params, source_kind, target_kind)
        result = result if turned is None else replace(result, reason=turned)
    if pair is not None:
        result = to_file(result, pair, source, target)
    notes = (*notes, *height_note(result, source, target))
    return replace(result, notes=(*different_systems(source, target), *notes, *result.notes))


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
