"""Peers that are programs: PDAL and CloudCompare, on a file, less what reading the file costs."""

import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.errors import DougongError
from dougong.evaluation.bench.ours import (
    CLOTH_M,
    NEIGHBOURS,
    ROR_OTHERS,
    ROR_RADIUS_M,
    SIGMAS,
    VOXEL_M,
    Arrays,
)


@dataclass(frozen=True, slots=True)
class Cost:
    """What a program took, reading its input left out of the seconds."""

    wall_s: float
    cpu_s: float
    peak_bytes: int
    """Of the whole process, the points included."""


def is_installed(program: str) -> bool:
    """Say whether `program` is on the path."""
    return shutil.which(program) is not None


def write_ply(path: Path, points: NDArray[np.float64]) -> None:
    """Write points as a binary PLY file of doubles, which both programs read."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        "property double x\nproperty double y\nproperty double z\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        points.astype("<f8").tofile(file)


def _cost(command: Sequence[str], threads: int) -> Cost:
    """Run a command and return what it took."""
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": str(threads),
        "QT_QPA_PLATFORM": "offscreen",
    }
    started = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode != 0:
            said.seek(0)
            words = said.read()[-300:].decode(errors="replace")
            raise DougongError(f"{command[0]} ended with {process.returncode}: {words}")
    return Cost(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)


def _less_reading(work: Sequence[str], reading: Sequence[str], threads: int) -> Cost:
    """Return what `work` takes more than `reading`."""
    whole, part = _cost(work, threads), _cost(reading, threads)
    return Cost(whole.wall_s - part.wall_s, whole.cpu_s - part.cpu_s, whole.peak_bytes)


def _pdal(arrays: Arrays, threads: int, stage: dict[str, Any]) -> Cost:
    with tempfile.TemporaryDirectory() as folder:
        cloud = Path(folder) / "cloud.ply"
        write_ply(cloud, arrays["points"])
        commands = []
        for name, stages in (("work", [stage]), ("read", [])):
            file = Path(folder) / f"{name}.json"
            reader = {"type": "readers.ply", "filename": str(cloud)}
            file.write_text(json.dumps({"pipeline": [reader, *stages, {"type": "writers.null"}]}))
            commands.append(["pdal", "pipeline", str(file)])
        return _less_reading(commands[0], commands[1], threads)


def pdal_voxel(arrays: Arrays, threads: int) -> Cost:
    """Keep the point nearest each voxel's centre."""
    stage = {"type": "filters.voxelcenternearestneighbor", "cell": VOXEL_M}
    return _pdal(arrays, threads, stage)


def pdal_sor(arrays: Arrays, threads: int) -> Cost:
    """Mark statistical outliers."""
    stage = {
        "type": "filters.outlier",
        "method": "statistical",
        "mean_k": NEIGHBOURS,
        "multiplier": SIGMAS,
    }
    return _pdal(arrays, threads, stage)


def pdal_ror(arrays: Arrays, threads: int) -> Cost:
    """Mark radius outliers."""
    stage = {
        "type": "filters.outlier",
        "method": "radius",
        "radius": ROR_RADIUS_M,
        "min_k": ROR_OTHERS,
    }
    return _pdal(arrays, threads, stage)


def pdal_csf(arrays: Arrays, threads: int) -> Cost:
    """Mark ground with a cloth."""
    stage = {
        "type": "filters.csf",
        "resolution": CLOTH_M,
        "rigidness": 3,
        "threshold": 0.5,
        "smooth": False,
    }
    return _pdal(arrays, threads, stage)


def cloudcompare_sor(arrays: Arrays, threads: int) -> Cost:
    """Remove statistical outliers."""
    with tempfile.TemporaryDirectory() as folder:
        cloud = Path(folder) / "cloud.ply"
        write_ply(cloud, arrays["points"])
        reading = ["CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-O", str(cloud)]
        return _less_reading([*reading, "-SOR", str(NEIGHBOURS), str(SIGMAS)], reading, threads)
