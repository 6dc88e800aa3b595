"""Which way surfaces face, and the faces of a building with their names and sizes."""

import numpy as np
import pytest

from dougong.registration.faces import find_faces
from dougong.registration.outward import outward


def grid(u, v, step=0.15):
    a, b = np.meshgrid(np.arange(0, u, step), np.arange(0, v, step))
    return a.ravel(), b.ravel()


def house(width=12.0, depth=8.0, height=4.0, eave=1.5):
    """A house with a flat roof that hangs over: points, unsigned normals, and what they are."""
    parts = []

    def add(points, normal, what):
        parts.append((points, np.tile(normal, (len(points), 1)), what))

    a, z = grid(width, height)
    add(np.column_stack([a, np.full(len(a), depth), z]), [0.0, -1.0, 0.0], "north")
    add(np.column_stack([a, np.zeros(len(a)), z]), [0.0, -1.0, 0.0], "south")
    a, z = grid(depth, height)
    add(np.column_stack([np.full(len(a), width), a, z]), [-1.0, 0.0, 0.0], "east")
    add(np.column_stack([np.zeros(len(a)), a, z]), [1.0, 0.0, 0.0], "west")
    a, b = grid(width + 2 * eave, depth + 2 * eave)
    roof = np.column_stack([a - eave, b - eave, np.full(len(a), height + 0.1)])
    add(roof, [0.0, 0.0, -1.0], "roof")
    a, b = grid(50.0, 50.0, 0.4)
    ground = np.column_stack([a - 19.0, b - 21.0, np.zeros(len(a))])
    site = np.concatenate([part[0] for part in parts] + [ground])
    points = np.concatenate([part[0] for part in parts])
    normals = np.concatenate([part[1] for part in parts])
    what = np.concatenate([np.full(len(part[0]), part[2]) for part in parts])
    order = np.lexsort(points.T[::-1])
    return points[order], normals[order], what[order], site


def test_walls_face_away_from_the_house_though_eaves_hang_over_them():
    points, normals, what, site = house()
    turned, is_known = outward(points, normals, site)
    expected = {"north": [0, 1, 0], "south": [0, -1, 0], "east": [1, 0, 0], "west": [-1, 0, 0],
                "roof": [0, 0, 1]}  # fmt: skip
    for name, direction in expected.items():
        here = what == name
        assert is_known[here].mean() > 0.95, name
        assert (turned[here] @ direction > 0.99).mean() > 0.95, name


def test_a_free_standing_wall_has_no_open_side_and_is_said_so():
    a, z = grid(6.0, 3.0)
    wall = np.column_stack([a, np.zeros(len(a)), z])
    ground = np.column_stack([*(g - 10.0 for g in grid(25.0, 20.0, 0.4)), np.zeros(63 * 50)])
    normals = np.tile([0.0, -1.0, 0.0], (len(wall), 1))
    turned, is_known = outward(wall, normals, np.vstack([wall, ground]))
    assert not is_known.any()
    assert (turned[:, 1] > 0.99).all()
    faces = find_faces(wall, turned, is_known, 0.15)
    assert [face.name for face in faces] == ["wall facing north or south"]
    assert not faces[0].is_directed


def test_faces_have_their_names_sizes_and_members():
    points, normals, what, site = house()
    turned, is_known = outward(points, normals, site)
    faces = find_faces(points, turned, is_known, 0.15)
    named = {face.name: face for face in faces}
    assert set(named) == {
        "north facade", "south facade", "east facade", "west facade", "level surface 3.9 m up",
    }  # fmt: skip
    north = named["north facade"]
    assert north.kind == "wall"
    assert north.width_m == pytest.approx(12.0, abs=0.4)
    assert north.height_m == pytest.approx(4.0, abs=0.4)
    assert north.area_m2 == pytest.approx(48.0, rel=0.1)
    assert (what[north.members] == "north").mean() > 0.98
    np.testing.assert_allclose(north.normal, [0, 1, 0], atol=0.02)
    by_axes = find_faces(points, turned, is_known, 0.15, has_compass=False)
    assert "+y facade" in {face.name for face in by_axes}


def test_a_round_wall_is_cut_at_the_compass_and_a_gate_does_not_cut_a_facade():
    turn, z = grid(2 * np.pi * 15.0, 5.0, 0.2)
    angle = turn / 15.0
    radial = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    ring = 15.0 * radial + np.column_stack([np.zeros((len(z), 2)), z])
    order = np.lexsort(ring.T[::-1])
    faces = find_faces(ring[order], radial[order], np.ones(len(ring), bool), 0.2)
    assert len(faces) == 8
    assert {face.name for face in faces} >= {"north facade", "south-west facade"}
    assert sum(face.area_m2 for face in faces) == pytest.approx(2 * np.pi * 15 * 5, rel=0.12)
    a, z = grid(20.0, 4.0)
    wall = np.column_stack([a, np.zeros(len(a)), z])
    wall = wall[(a < 8.0) | (a > 12.0)]
    wall = wall[np.lexsort(wall.T[::-1])]
    normals = np.tile([0.0, 1.0, 0.0], (len(wall), 1))
    one = find_faces(wall, normals, np.ones(len(wall), bool), 0.15)
    assert [face.name for face in one] == ["north facade"]
    assert one[0].width_m == pytest.approx(20.0, abs=0.6)


def test_leaves_and_few_points_are_no_face():
    rng = np.random.default_rng(0)
    cloud = rng.uniform(0, 5, (3000, 3))
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert find_faces(cloud, normals, np.ones(3000, bool), 0.2) == []
    assert find_faces(cloud[:5], normals[:5], np.ones(5, bool), 0.2) == []
