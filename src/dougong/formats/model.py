"""What this room hands over besides clouds: a file's description, findings, a written file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Triple = tuple[float, float, float]


def as_triple(values: NDArray[np.float64]) -> Triple:
    """Return three numbers of an array as plain floats."""
    return (float(values[0]), float(values[1]), float(values[2]))


@dataclass(frozen=True, slots=True, kw_only=True)
class FileInfo:
    """What a point cloud file says about itself."""

    path: Path
    format: str
    """LAS, LAZ, COPC, E57, PLY, PCD or text."""
    version: str
    points: int
    bytes: int
    is_compressed: bool
    stations: int = 1
    """Scans kept apart in the file (E57); 1 elsewhere."""
    extent_min: Triple | None = None
    """Low corner in file units and file coordinates; None: no finite point."""
    extent_max: Triple | None = None
    crs_wkt: str | None = None
    crs_name: str | None = None
    unit_names: tuple[str, str, str] = ("metre", "metre", "metre")
    """Units of x, y, z; "metre" where the file names none."""
    unit_m: Triple = (1.0, 1.0, 1.0)
    """Metres per file unit along x, y, z."""
    attributes: Mapping[str, str] = field(default_factory=dict)
    """Name to dtype, coordinates included."""
    scale: Triple | None = None
    offset: Triple | None = None
    point_format: int | None = None
    """LAS point format."""
    notes: tuple[str, ...] = ()


class Hold(NamedTuple):
    """What a writer that must see all points may hold of them, and where the rest goes."""

    points: int
    folder: Path


Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing `check` found: what is wrong and what to do."""

    severity: Severity
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedStation:
    """A scan of an E57 file with its pose."""

    index: int
    """Its place in the file it came from, from 0."""
    name: str
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z), scanner to file coordinates."""
    translation: Triple
    """Metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """A finished output file."""

    path: Path
    points: int
    bytes: int
    notes: tuple[str, ...] = ()
    """What the format could not hold, or holds in another way; counted, in words."""
    stations: tuple[PlacedStation, ...] = ()
    """E57 issued again: where each of its scans stands now."""
