"""What registration hands over: hypotheses, the fine fit, and the verdict with its proof."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dougong.typing import Transform

Status = Literal["ok", "ambiguous", "failed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One candidate pose, in the local frames of source and target."""

    T_target_source: Transform
    score: float
    """0..1, higher is better; one meaning for every method (see `hypotheses.score`)."""
    method: str
    """Which coarse method proposed it."""

    @property
    def yaw_deg(self) -> float:
        """Turn about the vertical, degrees in (-180, 180]."""
        return float(np.degrees(np.arctan2(self.T_target_source[1, 0], self.T_target_source[0, 0])))


@dataclass(frozen=True, slots=True, kw_only=True)
class FineResult:
    """One converged (or stopped) ICP, in the local frames of source and target."""

    T_target_source: Transform
    method: str
    """point-to-plane, point-to-point or none."""
    iterations: int
    stopped: str
    """Why it stopped, in words."""
    fitness: float
    """Inlier correspondences / source points, 0..1."""
    inlier_rmse_m: float
    """Root mean square residual over inliers, metres (point-to-plane: along normals)."""
    max_distance_m: float
    """The distance bound of an inlier at the last, finest level."""
    overlap_source: float
    """Share of source points with a target point within `max_distance_m`."""
    overlap_target: float
    covariance: NDArray[np.float64] | None
    """(6, 6) of (omega rad, v m), with a free scale (7, 7) with ln s, about `covariance_about`,
    block jackknife; None: unknown."""
    covariance_about: NDArray[np.float64]
    """(3,), local target coordinates."""
    covariance_of_control: NDArray[np.float64] | None = None
    """(6, 6), the part of `covariance` that the sigmas of control points bring; None: no points."""
    covariance_blocks: int = 0
    """Independent blocks of surface behind `covariance`; 0 where it is None."""
    covariance_widening: float = 1.0
    """What `covariance` holds for being known from so few blocks: `covariance.widening_of`."""
    unobservable: tuple[Mapping[str, Any], ...] = ()
    """Directions the data do not fix: {"vector": 6 numbers, "text": words}."""
    history: tuple[Mapping[str, float], ...] = ()
    """Per iteration: level, max_distance_m, inlier_rmse_m, fitness, step_m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """The verdict on one pair. The matrix maps source *file* to target *file* coordinates."""

    status: Status
    matrix: Transform | None
    """None when failed; the best pose when ambiguous."""
    reason: str
    probability: float
    scale: float
    dof: int
    coarse_method: str
    hypotheses: tuple[Hypothesis, ...]
    """Best first; in *file* coordinates, like `matrix`."""
    margin: float
    """1 - s2/s1 over poses more than 5 degrees or 0.5 m apart; 1 when there is one pose."""
    fine: FineResult | None
    scale_source: str = "none"
    """What fixes the scale: none (it is 1), units, search, grid (crs), grid (given)."""
    grid: Mapping[str, Any] | None = None
    """What map projections do to lengths between the clouds; None: nothing."""
    notes: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    pairs: Mapping[str, Any] | None = None
    """What the picked pairs said (`picked_pairs.pairs_document`); None: there were none."""
    scale_search: Mapping[str, Any] | None = None
    """What the search for the scale found (`free_scale_result.scale_document`); None: none."""
    checks: Mapping[str, Any] | None = None
    """What control and check points said (`control.checks_document`); None: there were none."""
