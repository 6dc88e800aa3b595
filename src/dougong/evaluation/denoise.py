"""What noise filters take and what they leave: rates, trade-off curves, and a study over samples.

Every filter is run as a score per point (larger: sooner removed), so that its whole curve of noise
removed against feature points kept is known, and at its own settings. Definitions: METHOD.md 5.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation import facade
from dougong.evaluation.denoise_noise import (
    NOISE_KINDS,
    Pattern,
    Sample,
    local_spacing,
    make_sample,
    surface_distance,
)
from dougong.evaluation.denoise_shapes import SHAPES, mesh_of_facade
from dougong.evaluation.mesh import FINE, OUTLIER, SURFACE, VEGETATION
from dougong.filters.curvature_weighted import CurvatureWeighted, curvature_weighted, excess
from dougong.filters.radius import Radius, radius
from dougong.filters.statistical import Statistical, mean_distances, statistical
from dougong.typing import Mask, Points, Values

LEVELS = (0.90, 0.92, 0.94, 0.95, 0.96, 0.97, 0.98, 0.985, 0.99, 0.995, 0.999)
"""Feature retention at which the curves are read."""
DENSITIES = {
    "facade": 300.0, "tiles": 2000.0, "rods": 1500.0,
    "inscription": 20_000.0, "statue": 5000.0, "tree": 1000.0,
}  # fmt: skip
"""Points per square metre of each test piece, unless told otherwise."""
_PATCH_M = 0.25
_PATCH_POINTS = 8


class Method(NamedTuple):
    """A filter at one setting."""

    name: str
    is_kept: Callable[[Points], Mask]


def _cwasf(name: str, **settings: Any) -> Method:
    params = CurvatureWeighted(**settings)
    return Method(name, lambda points: curvature_weighted(points, params).is_kept)


def _sor(name: str, **settings: Any) -> Method:
    params = Statistical(**settings)
    return Method(name, lambda points: statistical(points, params).is_kept)


METHODS: tuple[Method, ...] = (
    _cwasf("CWASF paper", rule="paper"),
    _cwasf("CWASF global", rule="global"),
    _cwasf("CWASF protective", rule="protective"),
    *(_sor(f"SOR 0.15 m, {m:g} sigma", radius_m=0.15, multiplier=m) for m in (0.5, 1.0, 2.0, 3.0)),
    *(_sor(f"SOR k = 20, {m:g} sigma", neighbours=20, multiplier=m) for m in (1.0, 2.0)),
    Method("ROR 4 in 0.10 m", lambda points: radius(points, Radius()).is_kept),
)
"""The filters of the tables, at the settings that people use."""


def facade_sample(density: float = 300.0, noise_share: float = 0.02, seed: int = 0) -> Sample:
    """Return the bracketed facade of METHOD.md 1.3 with its three kinds of noise."""
    points, labels = facade.bracketed_facade(density, noise_share, seed)
    is_noise = labels >= OUTLIER
    spacing = local_spacing(points[~is_noise], points[is_noise])
    limit = np.maximum(3 * 0.002, spacing)
    is_separable = np.zeros(len(points), bool)
    mesh, rng = mesh_of_facade(), np.random.default_rng(seed)
    is_separable[is_noise] = surface_distance(points[is_noise], mesh, rng) > limit
    return Sample(
        name="facade of the paper",
        points=points,
        labels=labels,
        is_separable=is_separable,
        spacing_m=float(np.median(spacing)),
    )


def _percent(chosen: NDArray[Any]) -> float:
    return float(100.0 * chosen.mean()) if len(chosen) else float("nan")


def worst_patches(is_kept: Mask, sample: Sample) -> float:
    """Return the retention, percent, of the true points in the 5 % of 0.25 m cells that lose most.

    Cells with fewer than 8 true points are left out; vegetation does not count.
    """
    is_true = (sample.labels == SURFACE) | (sample.labels == FINE)
    cells = np.floor(sample.points[is_true] / _PATCH_M).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    held = np.bincount(cell.ravel())
    kept = np.bincount(cell.ravel(), weights=is_kept[is_true].astype(np.float64))
    enough = held >= _PATCH_POINTS
    held, kept = held[enough], kept[enough]
    if not len(held):
        return float("nan")
    worst = np.argsort(kept / held, kind="stable")[: max(1, round(0.05 * len(held)))]
    return float(100.0 * kept[worst].sum() / held[worst].sum())


def rates(is_kept: Mask, sample: Sample) -> dict[str, float]:
    """Return removal and retention, percent; NaN where the sample has none of a kind."""
    labels, gone = sample.labels, ~is_kept
    row = {
        "noise": _percent(gone[sample.is_noise]),
        "separable": _percent(gone[sample.is_separable]),
        "feature": _percent(is_kept[labels == FINE]),
        "flat": _percent(is_kept[labels == SURFACE]),
        "vegetation": _percent(is_kept[labels == VEGETATION]),
        "worst_patches": worst_patches(is_kept, sample),
    }
    for label, name in NOISE_KINDS.items():
        row[f"separable_{name}"] = _percent(gone[sample.is_separable & (labels == label)])
    return row


def summary(
    rows: Iterable[Mapping[str, Any]], by: str, columns: Sequence[str]
) -> dict[str, list[tuple[float, float]]]:
    """Return mean and standard deviation of each column, for every value of column `by`."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(str(row[by]), []).append(row)
    return {
        name: [
            (float(np.nanmean(values)), float(np.nanstd(values)))
            if not np.isnan(values).all()
            else (float("nan"), float("nan"))
            for values in (np.array([row[column] for row in group]) for column in columns)
        ]
        for name, group in groups.items()
    }


