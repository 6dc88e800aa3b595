"""The clouds of a report as the page carries them: thinned, rounded to a millimetre, packed.

A cloud is a zlib stream of byte planes in base64, its points in Morton order so that neighbours in
space are neighbours in the stream: per axis the low and the high byte of the position inside its
block, then the size, the colour, the distance to the other clouds, the class, the reason of
removal.
About 8 bytes a point.
"""

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import distinct, first_places
from dougong.report.layers import Cores, Layer
from dougong.typing import Points, Transform, Values

MAX_POINTS = 400_000
"""Points of all clouds together that a page carries."""
STEP_M = 0.001
"""Positions are rounded to this: they are off by half of it at most, along each axis."""
REACH_M = 0.25
"""Beyond this a point has no other cloud near it."""
NO_CLOUD = 255
SMALLEST_M = 0.002
_AROUND = 5
_BLOCK = 1 << 16
_NEIGHBOURS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Packed:
    """One cloud in the page."""

    head: dict[str, Any]
    """What the viewer must know to unpack it."""
    data: str
    """Base64 of the zlib stream."""


def thinned(points: Points, most: int) -> NDArray[np.int64]:
    """Return which points (k,) show a cloud (n, 3) evenly with at most `most` of them, in order.

    The first point of each cell of about the finest grid that is coarse enough.
    """
    if len(points) <= most:
        return np.arange(len(points))
    coarse = max(float(np.ptp(points, axis=0).max()), 1e-3)
    fine = coarse / 2**17
    for _ in range(14):
        middle = float(np.sqrt(fine * coarse))
        if len(distinct(_cells(points, middle))) > most:
            fine = middle
        else:
            coarse = middle
    return np.sort(first_places(_cells(points, coarse)))


def _cells(points: Points, edge: float) -> NDArray[np.int64]:
    """Return the number of each point's cell (n,)."""
    x, y, z = np.floor((points - points.min(axis=0)) / edge).astype(np.int64).T
    cells: NDArray[np.int64] = (x << 42) | (y << 21) | z
    return cells


def sizes(points: Points) -> Values:
    """Return how large each point (n, 3) is drawn, metres (n,): the spacing of points around it.

    At most 2.5 times the usual; a lone point, at six times, is no surface and stays as small as
    the others.
    """
    from scipy.spatial import cKDTree

    if len(points) <= _AROUND:
        return np.full(len(points), SMALLEST_M)
    near, _ = cKDTree(points).query(points, _AROUND, workers=-1)
    # In a square lattice the fourth neighbour is one spacing away; scatter needs about as much.
    found: Values = 1.05 * near[:, -1]
    usual = float(np.median(found))
    found[found > 6.0 * usual] = usual
    return np.clip(found, SMALLEST_M, max(2.5 * usual, SMALLEST_M))


def size_codes(found: Values) -> NDArray[np.uint8]:
    """Return sizes (n,) as bytes: quarter octaves above `SMALLEST_M`."""
    return np.clip(np.round(4 * np.log2(found / SMALLEST_M)), 0, 63).astype(np.uint8)


