"""Whole runs of the program on surveyed buildings: files in, result out, judged by the truth."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.evaluation.hard_trials import Base, base_of, two_scans
from dougong.evaluation.metrics import PoseErrors, Truth, pose_errors
from dougong.evaluation.scanner import Scanner
from dougong.evaluation.scenes import make_scene
from dougong.formats import write
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import from_files
from dougong.pipeline.run import run
from dougong.pipeline.store import Store
from dougong.registration.checks import level_of

DRONE_SHARE = 0.6
"""Points of a drone's cloud / points of the scanner's."""
SYSTEMATIC = Scanner(range_offset_m=0.002, angle_noise_deg=0.004, compensator_error_deg=0.002)
"""A scanner with a wrong instrument constant, twice the angular noise and 7 arc seconds of tilt
left at each station; the other scanner of its pair has the constant with the other sign."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Surveyed:
    """Two clouds of one building and how they really lie."""

    source: Cloud
    target: Cloud
    truth: Truth
    is_scan: bool
    """The target is another scan, not a drone's cloud."""


def by_drone(kind: str, seed: int, points: int) -> Surveyed:
    """Survey a building from the ground and from the air."""
    flown = round(DRONE_SHARE * points)
    scene = make_scene(kind, seed, lidar_points=points, photogrammetry_points=flown)
    return Surveyed(
        source=scene.lidar, target=scene.photogrammetry, truth=scene.truth, is_scan=False
    )


def by_scanner(kind: str, seed: int, points: int) -> Surveyed:
    """Scan a building twice, from other stations; noise is independent, nothing else is wrong."""
    return _scanned(_base(kind, seed, points, Scanner()), seed)


def by_faulty_scanners(kind: str, seed: int, points: int) -> Surveyed:
    """Scan a building twice, by instruments out of adjustment whose ranges are long and short."""
    other = SYSTEMATIC.model_copy(update={"range_offset_m": -SYSTEMATIC.range_offset_m})
    long, short = (_base(kind, seed, points, scanner) for scanner in (SYSTEMATIC, other))
    even, odd = long.station % 2 == 0, short.station % 2 == 1
    both = replace(
        long,
        lidar=np.vstack([long.lidar[even], short.lidar[odd]]),
        lidar_label=np.concatenate([long.lidar_label[even], short.lidar_label[odd]]),
        station=np.concatenate([long.station[even], short.station[odd]]),
    )
    return _scanned(both, seed)


def _base(kind: str, seed: int, points: int, scanner: Scanner) -> Base:
    # The drone is only there to say what is seen from outside: it takes few points.
    return base_of(
        make_scene(kind, seed, lidar_points=points, photogrammetry_points=1000, scanner=scanner)
    )


def _scanned(base: Base, seed: int) -> Surveyed:
    trial = two_scans(base, np.random.default_rng([seed, 7]))
    assert trial.truth is not None
    return Surveyed(
        source=Cloud.from_points(trial.source, name="source"),
        target=Cloud.from_points(trial.target, name="target"),
        truth=trial.truth,
        is_scan=True,
    )


PAIRS: Mapping[str, Callable[[str, int, int], Surveyed]] = {
    "scanner and drone": by_drone,
    "two scanners": by_scanner,
    "two scanners out of adjustment": by_faulty_scanners,
}


def run_pair(surveyed: Surveyed, progress: Progress) -> dict[str, Any]:
    """Put a pair through `dougong run`, from LAZ files to the merged cloud; one row of figures."""
    with tempfile.TemporaryDirectory(prefix="dougong-study-") as folder:
        result = _result(surveyed, Path(folder), progress)
    row = {**_counts(result), "status": result["registrations"][0]["status"]}
    row |= {f"{name}_s": seconds for name, seconds in result["seconds"].items()}
    matrix = result["registrations"][0]["matrix"]
    if matrix is not None:
        row |= _judged(pose_errors(matrix, surveyed.truth))
        distances = result["registrations"][0]["distances"] or {}
        row["observed95_mm"] = _mm(distances.get("within95_m"))
    return row


def _result(surveyed: Surveyed, folder: Path, progress: Progress) -> dict[str, Any]:
    """Write both clouds as a survey would deliver them, and run everything on them."""
    source, target = folder / "source.laz", folder / "target.laz"
    write(surveyed.source, source)
    write(surveyed.target, target)
    scans = [source, target] if surveyed.is_scan else [source]
    project = from_files(scans, [] if surveyed.is_scan else [target])
    head = project.project.model_copy(update={"reference": "target"})
    out = folder / "out"
    out.mkdir()
    return run(
        project.model_copy(update={"project": head}),
        folder,
        out,
        store=Store.beside(out),
        progress=progress,
    )


def _counts(result: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for cloud in result["clouds"]:
        name = cloud["name"]
        row |= {
            f"{name}_points_before": cloud["points_in"],
            f"{name}_points_after": cloud["points_out"],
            f"{name}_reduction_percent": 100.0 * cloud["reduction"],
        }
    row["merged_points"] = (result["merged"] or {}).get("points")
    row["peak_memory_bytes"] = result["peak_memory_bytes"]
    return row


def _judged(errors: PoseErrors) -> dict[str, Any]:
    """Return METHOD's A to C of a pose, and the level of accuracy that each reaches."""
    return {
        "pose95_mm": _mm(errors.tre95_m),
        "bending_floor95_mm": _mm(errors.bending_floor95_m),
        "total95_mm": _mm(errors.total95_m),
        "rotation_error_deg": errors.rotation_error_deg,
        "translation_error_mm": _mm(float(np.linalg.norm(errors.translation_at_centroid_m))),
        "pose_level": level_of(errors.tre95_m) or "none",
        "total_level": level_of(errors.total95_m) or "none",
        "is_correct": errors.is_correct,
        "is_accurate": errors.is_accurate,
    }


def _mm(metres: float | None) -> float | None:
    return None if metres is None else 1e3 * metres
