"""The ray kernel against its slow twin, and its promises about ties, order and threads."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong import threads
from dougong.errors import InputError
from dougong.evaluation.mesh import Mesh, Tracer, join
from reference import rays as reference


def soup(rng, count):
    corners = rng.normal(size=(count, 1, 3)) + 0.6 * rng.normal(size=(count, 3, 3))
    return Mesh.of(corners.reshape(-1, 3), np.arange(3 * count))


def some_rays(rng, count):
    origins = 3 * rng.normal(size=(count, 3))
    return origins, rng.normal(size=(count, 3)) - 0.5 * origins


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 60))
def test_agrees_with_every_pair_tried(seed, count):
    rng = np.random.default_rng(seed)
    mesh = soup(rng, count)
    origins, directions = some_rays(rng, 40)
    reach = rng.uniform(0.2, 4.0, 40)
    distance, face = Tracer(mesh).cast(origins, directions, reach)
    expected, expected_face = reference.cast(
        mesh.corners(), np.hstack([origins, directions]), reach
    )
    np.testing.assert_allclose(distance, expected, rtol=1e-9)
    np.testing.assert_array_equal(face, expected_face)


def test_any_hit_agrees_with_nearest_hit():
    rng = np.random.default_rng(4)
    tracer = Tracer(soup(rng, 300))
    start, stop = 3 * rng.normal(size=(2, 500, 3))
    length = np.linalg.norm(stop - start, axis=1)
    distance, _ = tracer.cast(start, (stop - start) / length[:, None], length - 2e-3)
    np.testing.assert_array_equal(tracer.is_clear(start, stop), np.isinf(distance))


def test_of_equal_triangles_the_first_wins():
    one = soup(np.random.default_rng(0), 1)
    tracer = Tracer(join([one] * 9))
    middle = one.vertices.mean(axis=0)
    _, face = tracer.cast(middle - (0, 0, 5.0), np.array([[0, 0, 1.0]]))
    assert face[0] == 0


def test_meshes_behind_one_another_equal_one_mesh():
    rng = np.random.default_rng(7)
    first, second = soup(rng, 200), soup(rng, 90)
    origins, directions = some_rays(rng, 2000)
    apart = Tracer(first).together_with(second).cast(origins, directions)
    whole = Tracer(join([first, second])).cast(origins, directions)
    np.testing.assert_array_equal(apart[0], whole[0])
    np.testing.assert_array_equal(apart[1], whole[1])


def test_axis_parallel_rays_and_flat_meshes():
    # Zero components of a direction, and boxes without thickness.
    square = Mesh.of([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)])
    origins = np.array([(0.3, 0.2, 5.0), (0.3, 0.2, -5.0), (2.0, 0.2, 5.0), (0.3, 0.2, 0.5)])
    directions = np.array([(0, 0, -1.0), (0, 0, 1.0), (0, 0, -1.0), (1.0, 0, 0)])
    distance, face = Tracer(square).cast(origins, directions)
    np.testing.assert_allclose(distance, [5.0, 5.0, np.inf, np.inf])
    np.testing.assert_array_equal(face, [0, 0, -1, -1])


def test_threads_change_nothing():
    rng = np.random.default_rng(1)
    tracer = Tracer(soup(rng, 500))
    origins, directions = some_rays(rng, 150_000)
    before = threads.get_threads()
    answers = []
    for count in (1, 3):
        threads.set_threads(count)
        answers.append(tracer.cast(origins, directions))
    threads.set_threads(before)
    for one, three in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, three)


def test_many_triangles_on_one_spot_do_not_break_the_tree():
    rng = np.random.default_rng(2)
    tracer = Tracer(join([soup(rng, 1)] * 2000))
    distance, _ = tracer.cast(np.full((1, 3), 9.0), -np.ones((1, 3)))
    assert distance.shape == (1,)


def test_an_empty_mesh_is_refused():
    with pytest.raises(InputError, match="no face"):
        Tracer(join([]))
