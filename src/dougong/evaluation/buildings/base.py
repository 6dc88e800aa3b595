"""What a building hands to the scene round it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.mesh import Mesh


@dataclass(frozen=True, slots=True, kw_only=True)
class Building:
    """A building in site coordinates: metres, z up, level ground at z = 0 round it."""

    mesh: Mesh
    stations: NDArray[np.float64]
    """(k, 3) where a surveyor would stand: x, y and the height of the floor there."""
    half: tuple[float, float]
    """Half extents of the built-up area in x and y; level ground reaches this far."""
    front: float = -90.0
    """The direction of the main entrance, degrees."""
    back: float | None = None
    """Ground behind this y does not exist (the rock of a cliff stands there)."""
    paths: tuple[tuple[float, float, float, float], ...] = field(default=())
    """Paved strips: x0, y0, x1, y1."""
