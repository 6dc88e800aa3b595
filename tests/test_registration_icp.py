"""Fine registration: exact answers on shapes with known motion, honest about what slides."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from dougong.errors import RegistrationError
from dougong.registration import covariance, icp_solve, overlap
from dougong.registration.icp import Icp, refine
from dougong.registration.prepare import Prepared
from reference import icp as reference


def box(rng, spacing=0.12, size=(9.0, 6.0, 4.0), faces="xyzXY"):
    """Points and outward normals of a box's faces; z is the floor round it."""
    points, normals = [], []
    half = np.array(size) / 2
    for axis, name in enumerate("xyz"):
        for side, letter in ((-1, name), (1, name.upper())):
            if letter not in faces:
                continue
            others = [k for k in range(3) if k != axis]
            count = int(size[others[0]] * size[others[1]] / spacing**2)
            at = rng.uniform(-half, half, (count, 3))
            at[:, axis] = side * half[axis]
            normal = np.zeros(3)
            normal[axis] = side
            points.append(at)
            normals.append(np.tile(normal, (count, 1)))
    return np.concatenate(points), np.concatenate(normals)


def prepared(points, normals, spacing=0.12, sigma=0.002):
    n = len(points)
    return Prepared(
        xyz=np.ascontiguousarray(points),
        normals=np.ascontiguousarray(normals),
        normal_is_oriented=True,
        planarity=np.ones(n),
        is_ground=normals[:, 2] < -0.5,
        height_above_ground=points[:, 2],
        weights_area=np.full(n, spacing**2),
        spacing_m=spacing,
        sigma_m=sigma,
        kind="lidar",
    )


def motion(turn_deg, shift):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    T[:3, 3] = shift
    return T


def away(T, other):
    """Angle in degrees and shift in metres between two poses."""
    turn = Rotation.from_matrix(T[:3, :3] @ other[:3, :3].T).magnitude()
    return np.degrees(turn), np.linalg.norm(T[:3, 3] - other[:3, 3])


def pair(seed=0, T=None, faces="xyzXY", sigma=0.0):
    """Two independent samplings of a box, the source moved by the inverse of T."""
    rng = np.random.default_rng(seed)
    T = np.eye(4) if T is None else T
    source, source_normals = box(rng, faces=faces)
    target, target_normals = box(rng, faces=faces)
    source = source + sigma * rng.normal(size=source.shape)
    target = target + sigma * rng.normal(size=target.shape)
    R = T[:3, :3]
    return (
        prepared((source - T[:3, 3]) @ R, source_normals @ R),
        prepared(target, target_normals),
    )


def test_kernel_equals_its_definition():
    rng = np.random.default_rng(1)
    n, blocks = 200, 4
    points, normals = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    residuals, weights = rng.normal(size=n), rng.random(n)
    weights[::7] = 0.0
    block = rng.integers(0, blocks, n)
    H, g = icp_solve.normal_equations(points, normals, residuals, weights, block, blocks)
    H_slow, g_slow = reference.normal_equations(points, normals, residuals, weights, block, blocks)
    np.testing.assert_allclose(H, H_slow, atol=1e-12)
    np.testing.assert_allclose(g, g_slow, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_exponential_is_the_rotation_about_the_vector(seed):
    omega = np.random.default_rng(seed).normal(size=3) * 10.0 ** -(seed % 9)
    R = icp_solve.rotation_of(omega)
    np.testing.assert_allclose(R, Rotation.from_rotvec(omega).as_matrix(), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)


def test_finds_the_motion_between_two_samplings():
    T = motion([0.4, -0.5, 37.0], [12.0, -30.0, 4.0])
    source, target = pair(0, T)
    start = motion([0.2, 0.2, 1.5], [0.15, -0.2, 0.1]) @ T
    found = refine(source, target, start)
    angle, shift = away(found.T_target_source, T)
    assert angle < 0.006
    assert shift < 0.006
    assert found.fitness > 0.5
    assert found.inlier_rmse_m < 0.01


def test_point_to_point_comes_nearer_too():
    source, target = pair(0)
    start = motion([0.2, 0.2, 1.0], [0.15, -0.2, 0.1])
    found = refine(source, target, start, Icp(method="point-to-point"))
    angle, shift = away(found.T_target_source, np.eye(4))
    assert angle < 0.3
    assert shift < 0.03


def test_is_more_exact_than_the_noise():
    source, target = pair(3, sigma=0.015)
    found = refine(source, target, motion([0.2, 0.1, 0.8], [0.1, 0.1, 0.1]))
    angle, shift = away(found.T_target_source, np.eye(4))
    assert angle < 0.02
    assert shift < 0.003


def test_covariance_covers_the_error():
    """The errors of 8 independent pairs stay within what the covariance promises."""
    ratios = []
    for seed in range(8):
        source, target = pair(seed + 20, sigma=0.01)
        found = refine(source, target, np.eye(4), Icp(block_m=1.5, points_per_level=3000, levels=2))
        c = found.covariance_about
        T = found.T_target_source
        error = np.concatenate(
            [Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, :3] @ c + T[:3, 3] - c]
        )
        ratios.append(error @ np.linalg.solve(found.covariance, error) / 6.0)
    # A mean chi square per degree of freedom near 1; conservative is allowed, boastful is not.
    assert 0.1 < np.mean(ratios) < 2.0


