"""What a search for the scale says: refused, in doubt, or part of the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.registration.free_scale import LEAST, MOST, ScaleSearch, with_unit
from dougong.registration.result import Registration

_OFF_SIGMAS = 3.3
"""1 in 1000 by chance."""


def refusal(found: ScaleSearch) -> str | None:
    """Return why there is no scale to go on with; None: there is one."""
    if not found.candidates:
        return (
            f"no scale between {LEAST:g} and {MOST:g} metres per unit brings the two clouds "
            "together: what they share holds no scale (one wall grows into itself), or they share "
            "nothing that the search can see. Control points or a known length would give it."
        )
    best = found.candidates[0]
    if not best.fit.holds_scale or best.fit.covariance is None:
        return (
            "the scale is not observable: the surface that both clouds share grows into itself (a "
            "plane, a corner), so any scale fits. Scale the cloud by a known length or by control "
            "points, or give it more in common with the other one."
        )
    return None


def in_metres(found: ScaleSearch, source: Cloud, target: Cloud) -> tuple[Cloud, Cloud]:
    """Return both clouds, the free one with the unit that was found."""
    k = found.candidates[0].metres_per_unit
    if found.side == "source":
        return with_unit(source, k), target
    return source, with_unit(target, k)


def scale_document(found: ScaleSearch, source: Cloud, target: Cloud) -> dict[str, Any]:
    """Return the search as plain data: per scale the loss of the metric cloud's structure."""
    name = source.name if found.side == "source" else target.name
    undecided = [c.metres_per_unit for c in found.undecided]
    rows = [
        {
            "metres_per_unit": c.metres_per_unit,
            "loss": c.loss,
            "is_undecided": c.metres_per_unit in undecided,
        }
        for c in found.candidates
    ]
    best = found.candidates[0] if found.candidates else None
    covariance = None if best is None else best.fit.covariance
    return {
        "cloud": name,
        "side": found.side,
        "metres_per_unit": None if best is None else best.metres_per_unit,
        "sigma_ln": None if covariance is None else float(np.sqrt(covariance[6, 6])),
        "control_points": found.control_points,
        "candidates": rows,
    }


def with_scale(
    result: Registration,
    found: ScaleSearch,
    clouds: tuple[Cloud, Cloud],
    dof: int,
    most_spread_m: float,
) -> Registration:
    """Return the rigid result of `in_metres` with its scale: covariance, doubt, words."""
    source, target = clouds
    best = found.candidates[0]
    covariance = best.fit.covariance
    assert covariance is not None
    sigma = float(np.sqrt(covariance[6, 6]))
    name = source.name if found.side == "source" else target.name
    fine = result.fine
    if fine is not None:
        about = best.fit.centre
        # The document gives it in the target's own frame, whose metres are not known yet.
        about = about / best.metres_per_unit if found.side == "target" else about
        fine = replace(fine, covariance=covariance, covariance_about=about)
    status, reason = result.status, result.reason
    doubt = _doubt(found, sigma, most_spread_m)
    if status == "ok" and doubt is not None:
        status, reason = "ambiguous", doubt
    unit = f"one unit of {name} is {best.metres_per_unit:.6g} m (sigma {100 * sigma:.2g} %)"
    reason = f"{reason} {_origin(found)}: {unit}."
    notes = [note for note in result.notes if not note.startswith("units differ")]
    return replace(
        result,
        status=status,
        reason=reason,
        fine=fine,
        dof=dof,
        scale_source="search",
        scale_search=scale_document(found, source, target),
        parameters={**result.parameters, "dof": dof},
        notes=tuple(notes),
    )


def _origin(found: ScaleSearch) -> str:
    if not found.control_points:
        return "The scale was searched"
    plural = "s" if found.control_points != 1 else ""
    return (
        f"The scale follows from the clouds and {found.control_points} control point{plural} "
        "together"
    )


def _doubt(found: ScaleSearch, sigma: float, most_spread_m: float) -> str | None:
    best = found.candidates[0]
    if found.contradiction is not None:
        return found.contradiction
    if found.undecided:
        shown = ", ".join(f"{c.metres_per_unit:.4g}" for c in (best, *found.undecided))
        return (
            f"several scales explain the clouds equally well: {shown} metres per unit. A known "
            "length or control points would decide."
        )
    spread = 1.96 * sigma * best.fit.length_m
    if spread > most_spread_m:
        return (
            f"the scale is held too weakly: its uncertainty of {196 * sigma:.2g} % (95 %) moves "
            f"the shared surface by {spread:.2g} m, at most {most_spread_m:.2g} m expected."
        )
    return None


def is_off_metres(found: ScaleSearch) -> bool:
    """Say whether a cloud that was taken for metres is off by more than chance (3.3 sigma)."""
    if not found.candidates:
        return False
    best = found.candidates[0]
    if not best.fit.holds_scale or best.fit.covariance is None:
        return False
    sigma = float(np.sqrt(best.fit.covariance[6, 6]))
    return abs(float(np.log(best.metres_per_unit))) > _OFF_SIGMAS * sigma


def metre_note(found: ScaleSearch, source: Cloud, target: Cloud) -> str:
    """Return what is to be said of a cloud without a declared unit that stays in metres."""
    name = source.name if found.side == "source" else target.name
    best = found.candidates[0] if found.candidates else None
    if best is None or not best.fit.holds_scale or best.fit.covariance is None:
        return (
            f"{name} declares no unit and is taken for metres: what both clouds share does not "
            "hold its scale, so that could not be checked"
        )
    off = 100.0 * (best.metres_per_unit - 1.0)
    sigma = 100.0 * float(np.sqrt(best.fit.covariance[6, 6]))
    return (
        f"{name} declares no unit and is taken for metres: its scale fits the other cloud's to "
        f"{off:+.3f} % (sigma {sigma:.2g} %)"
    )


def in_found_unit(
    result: Registration, clouds: Sequence[Cloud]
) -> tuple[Cloud, Cloud, Registration]:
    """Return both clouds in metres, and the result with its covariance about a place in them."""
    source, target = clouds
    search, fine = result.scale_search, result.fine
    if search is None or search["metres_per_unit"] is None:
        return source, target, result
    k = search["metres_per_unit"]
    if search["side"] == "source":
        return with_unit(source, k), target, result
    if fine is not None:
        result = replace(result, fine=replace(fine, covariance_about=fine.covariance_about * k))
    return source, with_unit(target, k), result
