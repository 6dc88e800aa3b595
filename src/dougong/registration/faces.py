"""The faces of a building: large even surfaces among core points, with a name and a size.

Planes are grown from the evenest core points over their neighbours; planes that meet at a small
angle (a curved roof, a round wall) become one surface, cut at the eight directions of the compass
where it turns through more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dougong._sorting import count_rows, distinct
from dougong.filters import neighbourhood
from dougong.typing import Index, Mask, Points, Values

FaceKind = Literal["wall", "slope", "level"]
COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
AXES = ("+x", "+x+y", "+y", "-x+y", "-x", "-x-y", "-y", "+x-y")
_WALL, _LEVEL = 0.3, 0.94
_NEIGHBOURS = 12
_REACH_SPACINGS = 2.5
_SAME_PLANE = float(np.cos(np.radians(12.0)))
_EVEN = float(np.cos(np.radians(8.0)))
_MEETING = float(np.cos(np.radians(25.0)))
_CONTINUES = float(np.cos(np.radians(5.0)))
_GAP_M = 10.0
_PAIRED = 300
"""Planes that are compared with each other: the largest."""
_LEAST_POINTS = 20
_TURN = float(np.radians(60.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Face:
    """One even surface, in the frame of its core points."""

    name: str
    kind: FaceKind
    is_directed: bool
    """False: which side is open is not known, so the sign follows a convention."""
    normal: Values
    """(3,) unit, to the open side."""
    centre: Values
    """(3,)"""
    width_m: float
    """Along the level direction of the face; of a level one, its longer side."""
    height_m: float
    """Across that."""
    area_m2: float
    members: Index
    """Which core points."""


def find_faces(
    core: Points,
    normals: Points,
    is_known: Mask,
    spacing_m: float,
    *,
    tolerance_m: float = 0.05,
    least_area_m2: float = 2.0,
    has_compass: bool = True,
) -> list[Face]:
    """Return the faces of at least `least_area_m2`, the largest first.

    Parameters
    ----------
    core, normals : ndarray, shape (k, 3)
        Core points in canonical order, and normals to the open side (see `outward`).
    is_known : ndarray, shape (k,)
        Where that side is known.
    spacing_m : float
        Of the core points.
    tolerance_m : float
        How far a core point may lie off its plane.
    has_compass : bool
        False: y is not north, and faces are named by the axes.
    """
    if len(core) < _LEAST_POINTS:
        return []
    index = neighbourhood.build_index(core)
    near, _ = neighbourhood.knn(index, None, _NEIGHBOURS, _REACH_SPACINGS * spacing_m)
    plane = _grown(core, normals, near, tolerance_m)
    surface = _joined(core, plane, normals, near, tolerance_m)
    words = COMPASS if has_compass else AXES
    found = []
    for number in range(int(surface.max()) + 1):
        members = np.flatnonzero(surface == number)
        area = _area(core[members], normals[members], spacing_m)
        if len(members) >= _LEAST_POINTS and area >= least_area_m2:
            found.append(_described(core, normals, is_known, members, area, words))
    found.sort(key=lambda face: (-face.area_m2, tuple(face.centre)))
    return _numbered(_with_levels(found, core))


def _grown(core: Points, normals: Points, near: Index, tolerance_m: float) -> Index:
    """Return the plane (k,) each core point belongs to, -1 for none."""
    plane = np.full(len(core), -1, dtype=np.int64)
    is_near = near >= 0
    with np.errstate(invalid="ignore"):
        alike = np.abs(np.einsum("kni,ki->kn", normals[near], normals))
    even = np.where(is_near, alike, 0.0).sum(axis=1) / np.maximum(is_near.sum(axis=1), 1)
    even = np.where((is_near.sum(axis=1) >= 4) & np.isfinite(even), np.round(even, 6), 0.0)
    seeds = np.argsort(-even, kind="stable")
    is_open = np.isfinite(normals[:, 0])
    was_tried = ~is_open
    count = 0
    for seed in seeds[even[seeds] > _EVEN]:
        if was_tried[seed] or plane[seed] >= 0:
            continue
        members = _grow_one(core, normals, near, is_open & (plane < 0), int(seed), tolerance_m)
        was_tried[members] = True
        if len(members) >= _LEAST_POINTS:
            plane[members] = count
            count += 1
    return plane


def _grow_one(
    core: Points, normals: Points, near: Index, is_open: Mask, seed: int, tolerance_m: float
) -> Index:
    """Return the core points of the plane that grows from `seed`."""
    is_member = np.zeros(len(core), dtype=bool)
    is_member[seed] = True
    frontier = np.array([seed])
    normal, middle, fitted = normals[seed], core[seed], 1
    while len(frontier):
        asked = distinct(near[frontier].ravel())
        asked = asked[asked >= 0]
        asked = asked[is_open[asked] & ~is_member[asked]]
        is_on = np.abs((core[asked] - middle) @ normal) <= tolerance_m
        is_on &= np.abs(normals[asked] @ normal) >= _SAME_PLANE
        frontier = asked[is_on]
        is_member[frontier] = True
        count = int(is_member.sum()) if len(frontier) else 0
        if count >= 2 * max(fitted, 6):
            members = core[is_member]
            middle = members.mean(axis=0)
            spread = members - middle
            normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
            fitted = count
    members_of: Index = np.flatnonzero(is_member).astype(np.int64)
    return members_of


def _in_one_plane(
    core: Points, plane: Index, mean: Points, tolerance_m: float
) -> tuple[Index, Index]:
    """Return the pairs of planes that continue each other across a gap (a gate, a buttress)."""
    sizes = np.bincount(plane[plane >= 0], minlength=len(mean))
    most = np.argsort(-sizes, kind="stable")[:_PAIRED]
    boxes = [core[plane == number] for number in most]
    low, high = (np.array([edge(box, axis=0) for box in boxes]) for edge in (np.min, np.max))
    middle, facing = (low + high) / 2.0, mean[most]
    off = np.abs(np.einsum("abi,ai->ab", middle[None] - middle[:, None], facing))
    gap = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)
    is_one = (facing @ facing.T >= _CONTINUES) & (np.maximum(off, off.T) <= 2.0 * tolerance_m)
    a, b = np.nonzero(is_one & (gap <= _GAP_M))
    return most[a], most[b]


def _joined(core: Points, plane: Index, normals: Points, near: Index, tolerance_m: float) -> Index:
    """Return the surface (k,) of each core point: planes that meet at a small angle are one."""
    count = int(plane.max()) + 1
    if count == 0:
        return plane
    mean = np.zeros((count, 3))
    on = plane >= 0
    np.add.at(mean, plane[on], normals[on])
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    first = np.repeat(plane, near.shape[1])
    second = np.where(near >= 0, plane[near], -1).ravel()
    is_edge = (first >= 0) & (second >= 0) & (first != second)
    first, second = first[is_edge], second[is_edge]
    pairs, shared = np.unique(first * count + second, return_counts=True)
    a, b = pairs // count, pairs % count
    meets = (shared >= 6) & (np.einsum("ij,ij->i", mean[a], mean[b]) >= _MEETING)
    meets &= _kinds(mean[a]) == _kinds(mean[b])
    c, d = _in_one_plane(core, plane, mean, tolerance_m)
    ends = np.concatenate([a[meets], c]), np.concatenate([b[meets], d])
    graph = coo_array((np.ones(len(ends[0])), ends), shape=(count, count))
    parts, label = connected_components(graph, directed=False)
    octant = _octants(mean)
    key = label.astype(np.int64) * 9
    for part in range(parts):
        inside = np.flatnonzero(label == part)
        is_level = _kinds(mean[inside])[0] == 2
        if not is_level and _turn(mean[inside]) > _TURN:
            key[inside] += 1 + octant[inside]
    _, dense = np.unique(key, return_inverse=True)
    return np.where(on, dense.reshape(-1)[np.maximum(plane, 0)], -1).astype(np.int64)


def _turn(mean: Points) -> float:
    """Return through what angle about the vertical a surface's planes turn."""
    azimuth = np.sort(np.arctan2(mean[:, 1], mean[:, 0]))
    gaps = np.diff(np.concatenate([azimuth, azimuth[:1] + 2 * np.pi]))
    return float(2 * np.pi - gaps.max())