def shares(counts: list[int], most: int) -> list[int]:
    """Return how many points each cloud may have: equal shares, what one leaves goes to others."""
    given = [0] * len(counts)
    open_ = sorted(range(len(counts)), key=lambda index: counts[index])
    left = most
    for rank, index in enumerate(open_):
        given[index] = min(counts[index], left // (len(open_) - rank))
        left -= given[index]
    return given


def distances(points: Points, others: Points) -> Values:
    """Return how far each point lies from the surface of the other clouds.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
    others : ndarray, shape (m, 3)

    Returns
    -------
    ndarray, shape (n,)
        Metres to the plane through the 8 nearest points of `others`; NaN where the nearest is
        farther than `REACH_M`.
    """
    from scipy.spatial import cKDTree

    if len(others) < _NEIGHBOURS:
        return np.full(len(points), np.nan)
    near, index = cKDTree(others).query(points, _NEIGHBOURS, workers=-1)
    patch = others[index]
    middle = patch.mean(axis=1)
    spread = patch - middle[:, None, :]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    found: Values = np.abs(np.einsum("ni,ni->n", points - middle, normal))
    found[near[:, 0] > REACH_M] = np.nan
    return found


def signed_distances(points: Points, cores: Sequence[Cores]) -> Values:
    """Return the signed distance (n,) at each point (n, 3): that of the nearest core point.

    Metres; NaN where no core point is in reach.
    """
    from scipy.spatial import cKDTree

    found = np.full(len(points), np.nan)
    nearest = np.full(len(points), np.inf)
    for core in cores:
        if not len(core.after):
            continue
        away, place = cKDTree(core.after).query(points, workers=-1)
        is_nearer = (away <= core.reach_m) & (away < nearest)
        nearest[is_nearer] = away[is_nearer]
        found[is_nearer] = core.distance_m[place[is_nearer]]
    return found


def distance_codes(found: Values) -> NDArray[np.uint8]:
    """Return signed distances (n,) as bytes: 127 + 127 sign(d) sqrt(|d| / reach); 255 for NaN.

    Fine where d is small: the steps are 0.25 mm at 1 mm and 1.2 mm at 25 mm.
    """
    share = np.sqrt(np.clip(np.abs(np.nan_to_num(found)) / REACH_M, 0.0, 1.0))
    codes = (127 + np.round(127 * np.sign(np.nan_to_num(found)) * share)).astype(np.uint8)
    codes[np.isnan(found)] = NO_CLOUD
    return codes


def back_motion(layer: Layer) -> Transform:
    """Return the (4, 4) similarity that takes a layer's `after` points to its `before` points.

    Umeyama 1991, on at most 5000 of them; they are the same points, so it fits to rounding.
    """
    chosen = slice(None, None, max(1, len(layer.after) // 5000))
    source, target = layer.after[chosen], layer.before[chosen]
    low, high = source.mean(axis=0), target.mean(axis=0)
    u, d, v = np.linalg.svd((target - high).T @ (source - low))
    sign = np.array([1.0, 1.0, np.linalg.det(u @ v)])
    turn = u * sign @ v
    scale = float((d * sign).sum() / max(float(((source - low) ** 2).sum()), 1e-12))
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:3, 3] = high - scale * turn @ low
    return matrix


def pack(
    points: Points,
    *,
    source: int,
    element: str,
    colours: NDArray[np.uint8] | None = None,
    found: Values | None = None,
    classes: NDArray[np.uint8] | None = None,
    reasons: NDArray[np.uint8] | None = None,
) -> Packed:
    """Pack the points (n, 3) of a cloud, metres, with what is known of each.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
    source : int
        Which cloud of the scene they belong to.
    element : str
        The id of the page's element that holds them.
    colours : ndarray, shape (n, 3) or (n, 1), optional
        Colours, or grey.
    found : ndarray, shape (n,), optional
        Signed distances to the other clouds, metres.
    classes, reasons : ndarray, shape (n,), optional
        LAS classes; `dougong.filters.selection.Reason` of removal.
    """
    lattice = np.round(points / STEP_M).astype(np.int64)
    block, inside = lattice // _BLOCK, lattice % _BLOCK
    order = np.lexsort((_morton(inside), block[:, 2], block[:, 1], block[:, 0]))
    block, inside = block[order], inside[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(block, axis=0) != 0).any(axis=1)])
    counts = np.diff(np.r_[starts, len(block)])
    planes: list[NDArray[Any]] = [
        part for axis in range(3) for part in (inside[:, axis] & 255, inside[:, axis] >> 8)
    ]
    planes.append(size_codes(sizes(points))[order])
    kind = "none"
    if colours is not None:
        kind = "rgb" if colours.shape[1] == 3 else "intensity"
        planes += list(colours[order].T)
    if found is not None:
        planes.append(distance_codes(found)[order])
    planes += [values[order] for values in (classes, reasons) if values is not None]
    raw = b"".join(np.ascontiguousarray(plane, dtype=np.uint8).tobytes() for plane in planes)
    return Packed(
        head={
            "source": source,
            "points": len(points),
            "step_m": STEP_M,
            "spacing_m": SMALLEST_M,
            "blocks": np.column_stack([block[starts], counts]).tolist(),
            "colour": kind,
            "has_residual": found is not None,
            "has_class": classes is not None,
            "has_reason": reasons is not None,
            "element": element,
        },
        data=base64.b64encode(zlib.compress(raw, 8)).decode("ascii"),
    )


def _morton(cells: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return Morton keys (n,) of 16-bit cells (n, 3)."""
    key = np.zeros(len(cells), dtype=np.uint64)
    for axis in range(3):
        bits = cells[:, axis].astype(np.uint64)
        for shift, mask in ((32, 0xFFFF00000000FFFF), (16, 0x00FF0000FF0000FF),
                            (8, 0xF00F00F00F00F00F), (4, 0x30C30C30C30C30C3),
                            (2, 0x9249249249249249)):  # fmt: skip
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        key |= bits << np.uint64(axis)
    return key
