"""A cloud as plan rasters: walls with their direction and occupancy, by bands of height.

Each cell and band is *occupied*, *free* (seen through) or *unseen*; unseen is not empty. What a
sensor saw through follows from how it works: a drone saw everything above the top of a column;
a scanner on the ground that saw a spot of ground saw the air above it up to the first surface.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dougong.registration.cleaning import extent
from dougong.registration.levelling import rotation_to_vertical
from dougong.registration.prepare import Prepared
from dougong.typing import Points, Values

_WALL_VERTICALITY = 0.8
"""A surface whose normal's horizontal part is longer than this counts as wall (37 degrees)."""
_FULL = 0.25
"""Share of a cell that must be covered by surface for full occupancy."""
_OCCUPIED = 0.2
"""Occupancy from which a band stops a ray."""

Raster = NDArray[np.float32]
"""(rows, columns, 3 b + 2): b cosines and b sines of the double wall direction, b signed
occupancies (+ occupied, - free, 0 unseen), their energy, and 1 where the column was seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanView:
    """A prepared cloud seen from above: levelled coordinates and what the rasters need."""

    xyz: Points
    """(n, 3) levelled: z is up."""
    rotation: NDArray[np.float64]
    """(3, 3) that levelled the local frame."""
    band: NDArray[np.int64]
    """(n,) band of height above ground; -1 below the first, b above the last."""
    wall: Values
    """(n,) square metres of planar wall that the point stands for."""
    double: NDArray[np.complex128]
    """(n,) exp(2 i direction of the normal in plan): the same for either sign."""
    area: Values
    is_ground: NDArray[np.bool_]
    sees_from_above: bool
    has_ground: bool
    edges_m: NDArray[np.float64]
    low: NDArray[np.float64]
    """(2,) low corner in plan."""
    high: NDArray[np.float64]

    @property
    def pivot(self) -> NDArray[np.float64]:
        """Return the point (2,) that poses turn about: the centre of the plan box."""
        return 0.5 * (self.low + self.high)


def plan_view(cloud: Prepared, edges_m: NDArray[np.float64]) -> PlanView:
    """Level `cloud` and sort its points into bands of height above ground."""
    rotation = rotation_to_vertical(cloud.up)
    xyz = np.ascontiguousarray(cloud.xyz @ rotation.T)
    normals = cloud.normals @ rotation.T
    horizontal = np.hypot(normals[:, 0], normals[:, 1])
    # Foliage and clutter have no planes: their normals are chance.
    trust = np.clip((cloud.planarity - 0.7) / 0.2, 0.0, 1.0)
    wall = np.where(horizontal > _WALL_VERTICALITY, trust * cloud.weights_area, 0.0)
    direction = (normals[:, 0] + 1j * normals[:, 1]) / np.maximum(horizontal, 1e-12)
    low, high = extent(xyz)
    return PlanView(
        xyz=xyz,
        rotation=rotation,
        band=np.searchsorted(edges_m, cloud.height_above_ground, side="right") - 1,
        wall=wall,
        double=(direction * direction).astype(np.complex128),
        area=cloud.weights_area,
        is_ground=cloud.is_ground,
        sees_from_above=cloud.kind == "photogrammetry",
        has_ground=cloud.has_ground,
        edges_m=edges_m,
        low=low[:2],
        high=high[:2],
    )


def plan_raster(view: PlanView, cell_m: float, blur_cells: float, wall_share: float) -> Raster:
    """Return the raster of `view` at `cell_m`, its low corner at ``view.low``.

    `wall_share` of the energy goes to the walls, the rest to the occupancy, whatever the cloud.
    """
    columns, rows = np.ceil((view.high - view.low) / cell_m).astype(int) + 1
    place = np.floor((view.xyz[:, :2] - view.low) / cell_m).astype(np.int64)
    flat = place[:, 1] * columns + place[:, 0]
    size = int(rows * columns)
    has_points = np.bincount(flat, minlength=size) > 0
    has_ground = np.bincount(flat[view.is_ground], minlength=size) > 0
    bands = len(view.edges_m) - 1
    out = np.empty((rows, columns, 3 * bands + 2), dtype=np.float32)

    def blurred(values: Values) -> Raster:
        image = np.ascontiguousarray(values.reshape(rows, columns), dtype=np.float32)
        if blur_cells > 0:
            image = cv2.GaussianBlur(image, (0, 0), blur_cells, borderType=cv2.BORDER_CONSTANT)
        return image

    # Band by band: at a site's full size all bands together would be most of the memory.
    occupied = np.empty((size, bands))
    for band in range(bands):
        cosine, sine, occupied[:, band] = _band(view, band, flat, size, cell_m)
        out[..., band], out[..., bands + band] = blurred(cosine), blurred(sine)
    free = _free(view, occupied, has_points, has_ground)
    # Free space weighs as much as what is occupied: the mean over the seen cells is zero.
    balance = min(1.0, float(occupied.sum() / max(float(free.sum()), 1.0)))
    for band in range(bands):
        signed = occupied[:, band] - balance * free[:, band]
        out[..., 2 * bands + band] = blurred(signed)
    _balance(out, bands, wall_share)
    out[..., 3 * bands] = (out[..., : 3 * bands] ** 2).sum(axis=-1)
    out[..., 3 * bands + 1] = has_points.reshape(rows, columns)
    return out


def _band(
    view: PlanView, band: int, flat: NDArray[np.int64], size: int, cell_m: float
) -> tuple[Values, Values, Values]:
    """Return the walls of a band, as amounts times cosines and sines, and occupancies (size,)."""
    here = view.band == band
    cell = flat[here]
    # A wall that crosses the cell and fills half of its band counts in full; tall bands are filled
    # by few walls, so at most 3 m are asked for.
    full = cell_m * min(float(np.diff(view.edges_m)[band]), 3.0) * 0.5
    wall, double = view.wall[here], view.double[here]
    amount = np.bincount(cell, wall, size)
    scale = np.minimum(amount / full, 1.0) / np.maximum(amount, 1e-12)
    cosine = np.bincount(cell, wall * double.real, size) * scale
    sine = np.bincount(cell, wall * double.imag, size) * scale
    area = np.bincount(cell, view.area[here], size)
    return cosine, sine, np.minimum(area / (_FULL * cell_m**2), 1.0)


def _free(
    view: PlanView,
    occupied: NDArray[np.float64],
    has_points: NDArray[np.bool_],
    has_ground: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Say where a sensor saw through the cell's band, (size, b)."""
    is_hit = occupied > _OCCUPIED
    if view.sees_from_above:
        # Nothing at or above this band in a column that was seen from above.
        is_above = np.logical_or.accumulate(is_hit[:, ::-1], axis=1)[:, ::-1]
        is_free = ~is_above & has_points[:, None] & view.has_ground
    else:
        is_below = ~np.logical_or.accumulate(is_hit, axis=1)
        is_free = is_below & has_ground[:, None]
    seen: NDArray[np.bool_] = is_free & (occupied == 0.0)
    return seen


