"""Triangle meshes with a label and a material per face, and what rays see of them."""

from __future__ import annotations

import gzip
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong.errors import FormatError, InputError
from dougong.kernels import rays as kernels
from dougong.threads import for_blocks
from dougong.typing import Index, Mask, Points, Values

Faces = NDArray[np.int64]
Bytes = NDArray[np.uint8]

SURFACE, FINE, GROUND, VEGETATION, CLUTTER, OUTLIER, NEAR_NOISE, MIXED, CLUSTER = range(9)
"""The truth labels: what a generated point lies on, or which kind of noise it is."""

MATERIALS: dict[str, tuple[tuple[int, int, int], float]] = {
    "stone": ((168, 163, 152), 0.45),
    "brick": ((132, 126, 118), 0.35),
    "earth": ((188, 158, 112), 0.42),
    "plaster": ((222, 214, 198), 0.70),
    "red": ((142, 48, 36), 0.40),
    "timber": ((112, 78, 52), 0.38),
    "blue": ((52, 96, 112), 0.40),
    "tile": ((88, 90, 94), 0.22),
    "glazed": ((186, 142, 54), 0.30),
    "rock": ((164, 138, 106), 0.48),
    "gold": ((196, 164, 92), 0.50),
    "soil": ((146, 130, 100), 0.35),
    "grass": ((96, 118, 62), 0.55),
    "paving": ((158, 154, 146), 0.42),
    "leaf": ((62, 96, 42), 0.55),
    "bark": ((92, 74, 58), 0.35),
    "cloth": ((70, 84, 128), 0.40),
    "paint": ((176, 182, 188), 0.60),
    "dark": ((46, 44, 44), 0.08),
}
"""Colour (red, green, blue 0..255) and near-infrared reflectance of each material."""

_NAMES = tuple(MATERIALS)
COLOURS = np.array([MATERIALS[name][0] for name in _NAMES], dtype=np.float64)
REFLECTANCES = np.array([MATERIALS[name][1] for name in _NAMES])


