"""What points say about a pose: explained, nothing there, contradicted."""

import numpy as np
import pytest

from dougong.registration.object_evidence import blocks_of, court_of, hear, is_worse, noise_of
from dougong.registration.object_fit import body_of
from dougong.registration.pose_search import view_of
from dougong.registration.surface import surface
from object_shapes import chair

SPACING = 0.02
GAP = 1.5 * SPACING


def plate(low, high, height=0.0):
    """Return a level plate over x in low..high as a body, its middle at the origin of x alone."""
    x, y = np.meshgrid(np.arange(low, high, SPACING), np.arange(-0.5, 0.5, SPACING))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])
    return body_of(view_of(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), SPACING))


def pose(shift):
    T = np.eye(4)
    T[:3, 3] = shift
    return T


def test_where_a_surface_goes_on_beyond_the_other_cloud_nothing_speaks_against():
    # Half of each plate has no counterpart: laid end over end, they are one longer plate.
    heard = hear(court_of(plate(0.0, 1.0), plate(0.0, 1.0), 0.002, GAP), pose((0.5, 0.0, 0.0)))
    assert heard.explained == pytest.approx(0.5, abs=0.05)
    assert heard.loss.max() <= 1.0
    assert heard.explained_source == pytest.approx(0.5, abs=0.05)


def test_a_surface_inside_what_the_other_cloud_shows_and_off_it_speaks_against():
    small, large = plate(0.0, 0.4), plate(0.0, 2.0)
    court = court_of(small, large, 0.002, GAP)
    on = hear(court, pose((0.0, 0.0, 0.0)))
    off = hear(court, pose((0.0, 0.0, 2.0 * GAP)))
    away = hear(court, pose((0.0, 0.0, 10.0 * GAP)))
    count = len(small.view.points)
    assert on.loss[:count].mean() == pytest.approx(0.0, abs=0.01)
    assert off.loss[:count].mean() > 2.5
    assert away.loss[:count].mean() == pytest.approx(1.0)


def test_a_pose_that_contradicts_loses_to_one_that_shows_less():
    small, large = plate(0.0, 1.0), plate(0.0, 1.0)
    court = court_of(small, large, 0.002, GAP)
    half = hear(court, pose((0.5, 0.0, 0.0)))
    whole_but_off = hear(court, pose((0.0, 0.0, 1.5 * GAP)))
    block, blocks = blocks_of(small.view, large.view)
    assert is_worse(half, whole_but_off, block, blocks, 3.0)
    assert not is_worse(whole_but_off, half, block, blocks, 3.0)


def test_the_noise_is_that_of_the_tightest_pose_that_matches_as_much():
    rng = np.random.default_rng(0)
    bodies = []
    for seed in (0, 1):
        points = chair(seed, 3000)
        points += rng.normal(0.0, 0.004, points.shape)
        bodies.append(body_of(view_of(points, surface(points, 12).normals, 0.02)))
    poses = [pose((0.0, 0.0, z)) for z in (0.02, 0.0, 3.0)]
    sigma = noise_of(*bodies, poses, 0.04)
    assert 0.002 < sigma < 0.012
