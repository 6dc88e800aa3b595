"""How right a registration is, by points that had no part in it; USIBD's levels of accuracy."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from dougong.registration.control import Adjusted, Control
from dougong.registration.overlap import apply
from dougong.typing import Mask, Points, Transform

LEVELS_M = {"LOA50": 0.001, "LOA40": 0.005, "LOA30": 0.015, "LOA20": 0.05, "LOA10": 0.15}
"""Upper end of USIBD's levels of accuracy (C120), 95 %, finest first."""
_FACTOR_95 = {1: 1.96, 2: 1.73, 3: 1.61}
"""95 % of an error whose RMSE over 1, 2, 3 normal axes is 1 (METHOD.md 5)."""
DISTRIBUTION_FREE = 59
"""So many check points bound 95 % of the errors with 95 % confidence by the largest of them."""


def checks_document(
    control: Control, adjusted: Adjusted | None, T: Transform | None
) -> dict[str, Any]:
    """Return what ``registration.json`` says as ``checks``: residuals at the final pose, metres.

    Parameters
    ----------
    control : Control
    adjusted : Adjusted or None
        Says which control points were left in.
    T : ndarray, shape (4, 4), optional
        The final pose, local frames; None: the registration failed.
    """
    points = control.points
    used = adjusted.used if adjusted is not None else control.used
    off: list[Any] = [None] * len(points)
    if T is not None:
        off = list(points.target - apply(T, points.source))
    rows = []
    for place, name in enumerate(points.names):
        residual = off[place]
        rows.append(
            {
                "name": name,
                "role": "check" if points.is_check[place] else "control",
                "is_used": bool(used[place]) and not bool(points.is_check[place]),
                "sigma_m": float(points.sigma_m[place]),
                "residual_m": None if residual is None else float(np.linalg.norm(residual)),
                "residual_xyz_m": None if residual is None else [float(v) for v in residual],
            }
        )
    bad = [row["name"] for row in rows if row["role"] == "control" and not row["is_used"]]
    held = points.is_check
    error = None
    if T is not None and held.any():
        error = check_error(points.target[held] - apply(T, points.source[held]))
    return {
        **points.record,
        "points": rows,
        "bad": bad,
        "control_points": int((~held).sum()),
        "check_points": int(held.sum()),
        "check": error,
        "level": None if error is None else error["level"],
        "why_no_level": None if error is not None else _why_no_level(T, held),
    }


def _why_no_level(T: Transform | None, held: Mask) -> str:
    if not held.any():
        return "no check points were held out: a level of accuracy needs independent points"
    return "there is no pose" if T is None else "unknown"


def check_error(residuals: Points) -> dict[str, Any]:
    """Return the error that independent points show: RMSE, 95 % bound, level of accuracy.

    Parameters
    ----------
    residuals : ndarray, shape (n, 3)
        Target minus moved source, metres, of points that had no part in the fit.

    Returns
    -------
    dict
        ``check_rmse_m`` (3-D), of the plan and of heights; ``error95_m`` = 1.61 x RMSE (normal
        errors), 1.73 x in plan, 1.96 x in height; ``upper95_m``, the same for the RMSE's upper
        95 % confidence bound, which few points make large; ``distribution_free95_m``, the largest
        of at least 59 errors, else None; ``level``, the finest USIBD level whose upper end is not
        below ``upper95_m``, None
        where that is coarser than all.
    """
    count = len(residuals)
    square = np.square(residuals)
    rmse = float(np.sqrt(square.sum(axis=1).mean()))
    plan = float(np.sqrt(square[:, :2].sum(axis=1).mean()))
    height = float(np.sqrt(square[:, 2].mean()))
    widen = float(np.sqrt(3 * count / stats.chi2.ppf(0.05, 3 * count)))
    upper = _FACTOR_95[3] * rmse * widen
    lengths = np.sqrt(square.sum(axis=1))
    return {
        "points": count,
        "check_rmse_m": rmse,
        "check_rmse_plan_m": plan,
        "check_rmse_height_m": height,
        "error95_m": _FACTOR_95[3] * rmse,
        "error95_plan_m": _FACTOR_95[2] * plan,
        "error95_height_m": _FACTOR_95[1] * height,
        "upper95_m": upper,
        "largest_m": float(lengths.max()),
        "distribution_free95_m": float(lengths.max()) if count >= DISTRIBUTION_FREE else None,
        "level": level_of(upper),
    }


def level_of(error95_m: float) -> str | None:
    """Return the finest USIBD level of accuracy that holds a 95 % error; None: none does."""
    return next((name for name, most in LEVELS_M.items() if error95_m <= most), None)


def reaches(level: str | None, required: str) -> bool:
    """Say whether a level of accuracy is at least as fine as the required one."""
    order = list(LEVELS_M)
    return level is not None and order.index(level) <= order.index(required)