def material(name: str) -> int:
    """Return the number of a material."""
    return _NAMES.index(name)


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in metres; faces of a solid turn counter-clockwise seen from outside."""

    vertices: Points
    """(n, 3)"""
    faces: Faces
    """(m, 3) positions of vertices."""
    labels: Bytes
    """(m,) truth label of each face."""
    materials: Bytes
    """(m,) positions in `MATERIALS`."""

    def __len__(self) -> int:
        return len(self.faces)

    @classmethod
    def of(
        cls, vertices: ArrayLike, faces: ArrayLike, paint: str = "stone", label: int = SURFACE
    ) -> Mesh:
        """Return a mesh of one label and one material."""
        triangles = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
        ones = np.ones(len(triangles), dtype=np.uint8)
        return cls(
            np.asarray(vertices, dtype=np.float64).reshape(-1, 3),
            triangles,
            ones * np.uint8(label),
            ones * np.uint8(material(paint)),
        )

    def corners(self) -> NDArray[np.float64]:
        """Return the corners of the faces, (m, 3, 3)."""
        corners: NDArray[np.float64] = self.vertices[self.faces]
        return corners

    def normals(self) -> Points:
        """Return the unit normals of the faces, (m, 3); zero where a face has no area."""
        corner = self.corners()
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        normals: Points = across / np.where(length > 0, length, 1.0)
        return normals

    def areas(self) -> Values:
        """Return the areas of the faces, (m,), square metres."""
        corner = self.corners()
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        areas: Values = np.linalg.norm(across, axis=1) / 2
        return areas

    def extent(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the low and the high corner of the axis-aligned box, (3,) each."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def turned(self, yaw_deg: float, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
        """Return the mesh turned about the z axis, then shifted."""
        return replace(self, vertices=self.vertices @ _turn(yaw_deg).T + np.asarray(shift))

    def scaled(self, x: float, y: float, z: float) -> Mesh:
        """Return the mesh stretched along its axes (positive factors)."""
        return replace(self, vertices=self.vertices * np.array([x, y, z]))

    def repeated(self, places: Iterable[tuple[float, Sequence[float]]]) -> Mesh:
        """Return one copy per place (yaw in degrees, shift), joined."""
        return join([self.turned(yaw, shift) for yaw, shift in places])

    def labelled(self, label: int) -> Mesh:
        """Return the mesh with every face under one label."""
        return replace(self, labels=np.full(len(self), label, dtype=np.uint8))

    def samples(self, count: int, rng: np.random.Generator) -> tuple[Points, Index]:
        """Draw points uniformly by area; return them (count, 3) and their faces (count,)."""
        area = np.cumsum(self.areas())
        # Stratified along the cumulated area: the same expectation, less scatter.
        at = (np.arange(count) + rng.random(count)) / count * area[-1]
        face: Index = np.minimum(np.searchsorted(area, at, side="right"), len(self) - 1)
        u, v = rng.random((2, count))
        is_outside = u + v > 1
        u[is_outside], v[is_outside] = 1 - u[is_outside], 1 - v[is_outside]
        corner = self.vertices[self.faces[face]]
        edges = corner[:, 1:] - corner[:, :1]
        points: Points = corner[:, 0] + u[:, None] * edges[:, 0] + v[:, None] * edges[:, 1]
        return points, face


def _turn(yaw_deg: float) -> NDArray[np.float64]:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def join(meshes: Iterable[Mesh]) -> Mesh:
    """Return the meshes as one; vertices are not merged."""
    parts = list(meshes)
    if not parts:
        return Mesh.of(np.zeros((0, 3)), np.zeros((0, 3)))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.labels for part in parts]),
        np.concatenate([part.materials for part in parts]),
    )


class Tracer:
    """Meshes behind one another, ready for rays. Faces are numbered through all of them."""

    def __init__(self, mesh: Mesh) -> None:
        if not len(mesh):
            msg = "there is no face to trace, got an empty mesh. Pass at least one triangle."
            raise InputError(msg)
        self.mesh = mesh
        self.normals = mesh.normals()
        self._trees = [_tree(mesh, 0)]

    def together_with(self, other: Mesh) -> Tracer:
        """Return a tracer of both; the tree of the first mesh is shared, not built again."""
        if not len(other):
            return self
        both = Tracer.__new__(Tracer)
        both.mesh = join([self.mesh, other])
        both.normals = np.concatenate([self.normals, other.normals()])
        both._trees = [*self._trees, _tree(other, len(self.mesh))]
        return both

    def cast(
        self, origins: Points, directions: Points, reach: float | Values = np.inf
    ) -> tuple[Values, Index]:
        """Return the distance (n,) along each ray and the face (n,) it meets; infinity and -1."""
        return self._run(origins, directions, reach, is_any=False)

    def is_clear(self, start: Points, stop: Points) -> Mask:
        """Say for each pair whether nothing stands between; ends are left out by 2 mm."""
        between = stop - start
        length = np.linalg.norm(between, axis=1)
        direction = between / np.maximum(length, 1e-9)[:, None]
        distance, _ = self._run(start, direction, length - 2e-3, is_any=True)
        return np.isinf(distance)

    def _run(
        self, origins: Points, directions: Points, reach: float | Values, is_any: bool
    ) -> tuple[Values, Index]:
        count = len(directions)
        rays = np.empty((count, 6))
        rays[:, :3], rays[:, 3:] = origins, directions
        limits = np.full(count, reach) if np.isscalar(reach) else np.array(reach, np.float64)
        distance, face = np.full(count, np.inf), np.full(count, -1, dtype=np.int64)
        for tree in self._trees:
            near, hit = np.empty(count), np.empty(count, dtype=np.int64)
            task = partial(_cast_block, tree, rays, limits, is_any, near, hit)
            for_blocks(count, 1 << 16, task)
            is_nearer = hit >= 0
            distance[is_nearer], face[is_nearer] = near[is_nearer], hit[is_nearer]
            # What was found bounds the search in the next mesh.
            limits[is_nearer] = near[is_nearer]
        return distance, face


Tree = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]


def _tree(mesh: Mesh, first_number: int) -> Tree:
    """Return the bounding volume hierarchy of a mesh, as the kernels take it."""
    corner = mesh.corners()
    low, high = corner.min(axis=1), corner.max(axis=1)
    count = len(mesh)
    order = np.arange(count)
    boxes, links = np.empty((2 * count, 6)), np.empty((2 * count, 2), dtype=np.int64)
    nodes = kernels.build_tree(low, high, order, boxes, links)
    corner = corner[order]
    edges = corner[:, 1:] - corner[:, :1]
    packed = np.concatenate([corner[:, 0], edges[:, 0], edges[:, 1]], axis=1)
    numbers = order + first_number
    return boxes[:nodes].copy(), links[:nodes].copy(), np.ascontiguousarray(packed), numbers


def _cast_block(
    tree: Tree,
    rays: NDArray[np.float64],
    limits: Values,
    is_any: bool,
    distance: Values,
    face: Index,
    start: int,
    stop: int,
) -> None:
    part = slice(start, stop)
    kernels.cast_rays(tree, rays[part], limits[part], is_any, distance[part], face[part])


def load_mesh(path: str | Path, *, is_y_up: bool = False) -> tuple[Points, Faces]:
    """Read the triangles of a PLY or OBJ file (``.gz`` too); polygons are cut into fans.

    Parameters
    ----------
    path : str or Path
        ``.ply``, ``.obj``, ``.obj.gz``.
    is_y_up : bool
        The file's y axis points up: it is turned onto z (x stays).

    Returns
    -------
    vertices, faces : ndarray, shapes (n, 3) and (m, 3)

    Raises
    ------
    FormatError
        Neither PLY nor OBJ, or no faces inside.
    """
    file = Path(path)
    name = file.name.lower().removesuffix(".gz")
    if name.endswith(".ply"):
        vertices, faces = _read_ply(file)
    elif name.endswith(".obj"):
        vertices, faces = _read_obj(file)
    else:
        msg = f"{file.name}: not a mesh we read. Pass a .ply, .obj or .obj.gz file."
        raise FormatError(msg)
    if not len(faces):
        msg = f"{file.name}: has {len(vertices)} vertices and no faces. Pass a mesh, not a cloud."
        raise FormatError(msg)
    if is_y_up:
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    return np.ascontiguousarray(vertices), faces


def _read_ply(file: Path) -> tuple[Points, Faces]:
    from plyfile import PlyData, PlyElementParseError

    def rows(data: PlyData) -> tuple[Points, Sequence[NDArray[np.int64]]]:
        vertex = data["vertex"]
        vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
        names = [prop.name for prop in data["face"].properties]
        column = next(name for name in names if name in ("vertex_indices", "vertex_index"))
        return vertices, data["face"][column]

    for column in ("vertex_indices", "vertex_index"):
        try:
            # A file of triangles only is read at once; any other face by face.
            vertices, faces = rows(PlyData.read(str(file), known_list_len={"face": {column: 3}}))
        except (PlyElementParseError, KeyError, ValueError):
            continue
        # Of a text file the known length is ignored, and rows come one by one.
        if isinstance(faces, np.ndarray) and faces.ndim == 2:
            return vertices, np.ascontiguousarray(faces, dtype=np.int64)
        return vertices, _fans(list(faces))
    vertices, faces = rows(PlyData.read(str(file)))
    return vertices, _fans(faces)


def _read_obj(file: Path) -> tuple[Points, Faces]:
    opener = gzip.open if file.suffix == ".gz" else open
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    with opener(file, "rt", encoding="utf-8", errors="replace") as lines:
        for line in lines:
            word = line.split()
            if not word:
                continue
            if word[0] == "v":
                vertices.append([float(value) for value in word[1:4]])
            elif word[0] == "f":
                indices = [int(value.split("/")[0]) for value in word[1:]]
                # Negative indices count back from the vertex read last.
                polygons.append([i - 1 if i > 0 else len(vertices) + i for i in indices])
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), _fans(polygons)


def _fans(polygons: Sequence[Sequence[int] | NDArray[np.int64]]) -> Faces:
    """Cut polygons into triangles round their first corner, (m, 3)."""
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    parts = []
    for size in np.unique(sizes[sizes >= 3]):
        chosen = [polygons[int(i)] for i in np.flatnonzero(sizes == size)]
        same = np.array(chosen, dtype=np.int64)
        parts += [same[:, [0, k, k + 1]] for k in range(1, int(size) - 1)]
    return np.concatenate(parts) if parts else np.zeros((0, 3), dtype=np.int64)
