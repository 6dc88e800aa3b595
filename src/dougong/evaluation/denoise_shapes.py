"""Shapes that a noise filter must not harm: brackets, tiles, rods, inscriptions, statues, a tree.

Each is a mesh in metres, z up, seen from a scanner in front of it (towards -y), with the truth
labels of `mesh`: 0 plain surface, 1 fine geometry, 3 vegetation.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation import facade
from dougong.evaluation.mesh import FINE, SURFACE, VEGETATION, Mesh, join
from dougong.evaluation.solids import block, lathe, pipe

Rng = np.random.Generator


class Shape(NamedTuple):
    """A test piece and where it is scanned from."""

    mesh: Mesh
    stations: NDArray[np.float64]
    """(k, 3) metres."""


def mesh_of_facade() -> Mesh:
    """Return the bracketed facade of `facade` as triangles."""
    faces = facade._faces()
    corners = np.array(
        [[f.corner, f.corner + f.along, f.corner + f.along + f.across, f.corner + f.across]
         for f in faces]
    )  # fmt: skip
    quads = np.arange(4 * len(faces)).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    labels = np.tile(np.array([f.label for f in faces], np.uint8), 2)
    plain = Mesh.of(corners.reshape(-1, 3), triangles)
    return Mesh(plain.vertices, plain.faces, labels, plain.materials)


def _height_field(x: NDArray[np.float64], z: NDArray[np.float64], out_m: NDArray[np.float64],
                  is_fine: NDArray[np.bool_]) -> Mesh:  # fmt: skip
    """Return a wall over the lines x (n,) and z (m,), standing out by out_m (n, m) towards -y."""
    grid_x, grid_z = np.meshgrid(x, z, indexing="ij")
    vertices = np.stack([grid_x, -out_m, grid_z], axis=-1).reshape(-1, 3)
    at = np.arange(len(vertices)).reshape(out_m.shape)
    a, b, c, d = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    fine = is_fine[:-1, :-1] | is_fine[1:, :-1] | is_fine[1:, 1:] | is_fine[:-1, 1:]
    plain = Mesh.of(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    labels = np.tile(np.where(fine.ravel(), FINE, SURFACE).astype(np.uint8), 2)
    return Mesh(plain.vertices, plain.faces, labels, plain.materials)


def bracketed_facade(_: Rng) -> Shape:
    """Return a facade of 12 x 4.5 m with bracket sets, rafters and an eave."""
    return Shape(mesh_of_facade(), np.array([[3.0, -7.0, 1.6], [9.5, -9.0, 1.6]]))


def roof_tiles(rng: Rng) -> Shape:
    """Return a roof slope of round tiles over pans, with a ridge, its beasts and a thin finial."""
    x, up = np.arange(0.0, 3.0, 0.01), np.arange(0.0, 2.0, 0.02)
    across = np.abs((x / 0.24) % 1.0 - 0.5) * 0.24
    tube = np.sqrt(np.maximum(0.055**2 - across**2, 0.0))
    lip = 0.012 * ((up / 0.30) % 1.0)
    out = tube[:, None] + lip[None]
    slope = _height_field(x, up, out, np.broadcast_to(tube[:, None] > 0, out.shape))
    turn = np.radians(60.0)
    y, z = slope.vertices[:, 1].copy(), slope.vertices[:, 2].copy()
    slope.vertices[:, 1] = y * np.cos(turn) + z * np.sin(turn)
    slope.vertices[:, 2] = 2.0 - y * np.sin(turn) + z * np.cos(turn)
    top = slope.vertices[:, 1:].max(axis=0)
    parts = [slope, block((1.5, top[0], top[1] - 0.05), (3.0, 0.16, 0.2))]
    for at in (0.4, 0.9, 1.4):
        parts.append(_beast(rng).turned(0.0, (at, top[0], top[1] + 0.15)))
    spike = lathe([(0.05, 0), (0.02, 0.1), (0.045, 0.2), (0.006, 0.3), (0.004, 0.6)], 10)
    parts.append(spike.labelled(FINE).turned(0.0, (2.5, top[0], top[1] + 0.15)))
    return Shape(join(parts), np.array([[1.0, -6.0, 4.5], [3.5, -5.0, 5.0]]))


def _blob(centre: tuple[float, float, float], size: tuple[float, float, float], rng: Rng) -> Mesh:
    """Return a smooth lump: an ellipsoid with gentle waves."""
    polar, turn = np.linspace(0.02, np.pi - 0.02, 24), np.linspace(0, 2 * np.pi, 36, endpoint=False)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    k = rng.integers(2, 5, 2)
    wave = 1 + 0.06 * np.sin(k[0] * t + 1) * np.sin(p) ** 2 + 0.06 * np.cos((k[1] + 1) * p)
    unit = np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], axis=-1)
    vertices = (unit * wave[..., None] * size + centre).reshape(-1, 3)
    at = np.arange(p.size).reshape(p.shape)
    after = np.roll(at, -1, axis=1)
    quads = np.stack([at[:-1], at[1:], after[1:], after[:-1]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh.of(vertices, faces, "stone", FINE)


def _beast(rng: Rng) -> Mesh:
    """Return a ridge beast about 30 cm tall: body, head and a tail 1 cm thick."""
    tail = pipe([(0.09, 0, 0.08), (0.14, 0, 0.18), (0.12, 0, 0.30)], (0.012, 0.012), label=FINE)
    body = _blob((0, 0, 0.10), (0.10, 0.05, 0.10), rng)
    return join([body, _blob((-0.08, 0, 0.22), (0.05, 0.04, 0.06), rng), tail])


def rods(_: Rng) -> Shape:
    """Return a wall with a lattice, a railing of thin rods and a wire before it."""
    parts = [block((1.5, 0.1, 0), (3.0, 0.2, 2.2))]
    for at in np.arange(0.2, 2.9, 0.12):
        parts.append(block((at, -0.45, 0), (0.016, 0.016, 1.0), label=FINE))
    parts.append(block((1.5, -0.45, 1.0), (2.8, 0.05, 0.04), label=FINE))
    for at in np.arange(0.4, 1.4, 0.1):
        parts.append(block((at, -0.04, 1.3), (0.02, 0.02, 0.8), label=FINE))
        parts.append(block((0.9, -0.04, at + 0.9), (1.1, 0.02, 0.02), label=FINE))
    x = np.linspace(0, 3, 25)
    sag = 1.9 - 0.1 * np.sin(np.pi * x / 3)
    wire = np.stack([x, np.full_like(x, -0.8), sag], axis=1)
    parts.append(pipe(wire, (0.008, 0.008), label=FINE))
    return Shape(join(parts), np.array([[0.8, -5.0, 1.6], [2.5, -6.0, 1.6]]))


def inscription(rng: Rng) -> Shape:
    """Return a stele of 1 x 1 m with strokes cut 2 to 5 mm deep."""
    lines = np.arange(0.0, 1.0001, 0.004)
    x, z = np.meshgrid(lines, lines, indexing="ij")
    out, is_fine = np.zeros_like(x), np.zeros(x.shape, bool)
    for row in np.arange(0.12, 0.95, 0.13):
        for column in np.arange(0.12, 0.95, 0.13):
            for _ in range(4):
                centre = rng.uniform(-0.03, 0.03, 2) + (column, row)
                angle, length = rng.choice([0, 90, 45, 135]), rng.uniform(0.02, 0.045)
                c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
                along = c * (x - centre[0]) + s * (z - centre[1])
                across = -s * (x - centre[0]) + c * (z - centre[1])
                is_in = (np.abs(along) < length) & (np.abs(across) < 0.007)
                out[is_in] = -rng.uniform(0.002, 0.005)
                is_fine |= is_in
    slab = _height_field(lines, lines, out, is_fine)
    return Shape(slab, np.array([[0.2, -3.0, 1.0], [0.9, -3.5, 1.2]]))


def statue(rng: Rng) -> Shape:
    """Return a figure of smooth lumps on a plinth, a staff in its hand, before a plain wall."""
    parts = [
        block((0, 0.6, 0), (2.0, 0.1, 2.2)),
        block((0, 0, 0), (0.6, 0.5, 0.4)),
        _blob((0, 0, 0.75), (0.22, 0.16, 0.38), rng),
        _blob((0, 0, 1.28), (0.11, 0.11, 0.14), rng),
        _blob((0.26, -0.05, 0.95), (0.07, 0.07, 0.22), rng),
        _blob((-0.26, -0.05, 0.95), (0.07, 0.07, 0.22), rng),
        block((0.33, -0.12, 0.4), (0.02, 0.02, 1.2), label=FINE),
    ]
    return Shape(join(parts), np.array([[-1.5, -4.0, 1.4], [2.0, -4.5, 1.4]]))


def tree_by_wall(rng: Rng) -> Shape:
    """Return a wall with a cornice and a tree's canopy of loose leaves half a metre before it."""
    parts = [
        block((2.0, 0.1, 0), (4.0, 0.2, 3.0)),
        block((2.0, -0.05, 2.7), (4.0, 0.1, 0.06), label=FINE),
        block((2.0, -0.08, 2.8), (4.0, 0.16, 0.06), label=FINE),
    ]
    for at in np.arange(0.1, 4.0, 0.2):
        parts.append(block((at, -0.10, 2.60), (0.08, 0.2, 0.10), label=FINE))
    leaves = 900
    centre = rng.normal(size=(leaves, 3))
    centre *= (rng.random((leaves, 1)) ** (1 / 3)) / np.linalg.norm(centre, axis=1, keepdims=True)
    centre = centre * (0.8, 0.6, 0.7) + (1.2, -1.1, 1.8)
    corners = centre[:, None] + rng.normal(0, 0.035, (leaves, 3, 3))
    faces = np.arange(3 * leaves).reshape(-1, 3)
    parts.append(Mesh.of(corners.reshape(-1, 3), faces, "leaf", VEGETATION))
    parts.append(block((1.2, -1.1, 0), (0.12, 0.12, 1.9), "bark", VEGETATION))
    return Shape(join(parts), np.array([[3.0, -6.0, 1.6], [0.0, -7.0, 1.6]]))


SHAPES: dict[str, Callable[[Rng], Shape]] = {
    "facade": bracketed_facade,
    "tiles": roof_tiles,
    "rods": rods,
    "inscription": inscription,
    "statue": statue,
    "tree": tree_by_wall,
}
"""Every test piece by its name."""