def test_answer_ignores_point_order_and_offset():
    source, target = pair(5, sigma=0.005)
    start = motion([0, 0, 1.0], [0.1, 0.05, -0.1])
    plain = refine(source, target, start).T_target_source
    order = np.random.default_rng(0).permutation(len(source.xyz))
    shuffled = prepared(source.xyz[order], source.normals[order])
    np.testing.assert_array_equal(refine(shuffled, target, start).T_target_source, plain)
    away_m = np.array([512.0, -256.0, 64.0])
    moved = refine(
        source, prepared(target.xyz + away_m, target.normals), motion([0, 0, 0], away_m) @ start
    ).T_target_source
    np.testing.assert_allclose(moved[:3, 3] - away_m, plain[:3, 3], atol=2e-3)


def test_four_degrees_of_freedom_leave_the_tilt():
    source, target = pair(6, motion([0.0, 0.0, 20.0], [1.0, 2.0, 3.0]))
    start = motion([0.0, 0.0, 21.0], [1.1, 2.0, 3.0])
    T = refine(source, target, start, Icp(dof=4)).T_target_source
    np.testing.assert_allclose(T[2, :3], [0, 0, 1], atol=1e-12)
    assert away(T, motion([0.0, 0.0, 20.0], [1.0, 2.0, 3.0]))[0] < 0.01


def test_a_plane_slides_and_a_box_does_not():
    source, target = pair(7, faces="xX")
    texts = [u["text"] for u in refine(source, target, np.eye(4)).unobservable]
    assert len(texts) == 3
    assert any("slides along the direction 90 deg" in text for text in texts)
    assert any("up and down" in text for text in texts)
    assert refine(*pair(8), np.eye(4)).unobservable == ()


def test_a_cylinder_turns_about_its_axis():
    rng = np.random.default_rng(9)

    def tower():
        angle, z = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(-3, 3, 6000)
        wall = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), z])
        normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * z])
        floor, floor_normals = box(rng, size=(14.0, 14.0, 6.0), faces="z")
        return prepared(np.concatenate([wall, floor]), np.concatenate([normals, floor_normals]))

    found = refine(tower(), tower(), np.eye(4)).unobservable
    assert len(found) == 1
    assert "turns about the vertical" in found[0]["text"]


def test_undersides_do_not_pair_with_tops():
    """A roof of 6 cm: one sensor sees the top, the other the underside. z must not move."""
    rng = np.random.default_rng(10)
    walls, wall_normals = box(rng, faces="xXyYz")
    walls2, wall_normals2 = box(rng, faces="xXyYz")
    top, top_normals = box(rng, faces="Z")
    below = top - [0.0, 0.0, 0.06]
    source = prepared(np.concatenate([walls, below]), np.concatenate([wall_normals, -top_normals]))
    target = prepared(np.concatenate([walls2, top]), np.concatenate([wall_normals2, top_normals]))
    found = refine(source, target, motion([0, 0, 0.3], [0.05, 0.05, 0.05]))
    assert abs(found.T_target_source[2, 3]) < 0.002


def test_thinning_keeps_original_points_whatever_their_order():
    points = np.random.default_rng(11).uniform(-5, 5, (4000, 3))
    canonical = points[np.lexsort(points.T[::-1])]
    kept = canonical[overlap.thin(canonical, 0.9)]
    assert len(np.unique(np.floor(kept / 0.9), axis=0)) == len(kept)
    cells = np.unique(np.floor(points / 0.9), axis=0)
    assert len(cells) == len(kept)


@pytest.mark.parametrize("shift", [0.0, 0.37, 4e6])
def test_blocks_cover_all_points_by_place_wherever_the_origin_is(shift):
    """In plan the first block begins a quarter of an edge before the points."""
    points = np.array([[0.0, 0.0, 0.0], [3.7, 3.7, 4.9], [3.8, 0.1, 0.1], [9.0, 0.0, 0.0]])
    block, count = covariance.blocks_of(points + shift, 5.0)
    assert count == 3
    assert block[0] == block[1] != block[2] != block[3]


