"""The covariance of a fit covers the truth although neighbouring errors go together."""

import numpy as np

from dougong.evaluation.coverage import _field, coverage


def test_the_ellipsoid_is_near_what_it_promises():
    found = coverage(range(24))
    # Measured over 40 runs: 0.83, where 0.95 is promised; a covariance that took every point for
    # an observation of its own would hold next to none.
    assert found.covered >= 16
    assert 0.1 < np.mean(found.chi2_per_dof) < 2.5


def test_the_field_is_correlated_as_it_says():
    rng = np.random.default_rng(1)
    points = rng.uniform(-30, 30, (4000, 3))
    near = points + [1.5, 0, 0]
    products = []
    for seed in range(60):
        both = _field(np.random.default_rng(seed), np.vstack([points, near]), 1.5)
        products.append(np.mean(both[:4000] * both[4000:]))
    assert abs(np.mean(products) - np.exp(-0.5)) < 0.03
