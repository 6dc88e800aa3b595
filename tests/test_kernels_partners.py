"""Which points meet under a pose: the kernels give what NumPy gives, step by step."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dougong.filters.neighbourhood import build_index
from dougong.kernels import partners

COSINE = 0.7


def side(rng, count):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flags = rng.random((3, count)) < 0.3
    return partners.Side(rng.uniform(-2, 2, (count, 3)), normals, *flags)


def tree_of(points):
    index = build_index(points)
    return partners.Tree(index.points, index.boxes, index.order)


@pytest.fixture
def pair():
    rng = np.random.default_rng(5)
    source, target = side(rng, 700), side(rng, 900)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [40.0, 5.0, -3.0], degrees=True).as_matrix()
    T[:3, 3] = 0.3, -0.1, 0.2
    return source, target, T


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def found_by_numpy(source, asked, target, T, limit, cosine):
    """The partner (m,) of every asked point, -1 for none."""
    distance, place = cKDTree(target.xyz).query(moved(T, source.xyz[asked]))
    is_near = distance <= limit
    dot = np.einsum("ij,ij->i", source.normals[asked] @ T[:3, :3].T, target.normals[place])
    is_sure = source.is_oriented[asked] & target.is_oriented[place]
    is_alike = np.where(is_sure, dot, np.abs(dot)) > cosine
    is_slab = source.may_be_underside[asked] & target.is_top[place]
    is_slab |= target.may_be_underside[place] & source.is_top[asked]
    return np.where(is_near & is_alike & ~is_slab, place, -1)


def find(source, asked, target, T, limit):
    out = np.empty(len(asked), np.int64)
    tree = tree_of(target.xyz)
    for start in range(0, len(asked), 100):
        stop = min(start + 100, len(asked))
        partners.find(source, asked, target, tree, T, limit**2, COSINE, start, stop, out)
    return out


def test_partners_are_those_of_a_search_and_three_questions(pair):
    source, target, T = pair
    asked = np.arange(0, 700, 3)
    out = find(source, asked, target, T, 0.4)
    wanted = found_by_numpy(source, asked, target, T, 0.4, COSINE)
    np.testing.assert_array_equal(out, wanted)
    assert 10 < (out >= 0).sum() < len(asked)


def test_pairs_are_described_as_by_numpy(pair):
    source, target, T = pair
    asked = np.arange(700)
    to = find(source, asked, target, T, 0.4)
    s, t = asked[to >= 0], to[to >= 0]
    points, normals, offsets = (np.empty((len(s), 3)) for _ in range(3))
    residuals = np.empty(len(s))
    partners.describe(source, target, T, s, t, 4.0, 1.0, points, normals, offsets, residuals)
    a, b = source.normals[s] @ T[:3, :3].T, target.normals[t]
    sign = np.where(np.einsum("ij,ij->i", a, b) < 0.0, -1.0, 1.0)
    mean = 4.0 * a + sign[:, None] * b
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    np.testing.assert_allclose(points, moved(T, source.xyz[s]), atol=1e-12)
    np.testing.assert_allclose(offsets, points - target.xyz[t], atol=1e-12)
    np.testing.assert_allclose(normals, mean, atol=1e-12)
    np.testing.assert_allclose(residuals, np.einsum("ij,ij->i", mean, offsets), atol=1e-12)


def test_closeness_is_the_mean_of_what_numpy_finds(pair):
    source, target, T = pair
    moves = np.stack([np.eye(4), T, T @ T])
    out = np.empty(3)
    partners.closeness(
        source.xyz, source.normals, moves, tree_of(target.xyz), target.normals, 0.5, COSINE, 0, 3,
        out,
    )  # fmt: skip
    for move, score in zip(moves, out, strict=True):
        distance, place = cKDTree(target.xyz).query(moved(move, source.xyz))
        dot = np.einsum("ij,ij->i", source.normals @ move[:3, :3].T, target.normals[place])
        near = np.clip(1.0 - distance / 0.5, 0.0, None) * (np.abs(dot) > COSINE)
        assert score == pytest.approx(near.mean(), abs=1e-12)
        assert score > 0.01


def test_no_move_is_scored_beyond_the_reach(pair):
    source, target, T = pair
    far = T.copy()
    far[:3, 3] += 100.0
    out = np.empty(1)
    partners.closeness(
        source.xyz, source.normals, far[None], tree_of(target.xyz), target.normals, 0.5, COSINE,
        0, 1, out,
    )  # fmt: skip
    assert out[0] == 0.0
    assert (find(source, np.arange(700), target, far, 0.4) == -1).all()
