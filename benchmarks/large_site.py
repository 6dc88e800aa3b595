"""A site of any number of points, and what filtering it takes: time and memory of all processes.

    python benchmarks/large_site.py make FOLDER --points 1e7 [--strays 0.1]
    python benchmarks/large_site.py filter FOLDER --memory 2GB [--json FILE]
    python benchmarks/large_site.py run FOLDER --memory 4GB [--voxel 0.06] [--json FILE]

`make` streams two LAZ files, never holding more than a million points: scan.laz (85 % of the
points: six halls and their yard seen from twelve stations, dense near these, 2 mm noise, stray
points) and drone.laz (15 %: roofs, walls and yard at an even density, 15 mm noise). `filter` runs
both recipes, `run` the main job; both print the largest sum of proportional set sizes (PSS) of the
process tree, sampled every 0.25 s (Linux only), beside the wall and processor time, and the time to
merely decode the input with laspy and lazrs on all threads, measured before and after. `--voxel` is
the edge of the scan's voxel grid; `run` says what share it kept (0.06 keeps about 15 % at 3e7).
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import dougong
from dougong.cloud import Cloud
from dougong.evaluation.machine import machine
from dougong.formats import describe, write

PIECE = 1_000_000
YARD = np.array([120.0, 80.0])
HALLS = np.array([[x, y] for x in (25.0, 60.0, 95.0) for y in (22.0, 58.0)])
# No two are alike, or the site would fit onto itself a hall further on.
SIZES = np.array(
    [[20.0, 12, 6], [16, 10, 4.5], [22, 13, 8], [14, 14, 5], [18, 9, 7], [24, 11, 5.5]]
)
TURNS = np.radians([0.0, 4.0, -3.0, 7.0, 0.0, -6.0])
ORIGIN = np.array([5e5, 4e6, 100.0])


def walls_and_roofs(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return points (count, 3) on the halls: half on walls, half on roofs."""
    hall = rng.integers(0, len(HALLS), count)
    length, width, height = SIZES[hall].T
    u, v = rng.uniform(-0.5, 0.5, (2, count))
    is_long = rng.random(count) < length / (length + width)
    side = np.where(rng.random(count) < 0.5, 0.5, -0.5)
    x, y = np.where(is_long, u, side) * length, np.where(is_long, side, u) * width
    wall = np.column_stack([x, y, (v + 0.5) * height])
    ridge = height + 4.0 * (1.0 - 2.0 * np.abs(v))
    roof = np.column_stack([u * (length + 2), v * (width + 2), ridge])
    chosen = np.where((rng.random(count) < 0.5)[:, None], wall, roof)
    cos, sin = np.cos(TURNS[hall]), np.sin(TURNS[hall])
    chosen[:, :2] = np.column_stack(
        [cos * chosen[:, 0] - sin * chosen[:, 1], sin * chosen[:, 0] + cos * chosen[:, 1]]
    )
    chosen[:, :2] += HALLS[hall]
    return chosen


