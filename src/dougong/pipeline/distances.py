"""What is left between two registered clouds: signed distances, per point and per face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud, Frame
from dougong.filters import neighbourhood
from dougong.formats import write
from dougong.formats.units import parse_crs
from dougong.pipeline.marking import with_own
from dougong.registration.distances import Distances, SignedDistances, signed_distances
from dougong.registration.faces import Face, find_faces
from dougong.registration.outward import outward
from dougong.registration.result import Registration
from dougong.typing import Mask, Points, Values

DISTANCE, LOD = "m3c2_distance", "m3c2_lod95"
_SITE_POINTS = 2_000_000
_TAKEN_FROM = 1.5
"""A point takes the distance of the nearest core point up to this many core spacings away."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """The distances of one registered cloud, signed to the open side."""

    source: str
    target: str
    frame: Frame
    """Of the target: `signed.core` is local to it."""
    signed: SignedDistances
    normals: Points
    """(k, 3) to the open side: outward of walls, upward of what is seen from above."""
    is_directed: Mask
    """(k,) False where the open side is not known."""
    distance_m: Values
    """(k,) positive: the source lies in front of the target (above it); NaN: not observable."""
    faces: tuple[Face, ...]
    """Members are places among the core points with a distance."""


def measure(
    source: Cloud, target: Cloud, result: Registration, params: Distances | None = None
) -> Measured | None:
    """Measure what is left between a cloud and the reference it was registered to.

    Parameters
    ----------
    source, target : Cloud
        As they were registered, each in its own coordinates.
    result : Registration
        None is returned where it has no matrix, or where the clouds meet nowhere.
    params : Distances, optional
    """
    if result.matrix is None or len(source) == 0 or len(target) == 0:
        return None
    moved = source.moved(result.matrix, target.frame).xyz
    fine = result.fine
    is_known = fine is not None and fine.covariance is not None
    signed = signed_distances(
        moved,
        target.xyz,
        params,
        covariance=fine.covariance if fine is not None and is_known else None,
        covariance_about=fine.covariance_about if fine is not None and is_known else None,
    )
    observed = signed.is_observed
    if not observed.any():
        return None
    site = np.concatenate([_some(moved), _some(target.xyz)])
    normals, is_directed = outward(signed.core, signed.normals, site)
    with np.errstate(invalid="ignore"):
        sign = np.where(np.einsum("ki,ki->k", normals, signed.normals) < 0.0, -1.0, 1.0)
    noise = float(np.hypot(signed.scales.noise_source_m, signed.scales.noise_target_m))
    faces = find_faces(
        signed.core[observed],
        normals[observed],
        is_directed[observed],
        signed.scales.core_spacing_m,
        tolerance_m=float(np.clip(3.0 * noise, 0.05, 0.15)),
        has_compass=_has_north(target.frame.crs),
    )
    return Measured(
        source=source.name,
        target=target.name,
        frame=target.frame,
        signed=signed,
        normals=normals,
        is_directed=is_directed,
        distance_m=sign * signed.distance_m,
        faces=tuple(faces),
    )


def _has_north(crs: str | None) -> bool:
    """Say whether y is north: in a map projection it is, in a scanner's own frame it is not."""
    known = parse_crs(crs) if crs else None
    return known is not None and any(part.is_projected for part in (known.sub_crs_list or [known]))