def _kinds(normals: Points) -> NDArray[np.int64]:
    """Return 0 wall, 1 slope, 2 level for each normal."""
    rise = np.abs(normals[:, 2])
    return np.where(rise < _WALL, 0, np.where(rise < _LEVEL, 1, 2)).astype(np.int64)


def _octants(normals: Points) -> NDArray[np.int64]:
    """Return 0 east, 1 north-east .. 7 south-east for each normal."""
    turns = np.round(np.arctan2(normals[:, 1], normals[:, 0]) / (np.pi / 4.0))
    return turns.astype(np.int64) % 8


def _axes(normal: Values) -> tuple[Values, Values]:
    """Return the level direction in a face and the one across it, both unit."""
    level = np.array([-normal[1], normal[0], 0.0])
    size = float(np.linalg.norm(level))
    along = level / size if size > 0.2 else np.array([1.0, 0.0, 0.0])
    across = np.cross(normal, along)
    return along, across / np.linalg.norm(across)


def _area(core: Points, normals: Points, spacing_m: float) -> float:
    """Return the surface that core points cover: cells of two spacings on their mean plane."""
    normal = _mean(normals)
    along, across = _axes(normal)
    cell = 2.0 * spacing_m
    at = np.floor(np.column_stack([core @ along, core @ across]) / cell).astype(np.int64)
    lean = float(np.clip(np.abs(normals @ normal).mean(), 0.2, 1.0))
    return count_rows(at) * cell**2 / lean