def curve(score: NDArray[np.float64], sample: Sample) -> list[dict[str, float]]:
    """Return, at every feature retention of `LEVELS`, what else a cut of `score` keeps and takes.

    Parameters
    ----------
    score : ndarray, shape (n,)
        Points above the cut are removed; infinity always.
    sample : Sample
        Must hold feature points.
    """
    feature = np.sort(score[sample.labels == FINE])
    flat = score[sample.labels == SURFACE]
    points = []
    for level in LEVELS:
        cut = feature[min(len(feature) - 1, int(np.ceil(level * len(feature))) - 1)]
        points.append(
            {
                "feature": 100.0 * level,
                "separable": _percent(score[sample.is_separable] > cut),
                "flat": _percent(flat <= cut),
                "cut": float(cut),
            }
        )
    return points


def scores(sample: Sample) -> dict[str, Values]:
    """Return a score per point for each filter whose curve is drawn: larger goes sooner.

    ROR is given a radius of 2.5 spacings, which its user would have to know.
    """
    points = sample.points
    held = radius(points, Radius(radius_m=2.5 * sample.spacing_m)).attributes["neighbour_count"]
    ours = curvature_weighted(points, CurvatureWeighted(rule="protective"))
    return {
        "SOR k = 8": mean_distances(points, Statistical(neighbours=8)),
        "SOR k = 20": mean_distances(points, Statistical(neighbours=20)),
        "SOR 0.15 m": mean_distances(points, Statistical(radius_m=0.15)),
        "ROR 2.5 spacings": -held.astype(np.float64),
        "CWASF paper": excess(points),
        "CWASF protective": ours.attributes["removal_margin"],
    }


def study(
    shapes: Sequence[str] = tuple(SHAPES),
    patterns: Sequence[Pattern] = ("poisson", "gradient", "scan"),
    seeds: Sequence[int] = (0,),
    *,
    noise_share: float = 0.03,
    samples: Iterable[Sample] | None = None,
) -> list[dict[str, Any]]:
    """Run every filter over the test pieces and return plain rows, ready for JSON.

    Parameters
    ----------
    shapes : sequence of str
        Names of `SHAPES`.
    patterns : sequence of {"poisson", "gradient", "scan"}
    seeds : sequence of int
        Each draws shape, points and noise anew.
    noise_share : float
        Noise among the clean points, equally of each kind.
    samples : iterable of Sample, optional
        Study these instead.

    Returns
    -------
    list of dict
        Per sample and filter: ``sample``, ``points``, ``filter``, the rates (`rates`) at the
        settings of `METHODS`; for filters in `scores` a row with ``curve`` (`curve`) too.
    """
    given = _pieces(shapes, patterns, seeds, noise_share) if samples is None else samples
    rows: list[dict[str, Any]] = []
    for sample in given:
        about = {"sample": sample.name, "points": len(sample.points)}
        for method in METHODS:
            row = rates(method.is_kept(sample.points), sample)
            rows.append({**about, "filter": method.name, **row})
        for name, score in scores(sample).items():
            rows.append({**about, "filter": name, "curve": curve(score, sample)})
    return rows


def _pieces(
    shapes: Sequence[str], patterns: Sequence[Pattern], seeds: Sequence[int], share: float
) -> Iterable[Sample]:
    for seed in seeds:
        for name in shapes:
            shape = SHAPES[name](np.random.default_rng([seed, 1]))
            for pattern in patterns:
                yield make_sample(
                    f"{name}, {pattern}",
                    shape,
                    density=DENSITIES[name],
                    pattern=pattern,
                    noise_share=share,
                    seed=seed,
                )