def test_too_few_points_are_refused():
    points, normals = np.zeros((10, 3)), np.tile([0.0, 0.0, 1.0], (10, 1))
    few = prepared(points, normals)
    with pytest.raises(RegistrationError, match="source cloud has 10 usable points"):
        refine(few, few, np.eye(4))


def test_nothing_in_reach_is_said():
    source, target = pair(12)
    found = refine(source, target, motion([0, 0, 0], [50.0, 0, 0]))
    assert "fewer than 60 correspondences" in found.stopped
    assert found.fitness == 0.0
    assert found.covariance is None


def test_expected_displacement_follows_the_covariance():
    points = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    many = 10_000
    slides = np.zeros((6, 6))
    slides[3, 3] = 0.01**2
    found = covariance.displacement95(slides, np.zeros(3), points, many, 1.0)
    assert found == pytest.approx(0.0196, rel=0.05)
    turns = np.zeros((6, 6))
    turns[2, 2] = 0.001**2
    # One milliradian about z moves a point 10 m away by 10 mm.
    found = covariance.displacement95(turns, np.zeros(3), points[1:], many, 1.0)
    assert found == pytest.approx(0.0196, rel=0.05)
    # In three directions the length is a chi of three: 2.80 sigma, not 1.96.
    every = np.diag([0.0, 0.0, 0.0, 1e-4, 1e-4, 1e-4])
    found = covariance.displacement95(every, np.zeros(3), points, many, 1.0)
    assert found == pytest.approx(0.0280, rel=0.05)


def test_few_or_unequal_blocks_widen_the_covariance_to_hotellings():
    rng = np.random.default_rng(0)
    for unknowns, blocks in ((6, 15), (6, 60), (7, 30)):
        drawn = rng.normal(size=(3000, blocks, unknowns))
        centred = drawn - drawn.mean(axis=1, keepdims=True)
        known = np.einsum("rbi,rbj->rij", centred, centred) / (blocks - 1)
        miss = rng.normal(size=(3000, unknowns))
        square = np.einsum("ri,ri->r", miss, np.linalg.solve(known, miss[:, :, None])[:, :, 0])
        widening = covariance.widening_of(np.full(blocks, unknowns / blocks))
        covered = (square / widening <= chi2.ppf(0.95, unknowns)).mean()
        assert covered == pytest.approx(0.95, abs=0.015)
    equal, slivers = np.full(20, 0.3), np.concatenate([np.full(20, 0.29), np.full(20, 0.01)])
    assert covariance.widening_of(slivers) == pytest.approx(covariance.widening_of(equal), rel=0.15)


def test_few_blocks_widen_the_expected_displacement_by_students_t():
    slides = np.zeros((6, 6))
    slides[3, 3] = 0.01**2 * 1.7
    found = covariance.displacement95(slides, np.zeros(3), np.zeros((1, 3)), 16, 1.7)
    assert found == pytest.approx(0.0213, rel=0.06)


def ground_and_house(rng, per_m2):
    """Return points and normals of 44 x 44 m of ground and a house on it: few surfaces face x."""
    quads = [
        ((-22, -22, 0), (44, 0, 0), (0, 44, 0)),
        *(((-9, y, 0), (18, 0, 0), (0, 0, 6)) for y in (-4, 4)),
        *(((x, -4, 0), (0, 8, 0), (0, 0, 6)) for x in (-9, 9)),
    ]
    points, normals = [], []
    for corner, u, v in (np.array(quad, dtype=float) for quad in quads):
        across = np.cross(u, v)
        area = float(np.linalg.norm(across))
        at = rng.random((int(area * per_m2), 2))
        points.append(corner + at[:, :1] * u + at[:, 1:] * v)
        normals.append(np.broadcast_to(across / area, (len(at), 3)))
    xyz = np.concatenate(points)
    return xyz + rng.normal(0.0, 0.002, xyz.shape), np.concatenate(normals)


@pytest.mark.parametrize("shift", [(0.3, 0.0), (-0.3, 0.2), (0.0, 0.35), (0.06, -0.04)])
def test_few_surfaces_that_face_a_way_are_not_outliers_to_the_many(shift):
    # By one robust sigma for all, that of the ground, walls more than 12 mm off had no weight.
    rng = np.random.default_rng(5)
    source, target = (
        prepared(*ground_and_house(rng, per_m2), spacing=0.3) for per_m2 in (12.0, 30.0)
    )
    off = np.eye(4)
    off[:2, 3] = shift
    found = refine(source, target, off)
    assert np.abs(found.T_target_source[:2, 3]).max() < 0.002
