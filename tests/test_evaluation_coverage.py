"""The covariance of a fit covers the truth although neighbouring errors go together."""

import numpy as np

from dougong.evaluation.coverage import _field, coverage


def test_the_ellipsoid_holds_the_truth():
    found = coverage(range(24))
    # 24 runs of an honest ellipsoid hold the truth at least 20 times with a chance of 0.994.
    assert found.covered >= 20
    assert np.mean(found.chi2_per_dof) > 0.1


def test_the_field_is_correlated_as_it_says():
    rng = np.random.default_rng(1)
    points = rng.uniform(-30, 30, (4000, 3))
    near = points + [1.5, 0, 0]
    products = []
    for seed in range(60):
        both = _field(np.random.default_rng(seed), np.vstack([points, near]), 1.5)
        products.append(np.mean(both[:4000] * both[4000:]))
    assert abs(np.mean(products) - np.exp(-0.5)) < 0.03