def _balance(out: Raster, bands: int, wall_share: float) -> None:
    """Scale walls and occupancy to their shares of a total energy of one per seen metre."""
    wall = float((out[..., : 2 * bands] ** 2).sum())
    rest = float((out[..., 2 * bands : 3 * bands] ** 2).sum())
    total = wall + rest
    if wall > 0 and rest > 0:
        out[..., : 2 * bands] *= np.float32(np.sqrt(wall_share * total / wall))
        out[..., 2 * bands : 3 * bands] *= np.float32(np.sqrt((1 - wall_share) * total / rest))


def sparse_cells(
    raster: Raster, view: PlanView, cell_m: float, *, thin_free: bool = False
) -> tuple[Points, Raster]:
    """Return the seen cells: centres (n, 2) in metres about the pivot, values (n, 3 b + 2).

    With `thin_free` one in four of the cells that are nothing but free stays and counts four
    times: open ground is large and smooth.
    """
    row, column = np.nonzero((raster[..., -1] > 0) | (raster[..., -2] > 1e-4))
    values = raster[row, column]
    if thin_free:
        bands = (values.shape[1] - 2) // 3
        is_object = (values[:, : 2 * bands] != 0).any(axis=1)
        is_object |= (values[:, 2 * bands : 3 * bands] > 0).any(axis=1)
        stays = is_object | ((row % 2 == 0) & (column % 2 == 0))
        values = np.where(is_object[:, None], values, np.float32(4.0) * values)[stays]
        row, column = row[stays], column[stays]
    centre = view.low + (np.column_stack([column, row]) + 0.5) * cell_m - view.pivot
    return np.ascontiguousarray(centre), np.ascontiguousarray(values)
