"""How the points of a file can be coloured, by its first points."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud
from dougong.formats import iterate
from dougong.report.payload import REACH_M
from dougong.report.plates import round_length

RESIDUALS = ("m3c2_distance", "M3C2 distance", "m3c2_signed_distance")
"""Attributes that hold signed distances (metres) to the other clouds, the first found counts."""
SIGNED_TITLE = "signed distance along the normals (M3C2)"
SIGNED_WORDS = "+ where the registered cloud stands outside the reference, − inside"
_SAMPLE = 100_000
_UNCLASSIFIED = {0, 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What a viewer must know to colour a file."""

    colours: frozenset[str]
    """Of the colourings natural, class, reason, residual: those that mean something here."""
    grey: tuple[float, float]
    """Intensities that are drawn black and white."""
    colour_bits: int
    residual: str | None
    """The attribute with signed distances."""
    residual_shown_m: float
    """End of the scale of distances: a round length above nine tenths of them."""
    reasons: frozenset[int]


def look_at(path: Path) -> Look:
    """Return how a COPC file is coloured, by its first points (its coarsest level)."""
    sample = next(iter(iterate(path, _SAMPLE)))
    colours = set()
    grey = (0.0, 65535.0)
    intensity = sample.attribute("intensity")
    if intensity is not None and intensity.any():
        low, high = np.percentile(intensity, [1, 99])
        grey = (float(low), float(high))
        colours.add("natural")
    channels = [sample.attribute(name) for name in ("red", "green", "blue")]
    peak = max((int(channel.max()) for channel in channels if channel is not None), default=0)
    if peak:
        colours.add("natural")
    classes = sample.attribute("classification")
    if classes is not None and set(np.unique(classes).tolist()) - _UNCLASSIFIED:
        colours.add("class")
    codes = sample.attribute("dougong_reason")
    reasons = frozenset() if codes is None else frozenset(int(code) for code in np.unique(codes))
    if reasons - {0}:
        colours.add("reason")
    residual = residual_name(sample)
    shown = 0.05
    if residual is not None:
        colours.add("residual")
        shown = scale_end(sample.attribute(residual))
    return Look(
        colours=frozenset(colours),
        grey=grey,
        colour_bits=16 if peak > 255 else 8,
        residual=residual,
        residual_shown_m=shown,
        reasons=reasons,
    )


def residual_name(cloud: Cloud) -> str | None:
    """Return the attribute of `cloud` with signed distances to the other clouds, if it has one."""
    return next((name for name in RESIDUALS if name in cloud.attributes), None)


def scale_end(found: np.typing.ArrayLike | None) -> float:
    """Return the end of a scale of distances: a round length above nine tenths of `found` (n,)."""
    sizes = np.abs(np.asarray(found if found is not None else [], dtype=np.float64))
    sizes = sizes[np.isfinite(sizes)]
    if not len(sizes):
        return 0.05
    ninth = float(np.clip(np.percentile(sizes, 90), 0.004, REACH_M / 2))
    return min(round_length(2.2 * ninth), REACH_M)
