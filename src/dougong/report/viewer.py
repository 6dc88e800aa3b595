"""The 3-D view of the report: its scene, its points, and the script that the build put here."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dougong._words import counted
from dougong.report.figures import Place
from dougong.report.layers import Layer, Removed
from dougong.report.looks import SIGNED_TITLE, SIGNED_WORDS, scale_end
from dougong.report.payload import (
    MAX_POINTS,
    REACH_M,
    STEP_M,
    Packed,
    back_motion,
    distances,
    pack,
    shares,
    signed_distances,
    thinned,
)
from dougong.typing import Points, Values

STATIC = Path(__file__).parent / "static"
_EYE_M = 1.5
"""Height of the first level slice: through walls and posts, not through the roof."""
_LINE = 6000
_REMOVED_SHARE = 0.15
"""Share of the page's points that removed ones may take."""
NOT_BUILT = (
    "this copy of dougong was never built with its viewer; install it with pip, with the npm "
    "registry in reach"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class View3D:
    """Everything a page needs to show the clouds in 3-D."""

    scene: dict[str, Any]
    clouds: tuple[Packed, ...]
    script: str
    style: str
    lead: str


def why_missing(static: Path = STATIC) -> str | None:
    """Return why there is no viewer in this installation, None where there is one."""
    record = static / "viewer.json"
    if not record.is_file():
        return NOT_BUILT
    said: dict[str, Any] = json.loads(record.read_text(encoding="utf-8"))
    return None if said["is_built"] else str(said.get("why") or NOT_BUILT)


def view_3d(layers: list[Layer], place: Place, static: Path = STATIC) -> View3D:
    """Return the 3-D view of what a report shows.

    Parameters
    ----------
    layers : list of Layer
    place : Place
        What the views look at.
    static : Path
        Where the built viewer is.
    """
    shown = [layer for layer in layers if layer.is_placed and len(layer.after)]
    counts = [0 if layer.removed is None else len(layer.removed.after) for layer in shown]
    taken = shares(counts, round(_REMOVED_SHARE * MAX_POINTS))
    allowed = shares([len(layer.after) for layer in shown], MAX_POINTS - sum(taken))
    packed, found_all = [], []
    for index, (layer, most, out) in enumerate(zip(shown, allowed, taken, strict=True)):
        chosen = thinned(layer.after, most)
        found = _distances_of(layer.after[chosen], layer, shown)
        if found is not None:
            found_all.append(found[~np.isnan(found)])
        packed.append(
            pack(
                layer.after[chosen],
                source=index,
                element=f"viewer-points-{index}",
                colours=None if layer.colours is None else layer.colours[chosen],
                found=found,
                classes=None if layer.classes is None else layer.classes[chosen],
            )
        )
        if layer.removed is not None and out:
            packed.append(_packed_removed(layer.removed, out, index))
    return View3D(
        scene=_scene(shown, place, packed, found_all),
        clouds=tuple(packed),
        script=(static / "report.js").read_text(encoding="utf-8"),
        style=(static / "viewer.css").read_text(encoding="utf-8"),
        lead=_lead(shown, packed),
    )


def _distances_of(points: Points, layer: Layer, shown: list[Layer]) -> Values | None:
    """Return the distance (n,) to show at some points of a layer: signed where it was measured."""
    measured = [other for other in shown if other.cores is not None]
    if measured:
        # At the reference any registration counts, at another cloud its own.
        own = measured if layer.is_reference else [other for other in measured if other is layer]
        return signed_distances(points, [other.cores for other in own if other.cores is not None])
    others = [other.after for other in shown if other is not layer]
    return distances(points, np.concatenate(others)) if others else None


def _packed_removed(removed: Removed, most: int, index: int) -> Packed:
    chosen = thinned(removed.after, most)
    return pack(
        removed.after[chosen],
        source=index,
        element=f"viewer-removed-{index}",
        reasons=removed.reasons[chosen],
    )


def _scene(
    shown: list[Layer], place: Place, packed: list[Packed], found: list[Any]
) -> dict[str, Any]:
    classes = [np.unique(layer.classes) for layer in shown if layer.classes is not None]
    present = sorted({int(code) for codes in classes for code in codes})
    near = np.concatenate(found) if found else np.zeros(0)
    colours = ["source", "height"]
    colours += ["natural"] if any(layer.colours is not None for layer in shown) else []
    colours += ["residual"] if len(near) else []
    colours += ["class"] if set(present) - {0, 1} else []
    taken = [np.unique(layer.removed.reasons) for layer in shown if layer.removed is not None]
    reasons = sorted({0, *(int(code) for codes in taken for code in codes)})
    colours += ["reason"] if taken else []
    if len(shown) == 1:
        colours = [*colours[1:], "source"]
    level = min(0.5, _EYE_M / (place.top - place.floor))
    height = place.floor + level * (place.top - place.floor)
    reach = max(float(np.abs(layer.after - place.centre).max()) for layer in shown)
    return {
        "sources": [_source(layer, place) for layer in shown],
        "clouds": [cloud.head for cloud in packed],
        "origin": (shown[0].origin if shown[0].origin is not None else np.zeros(3)).tolist(),
        "centre": place.centre.tolist(),
        "radius": place.radius,
        "reach": reach,
        "floor": place.floor,
        "top": place.top,
        "yaw_deg": place.yaw_deg,
        "level": level,
        "thickness_m": _thickness(shown, place, height),
        "colours": colours,
        "natural": _natural(shown),
        "classes": present,
        "precision_m": STEP_M / 2,
        "reasons": reasons,
        "residual": _residual(shown, scale_end(near)),
    }


def _residual(shown: list[Layer], end_m: float) -> dict[str, Any]:
    """Return how distances are drawn and named."""
    is_signed = any(layer.cores is not None for layer in shown)
    return {
        "shown_m": end_m,
        "reach_m": None if is_signed else REACH_M,
        "code_max_m": REACH_M,
        "is_signed": is_signed,
        "title": SIGNED_TITLE if is_signed else "distance to the other cloud",
        "signs": SIGNED_WORDS if is_signed else None,
    }


def _thickness(shown: list[Layer], place: Place, height: float) -> float:
    """Return the thinnest level slice of those on offer in which the building is still a line."""
    points = np.concatenate([layer.after for layer in shown])
    points = points[np.hypot(*(points[:, :2] - place.centre[:2]).T) <= place.radius]
    off = np.abs(points[:, 2] - height)
    # The page holds fewer points than the layers do.
    share = min(1.0, MAX_POINTS / max(sum(len(layer.after) for layer in shown), 1))
    for thickness in (0.05, 0.1, 0.2):
        if share * float((off <= thickness / 2).sum()) >= _LINE:
            return thickness
    return 0.5


def _source(layer: Layer, place: Place) -> dict[str, Any]:
    """Return what the viewer must know of one cloud; its way back to where it was delivered."""
    source: dict[str, Any] = {
        "name": layer.name,
        "colour": list(layer.colour),
        "role": "reference" if layer.is_reference else None if layer.is_sure else "not sure",
        "motion": None,
    }
    if layer.is_reference:
        return source
    own = layer.before
    middle = np.median(own, axis=0)
    inside = own[np.hypot(*(own[:, :2] - middle[:2]).T) <= place.radius]
    middle[2] = np.percentile(inside[:, 2], 3)
    matrix = back_motion(layer)
    matrix[:3, 3] += np.array([*place.centre[:2], place.floor]) - middle
    source["motion"] = matrix.ravel().tolist()
    source["centre"] = np.median(layer.after, axis=0).tolist()
    return source


def _natural(shown: list[Layer]) -> str:
    """Return what the natural colours are, per cloud where they differ."""
    words = []
    for layer in shown:
        if layer.colours is None:
            words.append(f"{layer.name}: no colour in the file")
        elif layer.colours.shape[1] == 1:
            words.append(f"{layer.name}: intensity as grey")
        else:
            words.append(f"{layer.name}: colours of the file")
    return ", ".join(words)


def _lead(shown: list[Layer], packed: list[Packed]) -> str:
    count = sum(cloud.head["points"] for cloud in packed if not cloud.head["has_reason"])
    text = (
        f"{counted(count)}, evenly thinned for this page; positions rounded to "
        f"{STEP_M * 1000:g} mm (off by {STEP_M * 500:g} mm at most along each axis). "
    )
    if any(not layer.is_reference for layer in shown):
        text += (
            "As delivered: every cloud in its own axes, set down about one middle and not turned. "
        )
    if any(layer.cores is not None for layer in shown):
        text += (
            "Distance: signed, along the surface's normal, of the nearest core point (M3C2); "
            f"{SIGNED_WORDS}. "
        )
    elif len(shown) > 1:
        text += (
            "Distance: from a point to the plane through the 8 nearest points of the other clouds. "
        )
    out = sum(cloud.head["points"] for cloud in packed if cloud.head["has_reason"])
    if out:
        text += (
            f"Removed: {counted(out)} that the filters took out, each coloured by its reason; they "
            "are no part of the result. Decimated points are not among them."
        )
    return text.rstrip()
