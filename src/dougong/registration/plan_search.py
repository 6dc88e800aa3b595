"""The default coarse method: every yaw, every place in plan, then the heights (METHOD.md 2.2).

Both sensors know which way is up. So four numbers remain, and three of them are searched
exhaustively: masked correlation of plan rasters by FFT, one per yaw. Nothing is guessed from
moments or local features, so a plan without axes (round, square, octagonal) is no special case:
equal poses come out as equal peaks, and all of them are returned.
"""

import itertools
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy import fft

from dougong.kernels.plan import splat
from dougong.params import Parameters
from dougong.registration.heights import height_candidates, levels
from dougong.registration.hypotheses import rank
from dougong.registration.plan_refine import PlanPose, refine, suppress
from dougong.registration.prepare import Prepared
from dougong.registration.rasters import PlanView, Raster, plan_raster, plan_view, sparse_cells
from dougong.registration.result import Hypothesis
from dougong.threads import for_blocks
from dougong.typing import Transform

_MOST_CELLS = 2_000_000
"""Of a raster on which peaks are refined: 0.4 GB; the cell grows beyond 350 m square."""


class PlanSearch(Parameters):
    """How finely yaw and plan are searched, and how many peaks are kept."""

    cell_m: Annotated[float, Field(gt=0)] = 0.5
    """Cell of the first search; grows with the extent so that the images stay small."""
    fine_cell_m: Annotated[float, Field(gt=0)] = 0.25
    """Cell at which the peaks are refined; larger on sites of more than 350 m square."""
    max_cells: Annotated[int, Field(ge=64)] = 384
    """Rows and columns of the search images at most."""
    yaw_step_deg: Annotated[float, Field(gt=0, le=10)] = 2.0
    """Step of the first search; refined to an eighth."""
    band_edges_m: Annotated[tuple[float, ...], Field(min_length=2)] = (
        0.4,
        2.0,
        4.0,
        8.0,
        16.0,
        60.0,
    )
    """Borders of the bands of height above ground."""
    wall_share: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Share of the walls (with direction) in the correlation; the rest is occupancy."""
    min_overlap: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Poses at which the clouds share less of their content than this score lower."""
    peaks: Annotated[int, Field(ge=1)] = 64
    """Peaks of the first search that are refined."""
    max_hypotheses: Annotated[int, Field(ge=1)] = 16
    """Poses returned at most."""
    yaw_hint_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Only yaws within `yaw_hint_range_deg` of this are searched."""
    yaw_hint_range_deg: Annotated[float, Field(gt=0, le=180)] = 15.0
    separate_yaw_deg: Annotated[float, Field(gt=0)] = 5.0
    """Poses closer than this in yaw ..."""
    separate_m: Annotated[float, Field(gt=0)] = 0.5
    """... and than this in place are one."""

    @field_validator("band_edges_m")
    @classmethod
    def _ascend(cls, edges: tuple[float, ...]) -> tuple[float, ...]:
        if any(high <= low for low, high in itertools.pairwise(edges)):
            msg = f"{edges} do not ascend; each border lies above the one before"
            raise ValueError(msg)
        return edges


def plan_search(
    source: Prepared, target: Prepared, params: PlanSearch | None = None
) -> list[Hypothesis]:
    """Return the poses that bring the plans of `source` and `target` together, best first.

    Returns
    -------
    list of Hypothesis
        Local frames; scored by `hypotheses.score`. Empty when nothing correlates.

    Notes
    -----
    Cost: (360 / yaw step) x 17 FFTs of at most `max_cells`^2. Yaw and place come out within
    about 1/2 degree and one fine cell; tilts up to a degree do no harm. Deterministic.
    """
    params = params or PlanSearch()
    edges = np.asarray(params.band_edges_m)
    source_view, target_view = plan_view(source, edges), plan_view(target, edges)
    poses = search(source_view, target_view, params)
    source_levels, target_levels = levels(source_view), levels(target_view)
    hypotheses = [
        Hypothesis(
            T_target_source=pose_transform(pose, height, source_view, target_view),
            score=0.0,
            method="plan",
        )
        for pose in poses
        for height in height_candidates(pose, source_levels, target_levels)
    ]
    return rank(hypotheses, source, target)[: params.max_hypotheses]


def search(source: PlanView, target: PlanView, params: PlanSearch) -> list[PlanPose]:
    """Return the best separate poses in plan, refined, best correlation first."""
    cell = _cell(source, target, params)
    finest = max(params.fine_cell_m, *(_finest(view) for view in (source, target)))
    peaks = _first_peaks(source, target, cell, params)
    kept = suppress(peaks, 0.75 * params.yaw_step_deg, 1.5 * cell, params.peaks)
    step = params.yaw_step_deg
    while True:
        kept = refine(kept, source, target, cell, step, params.wall_share, params.min_overlap)
        # A poor peak may climb far; it must not leave the yaws that were asked for.
        kept = [pose for pose in kept if _is_wanted(pose.yaw, params)]
        kept = suppress(kept, params.separate_yaw_deg, max(params.separate_m, cell))
        if not kept:
            return []
        if cell <= finest:
            return kept[: 2 * params.max_hypotheses]
        # A pose that correlates far less well cannot win on finer cells.
        kept = [pose for pose in kept if pose.score >= 0.4 * kept[0].score]
        kept = kept[: 3 * params.max_hypotheses]
        cell, step = max(cell / 2.0, finest), max(step / 2.0, 0.5)


def _cell(source: PlanView, target: PlanView, params: PlanSearch) -> float:
    """Return the first search's cell: `cell_m`, or what keeps the images within bounds."""
    reach = float((target.high - target.low).max()) + 1.4 * _radius(source)
    return max(params.cell_m, reach / (params.max_cells - 8))


