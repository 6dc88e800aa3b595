"""Map projections between two clouds: both are brought to ground metres, and the pose back.

A cloud with a projected reference system is in grid metres: in plan it is shorter or longer than
the ground by the combined factor, in height it is not. A cloud without a projection is in ground
metres. The registration sees two metric clouds; what it finds is then written between *file*
coordinates with the known scale.

The contract's matrix is a similarity, so it scales heights as it scales the plan. It is exact at
the height of the middle of the shared surface, and off by factor x height difference above and
below: 4 mm at 10 m for the 400 ppm of UTM. A project whose reference is the scanner's own frame
keeps the scan as it was measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.formats import units_of
from dougong.formats.projection import GridScale, grid_scale, is_in_use, is_same_plan
from dougong.registration.control_solve import ControlPoints
from dougong.registration.picked_pairs import PickedPairs
from dougong.registration.result import FineResult, Hypothesis, Registration
from dougong.typing import Points, Transform, Values

Places = TypeVar("Places", PickedPairs, ControlPoints)
Setting = Literal["auto", "off"] | float
NEGLIGIBLE_PPM = 10.0
"""1 mm in 100 m, what a good scanner's own scale is known to: such maps count as true to scale."""
MAP_SIZE_M = 1e5
"""Coordinates from here on are a map's rather than a scanner's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """One cloud of a pair in ground metres."""

    cloud: Cloud
    """Local metres true in plan and in height; its frame counts in ground metres."""
    to_ground: NDArray[np.float64]
    """(3,) file coordinates x this = the metres of `cloud.frame`."""
    factor: float
    """Grid / ground in plan; 1 for a cloud in ground metres."""

    def forward(self) -> Transform:
        """Return the (4, 4) affine map from file coordinates to ground metres."""
        return np.diag([*self.to_ground, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two clouds in ground metres, and what was decided about their maps."""

    source: Ground
    target: Ground
    origin: Literal["crs", "given"]
    """Where the factor comes from: a reference system, or the user."""
    scales: Mapping[str, GridScale | None]
    """By "source", "target": what the reference system says; None: ground metres, or given."""
    notes: tuple[str, ...]

    @property
    def factor(self) -> float:
        """Lengths in plan in the target / those in the source."""
        return self.target.factor / self.source.factor

    def on_ground(self, places: Places) -> Places:
        """Return places known in the coordinates of both files, in ground metres."""
        return replace(
            places,
            source=places.source * self.source.to_ground,
            target=places.target * self.target.to_ground,
        )


def pair_on_ground(
    source: Cloud, target: Cloud, setting: Setting
) -> tuple[Pair | None, tuple[str, ...]]:
    """Return two clouds in ground metres where one map stands between them, and what to say.

    Parameters
    ----------
    source, target : Cloud
    setting : "auto", "off" or float
        auto: the factor of each projected cloud follows from its system and height. A number is
        the combined factor (grid / ground) of every projected cloud. off: maps are taken to be
        true to scale, as site-calibrated ground systems are.

    Returns
    -------
    pair : Pair or None
        None where no factor stands between the clouds.
    notes : tuple of str

    Raises
    ------
    InputError
        A factor is given, and neither cloud is in a map projection.
    """
    scales = {"source": _scale_of(source), "target": _scale_of(target)}
    notes: list[str] = []
    for key, cloud, other in (("source", source, target), ("target", target, source)):
        notes += _said_of(cloud, other, scales[key], scales["target" if key == "source" else key])
    one, two = scales["source"], scales["target"]
    if one is None and two is None:
        if not isinstance(setting, str):
            msg = (
                f"grid_scale {setting:.9g} is given, but neither {source.name} nor {target.name} "
                "is in a map projection. Export the projected cloud with its coordinate system, "
                "or leave the setting out."
            )
            raise InputError(msg)
        return None, tuple(notes)
    if _is_one_map(source, target, one, two):
        return None, tuple(notes)
    if setting == "off":
        return None, (*notes, "map projections are taken to be true to scale (grid_scale = off)")
    given = None if isinstance(setting, str) else float(setting)
    factors = [1.0 if scale is None else given or scale.factor for scale in (one, two)]
    ppm = 1e6 * (factors[1] / factors[0] - 1.0)
    if given is None and abs(ppm) < NEGLIGIBLE_PPM:
        said = f"the map projection scales by {ppm:+.1f} ppm, too little to matter: not applied"
        return None, (*notes, said)
    if factors[0] == factors[1]:
        return None, tuple(notes)
    pair = Pair(
        source=_on_ground(source, factors[0]),
        target=_on_ground(target, factors[1]),
        origin="crs" if given is None else "given",
        scales=scales if given is None else {"source": None, "target": None},
        notes=(*notes, *_words(source, target, scales, given)),
    )
    return pair, ()


