"""The sign-flip test against the count of all choices of signs, and against its own sense."""

import itertools

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from dougong.registration.randomisation import _saddle_point, sign_flip, student


def counted(values):
    """Count every choice of signs, one by one."""
    total = sum(values)
    sums = [
        sum(sign * abs(v) for sign, v in zip(signs, values, strict=True))
        for signs in itertools.product((1, -1), repeat=len(values))
    ]
    return np.mean([s >= total - 1e-9 for s in sums])


@pytest.mark.parametrize("seed", range(6))
def test_few_differences_are_counted_exactly(seed):
    values = np.random.default_rng(seed).normal(0.4, 1.0, 9)
    assert sign_flip(values) == pytest.approx(counted(values))


@pytest.mark.parametrize("spread", [0.1, 1.0, 2.0])
def test_the_saddle_point_meets_the_count(spread):
    rng = np.random.default_rng(3)
    for _ in range(20):
        sizes = np.exp(spread * rng.normal(size=16))
        sums = np.zeros(1)
        for size in sizes:
            sums = np.concatenate([sums + size, sums - size])
        for chance in (0.2, 1e-2, 1e-3):
            total = np.quantile(sums, 1.0 - chance) + 1e-12
            exact = np.mean(sums >= total)
            assert _saddle_point(sizes / sizes.max(), total / sizes.max()) == pytest.approx(
                exact, rel=0.35
            )


def test_one_heavy_block_among_coins_is_one_observation():
    coins = np.random.default_rng(1).choice([-0.1, 0.1], 60)
    assert 0.2 < sign_flip(np.array([100.0, *coins])) < 0.6


def test_blocks_that_all_agree_are_as_rare_as_their_number():
    assert sign_flip(np.geomspace(1.0, 1e3, 10)) == pytest.approx(2.0**-10)
    assert sign_flip(np.ones(40)) == pytest.approx(2.0**-40, rel=0.5)


def test_both_ways_make_one_and_scale_is_no_matter():
    values = np.random.default_rng(5).normal(0.3, 1.0, 50)
    assert sign_flip(values) + sign_flip(-values) == pytest.approx(1.0, abs=1e-6)
    assert sign_flip(1e-6 * values) == pytest.approx(sign_flip(values), rel=1e-6)
    assert sign_flip(np.zeros(4)) == 1.0


def test_student_tells_a_few_that_are_alike_and_is_a_plain_t_test():
    alike = np.array([1.0, 1.05, 0.95, 1.02])
    assert student(alike) < 1e-3 < sign_flip(alike)
    values = np.random.default_rng(6).choice([-1.0, 1.0], 40) + 0.4
    # Equal sizes but for the shift: nearly as many effective as there are.
    assert student(values) == pytest.approx(
        ttest_1samp(values, 0.0, alternative="greater").pvalue, rel=0.2
    )
    assert student(np.array([5.0, 5.0])) == 1.0
