"""SAC-IA and 4PCS: pairs equal to their twin, right poses, several of them, seeds and order."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong import threads
from dougong.registration import Register
from dougong.registration.congruent_sets import (
    CongruentSets,
    congruent,
    congruent_poses,
    draw_base,
    four_pcs,
    pairs_of,
)
from dougong.registration.pose_search import build_field, to_transform, view_of
from dougong.registration.prepare import prepare
from dougong.registration.sample_consensus import SacIa, consensus_poses, sac_ia
from dougong.registration.starting_poses import coarse_poses
from dougong.registration.surface import surface
from object_shapes import chair, errors, motion, moved
from reference import poses as twin
from registration_sites import SETTINGS, as_cloud, local_truth, pose_error, site
from registration_sites import motion as site_motion

SAC = SacIa(trials=40_000)
SETS = CongruentSets(sampled=200, bases=25)


def view(points):
    plane = surface(points, 12)
    return view_of(points, plane.normals, plane.spacing_m)


@pytest.fixture(scope="module")
def objects():
    truth = motion(3)
    one, two = view(chair(1)), view(moved(chair(2), truth))
    return one, two, build_field(two, 0.3), truth


@pytest.fixture(scope="module")
def sites():
    truth = site_motion(140.0, (4e5, 3e6, 50.0))
    source = as_cloud(site("photogrammetry", seed=1, per_m2=15.0))
    target = as_cloud(moved(site("photogrammetry", seed=2, per_m2=15.0), truth))
    return (
        prepare(source, "photogrammetry", SETTINGS),
        prepare(target, "photogrammetry", SETTINGS),
        local_truth(truth, source, target),
        (source.frame, target.frame),
        source.xyz.mean(axis=0),
    )


def test_pairs_are_the_twins():
    one = view(chair(5, 120))
    found = pairs_of(one.points, one.normals, 0.5, 0.05, 0.9, 0.3)
    expected = twin.pairs_at_distance(one.points, one.normals, 0.5, 0.05, 0.9, 0.3)
    assert len(expected) > 50
    np.testing.assert_array_equal(found, expected)


def test_a_base_is_flat_wide_and_crosses():
    points = view(chair(6, 300)).points
    rng = np.random.default_rng(0)
    bases = [b for b in (draw_base(points, 0.6, 0.02, rng) for _ in range(40)) if b is not None]
    assert len(bases) > 10
    for base in bases:
        a, b, c, d = points[base.places]
        gap = a + base.ratios[0] * (b - a) - c - base.ratios[1] * (d - c)
        assert np.linalg.norm(gap) < 0.05
        assert all(0.05 < r < 0.95 for r in base.ratios)
        assert max(base.lengths) <= 0.6 * np.ptp(points, axis=0).max() + 1e-9


def test_a_moved_base_is_found_again():
    points = view(chair(7, 200))
    base = None
    rng = np.random.default_rng(1)
    while base is None:
        base = draw_base(points.points, 0.6, 0.02, rng)
    T = motion(8)
    there, turned = moved(points.points, T), points.normals @ T[:3, :3].T
    sets = congruent(base, points.points, points.normals, there, turned, 0.02, SETS)
    assert (sets == base.places).all(axis=1).any()
    sides = np.linalg.norm(there[sets[:, 0]] - there[sets[:, 1]], axis=1)
    assert np.abs(sides - base.lengths[0]).max() <= 0.02 + 1e-12


@pytest.mark.parametrize(
    ("method", "params"), [(consensus_poses, SAC), (congruent_poses, SETS)], ids=["sac-ia", "4pcs"]
)
def test_objects_are_found_whatever_their_attitude(objects, method, params):
    one, two, field, truth = objects
    poses, scores = method(one, two, field, params)
    assert 1 < len(poses) <= params.returned
    assert (np.diff(scores) <= 0).all()
    at = one.points + one.centre
    angle, shift = errors(to_transform(poses[0], one, two), truth, at)
    # Three or four noisy points fix a pose roughly: enough for the fit that follows.
    assert angle < 18.0
    assert shift < 0.15
    turns = poses[:, :9].reshape(-1, 3, 3)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-9
    )
    for i in range(len(poses)):
        for j in range(i):
            gap = np.degrees(Rotation.from_matrix(turns[i] @ turns[j].T).magnitude())
            assert gap > 4.9 or np.linalg.norm(poses[i, 9:] - poses[j, 9:]) > 0.05
    count = threads.get_threads()
    threads.set_threads(1)
    again, _ = method(one, two, field, params)
    threads.set_threads(count)
    np.testing.assert_array_equal(again, poses)
    other, _ = method(one, two, field, params.model_copy(update={"seed": 1}))
    assert not np.array_equal(other, poses)


@pytest.mark.parametrize(("coarse", "key"), [("sac-ia", "sac_ia"), ("4pcs", "congruent_sets")])
def test_sites_are_found_through_register_s_table(sites, coarse, key):
    source, target, truth, frames, centre = sites
    params = Register(coarse=coarse, **{key: SAC if coarse == "sac-ia" else SETS})
    found = coarse_poses(source, target, *frames, params)
    assert {h.method for h in found} == {coarse}
    assert [h.score for h in found] == sorted((h.score for h in found), reverse=True)
    gaps = [pose_error(h.T_target_source, truth, centre) for h in found]
    assert min(yaw for yaw, plan, _ in gaps if plan < 3.0) < 6.0


@pytest.mark.parametrize("method", [sac_ia, four_pcs])
def test_order_of_points_changes_nothing(method):
    params = SacIa(trials=5000) if method is sac_ia else CongruentSets(sampled=150, bases=6)
    points = [site("photogrammetry", seed=s, per_m2=10.0) for s in (1, 2)]
    rng = np.random.default_rng(0)
    found = []
    for pair in (points, [rng.permutation(p) for p in points]):
        clouds = [prepare(as_cloud(p), "photogrammetry", SETTINGS) for p in pair]
        found.append(method(*clouds, params))
    assert len(found[0]) == len(found[1])
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a.T_target_source, b.T_target_source, atol=1e-9)
