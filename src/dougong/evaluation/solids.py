"""Closed solids to build with: every one has an inside, an outside and a thickness."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong.evaluation.mesh import SURFACE, Mesh, join

Floats = NDArray[np.float64]


def _closed(vertices: ArrayLike, faces: ArrayLike, paint: str, label: int) -> Mesh:
    """Return a closed mesh turned so that its volume is positive."""
    mesh = Mesh.of(vertices, faces, paint, label)
    a, b, c = np.moveaxis(mesh.corners() - mesh.vertices.mean(axis=0), 1, 0)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        mesh.faces[:] = mesh.faces[:, ::-1].copy()
    return mesh


def skin(rings: Floats, paint: str = "stone", label: int = SURFACE) -> Mesh:
    """Return the solid between closed rings (k, n, 3) stacked on one another, ends closed.

    The end faces are fans about their centres, so a ring may be any star-shaped polygon.
    """
    count, sides = rings.shape[:2]
    at = np.arange(count * sides).reshape(count, sides)
    after = np.roll(at, -1, axis=1)
    quads = np.stack([at[:-1], after[:-1], after[1:], at[1:]], axis=-1).reshape(-1, 4)
    low, high = count * sides, count * sides + 1
    ends = [
        np.stack([after[0], at[0], np.full(sides, low)], axis=1),
        np.stack([at[-1], after[-1], np.full(sides, high)], axis=1),
    ]
    vertices = np.concatenate(
        [rings.reshape(-1, 3), rings[0].mean(axis=0)[None], rings[-1].mean(axis=0)[None]]
    )
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], *ends])
    return _closed(vertices, faces, paint, label)


def box(low: Sequence[float], high: Sequence[float], paint: str = "stone", label: int = 0) -> Mesh:
    """Return an axis-aligned box."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    plan = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=np.float64)
    corners = [(*xy, z) for z in (z0, z1) for xy in plan]
    quads = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return Mesh.of(corners, faces, paint, label)


def block(
    centre: Sequence[float], size: Sequence[float], paint: str = "stone", label: int = 0
) -> Mesh:
    """Return a box standing on `centre` (its foot) with the given x, y, z sizes."""
    x, y, z = centre
    a, b, c = size
    return box((x - a / 2, y - b / 2, z), (x + a / 2, y + b / 2, z + c), paint, label)


def lathe(
    profile: ArrayLike, sides: int, paint: str = "stone", label: int = 0, turn_deg: float = 0.0
) -> Mesh:
    """Return a solid of revolution from its profile (k, 2) of radius and height, ends closed."""
    radius, height = np.asarray(profile, dtype=np.float64).T
    angle = np.radians(turn_deg) + 2 * np.pi * np.arange(sides) / sides
    rings = np.empty((len(radius), sides, 3))
    rings[..., 0] = radius[:, None] * np.cos(angle)
    rings[..., 1] = radius[:, None] * np.sin(angle)
    rings[..., 2] = height[:, None]
    return skin(rings, paint, label)


def beam(
    start: Sequence[float],
    stop: Sequence[float],
    size: tuple[float, float],
    paint: str = "timber",
    label: int = 0,
) -> Mesh:
    """Return a bar between two points; `size` is its width (level) and its height."""
    a, b = np.asarray(start, np.float64), np.asarray(stop, np.float64)
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross([0.0, 0.0, 1.0], along)
    if np.linalg.norm(side) < 1e-6:
        side = np.array([1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(along, side)
    w, h = size[0] / 2, size[1] / 2
    section = np.array(
        [-w * side - h * up, w * side - h * up, w * side + h * up, -w * side + h * up]
    )
    return skin(np.stack([a + section, b + section]), paint, label)


def pipe(path: ArrayLike, size: tuple[float, float], paint: str = "tile", label: int = 0) -> Mesh:
    """Return a bar of rectangular section whose foot follows a path (k, 3)."""
    line = np.asarray(path, dtype=np.float64)
    along = np.gradient(line, axis=0)
    side = np.cross([0.0, 0.0, 1.0], along)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    w, h = side * size[0] / 2, np.array([0.0, 0.0, size[1]])
    rings = np.stack([line - w, line + w, line + w * 0.8 + h, line - w * 0.8 + h], axis=1)
    return skin(rings, paint, label)


def sheet(top: Floats, bottom: Floats, paint: str = "tile", label: int = 0) -> Mesh:
    """Return the solid between two grids (k, n, 3) of equal shape, its rim closed."""
    k, n = top.shape[:2]
    at = np.arange(k * n).reshape(k, n)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    rim = np.concatenate([at[0, :-1], at[:-1, -1], at[-1, :0:-1], at[:0:-1, 0]])
    after = np.roll(rim, -1)
    low = k * n
    sides = np.stack([rim, after, after + low, rim + low], axis=-1)
    # The top is wound against its rim, so that every edge runs once each way.
    every = np.concatenate([quads[:, ::-1], quads + low, sides[:, ::-1]])
    every[: len(quads)] = quads
    every[len(quads) : 2 * len(quads)] = quads[:, ::-1] + low
    every[2 * len(quads) :] = sides
    faces = np.concatenate([every[:, [0, 1, 2]], every[:, [0, 2, 3]]])
    return _closed(np.concatenate([top.reshape(-1, 3), bottom.reshape(-1, 3)]), faces, paint, label)


def mound(top: Floats, apex: Sequence[float], paint: str = "rock", label: int = 0) -> Mesh:
    """Return the solid under a grid (k, n, 3) whose rim runs down to one point inside."""
    k, n = top.shape[:2]
    at = np.arange(k * n).reshape(k, n)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    rim = np.concatenate([at[0, :-1], at[:-1, -1], at[-1, :0:-1], at[:0:-1, 0]])
    fan = np.stack([rim, np.roll(rim, -1), np.full(len(rim), k * n)], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], fan])
    return _closed(np.vstack([top.reshape(-1, 3), apex]), faces, paint, label)