def _finest(view: PlanView) -> float:
    """Return the cell below which a raster of a cloud would hold more than `_MOST_CELLS`."""
    return float(np.sqrt(np.prod(view.high - view.low) / _MOST_CELLS))


def _radius(view: PlanView) -> float:
    return float(np.linalg.norm(view.xyz[:, :2] - view.pivot, axis=1).max())


def _yaws(params: PlanSearch) -> NDArray[np.float64]:
    """Return the yaws to search, radians; the second half is the first plus 180 degrees."""
    count = max(2, int(np.ceil(180.0 / params.yaw_step_deg)))
    yaws: NDArray[np.float64] = np.arange(count, dtype=np.float64) * (np.pi / count)
    return yaws


def _is_wanted(yaw: float, params: PlanSearch) -> bool:
    if params.yaw_hint_deg is None:
        return True
    off = (np.degrees(yaw) - params.yaw_hint_deg + 180.0) % 360.0 - 180.0
    return bool(abs(off) <= params.yaw_hint_range_deg + 0.5 * params.yaw_step_deg)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Spectra:
    """The target's half of the correlation."""

    images: NDArray[np.complex64]
    """(3 b, n, m)"""
    energy: NDArray[np.complex64]
    mask: NDArray[np.complex64]
    size: tuple[int, int]
    floor: float
    """Least energy that either cloud must bring into the overlap."""


def _first_peaks(
    source: PlanView, target: PlanView, cell: float, params: PlanSearch
) -> list[PlanPose]:
    """Correlate at every yaw and return the local maxima in plan of each."""
    raster = plan_raster(target, cell, 0.7, params.wall_share)
    half = 0.5 * cell
    fine = plan_raster(source, half, 0.0, params.wall_share)
    bands = len(params.band_edges_m) - 1
    # Two fine cells of a wall line, four of an area, fall into one search cell.
    fine[..., : 2 * bands] *= 0.5
    fine[..., 2 * bands :] *= 0.25
    xy, values = sparse_cells(fine, source, half)
    reach = int(np.ceil(1.4 * _radius(source) / cell))
    size = (
        fft.next_fast_len(raster.shape[0] + reach, real=True),
        fft.next_fast_len(raster.shape[1] + reach, real=True),
    )
    spectrum = fft.rfft2(np.moveaxis(raster, -1, 0), s=size)
    energies = float(values[:, -2].sum()), float(raster[..., -2].sum())
    floor = params.min_overlap * min(energies)
    if floor <= 0.0:
        return []
    spectra = _Spectra(
        images=spectrum[:-2], energy=spectrum[-2], mask=spectrum[-1], size=size, floor=floor
    )
    yaws = _yaws(params)
    found: list[list[PlanPose]] = [[] for _ in yaws]

    def task(start: int, stop: int) -> None:
        for index in range(start, stop):
            yaw = float(yaws[index])
            wanted = [turn for turn in (0, 1) if _is_wanted(yaw + turn * np.pi, params)]
            if wanted:
                spun = _source_spectrum(xy / cell, values, yaw, size)
                for turn in wanted:
                    image = _correlation(np.conj(spun) if turn else spun, spectra)
                    found[index] += _maxima(image, yaw + turn * np.pi, target, cell)

    for_blocks(len(yaws), 1, task)
    return [peak for peaks in found for peak in peaks]


