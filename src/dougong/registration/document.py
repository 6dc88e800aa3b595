"""The registration as the plain data of ``registration.json`` (DESIGN.md): a contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import dougong
from dougong.cloud import Frame
from dougong.registration.result import FineResult, Registration


def registration_to_json(
    result: Registration,
    *,
    source: str,
    target: str,
    target_frame: Frame,
    inputs: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Return the document of one registration, ready for ``json.dumps``.

    Parameters
    ----------
    result : Registration
    source, target : str
        Names of the two clouds (or their paths).
    target_frame : Frame
        Where the target's local origin lies: ``covariance_about`` is given in its file
        coordinates.
    inputs : sequence of mappings
        {"path", "sha256", "points"} of each input file.
    """
    fine = result.fine
    is_known = fine is not None and result.status != "failed"
    return {
        "status": result.status,
        "source": source,
        "target": target,
        "matrix": None if result.matrix is None else result.matrix.tolist(),
        "scale": result.scale,
        "scale_source": result.scale_source,
        "scale_search": None if result.scale_search is None else dict(result.scale_search),
        "grid": None if result.grid is None else dict(result.grid),
        "dof": result.dof,
        "coarse": {
            "method": result.coarse_method,
            "hypotheses": [
                {
                    "matrix": h.T_target_source.tolist(),
                    "score": h.score,
                    "yaw_deg": h.yaw_deg,
                }
                for h in result.hypotheses
            ],
            "margin": result.margin,
        },
        "probability": result.probability,
        "reason": result.reason,
        "fine": None if fine is None else _fine(fine),
        "covariance": (
            fine.covariance.tolist()
            if fine is not None and is_known and fine.covariance is not None
            else None
        ),
        "covariance_about": (
            target_frame.to_file(fine.covariance_about[None])[0].tolist()
            if fine is not None and is_known
            else None
        ),
        "unobservable": [dict(item) for item in fine.unobservable] if fine is not None else [],
        "checks": None if result.checks is None else dict(result.checks),
        "pairs": None if result.pairs is None else dict(result.pairs),
        "notes": list(result.notes),
        "seconds": dict(result.seconds),
        "dougong": dougong.__version__,
        "parameters": dict(result.parameters),
        "inputs": [dict(item) for item in inputs],
    }


def _fine(fine: FineResult) -> dict[str, Any]:
    return {
        "method": fine.method,
        "iterations": fine.iterations,
        "stopped": fine.stopped,
        "fitness": fine.fitness,
        # A fit without correspondences has no residuals; JSON has no NaN.
        "inlier_rmse_m": fine.inlier_rmse_m if fine.fitness > 0.0 else None,
        "max_distance_m": fine.max_distance_m,
        "overlap_source": fine.overlap_source,
        "overlap_target": fine.overlap_target,
        "history": [dict(item) for item in fine.history],
    }
