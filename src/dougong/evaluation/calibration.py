"""Whether declared probabilities are those observed, on generated pairs whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from dougong.cloud import Cloud
from dougong.errors import DougongError
from dougong.evaluation.metrics import CORRECT_TRE95_M, pose_errors
from dougong.evaluation.trial_pairs import TrialPair, make_pair
from dougong.registration.decision import Found, decide
from dougong.registration.icp import Icp
from dougong.registration.plan_search import PlanSearch, plan_search
from dougong.registration.prepare import Prepare, prepare
from dougong.registration.probability import MOST_PROBABLE, Belief, Evidence, shares
from dougong.registration.settings import Register
from dougong.typing import Index, Mask, Values

Row = Mapping[str, Any]
SETTINGS = Register(
    prepare=Prepare(min_spacing_m=0.4), plan=PlanSearch(peaks=24), icp=Icp(points_per_level=2000)
)
"""Thinned: what fewer peaks and points lose, the verdict has to notice."""
BINS = 15
_EXPECTED = np.array([0.0, 1.0, 2.0, 10.0, 0.5, 2.0, 0.5])
_DOUBT = np.array([4.0, 2.0, 4.0, 10.0, 1.0, 5.0, 1.0])
"""What the coefficients are taken to be, and to how much, before any pair is seen: a few pairs
in which nothing failed would else make every pose certain. Thousands of pairs outweigh it."""


def measure(kind: str, seed: int, settings: Register = SETTINGS) -> dict[str, Any]:
    """Register one pair and return what was said about it and what is true, plain."""
    pair = make_pair(kind, seed)
    row: dict[str, Any] = {"kind": kind, "seed": seed, "is_unique": pair.is_unique}
    try:
        found, tre95 = _registered(pair, settings)
    except DougongError as error:
        return {**row, "status": "failed", "reason": str(error), "is_correct": False}
    row |= {"status": found.status, "reason": found.reason, "tre95_m": tre95}
    row["is_correct"] = found.T is not None and tre95 is not None and tre95 <= CORRECT_TRE95_M
    evidence = found.evidence
    if evidence is None:
        return row
    if found.T is not None:
        row["probability"] = found.probability
    # Of refused poses too: where the limits should lie is read from both.
    return row | {
        "sharpness": evidence.sharpness,
        "explained": evidence.explained,
        "violation": evidence.violation,
        "spread_m": evidence.spread_m,
        "rivals": list(evidence.rivals),
        "is_undecided": evidence.is_undecided,
    }


def _registered(pair: TrialPair, settings: Register) -> tuple[Found, float | None]:
    """Return the verdict and how far its best pose, refused or not, is from the truth."""
    clouds = [Cloud.from_points(points) for points in (pair.source, pair.target)]
    one = prepare(clouds[0], "lidar", settings.prepare)
    two = prepare(clouds[1], "photogrammetry", settings.prepare)
    found = decide(one, two, plan_search(one, two, settings.plan), settings)
    T = found.T
    if T is None and found.ruling is not None:
        T = found.ruling.winner.T
    if T is None or pair.truth is None:
        return found, None
    matrix = T.copy()
    origins = [cloud.frame.origin for cloud in clouds]
    matrix[:3, 3] += origins[1] - matrix[:3, :3] @ origins[0]
    return found, pose_errors(matrix, pair.truth).tre95_m


def evidence_of(row: Row) -> Evidence | None:
    """Return the evidence a row was judged on; None: its pose was refused."""
    if "probability" not in row:
        return None
    return Evidence(
        sharpness=row["sharpness"],
        explained=row["explained"],
        violation=row["violation"],
        spread_m=np.inf if row["spread_m"] is None else row["spread_m"],
        rivals=tuple(row["rivals"]),
        is_undecided=row["is_undecided"],
    )


def probabilities(rows: Sequence[Row], belief: Belief) -> Values:
    """Return what `belief` says of every row: 0 where the pose was refused."""
    found = (evidence_of(row) for row in rows)
    return np.array([0.0 if e is None else belief.probability(e) for e in found])


def fit(rows: Sequence[Row]) -> Belief:
    """Return the most likely belief, given what was observed and `_EXPECTED`.

    Poses that were refused say nothing: their probability is 0 whatever the coefficients.
    """
    judged = [(e, bool(row["is_correct"])) for row in rows if (e := evidence_of(row)) is not None]
    terms = np.array([evidence.terms() for evidence, _ in judged])
    is_correct = np.array([correct for _, correct in judged])

    def cost(numbers: NDArray[np.float64]) -> float:
        trust = 1.0 / (1.0 + np.exp(-terms @ numbers[:-1]))
        rivals = np.array([shares(evidence.rivals, numbers[-1]) for evidence, _ in judged])
        p = np.clip(trust / (1.0 + rivals), 1.0 - MOST_PROBABLE, MOST_PROBABLE)
        likely = np.where(is_correct, np.log(p), np.log1p(-p)).sum()
        return float(-likely + 0.5 * np.square((numbers - _EXPECTED) / _DOUBT).sum())

    bounds = [(-20.0, 20.0), *[(0.0, 50.0)] * 5, (0.05, 3.0)]
    best = optimize.minimize(cost, _EXPECTED, method="L-BFGS-B", bounds=bounds)
    return Belief(trust=tuple(float(x) for x in best.x[:-1]), rival_power=float(best.x[-1]))


def calibration_error(p: Values, is_correct: Mask, bins: int = BINS) -> float:
    """Return the expected calibration error: the mean over pairs of |declared - observed|.

    In `bins` equal steps of the declared probability.
    """
    place = _bin_of(p, bins)
    off = np.bincount(place, p - is_correct, bins)
    return float(np.abs(off).sum() / max(len(p), 1))


def _bin_of(p: Values, bins: int) -> Index:
    place: Index = np.minimum((p * bins).astype(np.int64), bins - 1)
    return place


def error_by_chance(p: Values, bins: int = BINS, draws: int = 200) -> float:
    """Return the calibration error that so many pairs show on average where `p` is exact.

    It falls with the number of pairs; a measured error near it is no sign of a wrong probability.
    """
    rng = np.random.default_rng(0)
    return float(
        np.mean([calibration_error(p, rng.random(len(p)) < p, bins) for _ in range(draws)])
    )


def reliability(p: Values, is_correct: Mask, bins: int = BINS) -> list[dict[str, float]]:
    """Return, for every bin that holds pairs, the declared and the observed frequency.

    With the 95 % interval of the observed one (Clopper and Pearson 1934).
    """
    place = _bin_of(p, bins)
    table = []
    for k in np.unique(place):
        chosen = is_correct[place == k]
        count, hits = len(chosen), int(chosen.sum())
        low = float(stats.beta.ppf(0.025, hits, count - hits + 1)) if hits else 0.0
        high = float(stats.beta.ppf(0.975, hits + 1, count - hits)) if hits < count else 1.0
        table.append(
            {
                "pairs": count,
                "share": count / len(p),
                "declared": float(p[place == k].mean()),
                "observed": hits / count,
                "low95": low,
                "high95": high,
            }
        )
    return table


def area_under_roc(p: Values, is_correct: Mask) -> float:
    """Return the chance that a true pose is declared more probable than a false one; ties half."""
    true, false = p[is_correct], p[~is_correct]
    if not len(true) or not len(false):
        return float("nan")
    ranks = stats.rankdata(np.concatenate([true, false]))
    above = ranks[: len(true)].sum() - len(true) * (len(true) + 1) / 2
    return float(above / (len(true) * len(false)))
