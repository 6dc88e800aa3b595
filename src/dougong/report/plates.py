"""Pictures as small SVG plates: the drawing, a scale bar, a frame round what is enlarged."""

import base64
from dataclasses import dataclass

import numpy as np

from dougong.report.drawing import Image, View, png
from dougong.typing import Values


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A rectangle drawn on a plate, pixels."""

    left: float
    top: float
    width: float
    height: float


def round_length(metres: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most `metres`."""
    power = 10.0 ** np.floor(np.log10(metres))
    return float(max(step * power for step in (1, 2, 5) if step * power <= metres * (1 + 1e-9)))


def length_text(metres: float) -> str:
    """Return a length with its unit: ``20 m``, ``50 cm``, ``5 mm``."""
    if metres >= 1:
        return f"{metres:g} m"
    return f"{metres * 100:g} cm" if metres >= 0.01 else f"{metres * 1000:g} mm"


def plate(
    image: Image,
    view: View,
    label: str,
    marks: tuple[Mark, ...] = (),
    text_px: int = 16,
    over: str = "",
) -> str:
    """Return an SVG of `image` with a scale bar.

    Parameters
    ----------
    image : ndarray, shape (height, width, 4)
    view : View
        Whose scale the bar shows.
    label : str
        What is to be seen, for readers who cannot see it; plain words, no markup.
    marks : tuple of Mark
        Rectangles round enlarged parts.
    text_px : int
        Size of the text, in pixels of the picture: larger where the page shows it smaller.
    over : str
        More SVG, drawn over the picture.
    """
    height, width = image.shape[:2]
    data = base64.b64encode(png(image)).decode("ascii")
    bar = round_length(view.width_m / 4)
    pixels = bar / view.pixel_m
    y = height - 18
    frames = "".join(
        f'<rect class="mark" x="{mark.left:.1f}" y="{mark.top:.1f}" '
        f'width="{mark.width:.1f}" height="{mark.height:.1f}"/>'
        for mark in marks
    )
    text = label.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{text}">'
        f'<image width="{width}" height="{height}" href="data:image/png;base64,{data}"/>'
        f"{frames}{over}"
        f'<path class="bar" d="M18 {y - 6}V{y}H{18 + pixels:.1f}V{y - 6}"/>'
        f'<text class="bar-text" x="{26 + pixels:.1f}" y="{y + 1}" style="font-size:{text_px}px">'
        f"{length_text(bar)}</text></svg>"
    )


def line_chart(values: Values, unit: str, label: str) -> str:
    """Return a small SVG line chart of `values` (n,) over their index, from zero."""
    width, height, left, low = 520, 150, 58, 26
    top = float(np.max(values)) * 1.08 or 1.0
    count = max(len(values) - 1, 1)
    x = left + np.arange(len(values)) / count * (width - left - 14)
    y = height - low - np.asarray(values) / top * (height - low - 12)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{label}">'
        f'<path class="axis" d="M{left} 10V{height - low}H{width - 10}"/>'
        f'<text x="{left - 8}" y="18" text-anchor="end">{top:.3g}</text>'
        f'<text x="{left - 8}" y="{height - low}" text-anchor="end">0</text>'
        f'<text x="{left - 8}" y="{(height - low) / 2 + 8}" text-anchor="end">{unit}</text>'
        f'<text x="{left}" y="{height - 8}">first iteration</text>'
        f'<text x="{width - 10}" y="{height - 8}" text-anchor="end">{len(values)}</text>'
        f'<polyline class="line" points="{points}"/>'
        f'<circle class="dot" cx="{x[-1]:.1f}" cy="{y[-1]:.1f}" r="3.5"/></svg>'
    )
