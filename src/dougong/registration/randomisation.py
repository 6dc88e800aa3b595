"""Paired differences: could they as well have had other signs, or a mean of nothing."""

from __future__ import annotations

import numpy as np
from scipy import optimize, special, stats

from dougong.typing import Values

_COUNTED = 16
"""Up to so many differences every choice of signs is counted."""


def sign_flip(differences: Values) -> float:
    """Return the chance that coin-tossed signs give a sum as large as that of `differences`.

    P(sum of e_i |d_i| >= sum of d_i), the e_i independent and +1 or -1 with even chance: counted
    for at most 16 differences, by a saddle point (Lugannani and Rice 1980) for more. Never less
    than 2^-n, the chance of the one choice in which all signs agree.

    Parameters
    ----------
    differences : ndarray, shape (n,)
        Any unit; zeros say nothing and are left out.

    Returns
    -------
    float
        1.0 where no difference is left.

    Notes
    -----
    No distribution of the sizes is assumed, only that a difference could as well have been its
    opposite. One that outweighs all others together leaves the answer to its own sign.
    """
    values = differences[differences != 0.0]
    if not len(values):
        return 1.0
    sizes = np.sort(np.abs(values))[::-1] / np.abs(values).max()
    total = float(np.sort(values).sum() / np.abs(values).max())
    if len(sizes) <= _COUNTED:
        return _counted(sizes, total)
    if total < 0.0:
        return 1.0 - _saddle_point(sizes, -total)
    return _saddle_point(sizes, total)


def student(differences: Values) -> float:
    """Return the chance, by Student's t, of so large a sum if the mean difference were 0.

    Degrees of freedom: the effective number of differences, (sum |d|)^2 / sum d^2, less one, so
    that unequal ones count for fewer. It tells a few that are alike, which `sign_flip` cannot;
    1.0 for fewer than three.
    """
    size = float(np.abs(differences).sum())
    if size <= 0.0 or len(differences) < 3:
        return 1.0
    count = len(differences)
    effective = size**2 / float(differences @ differences)
    off = np.square(differences - differences.mean()).sum()
    spread = float(np.sqrt(off * count / (count - 1)))
    statistic = float(differences.sum()) / max(spread, 1e-300)
    return float(stats.t.sf(statistic, max(effective - 1.0, 1.0)))


def _counted(sizes: Values, total: float) -> float:
    sums = np.zeros(1)
    for size in sizes:
        sums = np.concatenate([sums + size, sums - size])
    return float(np.mean(sums >= total - 1e-9 * len(sizes)))


def _saddle_point(sizes: Values, total: float) -> float:
    """Return P(sum >= total) for total >= 0; K(t) = sum log cosh(t d_i)."""
    least = 0.5 ** len(sizes)
    spread = float(np.sqrt(sizes @ sizes))
    if total <= 1e-6 * spread:
        return 0.5
    # Beyond this t all signs agree: the sum is as large as it can be.
    highest = 40.0 / float(sizes.min())
    if float(sizes @ np.tanh(highest * sizes)) <= total:
        return least
    t = float(optimize.brentq(lambda x: float(sizes @ np.tanh(x * sizes)) - total, 0.0, highest))
    generating = float(np.sum(np.logaddexp(t * sizes, -t * sizes) - np.log(2.0)))
    curvature = float(np.square(sizes) @ (1.0 - np.square(np.tanh(t * sizes))))
    w = float(np.sqrt(max(2.0 * (t * total - generating), 0.0)))
    u = t * float(np.sqrt(curvature))
    if w < 1e-3 or u < 1e-3:
        return float(special.ndtr(-total / spread))
    density = float(np.exp(-0.5 * w * w) / np.sqrt(2.0 * np.pi))
    chance = float(special.ndtr(-w)) + density * (1.0 / u - 1.0 / w)
    return float(np.clip(chance, least, 0.5))
