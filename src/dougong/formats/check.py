"""Find what is wrong with a point cloud file, and say what to do about it.

One pass in chunks. Kept per point: 8 bytes for the duplicates; kept of the cloud: every k-th
point for the wide box.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong._words import counted, of_all
from dougong.cloud import Cloud, Frame
from dougong.errors import FormatError
from dougong.formats.describe import describe
from dougong.formats.faults import (
    COARSE_M,
    FEW,
    SAMPLE,
    coordinate_hashes,
    copies_among,
    unit_suspicion,
    wide_box,
)
from dougong.formats.model import FileInfo, Finding
from dougong.formats.projection import projection_problem
from dougong.formats.registry import iterate
from dougong.formats.stream import unit_notes
from dougong.formats.units import metric_problem
from dougong.typing import Points

_CHUNK = 1_000_000


@dataclass
class _Tally:
    """What one pass over the cloud gathers."""

    frame: Frame = field(default_factory=Frame)
    rows: int = 0
    hashes: list[NDArray[np.uint64]] = field(default_factory=list)
    samples: list[Points] = field(default_factory=list)
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -np.inf))
    at_origin: int = 0
    common_step: list[int] = field(default_factory=lambda: [0, 0, 0])
    """LAS: greatest common divisor of the integer coordinates."""
    colour_max: int = -1
    notes: list[str] = field(default_factory=list)

    def add(self, cloud: Cloud, stride: int) -> None:
        """Count a chunk in."""
        self.frame = cloud.frame
        self.rows += len(cloud)
        said = unit_notes(cloud.frame)  # `_of_frame` says these as warnings
        self.notes += [note for note in cloud.notes if note not in said]
        self.hashes.append(coordinate_hashes(cloud.xyz))
        self.samples.append(cloud.xyz[::stride])
        self.low = np.minimum(self.low, cloud.xyz.min(axis=0))
        self.high = np.maximum(self.high, cloud.xyz.max(axis=0))
        # On a lattice that 0, 0, 0 is not on it was rounded to the nearest place.
        step = np.multiply(cloud.frame.step or (0.0, 0.0, 0.0), cloud.frame.unit_m)
        near = np.abs(cloud.xyz + cloud.frame.origin) <= 0.500001 * step
        self.at_origin += int(near.all(axis=1).sum())
        names = cloud.records.dtype.names or ()
        if {"X", "Y", "Z"} <= set(names) and cloud.records.dtype["X"].kind == "i":
            for axis, name in enumerate("XYZ"):
                values = cloud.records[name].astype(np.int64)
                step = int(np.gcd.reduce(values - values[0]))
                self.common_step[axis] = int(np.gcd(self.common_step[axis], step))
        red = cloud.attribute("red")
        if red is not None and red.dtype.itemsize == 2:
            self.colour_max = max(self.colour_max, int(red.max()))


def check(path: Path | str) -> list[Finding]:
    """Return what is wrong with a file, errors first; an empty list means: nothing found.

    A file that cannot be read at all gives one error. Everything else is a warning (handled when
    the file is used, but worth knowing) or information.
    """
    path = Path(path)
    try:
        info = describe(path)
        tally = _pass(path, info)
        if tally.rows == 0:
            return [Finding("error", f"{path.name} holds no points. Export it again.")]
    except FormatError as error:
        return [Finding("error", str(error))]
    findings = [
        *_of_frame(info, tally),
        *_of_step(info, tally),
        *_of_box(info, tally),
        *_of_points(path, info, tally),
    ]
    order = {"error": 0, "warning": 1, "info": 2}
    return sorted(findings, key=lambda finding: order[finding.severity])


def _pass(path: Path, info: FileInfo) -> _Tally:
    tally = _Tally()
    for chunk in iterate(path, _CHUNK):
        if len(chunk):
            tally.add(chunk, max(1, info.points // SAMPLE))
    return tally


def _of_frame(info: FileInfo, tally: _Tally) -> list[Finding]:
    name = info.path.name
    if info.crs_wkt is None:
        text = (
            f"{name} has no coordinate reference system; its numbers are taken as metres. "
            "That is right for a scanner's own coordinates; otherwise export it with one."
        )
        return [Finding("warning", text)]
    # Of the points, since a header's box may be stale, and one stray would move the middle of both.
    middle = tally.frame.to_file(np.median(np.concatenate(tally.samples), axis=0)[None])[0]
    problem = metric_problem(info.crs_wkt, middle, middle, name)
    problem = problem or projection_problem(info.crs_wkt, middle, name)
    if problem:
        return [Finding("error", problem)]
    if info.unit_m != (1.0, 1.0, 1.0):
        units = ", ".join(
            f"{axis} in {unit}" for axis, unit in zip("xyz", info.unit_names, strict=True)
        )
        text = f"{name} is not in metres ({units}); it is converted while reading."
        return [Finding("warning", text)]
    return []


def _of_step(info: FileInfo, tally: _Tally) -> list[Finding]:
    found: list[Finding] = []
    if info.scale is None:
        return found
    name = info.path.name
    coarse = []
    for axis in range(3):
        step_m = info.scale[axis] * info.unit_m[axis]
        used = tally.common_step[axis]
        if used * step_m >= COARSE_M * (1 - 1e-9) and used > 1 and tally.rows >= FEW:
            text = (
                f"{name}: every {'xyz'[axis]} is a multiple of {used * step_m:.3g} m, coarser than "
                "the file's own step; detail was lost before this file was written."
            )
            found.append(Finding("warning", text))
        elif step_m >= COARSE_M * (1 - 1e-9):
            coarse.append(f"{'xyz'[axis]} in steps of {step_m:.3g} m")
    if coarse:
        text = (
            f"{name} stores {', '.join(coarse)}: too coarse for a building. "
            "Export it with a scale of 0.001 m or finer."
        )
        found.append(Finding("warning", text))
    if tally.colour_max == 0:
        found.append(Finding("info", f"{name} has room for colours but no colours: all are 0."))
    elif 0 < tally.colour_max <= 255:
        text = f"{name} has colours in 0..{tally.colour_max} where LAS has 0..65535: it looks dark."
        found.append(Finding("info", text))
    return found


def _of_box(info: FileInfo, tally: _Tally) -> list[Finding]:
    """LAS only: points outside the box of the header mean a stale header or damaged points."""
    if info.scale is None or info.extent_min is None or info.extent_max is None:
        return []
    low, high = tally.frame.to_local(np.array([info.extent_min, info.extent_max]))
    beyond = float(np.maximum(low - tally.low, tally.high - high).max())
    if beyond <= 1.01 * max(np.multiply(info.scale, info.unit_m)):
        return []
    text = (
        f"{info.path.name}: points lie up to {beyond:.3g} m outside the box its header states: "
        "the header is stale or the points are damaged. Compare it with the original."
    )
    return [Finding("warning", text)]


def _of_points(path: Path, info: FileInfo, tally: _Tally) -> list[Finding]:
    # What reading handled (bad rows, guessed columns) is already counted in words.
    found = [
        Finding(
            "warning" if "dropped" in note or "wrongly" in note else "info",
            f"{path.name}: {note}",
        )
        for note in dict.fromkeys(tally.notes)
    ]
    copies = copies_among(np.concatenate(tally.hashes))
    if 0 < copies == tally.rows - 1:
        place = ", ".join(f"{value:.10g}" for value in tally.frame.to_file(tally.low[None])[0])
        text = (
            f"{path.name}: all {tally.rows:,} points lie at one place ({place}), so it shows "
            "nothing. Export it again."
        )
        found.append(Finding("error", text))
    elif copies:
        text = (
            f"{path.name}: {of_all(copies, tally.rows, 'lies', 'lie')} exactly on another one. "
            "The voxel grid keeps one of each."
        )
        found.append(Finding("warning", text))
    origin = tally.frame.origin
    sample = np.concatenate(tally.samples)
    if tally.rows < FEW:
        text = f"{path.name} holds only {counted(tally.rows)}: too few to filter or register."
        found.append(Finding("warning", text))
    elif suspicion := unit_suspicion(sample, tally.frame):
        found.append(Finding("warning", f"{path.name}: {suspicion}"))
    low, high = wide_box(sample)
    is_inside_origin = bool(((-origin >= low) & (-origin <= high)).all())
    if tally.at_origin and (tally.at_origin > 1 or not is_inside_origin):
        text = (
            f"{path.name}: {counted(tally.at_origin)} exactly at 0, 0, 0, as scanners write "
            "missing returns. Drop what is there."
        )
        found.append(Finding("warning", text))
    return found + _far_points(path, info, tally, low, high)


def _far_points(path: Path, info: FileInfo, tally: _Tally, low: Any, high: Any) -> list[Finding]:
    if (tally.low >= low).all() and (tally.high <= high).all():
        return []
    count, farthest = 0, 0.0
    for chunk in iterate(path, _CHUNK):
        beyond = np.maximum(low - chunk.xyz, chunk.xyz - high).max(axis=1)
        count += int((beyond > 0).sum())
        farthest = max(farthest, float(beyond.max()))
    text = (
        f"{path.name}: {of_all(count, info.points, 'lies', 'lie')} far from all others, up to "
        f"{farthest:,.0f} m. Filters drop most of them; crop them before other use."
    )
    return [Finding("warning", text)]
