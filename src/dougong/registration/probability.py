"""How probable it is that a pose is the true one, from the evidence its verdict rests on.

A pose is true when it lies within 50 mm of the truth (TRE95, METHOD.md 5). Two things can be
wrong with it. Another pose may be it: each rival takes a share of the belief, a whole one where
the blocks do not prefer either, next to none where they are sure. And none of the poses may be
it: the trust in the fit itself, a logistic function of the evidence.

    P = trust / (1 + sum over rivals of min(1, 2 p)^rival_power)
    logit(trust) = constant + a ln(sharpness) + b explained - c violation - d ln(spread / 50 mm)
                   - e [a rival is undecided]

a..e and `rival_power` are not negative, so more evidence never makes a pose less probable. e is
there because a plain building fits other plain buildings too: where several poses of it are
alike, more often none of them is true. ``benchmarks/fit_probability.py`` fits the coefficients on
generated pairs with known answers; ``dougong evaluate probability`` measures on other seeds, and
on kinds of building that the fit has not seen, how often a pose is right at each declared
probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MOST_PROBABLE = 0.999
"""No number of pairs that can be measured proves more than this."""
_SPREAD_M = 0.05
_LEAST_SPREAD_M, _MOST_SPREAD_M = 0.005, 1.0
_MOST_SHARPNESS = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the verdict on a pose rests on."""

    sharpness: float
    explained: float
    violation: float
    spread_m: float
    """How closely the blocks hold the pose, see `covariance.displacement95`; inf: unknown."""
    rivals: tuple[float, ...]
    """The blocks' p-value against each rival pose; 1: as good as the winner."""
    is_undecided: bool
    """The verdict could not tell every rival from the pose."""

    def terms(self) -> tuple[float, ...]:
        """Return what each coefficient of the trust is multiplied with.

        Bounded: what is ten times sharper than needed is not ten times surer.
        """
        spread = float(np.clip(self.spread_m, _LEAST_SPREAD_M, _MOST_SPREAD_M))
        return (
            1.0,
            float(np.log(np.clip(self.sharpness, 1.0, _MOST_SHARPNESS))),
            float(np.clip(self.explained, 0.0, 1.0)),
            -float(np.clip(self.violation, 0.0, 0.2)),
            -float(np.log(spread / _SPREAD_M)),
            -float(self.is_undecided),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Belief:
    """The coefficients of the probability."""

    trust: tuple[float, ...]
    """Constant, ln(sharpness), explained, violation, ln(spread), undecided; `Evidence.terms`."""
    rival_power: float

    def probability(self, evidence: Evidence) -> float:
        """Return the probability, 0..0.999, that the pose is true."""
        logit = float(np.dot(self.trust, evidence.terms()))
        share = 1.0 + shares(evidence.rivals, self.rival_power)
        return float(min(MOST_PROBABLE, 1.0 / (1.0 + np.exp(-logit)) / share))


def shares(p_values: Sequence[float], power: float) -> float:
    """Return the belief in all rivals together, in units of that in the winner."""
    doubt = np.minimum(1.0, 2.0 * np.maximum(np.asarray(p_values, dtype=np.float64), 1e-12))
    return float(np.sum(doubt**power))


BELIEF = Belief(trust=(0.484, 0.0, 5.643, 13.301, 1.910, 5.060), rival_power=1.828)
"""Fitted on the pairs of `trial_pairs.TRAINED`, seeds 0-179 and 100000-100126."""