def yard(rng: np.random.Generator, count: int, *, is_scan: bool) -> np.ndarray:
    """Return points (count, 3) of the ground, round stations or at an even density."""
    plan = rng.uniform(0.0, YARD, (count, 2))
    if is_scan:
        stations = np.array([[x, y] for x in (8.0, 42.0, 78.0, 112.0) for y in (5.0, 40.0, 75.0)])
        far = 2.0 + rng.exponential(6.0, count)
        turn = rng.uniform(0.0, 2.0 * np.pi, count)
        round_them = far[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        plan = np.clip(stations[rng.integers(0, len(stations), count)] + round_them, 0.0, YARD)
    return np.column_stack([plan, 0.3 * np.sin(plan[:, 0] / 15.0)])


def pieces(points: int, strays: float, *, is_scan: bool) -> Iterator[Cloud]:
    """Yield a cloud of so many points, the same at every call, `strays` of them off everything."""
    for number, start in enumerate(range(0, points, PIECE)):
        rng = np.random.default_rng([int(is_scan), number])
        count = min(PIECE, points - start)
        ground = yard(rng, count * 2 // 5, is_scan=is_scan)
        xyz = np.vstack([ground, walls_and_roofs(rng, count - len(ground))])
        xyz += rng.normal(0.0, 0.002 if is_scan else 0.015, xyz.shape)
        stray = rng.random(count) < strays
        xyz[stray] += rng.normal(0.0, 2.0, (int(stray.sum()), 3))
        yield Cloud.from_points(
            np.round(np.vstack([np.zeros(3), xyz]) + ORIGIN, 3),
            intensity=rng.integers(0, 4096, count + 1).astype("<u2"),
        ).select(np.arange(1, count + 1))


def make(folder: Path, points: int, strays: float) -> None:
    """Write the two clouds."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, share in (("scan", 0.85), ("drone", 0.15)):
        count = int(points * share)
        source = partial(one_frame, count, strays, is_scan=name == "scan")
        written = write(source, folder / f"{name}.laz", overwrite=True)
        print(f"{written.path}: {written.points:,} points, {written.bytes / 1e6:.0f} MB")


def one_frame(points: int, strays: float, *, is_scan: bool) -> Iterator[Cloud]:
    """Yield the pieces in the frame of the first one."""
    first = None
    for piece in pieces(points, strays, is_scan=is_scan):
        first = first or piece
        yield piece if piece is first else piece.rebased(first.frame.origin)


def tree_pss(root: int) -> int:
    """Return the proportional set sizes of a process and those that it started, in bytes."""
    total, waiting = 0, [root]
    while waiting:
        pid = waiting.pop()
        try:
            told = Path(f"/proc/{pid}/smaps_rollup").read_text()
            tasks = Path(f"/proc/{pid}/task").iterdir()
            waiting += [int(c) for t in tasks for c in (t / "children").read_text().split()]
        except (OSError, ProcessLookupError):
            continue
        total += sum(int(s.split()[1]) for s in told.splitlines() if s.startswith("Pss:")) * 1024
    return total


def measured(command: list[str]) -> dict[str, Any]:
    """Run a command; return its wall and processor time and the largest PSS of its tree."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start, peak = time.perf_counter(), 0
    child = subprocess.Popen(command)
    while child.poll() is None:
        peak = max(peak, tree_pss(child.pid))
        time.sleep(0.25)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if child.returncode not in (0, 3):
        sys.exit(f"{' '.join(command)} ended with {child.returncode}")
    return {"wall_s": round(wall, 1), "cpu_s": round(cpu, 1), "peak_pss_bytes": peak}


DECODE = """
import sys, laspy
for path in sys.argv[1:]:
    with laspy.open(path, laz_backend=laspy.LazBackend.LazrsParallel) as file:
        for chunk in file.chunk_iterator(1_000_000):
            chunk.array
"""


def decoded(folder: Path) -> dict[str, Any]:
    """Return what merely decoding the input takes."""
    paths = [str(folder / "scan.laz"), str(folder / "drone.laz")]
    return {"job": "decode", **measured([sys.executable, "-c", DECODE, *paths])}


PROJECT = """
[[cloud]]
name = "scan"
kind = "lidar"
files = ["{folder}/scan.laz"]
[[cloud]]
name = "drone"
kind = "photogrammetry"
files = ["{folder}/drone.laz"]
[filter.lidar.octree_voxel_grid]
voxel_m = {voxel}
"""


def work(folder: Path, verb: str, memory: str, voxel: float) -> dict[str, Any]:
    """Filter or run the site; return what was asked, and a row per command."""
    start = [sys.executable, "-m", "dougong"]
    rows = [decoded(folder)]
    with TemporaryDirectory(dir=folder) as out:
        scan, drone = str(folder / "scan.laz"), str(folder / "drone.laz")
        room = ["--memory", memory, "--quiet"]
        project = Path(out) / "project.toml"
        project.write_text(PROJECT.format(folder=folder.absolute(), voxel=voxel))
        jobs = {"run": [*start, "run", str(project), "--out", f"{out}/result"]}
        if verb == "filter":
            jobs = {
                kind: [*start, "filter", path, f"{out}/{kind}.laz", "--kind", kind]
                for kind, path in (("lidar", scan), ("photogrammetry", drone))
            }
        for name, command in jobs.items():
            row = {"job": name, "memory": memory, **measured([*command, *room])}
            books = Path(out) / ("result/result.json" if name == "run" else f"{name}.laz.json")
            rows.append({**row, **_told(json.loads(books.read_text()))})
    rows.append(decoded(folder))
    for row in rows:
        print(json.dumps(row))
    points = sum(describe(folder / f"{name}.laz").points for name in ("scan", "drone"))
    asked = {"points": points, "memory": memory, "voxel_m": voxel}
    return {**asked, "machine": machine(), "version": dougong.__version__, "jobs": rows}


def _told(document: dict[str, Any]) -> dict[str, Any]:
    """Return what the program itself says of its work: seconds, points by stage, what it found."""
    clouds = document.get("clouds", [document])
    stages = [stage for cloud in clouds for stage in cloud["stages"]]
    names = ("seconds", "cpu_seconds", "status", "merged", "result_hash")
    return {"stages": stages, **{name: document[name] for name in names if name in document}}


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("verb", choices=["make", "filter", "run"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=float, default=1e7)
    parser.add_argument("--strays", type=float, default=2e-4, help="share of stray points")
    parser.add_argument("--memory", default="2GB")
    parser.add_argument("--voxel", type=float, default=0.005)
    parser.add_argument("--json", type=Path, help="JSON lines: a line is added")
    asked = parser.parse_args()
    if asked.verb == "make":
        make(asked.folder, int(asked.points), asked.strays)
        return
    measured = work(asked.folder, asked.verb, asked.memory, asked.voxel)
    if asked.json:
        with asked.json.open("a", encoding="utf-8") as file:
            file.write(json.dumps(measured) + "\n")


if __name__ == "__main__":
    main()
