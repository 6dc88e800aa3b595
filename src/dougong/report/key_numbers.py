"""The three numbers of a report's first screen, each with its definition."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyNumber:
    """One of the three numbers of the first screen."""

    label: str
    value: str
    unit: str
    definition: str


def key_numbers(result: Mapping[str, Any], demo: Mapping[str, Any] | None) -> tuple[KeyNumber, ...]:
    """Return the three numbers of a run: against the truth, where it is known; else of the fit."""
    if demo is not None and demo["tre95_m"] is not None:
        return _truth_numbers(demo)
    if result["registrations"]:
        return tuple(pair_numbers(result["registrations"]))
    cloud = result["clouds"][0]
    return (
        KeyNumber(
            label="Points in",
            value=f"{cloud['points_in']:,}",
            unit="",
            definition="points with finite coordinates in the input files",
        ),
        KeyNumber(
            label="Points kept",
            value=f"{cloud['points_out']:,}",
            unit="",
            definition="original points, selected and never changed",
        ),
        KeyNumber(
            label="Reduction",
            value=f"{100 * cloud['reduction']:.2f}",
            unit="%",
            definition="data reduction rate: 1 - points kept / points in",
        ),
    )


def _truth_numbers(demo: Mapping[str, Any]) -> tuple[KeyNumber, ...]:
    return (
        KeyNumber(
            label="Pose error (TRE95)",
            value=f"{1000 * demo['tre95_m']:.1f}",
            unit="mm",
            definition=(
                "95 % of the surface that both sensors saw lies nearer than this to where the "
                "best possible pose would put it"
            ),
        ),
        KeyNumber(
            label="Rotation error",
            value=f"{demo['rotation_error_deg']:.4f}",
            unit="deg",
            definition="angle between the pose found and the best possible pose",
        ),
        KeyNumber(
            label="Bending floor",
            value=f"{1000 * demo['bending_floor95_m']:.1f}",
            unit="mm",
            definition=(
                "95 % residual that the best rigid pose itself leaves, since the drone cloud is "
                "slowly bent; no rigid registration can do better"
            ),
        ),
    )


def pair_numbers(documents: Sequence[Mapping[str, Any]]) -> list[KeyNumber]:
    """Return what is left between the clouds; where it was not measured, how the fit went."""
    fit = _fit_numbers(documents)
    measured = [document["distances"] for document in documents if document.get("distances")]
    if not measured:
        return fit
    worst = max(measured, key=lambda found: float(found["within95_m"]))
    more = " (the worst of all links)" if len(documents) > 1 else ""
    return [
        KeyNumber(
            label="95 % of distances within",
            value=f"{1e3 * worst['within95_m']:.1f}",
            unit="mm",
            definition=(
                "between the two clouds along the surface's normal (M3C2), where both show it"
                f"{more}; fit to each other, not accuracy"
            ),
        ),
        KeyNumber(
            label="Level of detection (95 %)",
            value=f"{1e3 * worst['lod95_m']:.1f}",
            unit="mm",
            definition=(
                "a smaller distance cannot be told from none: noise, roughness and the "
                "registration's own uncertainty; the typical value"
            ),
        ),
        replace(
            fit[1], definition=f"share of the moved cloud with the other cloud {_reach(documents)}"
        ),
    ]


def _reach(documents: Sequence[Mapping[str, Any]]) -> str:
    """Return the distance bound of the overlap in words."""
    bounds = [document["fine"]["max_distance_m"] for document in documents if document["fine"]]
    return f"within {1000 * max(bounds):.0f} mm" if bounds else "near"


def _fit_numbers(documents: Sequence[Mapping[str, Any]]) -> list[KeyNumber]:
    fines = [document["fine"] for document in documents if document["fine"]]
    rmse = [fine["inlier_rmse_m"] for fine in fines if fine["inlier_rmse_m"] is not None]
    margin = min(document["coarse"]["margin"] for document in documents)
    worst = " (the worst of all links)" if len(documents) > 1 else ""
    reach = max((fine["max_distance_m"] for fine in fines), default=None)
    return [
        KeyNumber(
            label="Inlier RMSE",
            value=f"{1000 * max(rmse):.1f}" if rmse else "none",
            unit="mm" if rmse else "",
            definition=(
                "root mean square residual of the correspondences"
                + (f" within {1000 * reach:.0f} mm" if reach else "")
                + f"{worst}; a measure of fit, not of accuracy"
            ),
        ),
        KeyNumber(
            label="Overlap",
            value=f"{100 * min(fine['overlap_source'] for fine in fines):.0f}" if fines else "none",
            unit="%" if fines else "",
            definition=f"share of the moved cloud with the other cloud within that distance{worst}",
        ),
        KeyNumber(
            label="Margin",
            value=f"{margin:.2f}",
            unit="",
            definition=(
                "1 - s2/s1: how far the best coarse pose leads the next one that lies more than "
                f"5 deg or 0.5 m away; 0 is a tie, 1 is no rival{worst}"
            ),
        ),
    ]
