"""The generated buildings as solids, and the meshes that are read from files."""

import gzip

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dougong.errors import FormatError
from dougong.evaluation import scenes, solids
from dougong.evaluation.mesh import FINE, Mesh, Tracer, join, load_mesh
from dougong.evaluation.survey import stream

KINDS = sorted(scenes.BUILDERS)


def build(kind, seed=0, **kwargs):
    return scenes.BUILDERS[kind](stream(seed, kind), **kwargs)


@pytest.mark.parametrize("kind", KINDS)
def test_every_building_is_made_of_closed_solids(kind):
    mesh = build(kind).mesh
    assert solids.is_closed(mesh)
    assert np.isfinite(mesh.vertices).all()
    assert (mesh.labels == FINE).mean() > 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_eaves_have_an_underside(kind):
    """A ray from the ground up under an eave meets wood or tile from below, then tile on top."""
    building = build(kind)
    tracer = Tracer(building.mesh)
    top = np.flatnonzero(building.mesh.materials == list(scenes_materials()).index("tile"))
    upward = top[tracer.normals[top, 2] > 0.3]
    spots = building.mesh.corners()[upward].mean(axis=1)[:: max(1, len(upward) // 400)]
    down, _ = tracer.cast(spots + (0, 0, 1e-4), np.broadcast_to((0, 0, -1.0), spots.shape))
    # Through the roof from outside in: thickness between the two skins.
    through, face = tracer.cast(spots - (0, 0, 1e-4), np.broadcast_to((0, 0, -1.0), spots.shape))
    assert (down < 1e-2).all()
    hit = face >= 0
    assert hit.mean() > 0.99
    assert np.median(through[hit]) > 0.1


def scenes_materials():
    from dougong.evaluation.mesh import MATERIALS

    return MATERIALS


@pytest.mark.parametrize("kind", KINDS)
def test_stations_stand_in_the_open_on_the_ground(kind):
    for seed in (1,):
        world, tracer = scenes._world(kind, seed, True)
        down = np.broadcast_to((0, 0, -1.0), world.stations.shape)
        below, _ = tracer.cast(world.stations, down)
        assert ((below > 1.3) & (below < 2.1)).all(), (kind, seed, below)
        for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
            side = np.array([np.cos(angle), np.sin(angle), 0.0])
            distance, _ = tracer.cast(world.stations, np.broadcast_to(side, world.stations.shape))
            assert (distance > 0.25).all(), (kind, seed, distance)


@pytest.mark.parametrize(
    ("kind", "turn"), [("hall", 180), ("pagoda", 90), ("tulou", 90), ("wall", 180)]
)
def test_without_a_site_the_building_repeats_itself(kind, turn):
    mesh = scenes._world(kind, 3, False)[0].static
    points, _ = mesh.samples(2000, np.random.default_rng(0))
    turned = Tracer(mesh.turned(turn))
    # Every sampled point lies on the turned mesh: it is met along some axis within 0.1 mm.
    on = np.zeros(len(points), dtype=bool)
    for axis in np.vstack([np.eye(3), np.ones((1, 3)) / np.sqrt(3)]):
        start = points - 0.005 * axis
        distance, _ = turned.cast(start, np.broadcast_to(axis, points.shape))
        on |= np.abs(distance - 0.005) < 1e-4
    assert on.mean() > 0.95


@pytest.mark.parametrize(("kind", "turn"), [("hall", 180), ("pagoda", 90), ("tulou", 90)])
def test_the_site_breaks_the_symmetry(kind, turn):
    mesh = scenes._world(kind, 3, True)[0].static
    still = mesh.vertices[np.unique(mesh.faces[mesh.labels < 2])]
    turned = mesh.turned(turn).vertices
    distance, _ = cKDTree(turned).query(still[::7])
    assert (distance > 0.5).mean() > 0.02


@pytest.mark.parametrize(
    "solid",
    [
        solids.box((0, 0, 0), (1, 2, 3)),
        solids.lathe([(1, 0), (0.5, 2)], 7),
        solids.beam((0, 0, 0), (1, 1, 1), (0.1, 0.2)),
        solids.beam((0, 0, 0), (0, 0, 1), (0.1, 0.2)),
        solids.pipe([(0, 0, 0), (1, 0, 0.2), (2, 0.5, 0)], (0.3, 0.4)),
        solids.ball((1, 2, 3), (1, 2, 0.5)),
        solids.extruded(
            [(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)], -1.0, 1.0
        ),
        solids.ring(
            lambda a: np.broadcast_to([(1.0, 0), (2, 0), (2, 1), (1, 1)], (len(a), 4, 2)),
            np.linspace(0, 2 * np.pi, 12),
        ),
        solids.ring(
            lambda a: np.broadcast_to([(1.0, 0), (2, 0), (2, 1), (1, 1)], (len(a), 4, 2)),
            np.linspace(0, 2, 12),
        ),
    ],
    ids=str,
)
def test_solids_are_closed_and_turned_outwards(solid):
    assert solids.is_closed(solid)
    a, b, c = np.moveaxis(solid.corners(), 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_a_box_without_a_lid_is_not_closed():
    box = solids.box((0, 0, 0), (1, 1, 1))
    assert not solids.is_closed(
        Mesh(box.vertices, box.faces[2:], box.labels[2:], box.materials[2:])
    )


def test_samples_are_uniform_by_area():
    big, small = solids.box((0, 0, 0), (2, 2, 2)), solids.box((9, 0, 0), (10, 1, 1))
    points, _ = join([big, small]).samples(20_000, np.random.default_rng(0))
    assert (points[:, 0] > 5).mean() == pytest.approx(6 / 30, abs=0.005)


def test_load_obj_with_polygons_and_negative_indices(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\nf -1/1 -4//2 -3\n"
    path = tmp_path / "a.obj.gz"
    path.write_bytes(gzip.compress(text.encode()))
    vertices, faces = load_mesh(path)
    assert len(vertices) == 5
    assert {tuple(sorted(face)) for face in faces.tolist()} == {(0, 1, 2), (0, 2, 3), (1, 2, 4)}
    raised, _ = load_mesh(path, is_y_up=True)
    np.testing.assert_array_equal(raised[2], [1, 0, 1])


@pytest.mark.parametrize("polygon", [False, True])
def test_load_ply(tmp_path, polygon):
    faces = "4 0 1 2 3\n3 0 1 4\n" if polygon else "3 0 1 2\n3 0 1 4\n"
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n" + faces
    )
    _, found = load_mesh(path)
    assert len(found) == (3 if polygon else 2)


def test_a_cloud_is_not_a_mesh(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\n")
    with pytest.raises(FormatError, match="no faces"):
        load_mesh(path)
    with pytest.raises(FormatError, match="not a mesh"):
        load_mesh(tmp_path / "a.stl")