def _middle(cloud: Cloud) -> Points:
    """Return the median of a cloud, (3,) file coordinates: a far point does not move it."""
    middle: Points = cloud.frame.to_file(np.median(cloud.xyz, axis=0)[None])[0]
    return middle


def _scale_of(cloud: Cloud) -> GridScale | None:
    return grid_scale(cloud.frame.crs, _middle(cloud)) if len(cloud) else None


def _is_one_map(source: Cloud, target: Cloud, one: GridScale | None, two: GridScale | None) -> bool:
    """Say whether both clouds are on the same map: then no factor stands between them."""
    if one is not None and two is not None:
        return one.system == two.system or is_same_plan(
            source.frame.crs or "", target.frame.crs or ""
        )
    plain, projected = (source, target) if one is None else (target, source)
    # Among small numbers a scanner's own frame meets a site's map by accident.
    is_map = plain.frame.crs is None and _is_map_sized(plain)
    return is_map and _overlap_in_plan(plain, projected)


def _is_map_sized(cloud: Cloud) -> bool:
    return len(cloud) > 0 and bool(np.abs(_middle(cloud)[:2]).max() >= MAP_SIZE_M)


def _overlap_in_plan(one: Cloud, other: Cloud) -> bool:
    """Say whether the plans of two clouds meet, by their file coordinates as they stand."""
    return do_meet(plan_box(one), plan_box(other))


def plan_box(cloud: Cloud) -> Values:
    """Return the low and high plan corner (2, 2) without the outermost points, metres."""
    box: Values = np.column_stack([np.quantile(axis, [0.02, 0.98]) for axis in cloud.xyz.T])
    return (box + cloud.frame.origin)[:, :2]


def do_meet(one: Values, other: Values) -> bool:
    """Say whether two boxes of a low and a high corner (2, k) have a place in common."""
    return bool(((one[0] <= other[1]) & (other[0] <= one[1])).all())


def _said_of(
    cloud: Cloud, other: Cloud, scale: GridScale | None, other_scale: GridScale | None
) -> list[str]:
    """Return what is odd about one cloud's coordinates beside the other's system."""
    if scale is not None or not len(cloud):
        return []
    x, y, _ = _middle(cloud)
    is_projected = cloud.frame.crs is not None and units_of(cloud.frame.crs).is_projected
    if is_projected and not is_in_use(cloud.frame.crs, float(x), float(y)):
        return [
            f"{cloud.name} names {units_of(cloud.frame.crs).name}, but its coordinates "
            f"(x = {x:.0f}, y = {y:.0f}) do not lie where that system is used: taken as ground "
            "metres"
        ]
    if cloud.frame.crs is not None or not _is_map_sized(cloud):
        return []
    if other_scale is None and _is_map_sized(other):
        return []  # two files of one map that does not say its name: no factor is missing
    if other_scale is not None and _overlap_in_plan(cloud, other):
        return [
            f"{cloud.name} has no coordinate system, and its coordinates lie within those of "
            f"{other.name}: taken to be in the same one"
        ]
    return [
        f"{cloud.name} has coordinates of map size (x = {x:.0f}, y = {y:.0f}) and no coordinate "
        "system: taken as ground metres. Were they a map's, lengths would be off by up to 400 ppm "
        "(4 cm in 100 m); export it with its system"
    ]


def _on_ground(cloud: Cloud, factor: float) -> Ground:
    """Return a cloud in ground metres: its plan divided by the factor, its heights as they are."""
    plan = np.array([1.0 / factor, 1.0 / factor, 1.0])
    frame = cloud.frame
    local = frame.origin * plan
    metres = replace(frame, origin=local, crs=None, unit_m=(1.0, 1.0, 1.0), step=None)
    return Ground(
        cloud=cloud.stretched(plan, metres),
        to_ground=np.asarray(frame.unit_m) * plan,
        factor=factor,
    )


def _words(
    source: Cloud, target: Cloud, scales: Mapping[str, GridScale | None], given: float | None
) -> list[str]:
    said = []
    for cloud, scale in ((source, scales["source"]), (target, scales["target"])):
        if scale is None:
            continue
        if given is not None:
            said.append(f"{cloud.name}: combined factor {given:.9g} (grid / ground), as given")
            continue
        said.append(
            f"{cloud.name} is in {scale.system}: combined factor {scale.factor:.9f} "
            f"({scale.ppm:+.1f} ppm: point scale {scale.point_scale:.9f}, height "
            f"{scale.height_m:.0f} m {scale.height_factor:.9f})"
        )
        if scale.distortion > 1e-5:
            said.append(
                f"{cloud.name}: {scale.system} is not conformal, lengths depend on their direction "
                f"by {1e6 * scale.distortion:.0f} ppm"
            )
    return said


