"""Reading and writing each format, and what the library behind it takes for the bytes alone.

    python benchmarks/bench_formats.py [POINTS] [FORMAT ...]

CPU seconds of the better of two runs, files in the page cache. A whole scan with colour and
intensity on map coordinates; the libraries hold raw columns where we hold a cloud ready to work
on (local coordinates, bad rows found, units and step known).
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pyarrow.csv
import pye57
from plyfile import PlyData

from dougong.cloud import Cloud, Frame
from dougong.formats import read, reissue, write

FORMATS = ("las", "laz", "copc.laz", "e57", "ply", "csv")


def scan(count: int) -> Cloud:
    """Return `count` points on a 0.1 mm lattice at map coordinates, with colour and intensity."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 80, (count, 3))
    points[:, 2] = 3 * np.sin(points[:, 0] / 9) + rng.normal(0, 0.01, count)
    points = np.rint((points + [500_000, 4_000_000, 30]) * 1e4) / 1e4
    colours = rng.integers(0, 256, (3, count), dtype=np.uint8)
    return Cloud.from_points(
        points, crs="EPSG:32650", intensity=rng.integers(0, 4000, count).astype(np.uint16),
        red=colours[0], green=colours[1], blue=colours[2],
    )  # fmt: skip


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the CPU seconds of the better of two calls."""
    found = []
    for _ in range(2):
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return min(found)


def show(what: str, ours: float, theirs: float | None, library: str) -> None:
    """Print one row of the table."""
    beside = f"| {theirs:6.2f} {library} | {ours / theirs:.2f} |" if theirs else "| | |"
    print(f"| {what} | {ours:6.2f} {beside}", flush=True)


def laspy_writes(path: Path, out: Path) -> None:
    """Write what laspy read."""
    laspy.read(path).write(out)


def pye57_reads(path: Path) -> None:
    """Read all fields of the first scan."""
    with pye57.E57(str(path)) as file:
        file.read_scan(0, intensity=True, colors=True, ignore_missing_fields=True)


def pye57_writes(path: Path, out: Path) -> None:
    """Write what pye57 read (its float32 coordinates are what it does)."""
    with pye57.E57(str(path)) as file:
        data = file.read_scan(0, intensity=True, colors=True, ignore_missing_fields=True)
    start = time.process_time()
    with pye57.E57(str(out), mode="w") as file:
        file.write_scan_raw(data)
    pye57_writes.seconds = time.process_time() - start  # type: ignore[attr-defined]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("points", nargs="?", type=float, default=3e6)
    parser.add_argument("formats", nargs="*", default=FORMATS)
    asked = parser.parse_args()
    count, wanted = int(asked.points), asked.formats
    cloud = scan(count)
    print(f"{count:,} points; CPU seconds\n")
    print("| work | dougong | library alone | ratio |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(cloud, folder / "source.las")
        source = read(folder / "source.las")
        for suffix in wanted:
            path, again = folder / f"a.{suffix}", folder / f"b.{suffix}"
            if suffix == "csv":
                columns = [cloud.frame.to_file(cloud.xyz), cloud.attribute("intensity")[:, None]]
                np.savetxt(path, np.hstack(columns), fmt="%.4f", delimiter=",",
                           header="x,y,z,intensity", comments="")  # fmt: skip
                show("csv read", cpu_seconds(lambda p=path: read(p)),
                     cpu_seconds(lambda p=path: pyarrow.csv.read_csv(p)), "pyarrow")  # fmt: skip
                continue
            written = cpu_seconds(lambda p=path: write(source, p, overwrite=True))
            mine = cpu_seconds(lambda p=path: read(p))
            if suffix in ("las", "laz"):
                there = cpu_seconds(lambda p=path: laspy.read(p))
                both = cpu_seconds(lambda p=path, q=again: laspy_writes(p, q))
                show(f"{suffix} read", mine, there, "laspy")
                show(f"{suffix} write", written, both - there, "laspy")
            elif suffix == "e57":
                show("e57 read", mine, cpu_seconds(lambda p=path: pye57_reads(p)), "pye57")
                pye57_writes(path, again)
                show("e57 write", written, pye57_writes.seconds, "pye57")  # type: ignore[attr-defined]
                moved = cpu_seconds(lambda p=path, q=again: again_in_place(p, q))
                show("e57 issued again", moved, None, "")
            elif suffix == "ply":
                there = cpu_seconds(lambda p=path: plyfile_reads(p))
                show("ply read", mine, there, "plyfile")
                show("ply write", written, None, "")
            else:
                show(f"{suffix} read", mine, None, "")
                show(f"{suffix} write", written, None, "")
            if suffix == "laz":
                moved = cpu_seconds(lambda p=path, q=again: again_in_place(p, q))
                show("laz issued again", moved, None, "")


def plyfile_reads(path: Path) -> np.ndarray:
    """Read all vertices into memory."""
    return np.array(PlyData.read(str(path))["vertex"].data)


def again_in_place(path: Path, out: Path) -> None:
    """Issue a file again, turned a little."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    target = Frame(crs="EPSG:32650")
    reissue(path, out, [matrix], target, overwrite=True)


if __name__ == "__main__":
    main()
