"""M3C2: the kernels against their slow twins, and what must hold of any distance."""

import numpy as np
import pytest

from dougong.errors import InputError
from dougong.filters import neighbourhood
from dougong.registration.distances import Distances, normals_at, signed_distances
from dougong.threads import get_threads, set_threads
from reference import distances as twin

SMALL = Distances(
    normal_scale_m=0.5, projection_scale_m=0.3, max_distance_m=0.2, core_spacing_m=0.3
)


def turned(points, degrees, axis=(1.0, 2.0, 0.5)):
    from scipy.spatial.transform import Rotation

    unit = np.array(axis) / np.linalg.norm(axis)
    return points @ Rotation.from_rotvec(np.radians(degrees) * unit).as_matrix().T


def sheet(seed, noise=0.003, count=6000, size=4.0):
    """A gently waved sheet, z up."""
    rng = np.random.default_rng(seed)
    plan = rng.uniform(0, size, (count, 2))
    height = 0.05 * np.sin(plan[:, 0]) + rng.normal(0, noise, count)
    return np.column_stack([plan, height])


def flat(seed, noise, count=20_000, size=4.0, height=0.0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, size, (count, 2)), rng.normal(height, noise, count)])


@pytest.mark.parametrize("statistic", ["median", "mean"])
def test_kernels_agree_with_their_twins(statistic):
    source, target = turned(sheet(0), 40), turned(sheet(1), 40)
    found = signed_distances(source, target, SMALL.model_copy(update={"statistic": statistic}))
    counts, normals = twin.ball_normals(source, found.core, 0.25)
    assert counts.min() >= 3
    np.testing.assert_allclose(
        np.abs(np.einsum("ij,ij->i", normals, found.normals)), 1.0, atol=1e-9
    )
    args = (found.core, found.normals, 0.15, 0.2, statistic)
    n1, m1, s1 = twin.project(source, *args)
    n2, m2, s2 = twin.project(target, *args)
    np.testing.assert_array_equal(found.count_source, n1)
    np.testing.assert_array_equal(found.count_target, n2)
    seen = found.is_observed
    assert seen.mean() > 0.9
    np.testing.assert_allclose(found.distance_m[seen], (m1 - m2)[seen], atol=1e-12)
    cost = np.sqrt(np.pi / 2) if statistic == "median" else 1.0
    expected = twin.level_of_detection(cost * s1, n1, cost * s2, n2, 0.0)
    np.testing.assert_allclose(found.lod95_m[seen], expected[seen], atol=1e-12)


def test_a_cloud_is_at_zero_from_itself():
    source = sheet(0)
    found = signed_distances(source, source, SMALL)
    assert found.is_observed.all()
    assert (found.distance_m == 0.0).all()


@pytest.mark.parametrize("shift", [-0.05, 0.02])
@pytest.mark.parametrize("tilt", [0.0, 65.0])
def test_a_known_shift_is_recovered_with_its_sign_at_any_tilt(shift, tilt):
    up = np.array([0.0, 0.0, 1.0])
    source, target = turned(flat(0, 0.002, height=shift), tilt), turned(flat(1, 0.002), tilt)
    found = signed_distances(source, target, SMALL)
    axis = turned(up[None], tilt)[0]
    sign = np.sign(found.normals @ axis)
    inner = found.is_observed
    assert inner.mean() > 0.9
    assert np.median(sign * found.distance_m) == pytest.approx(shift, abs=3e-4)
    assert np.abs(sign[inner] * found.distance_m[inner] - shift).max() < 3e-3


def test_turning_both_clouds_changes_no_distance():
    source, target = sheet(0), sheet(1) + [0, 0, 0.01]
    first = signed_distances(source, target, SMALL)
    core = first.core
    second = signed_distances(
        turned(source, 77), turned(target, 77), SMALL,
        core=turned(core, 77), normals=turned(first.normals, 77),
    )  # fmt: skip
    seen = first.is_observed
    np.testing.assert_allclose(second.distance_m[seen], first.distance_m[seen], atol=1e-9)
    np.testing.assert_allclose(second.lod95_m[seen], first.lod95_m[seen], atol=1e-9)


def test_point_order_and_threads_change_no_bit_and_a_far_origin_nothing_to_speak_of():
    source, target = sheet(0, count=30_000), sheet(1, count=20_000) + [0, 0, 0.02]
    source = np.vstack([source, source[:500]])
    rng = np.random.default_rng(5)
    first = signed_distances(source, target)
    before = get_threads()
    try:
        set_threads(1 if before > 1 else 3)
        mixed = signed_distances(rng.permutation(source), rng.permutation(target))
    finally:
        set_threads(before)
    assert mixed.scales == first.scales
    for name in ("core", "normals", "distance_m", "lod95_m", "count_source"):
        np.testing.assert_array_equal(getattr(mixed, name), getattr(first, name))
    # A core point may fall into another voxel by rounding: the same places are asked.
    far = np.array([1024.0, -4096.0, 64.0])
    moved = signed_distances(source + far, target + far, core=first.core + far)
    np.testing.assert_allclose(moved.distance_m, first.distance_m, atol=1e-7)


def test_the_level_of_detection_holds_95_percent_where_nothing_differs():
    found = signed_distances(
        flat(0, 0.004, 60_000, 6.0), flat(1, 0.012, 40_000, 6.0),
        Distances(normal_scale_m=1.0, projection_scale_m=0.3, max_distance_m=0.2,
                  core_spacing_m=0.3),
    )  # fmt: skip
    seen = found.is_observed
    share = float((np.abs(found.distance_m[seen]) <= found.lod95_m[seen]).mean())
    assert seen.sum() > 300
    assert 0.91 < share < 0.99


def test_the_pose_enters_through_its_covariance_at_the_point():
    covariance = np.zeros((6, 6))
    covariance[5, 5] = 0.01**2  # height
    covariance[0, 0] = 0.002**2  # a turn about x lifts what lies far along y
    source, target = flat(0, 0.001), flat(1, 0.001)
    found = signed_distances(
        source, target, SMALL, covariance=covariance, covariance_about=np.zeros(3)
    )
    expected = np.hypot(0.01, 0.002 * found.core[:, 1])
    np.testing.assert_allclose(found.registration_m, expected, rtol=0.05)
    assert (found.lod95_m[found.is_observed] > 1.96 * 0.0095).all()
    assert found.has_registration
    assert not signed_distances(source, target, SMALL).has_registration


def test_nothing_is_said_where_a_cloud_is_missing_thin_or_a_line():
    source = flat(0, 0.002)
    half = source[source[:, 0] < 2.0] + [0, 0, 0.01]
    found = signed_distances(source, half, SMALL)
    assert found.core[:, 0].max() < 2.3
    thin = np.array([[0.5, 0.5, 0.0], [2.5, 2.5, 0.0]])
    assert not signed_distances(source, thin, SMALL).is_observed.any()
    line = np.column_stack([np.linspace(0, 4, 500), np.full((500, 2), 0.0)])
    wire = normals_at(neighbourhood.build_index(line), line[::50], 0.25)
    assert np.isnan(wire).all()
    apart = signed_distances(source, source + [0, 0, 30.0], SMALL)
    assert len(apart) == 0
    with pytest.raises(InputError, match="target has no points"):
        signed_distances(source, np.zeros((0, 3)), SMALL)


def test_core_points_stay_below_the_limit():
    source = flat(0, 0.002, 60_000, 6.0)
    found = signed_distances(source, flat(1, 0.002), Distances(max_core_points=1000))
    assert 300 < len(found) <= 1000
    assert found.scales.core_spacing_m > 0.1
