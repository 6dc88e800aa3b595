"""A lopsided object and a square bar, sampled by area."""

import numpy as np
from scipy.spatial.transform import Rotation


def box(rng, low, high, count):
    """Return points on the surface of a box."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    size = high - low
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=area / area.sum())
    points = low + rng.random((count, 3)) * size
    side = rng.integers(0, 2, count)
    points[np.arange(count), axis] = np.where(side, high[axis], low[axis])
    return points


def chair(seed, count=900):
    """Return a chair with one arm: no symmetry."""
    rng = np.random.default_rng(seed)
    parts = [
        box(rng, (-0.5, -0.5, 0.0), (0.5, 0.5, 0.1), count * 4 // 10),
        box(rng, (-0.5, 0.4, 0.1), (0.5, 0.5, 1.0), count * 4 // 10),
        box(rng, (0.4, -0.4, 0.1), (0.5, 0.4, 0.4), count - 2 * (count * 4 // 10)),
    ]
    return np.vstack(parts)


def bar(seed, count=900):
    """Return a square bar: 8 proper symmetries."""
    return box(np.random.default_rng(seed), (-0.3, -0.3, -0.9), (0.3, 0.3, 0.9), count)


def motion(seed):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).uniform(-2, 2, 3)
    return T


def moved(points, T):
    return points @ T[:3, :3].T + T[:3, 3]


def errors(found, truth, at):
    """Return (degrees, distance at the points' middle) between two poses."""
    turn = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).magnitude()
    middle = at.mean(axis=0)[None]
    return np.degrees(turn), float(np.linalg.norm(moved(middle, found) - moved(middle, truth)))