def ring(
    section: Callable[[Floats], Floats],
    angles: Floats,
    paint: str = "earth",
    label: int = 0,
) -> Mesh:
    """Return a section swept round the z axis.

    Parameters
    ----------
    section : callable
        angle (n,) radians -> (n, k, 2): radius and height of the k corners, in turning order.
    angles : ndarray, shape (n,)
        Ascending. A full circle (first = last - 2 pi) closes on itself, less ends in two walls.
    """
    corners = section(angles)
    rings = np.empty((*corners.shape[:2], 3))
    rings[..., 0] = corners[..., 0] * np.cos(angles)[:, None]
    rings[..., 1] = corners[..., 0] * np.sin(angles)[:, None]
    rings[..., 2] = corners[..., 1]
    if angles[-1] - angles[0] < 2 * np.pi - 1e-9:
        return skin(rings, paint, label)
    count, sides = rings.shape[0] - 1, rings.shape[1]
    at = np.arange(count * sides).reshape(count, sides)
    on, up = np.roll(at, -1, axis=0), np.roll(at, -1, axis=1)
    both = np.roll(up, -1, axis=0)
    faces = np.concatenate(
        [np.stack([at, up, both], -1).reshape(-1, 3), np.stack([at, both, on], -1).reshape(-1, 3)]
    )
    return _closed(rings[:-1].reshape(-1, 3), faces, paint, label)


def extruded(
    outline: ArrayLike,
    front: Callable[[Floats], Floats] | float,
    back: Callable[[Floats], Floats] | float,
    paint: str = "brick",
    label: int = 0,
) -> Mesh:
    """Return an upright slab: an outline (k, 2) in x and z between y = front(z) and y = back(z)."""
    flat = np.asarray(outline, dtype=np.float64)
    if _signed_area(flat) < 0:
        flat = flat[::-1]
    depths = [
        side(flat[:, 1]) if callable(side) else np.full(len(flat), side) for side in (front, back)
    ]
    vertices = np.concatenate([np.stack([flat[:, 0], y, flat[:, 1]], 1) for y in depths])
    caps = np.array(triangulated(flat))
    count = len(flat)
    at = np.arange(count)
    after = np.roll(at, -1)
    sides = np.stack([at, after, after + count, at + count], axis=1)
    faces = np.concatenate([caps, caps[:, ::-1] + count, sides[:, [0, 2, 1]], sides[:, [0, 3, 2]]])
    return _closed(vertices, faces, paint, label)


def _signed_area(flat: Floats) -> float:
    x, y = flat.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


def triangulated(outline: Floats) -> list[tuple[int, int, int]]:
    """Return triangles over a simple polygon (k, 2), counter-clockwise, by ear clipping."""
    left = list(range(len(outline)))
    triangles: list[tuple[int, int, int]] = []
    while len(left) > 3:
        ears = [
            (left[i - 1], left[i], left[(i + 1) % len(left)])
            for i in range(len(left))
            if _is_ear(outline, left, left[i - 1], left[i], left[(i + 1) % len(left)])
        ]
        if not ears:
            break
        triangles.append(ears[0])
        left.remove(ears[0][1])
    return [*triangles, (left[0], left[1], left[2])]


def _is_ear(outline: Floats, left: list[int], a: int, b: int, c: int) -> bool:
    pa, pb, pc = outline[a], outline[b], outline[c]

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        turn: Floats = (q[0] - p[0]) * (r[..., 1] - p[1]) - (q[1] - p[1]) * (r[..., 0] - p[0])
        return turn

    if side(pa, pb, pc) <= 1e-12:
        return False
    others = outline[[i for i in left if i not in (a, b, c)]]
    inside = (side(pa, pb, others) >= 0) & (side(pb, pc, others) >= 0) & (side(pc, pa, others) >= 0)
    return not bool(inside.any())


def ball(
    centre: Sequence[float],
    radii: Sequence[float],
    paint: str = "stone",
    label: int = 0,
    sides: int = 12,
) -> Mesh:
    """Return an ellipsoid."""
    angle = np.linspace(-np.pi / 2 + 0.05, np.pi / 2 - 0.05, max(6, sides // 2 + 1))
    round_ = lathe(np.stack([np.cos(angle), np.sin(angle)], axis=1), sides, paint, label)
    return round_.scaled(*radii).turned(0.0, centre)


def is_closed(mesh: Mesh) -> bool:
    """Say whether every edge of the mesh runs once each way (watertight solids, one by one)."""
    a = mesh.faces[:, [0, 1, 2]].ravel()
    b = mesh.faces[:, [1, 2, 0]].ravel()
    count = len(mesh.vertices)
    there, back = np.sort(a * count + b), np.sort(b * count + a)
    return bool(np.array_equal(there, back) and len(np.unique(there)) == len(there))


__all__ = [
    "ball",
    "beam",
    "block",
    "box",
    "extruded",
    "is_closed",
    "join",
    "lathe",
    "mound",
    "pipe",
    "ring",
    "sheet",
    "skin",
    "triangulated",
]
