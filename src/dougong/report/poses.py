"""The poses that were compared, drawn: score against yaw, and where each puts the cloud."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dougong.report.drawing import View, draw_dots
from dougong.report.figures import Figure, Place
from dougong.report.layers import COLOURS, Layer
from dougong.report.plates import plate
from dougong.typing import Points, Transform

_SHOWN = 3
_SAME_YAW_DEG, _SAME_PLACE_M = 5.0, 0.5
_POINTS = 60_000
_GREY = (150, 156, 160)
_RIVALS = (COLOURS[2], COLOURS[1])
_SIDE_PX = 640


def score_chart(hypotheses: tuple[Mapping[str, Any], ...], margin: float) -> str:
    """Return the scores of the listed poses over their yaw, as SVG."""
    width, height, left, low = 620, 230, 44, 44
    span, tall = width - left - 16, height - low - 30

    def at(yaw: float, score: float) -> tuple[float, float]:
        turn = (yaw + 180.0) % 360.0 - 180.0
        return left + (turn + 180.0) / 360.0 * span, height - low - score * tall

    marks = []
    for rank, hypothesis in reversed(list(enumerate(hypotheses))):
        x, y = at(hypothesis["yaw_deg"], hypothesis["score"])
        kind = "best" if rank == 0 else "rival"
        marks.append(f'<path class="stem {kind}" d="M{x:.1f} {height - low}V{y:.1f}"/>')
        shape = (
            f'<circle class="best" cx="{x:.1f}" cy="{y:.1f}" r="7"/>'
            if rank == 0
            else f'<path class="rival" d="M{x:.1f} {y - 6:.1f}l6 10h-12z"/>'
        )
        marks.append(shape)
    best, words = hypotheses[0], ""
    if len(hypotheses) > 1:
        _, y1 = at(0.0, best["score"])
        _, y2 = at(0.0, best["score"] * (1.0 - margin))
        x = width - 26
        words = (
            f'<path class="margin" d="M{x - 6} {y1:.1f}h12M{x} {y1:.1f}V{y2:.1f}M{x - 6} {y2:.1f}'
            f'h12"/><text x="{x + 10}" y="{y1 - 8:.1f}" text-anchor="end">margin '
            f"{margin:.2f}</text>"
        )
    ticks = "".join(
        f'<text x="{at(yaw, 0)[0]:.0f}" y="{height - low + 18}" text-anchor="middle">'
        f"{yaw:.0f}</text>"
        for yaw in (-180, -90, 0, 90, 179.99)
    )
    return (
        f'<svg class="chart scores" viewBox="0 0 {width} {height}" role="img" aria-label="score of '
        f'the {len(hypotheses)} listed poses over their yaw; margin {margin:.2f}">'
        f'<path class="axis" d="M{left} 20V{height - low}H{width - 16}"/>'
        f'<text x="{left - 8}" y="{at(0, 1)[1] + 5:.0f}" text-anchor="end">1</text>'
        f'<text x="{left - 8}" y="{height - low + 4}" text-anchor="end">0</text>'
        f"{ticks}{''.join(marks)}{words}"
        f'<text x="{left + span / 2:.0f}" y="{height - 4}" text-anchor="middle">yaw, deg</text>'
        "</svg>"
    )


def rival_poses(hypotheses: tuple[Mapping[str, Any], ...], middle: Points) -> list[int]:
    """Return the best pose and the next ones that differ from those before by 5 deg or 0.5 m.

    Parameters
    ----------
    hypotheses : tuple of mapping
        Best first.
    middle : ndarray, shape (1, 3)
        Where in the source's file coordinates places are compared.
    """
    chosen: list[int] = []
    for number, hypothesis in enumerate(hypotheses):
        place = _moved(np.array(hypothesis["matrix"]), middle)
        is_new = True
        for other in chosen:
            turn = hypothesis["yaw_deg"] - hypotheses[other]["yaw_deg"]
            turn = abs((turn + 180.0) % 360.0 - 180.0)
            gap = np.linalg.norm(place - _moved(np.array(hypotheses[other]["matrix"]), middle))
            is_new &= bool(turn > _SAME_YAW_DEG or gap > _SAME_PLACE_M)
        if is_new:
            chosen.append(number)
    return chosen[:_SHOWN]


def _moved(matrix: Transform, points: Points) -> Points:
    moved: Points = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def pose_plans(
    hypotheses: tuple[Mapping[str, Any], ...], source: Layer, target: Layer, place: Place
) -> tuple[Figure, ...]:
    """Return a plan for each competing pose: the source under it, over the reference.

    `source` lies under the first pose. Empty where there is none to compete with.
    """
    if source.origin is None or not source.is_placed or not hypotheses:
        return ()
    common = source.origin
    first = np.array(hypotheses[0]["matrix"])
    points = source.after[:: max(1, len(source.after) // _POINTS)]
    own = (points + (common - first[:3, 3])) @ np.linalg.inv(first[:3, :3]).T
    chosen = rival_poses(hypotheses, np.median(own, axis=0, keepdims=True))
    if len(chosen) < 2:
        return ()
    ground = target.after[:: max(1, len(target.after) // _POINTS)]
    view = View(
        right=np.array([1.0, 0.0, 0.0]),
        up=np.array([0.0, 1.0, 0.0]),
        towards=np.array([0.0, 0.0, 1.0]),
        centre=place.centre,
        width_m=2.6 * place.radius,
        width_px=_SIDE_PX,
        height_px=_SIDE_PX,
    )
    high = place.floor + 0.15 * (place.top - place.floor)
    figures = []
    for rank, number in enumerate(chosen):
        hypothesis = hypotheses[number]
        there = _moved(np.array(hypothesis["matrix"]), own) - common
        colour = source.colour if rank == 0 else _RIVALS[rank - 1]
        image = draw_dots(
            [(ground[ground[:, 2] > high], _GREY), (there[there[:, 2] > high], colour)], view, 2
        )
        title = "The pose taken" if rank == 0 else f"Rival {rank}"
        figures.append(
            Figure(
                title=title,
                caption=(
                    f"Score {hypothesis['score']:.3f}, yaw {hypothesis['yaw_deg']:.1f} deg; the "
                    "reference in grey, without the ground."
                ),
                svg=plate(image, view, f"plan of {title.lower()}", text_px=24),
            )
        )
    return tuple(figures)
