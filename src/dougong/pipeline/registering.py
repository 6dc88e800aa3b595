"""Registration of two clouds with what their reference systems say about it."""

from dataclasses import replace

import numpy as np

from dougong.cloud import Cloud
from dougong.formats import is_same_crs, require_metric, units_of
from dougong.formats.faults import coordinate_hashes
from dougong.registration import Register
from dougong.registration import register as search
from dougong.registration.picked_pairs import PickedPairs
from dougong.registration.result import Registration
from dougong.typing import Kind


def register(
    source: Cloud,
    target: Cloud,
    params: Register | None = None,
    *,
    source_kind: Kind = "lidar",
    target_kind: Kind = "photogrammetry",
    pairs: PickedPairs | None = None,
) -> Registration:
    """Find the motion from `source`'s file coordinates to `target`'s, and say how sure it is.

    Parameters
    ----------
    source, target : Cloud
        Raw or filtered; thinned and cleaned for the search, never changed.
    params : Register, optional
    source_kind, target_kind : {"lidar", "photogrammetry"}
        What a sensor can and cannot see decides what counts as a contradiction.
    pairs : PickedPairs, optional
        Places picked in both clouds, in file coordinates: one more pose for the proof to hear.

    Returns
    -------
    Registration
        Status ``ok``, ``ambiguous`` or ``failed`` with a reason in words.

    Raises
    ------
    FrameError
        A cloud is in degrees or earth-centred coordinates, or its heights have another unit.
    RegistrationError
        A cloud has too few points, or is not levelled.

    Notes
    -----
    Deterministic; independent of thread count, point order and coordinate offset.
    """
    require_metric(source)
    require_metric(target)
    result = search(
        without_copies(source),
        without_copies(target),
        params,
        source_kind=source_kind,
        target_kind=target_kind,
        pairs=pairs,
    )
    return replace(result, notes=(*different_systems(source, target), *result.notes))


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
        f"{source.name} is in {named[0]} and {target.name} in {named[1]}: a rigid motion stands in "
        "for the change of system and cannot undo the scale between two projections. "
        f"Reproject {source.name} first where millimetres count.",
    )
