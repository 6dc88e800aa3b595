"""What a report draws beyond the clouds themselves: distances, poses, removal, coverage."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dougong.report.coverage import Coverage, coverage
from dougong.report.figures import Figure, Place
from dougong.report.layers import Layer
from dougong.report.poses import pose_plans
from dougong.report.removal import Removal, removals
from dougong.report.residuals import Residuals, residuals


@dataclass(frozen=True, slots=True, kw_only=True)
class Annex:
    """By link or cloud, what there is to show."""

    residuals: tuple[Residuals, ...] = ()
    poses: Mapping[str, tuple[Figure, ...]] = field(default_factory=dict)
    """By the source's name."""
    removals: Mapping[str, Removal] = field(default_factory=dict)
    """By the cloud's name."""
    coverage: Coverage | None = None


def annex_of(
    folder: Path, document: Mapping[str, Any], layers: list[Layer], place: Place | None
) -> Annex:
    """Return the annex of a run's or a registration's document.

    Parameters
    ----------
    folder : Path
        Where the result's files are.
    document : mapping
        Of ``result.json`` or ``registration.json``.
    layers : list of Layer
        Empty where the clouds are gone.
    place : Place, optional
        None where there are no layers.
    """
    is_run = "registrations" in document
    links = document["registrations"] if is_run else [document]
    found = [residuals(folder, link) for link in links]
    by_name = {layer.name: layer for layer in layers}
    poses = {}
    for link in links:
        source, target = by_name.get(link["source"]), by_name.get(link["target"])
        if source is not None and target is not None and place is not None:
            listed = tuple(link["coarse"]["hypotheses"])
            poses[link["source"]] = pose_plans(listed, source, target, place)
    return Annex(
        residuals=tuple(one for one in found if one is not None),
        poses=poses,
        removals=removals(folder, document, layers) if is_run else {},
        coverage=coverage(layers, document, place) if is_run and place is not None else None,
    )