def to_file(result: Registration, pair: Pair, source: Cloud, target: Cloud) -> Registration:
    """Return a result between ground metres as one between the clouds' file coordinates.

    The affine map between the files is not quite a similarity, since heights are not projected.
    The nearest one of the known scale is taken, exact at the middle of the shared surface.
    """
    about = _about(result, pair)

    def convert(matrix: Transform) -> Transform:
        return similarity(_affine(matrix, pair), matrix, pair, about)

    matrix = None if result.matrix is None else convert(result.matrix)
    notes = [*pair.notes]
    error = 0.0
    if result.matrix is not None and matrix is not None:
        corners = _corners(source)
        gap = _applied(_affine(result.matrix, pair) - matrix, corners)
        error = float(np.abs(gap * np.asarray(target.frame.unit_m)).max())
        notes.append(
            "the matrix scales heights as it scales the plan, though maps leave heights alone: at "
            f"most {1e3 * error:.1f} mm between the foot and the top of {source.name}"
        )
    units = source.frame.unit_m[0] / target.frame.unit_m[0]
    if units != 1.0:
        notes.append(f"units differ: the matrix scales by {units:.9g} for them too")
    return replace(
        result,
        matrix=matrix,
        reason=f"{result.reason} {_ppm_sentence(pair)}".strip(),
        scale=result.scale * pair.factor * units,
        scale_source=f"grid ({pair.origin})" if result.scale == 1.0 else result.scale_source,
        grid=_document(pair, error),
        hypotheses=tuple(
            Hypothesis(T_target_source=convert(h.T_target_source), score=h.score, method=h.method)
            for h in result.hypotheses
        ),
        fine=_fine(result.fine, matrix, pair, source, target),
        notes=(*notes, *result.notes),
    )


def _ppm_sentence(pair: Pair) -> str:
    ppm = 1e6 * (pair.factor - 1.0)
    return (
        f"Lengths in plan are scaled by {pair.factor:.9f} ({ppm:+.1f} ppm) for the map projection."
    )


def _document(pair: Pair, height_error_m: float) -> dict[str, Any]:
    """Return what registration.json says of the maps."""
    return {
        "factor": pair.factor,
        "ppm": 1e6 * (pair.factor - 1.0),
        "from": pair.origin,
        "source_factor": pair.source.factor,
        "target_factor": pair.target.factor,
        "height_error_m": height_error_m,
        **{key: None if s is None else asdict(s) for key, s in pair.scales.items()},
    }


def _about(result: Registration, pair: Pair) -> Values:
    """Return where the similarity is exact, (3,) ground metres of the target."""
    target = pair.target.cloud
    if result.fine is not None and np.isfinite(result.fine.covariance_about).all():
        return result.fine.covariance_about + target.frame.origin
    middle: Values = np.median(target.xyz, axis=0) + target.frame.origin
    return middle


def _affine(matrix: Transform, pair: Pair) -> Transform:
    """Return the affine map between file coordinates of a motion between ground metres."""
    back = np.diag([*(1.0 / pair.target.to_ground), 1.0])
    affine: Transform = back @ matrix @ pair.source.forward()
    return affine


def similarity(affine: Transform, motion: Transform, pair: Pair, about: Values) -> Transform:
    """Return the similarity with the rotation of `motion` and the plan's scale.

    It equals `affine` at the point that `motion` brings to `about` (3,), ground metres.
    """
    scale_motion = float(np.cbrt(np.linalg.det(motion[:3, :3])))
    scale = scale_motion * float(pair.source.to_ground[0] / pair.target.to_ground[0])
    there = np.linalg.solve(motion[:3, :3], about - motion[:3, 3]) / pair.source.to_ground
    result = np.eye(4)
    result[:3, :3] = motion[:3, :3] * (scale / scale_motion)
    result[:3, 3] = affine[:3, :3] @ there + affine[:3, 3] - result[:3, :3] @ there
    return result


def _corners(cloud: Cloud) -> Points:
    """Return the corners (8, 3) of the box of a cloud without its outermost points, file frame."""
    low, high = np.column_stack([np.quantile(axis, [0.005, 0.995]) for axis in cloud.xyz.T])
    picks = np.array([[i >> k & 1 for k in range(3)] for i in range(8)], dtype=bool)
    return cloud.frame.to_file(np.where(picks, high, low))


def _applied(difference: Transform, points: Points) -> Points:
    moved: Points = points @ difference[:3, :3].T + difference[:3, 3]
    return moved


def _fine(
    fine: FineResult | None, matrix: Transform | None, pair: Pair, source: Cloud, target: Cloud
) -> FineResult | None:
    """Return the fit in the clouds' own local frames."""
    if fine is None or matrix is None:
        return fine
    unit = np.asarray(target.frame.unit_m)
    local = np.linalg.inv(target.frame.T_file_local()) @ matrix @ source.frame.T_file_local()
    about = fine.covariance_about * unit / pair.target.to_ground
    return replace(fine, T_target_source=local, covariance_about=about)
