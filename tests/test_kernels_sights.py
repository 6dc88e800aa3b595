"""What is hidden from a place: the kernel gives what NumPy gives."""

import numpy as np

from dougong.kernels.sights import hidden_shares


def hidden_by_numpy(points, place, rows, factor, extra):
    sight = points - place
    distance = np.linalg.norm(sight, axis=1)
    row = ((np.arcsin(sight[:, 2] / distance) / np.pi + 0.5) * rows).astype(int)
    column = ((np.arctan2(sight[:, 1], sight[:, 0]) / np.pi + 1.0) * rows).astype(int) % (2 * rows)
    nearest = np.full((rows, 2 * rows), np.inf)
    np.minimum.at(nearest, (np.clip(row, 0, rows - 1), column), distance)
    row = np.clip(row, 0, rows - 1)
    towards_horizon = np.where(2 * row < rows, row + 1, row - 1)
    least = np.maximum(nearest[row, column], nearest[towards_horizon, column])
    return np.mean(distance > factor * least + extra)


def test_shares_are_numpys_in_any_blocks():
    rng = np.random.default_rng(3)
    points, places = rng.uniform(-9, 9, (4000, 3)), rng.uniform(-9, 9, (11, 3))
    out = np.empty(11)
    for start in range(0, 11, 4):
        hidden_shares(points, places, 60, 1.15, 0.5, start, min(start + 4, 11), out)
    wanted = [hidden_by_numpy(points, place, 60, 1.15, 0.5) for place in places]
    # A direction on the border of a cell may be rounded to either side.
    np.testing.assert_allclose(out, wanted, atol=2.0 / len(points))
    assert 0.05 < out.min() < out.max() < 0.95


def test_level_ground_hides_nothing_and_a_wall_hides_what_is_behind_it():
    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform(-30, 30, (8000, 2)), np.full(8000, -1.6)])
    y, z = rng.uniform(-6, 6, 40_000), rng.uniform(-1.6, 3, 40_000)
    wall = np.column_stack([np.full(40_000, 4.0), y, z])
    out = np.empty(1)
    hidden_shares(ground, np.zeros((1, 3)), 90, 1.15, 0.5, 0, 1, out)
    assert out[0] < 0.005
    hidden_shares(np.vstack([ground, wall]), np.zeros((1, 3)), 90, 1.15, 0.5, 0, 1, out)
    is_behind = (ground[:, 0] > 5.0) & (np.abs(ground[:, 1]) < 1.4 * ground[:, 0])
    assert out[0] * 48_000 > 0.9 * is_behind.sum()
    assert out[0] * 48_000 < 1.1 * is_behind.sum()


def test_a_sphere_hides_nothing_from_its_middle_and_a_place_may_be_a_point():
    rng = np.random.default_rng(4)
    sphere = rng.normal(size=(2000, 3))
    sphere *= 5.0 / np.linalg.norm(sphere, axis=1, keepdims=True)
    out = np.empty(2)
    hidden_shares(sphere, np.array([[0.0, 0.0, 0.0], sphere[0]]), 60, 1.15, 0.5, 0, 2, out)
    assert out[0] == 0.0
    assert np.isfinite(out[1])