def _source_spectrum(
    xy: NDArray[np.float64], values: Raster, yaw: float, size: tuple[int, int]
) -> NDArray[np.complex64]:
    """Return the spectra (3 b + 2, n, m) of the source turned by `yaw` about its pivot.

    The pivot is at index 0 of a periodic image, so another half turn is the conjugate.
    """
    bands = (values.shape[1] - 2) // 3
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turned = values.copy()
    c2, s2 = np.float32(np.cos(2 * yaw)), np.float32(np.sin(2 * yaw))
    turned[:, :bands] = c2 * values[:, :bands] - s2 * values[:, bands : 2 * bands]
    turned[:, bands : 2 * bands] = s2 * values[:, :bands] + c2 * values[:, bands : 2 * bands]
    images = np.zeros((values.shape[1], *size), dtype=np.float32)
    splat(cosine * xy[:, 0] - sine * xy[:, 1], sine * xy[:, 0] + cosine * xy[:, 1], turned, images)
    spectrum: NDArray[np.complex64] = fft.rfft2(images)
    return spectrum


def _correlation(spun: NDArray[np.complex64], spectra: _Spectra) -> NDArray[np.float32]:
    """Return the masked normalised correlation for every shift of the pivot."""
    conjugate = np.conj(spun)
    product = np.einsum("kij,kij->ij", conjugate[:-2], spectra.images)
    parts = np.stack([product, conjugate[-2] * spectra.mask, conjugate[-1] * spectra.energy])
    image, source_energy, target_energy = fft.irfft2(parts, s=spectra.size)
    below = np.maximum(source_energy, spectra.floor) * np.maximum(target_energy, spectra.floor)
    correlation: NDArray[np.float32] = image / np.sqrt(below)
    return correlation


def _maxima(
    image: NDArray[np.float32], yaw: float, target: PlanView, cell: float, count: int = 8
) -> list[PlanPose]:
    """Return the `count` highest local maxima (3 x 3, periodic) of a correlation image."""
    highest = image
    for axis in (0, 1):
        highest = np.maximum(
            highest, np.maximum(np.roll(highest, 1, axis), np.roll(highest, -1, axis))
        )
    row, column = np.nonzero((image >= highest) & (image > 0.0))
    best = np.lexsort((column, row, -image[row, column]))[:count]
    peaks = []
    for r, c in zip(row[best], column[best], strict=True):
        # Shifts beyond the target and half of the margin mean negative ones.
        shift = [
            index - length if index > 0.5 * (length + span) else index
            for index, length, span in zip(
                (c, r),
                (image.shape[1], image.shape[0]),
                (target.high - target.low) / cell,
                strict=True,
            )
        ]
        place = target.low + (np.array(shift) + 0.5) * cell
        peaks.append(PlanPose(yaw=yaw, x=place[0], y=place[1], score=float(image[r, c])))
    return peaks


def pose_transform(pose: PlanPose, height: float, source: PlanView, target: PlanView) -> Transform:
    """Return the local 4x4 of a pose between the levelled frames."""
    cosine, sine = np.cos(pose.yaw), np.sin(pose.yaw)
    level = np.eye(4)
    level[:2, :2] = [[cosine, -sine], [sine, cosine]]
    level[:2, 3] = [pose.x, pose.y] - level[:2, :2] @ source.pivot
    level[2, 3] = height
    into, back = np.eye(4), np.eye(4)
    into[:3, :3] = source.rotation
    back[:3, :3] = target.rotation.T
    transform: Transform = back @ level @ into
    return transform