def _some(points: Points) -> Points:
    """Return the points that show where the site is high: all, or an even part of very many."""
    return points[:: max(1, len(points) // _SITE_POINTS)]


def as_cloud(measured: Measured) -> Cloud:
    """Return the core points as a cloud in the target's coordinates, with all that was measured."""
    signed = measured.signed
    columns = {
        DISTANCE: measured.distance_m,
        LOD: signed.lod95_m,
        "m3c2_registration": signed.registration_m,
        "m3c2_spread_source": signed.spread_source_m,
        "m3c2_spread_target": signed.spread_target_m,
        **{f"Normal{axis}": measured.normals[:, i] for i, axis in enumerate("XYZ")},
    }
    data = {name: values.astype(np.float32) for name, values in columns.items()}
    data["m3c2_count_source"] = signed.count_source.astype(np.uint32)
    data["m3c2_count_target"] = signed.count_target.astype(np.uint32)
    data["m3c2_is_directed"] = measured.is_directed.astype(np.uint8)
    records = np.zeros(len(signed), dtype=[(name, v.dtype.str) for name, v in data.items()])
    for name, values in data.items():
        records[name] = values
    return Cloud(
        xyz=signed.core,
        records=records,
        frame=measured.frame,
        name=f"{measured.source} to {measured.target}",
    )


def write_distances(measured: Measured, path: Path) -> None:
    """Write the core points with their distances."""
    path.parent.mkdir(exist_ok=True)
    write(as_cloud(measured), path)


class Painter:
    """Gives points the distance of the nearest core point that has one.

    ``m3c2_distance`` and ``m3c2_lod95``, float32; NaN where there is none within 1.5 core spacings.
    Points of the reference take those of whichever registered cloud is nearest.
    """

    def __init__(self, measured: Sequence[Measured]) -> None:
        """Take the clouds whose core points count; none: NaN everywhere."""
        self._measured = [
            (one, neighbourhood.build_index(one.signed.core[one.signed.is_observed]))
            for one in measured
        ]

    def painted(self, cloud: Cloud) -> Cloud:
        """Return a cloud of the target's frame with its distances."""
        distance = np.full(len(cloud), np.nan, dtype=np.float32)
        lod = distance.copy()
        nearest = np.full(len(cloud), np.inf)
        for one, index in self._measured:
            observed = one.signed.is_observed
            at = cloud.rebased(one.frame.origin).xyz
            reach = _TAKEN_FROM * one.signed.scales.core_spacing_m
            place, away = neighbourhood.nearest(index, at, reach)
            found = (place >= 0) & (away < nearest)
            nearest[found] = away[found]
            distance[found] = one.distance_m[observed][place[found]]
            lod[found] = one.signed.lod95_m[observed][place[found]]
        return with_own(with_own(cloud, DISTANCE, distance), LOD, lod)


def distances_document(measured: Measured, file: str) -> dict[str, Any]:
    """Return what registration.json and the report say of the distances.

    Parameters
    ----------
    measured : Measured
    file : str
        Where the core points are, beside the document.
    """
    signed = measured.signed
    observed = signed.is_observed
    distance, lod = measured.distance_m[observed], signed.lod95_m[observed]
    faces = [_face_document(measured, face, distance, lod) for face in measured.faces]
    return {
        "method": "M3C2",
        "file": file,
        "core_points": len(signed),
        "observed_points": len(distance),
        **_numbers(distance, lod),
        "has_registration_term": signed.has_registration,
        "scales": asdict(signed.scales),
        "faces": faces,
        "sentence": _sentence(measured, faces, _numbers(distance, lod)),
    }


def _numbers(distance: Values, lod: Values) -> dict[str, float]:
    """Return the summary of some distances; all metres but the share."""
    return {
        "median_m": float(np.median(distance)),
        "within95_m": float(np.quantile(np.abs(distance), 0.95)),
        "lod95_m": float(np.median(lod)),
        "significant_share": float(np.mean(np.abs(distance) > lod)),
    }


def _face_document(measured: Measured, face: Face, distance: Values, lod: Values) -> dict[str, Any]:
    numbers = _numbers(distance[face.members], lod[face.members])
    return {
        "name": face.name,
        "kind": face.kind,
        "is_directed": face.is_directed,
        "width_m": face.width_m,
        "height_m": face.height_m,
        "area_m2": face.area_m2,
        "normal": face.normal.tolist(),
        "centre": measured.frame.to_file(face.centre[None])[0].tolist(),
        "points": len(face.members),
        **numbers,
        "stands": _stands(face.kind, face.is_directed, numbers),
    }


def _stands(kind: str, is_directed: bool, numbers: dict[str, float]) -> str:
    """Return where the source stands to the target on a face, in words."""
    if abs(numbers["median_m"]) <= numbers["lod95_m"]:
        return "no difference can be told"
    is_front = numbers["median_m"] > 0.0
    if not is_directed:
        return "off (which side is open is not known)"
    if kind == "wall":
        return "in front of" if is_front else "behind"
    return "above" if is_front else "below"


def _sentence(
    measured: Measured, faces: Sequence[dict[str, Any]], everywhere: dict[str, float]
) -> str:
    """Return the one sentence to act on: the face that stands off most, or that none does."""
    off = [face for face in faces if abs(face["median_m"]) > face["lod95_m"]]
    if off:
        worst = max(off, key=lambda face: abs(face["median_m"]) / face["lod95_m"])
        size = f"{worst['width_m']:.1f} x {worst['height_m']:.1f} m"
        more = f"; {len(off)} of {len(faces)} faces differ" if len(off) > 1 else ""
        stands = worst["stands"] if worst["is_directed"] else "off"
        return (
            f"On the {worst['name']} ({size}) {measured.source} stands "
            f"{1e3 * abs(worst['median_m']):.0f} mm {stands} {measured.target} "
            f"(level of detection {1e3 * worst['lod95_m']:.0f} mm){more}."
        )
    where = (
        f"On the one large shared face {measured.source} does not stand off {measured.target} "
        "as a whole"
        if len(faces) == 1
        else f"On none of {len(faces)} large faces does {measured.source} stand off "
        f"{measured.target} as a whole"
        if faces
        else f"No large even face is shared; over all that is, {measured.source} and "
        f"{measured.target} differ by {1e3 * everywhere['median_m']:+.0f} mm (median)"
    )
    return (
        f"{where}; 95 % of the distances are within {1e3 * everywhere['within95_m']:.0f} mm, and "
        f"what is below {1e3 * everywhere['lod95_m']:.0f} mm cannot be told (typical level of "
        "detection)."
    )