def _mean(normals: Points) -> Values:
    total = normals.sum(axis=0)
    return np.asarray(total / max(float(np.linalg.norm(total)), 1e-12))


def _described(
    core: Points,
    normals: Points,
    is_known: Mask,
    members: Index,
    area: float,
    words: tuple[str, ...],
) -> Face:
    share = float(is_known[members].mean())
    normal = _mean(normals[members])
    kind: FaceKind = ("wall", "slope", "level")[int(_kinds(normal[None])[0])]
    along, across = _axes(normal)
    sides = [float(np.ptp(np.quantile(core[members] @ axis, [0.01, 0.99]))) for axis in
             (along, across)]  # fmt: skip
    if kind == "level":
        sides.sort(reverse=True)
    facing = words[int(_octants(normal[None])[0])]
    other = words[(int(_octants(normal[None])[0]) + 4) % 8]
    is_directed = share >= 0.7
    names = {
        "wall": f"{facing} facade" if is_directed else f"wall facing {facing} or {other}",
        "slope": f"slope facing {facing}",
        "level": "level surface",
    }
    return Face(
        name=names[kind],
        kind=kind,
        is_directed=is_directed,
        normal=normal,
        centre=np.median(core[members], axis=0),
        width_m=sides[0],
        height_m=sides[1],
        area_m2=area,
        members=members,
    )


def _with_levels(faces: list[Face], core: Points) -> list[Face]:
    """Return the faces, level ones named by their height above the lowest core points."""
    floor = float(np.quantile(core[:, 2], 0.02))
    return [
        replace(face, name=f"level surface {max(face.centre[2] - floor, 0.0):.1f} m up")
        if face.kind == "level"
        else face
        for face in faces
    ]


def _numbered(faces: list[Face]) -> list[Face]:
    """Return the faces; names that several bear are numbered, the largest first."""
    names = [face.name for face in faces]
    return [
        replace(face, name=f"{face.name}, {names[: place + 1].count(face.name)}")
        if names.count(face.name) > 1
        else face
        for place, face in enumerate(faces)
    ]
