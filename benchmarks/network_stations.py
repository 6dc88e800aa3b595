"""Many stations of one place in one frame: time, error of each station, links, and a bad link.

    python benchmarks/network_stations.py [--place hall] [--stations 12] [--points 60000]
                                          [--seed 0] [--drone]

Scans the place from every station, numbers the stations as on a walk from one to the next, as they
are recorded, puts each into a frame of its own (any yaw, up to 0.3 deg off level, anywhere), and
runs them as one project. Prints, per station, the status, the error
against its true place (95 % of its own points, after the best rigid motion is NOT taken out: the
reference stays where it is) and the largest loop error of its links.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from places import make

from dougong.cloud import Cloud
from dougong.formats import write
from dougong.pipeline.progress import Silent
from dougong.pipeline.project import Project
from dougong.pipeline.run import run
from dougong.pipeline.store import Store


def own_frame(rng: np.random.Generator) -> np.ndarray:
    """Return a motion (4, 4): any yaw, nearly level, tens of metres off."""
    yaw, (tilt, roll) = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-0.3, 0.3, 2))
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    lean = np.array([[1, 0, roll], [0, 1, -tilt], [-roll, tilt, 1]])
    u, _, vt = np.linalg.svd(turn @ lean)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ vt, rng.uniform(-50, 50, 3) * (1, 1, 0.1)
    return T


def stations_of(asked: argparse.Namespace, folder: Path) -> tuple[dict[str, np.ndarray], list]:
    """Write one file per station (and the flight); return the true motions and the entries."""
    options = {} if asked.place not in ("nuyda", "monastery") else {"stations": asked.stations}
    scene = make(
        asked.place,
        asked.seed,
        lidar_points=asked.points * asked.stations,
        photogrammetry_points=150_000,
        **options,
    )
    number = scene.lidar.attribute("station")
    everything = scene.lidar.frame.to_file(scene.lidar.xyz)
    scans = [everything[number == k] for k in np.unique(number[number >= 0])[: asked.stations]]
    rng = np.random.default_rng([asked.seed, 7])
    truth, entries = {}, []
    for station, of_walk in enumerate(walk([densest(xyz) for xyz in scans])):
        name, xyz = f"station{station:02d}", scans[of_walk]
        T = own_frame(rng)
        write(Cloud.from_points(xyz @ T[:3, :3].T + T[:3, 3]), folder / f"{name}.laz")
        truth[name] = T
        entries.append({"name": name, "kind": "lidar", "files": [f"{name}.laz"]})
    if asked.drone:
        write(scene.photogrammetry, folder / "drone.laz")
        truth["drone"] = scene.truth.T_best
        entries.append({"name": "drone", "kind": "photogrammetry", "files": ["drone.laz"]})
    return truth, entries


def densest(xyz: np.ndarray) -> np.ndarray:
    """Return the square metre (2,) with most points: the scanner stands on it."""
    cells, counts = np.unique(np.floor(xyz[:, :2]), axis=0, return_counts=True)
    return cells[np.argmax(counts)] + 0.5


def walk(places: list[np.ndarray]) -> list[int]:
    """Return the order of a walk from the first place, always on to the nearest one left."""
    order, left = [0], set(range(1, len(places)))
    while left:
        here = places[order[-1]]
        order.append(min(left, key=lambda k: (float(np.linalg.norm(places[k] - here)), k)))
        left.remove(order[-1])
    return order


def main() -> None:
    """Run what the command line asks for; exit 1 when a station that is `ok` is 50 mm off."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--place", default="hall")
    parser.add_argument("--stations", type=int, default=12)
    parser.add_argument("--points", type=int, default=60_000, help="per station")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drone", action="store_true", help="with the flight, as reference")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "out").mkdir()
        truth, entries = stations_of(asked, folder)
        project = Project.model_validate({"cloud": entries})
        store = Store.beside(folder / "out")
        wall, cpu = time.perf_counter(), time.process_time()
        result = run(project, folder, folder / "out", store=store, progress=Silent())
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        sys.exit(told(result, truth, folder, wall, cpu))


def told(result: dict, truth: dict, folder: Path, wall: float, cpu: float) -> int:
    """Print the table; return how the program ends."""
    from dougong.formats import read

    at = truth[result["reference"]]
    wrong = 0
    print("cloud         status     error95 mm  largest loop error mm")
    for document in result["registrations"]:
        name = document["source"]
        error = np.nan
        if document["matrix"] is not None:
            exact = at @ np.linalg.inv(truth[name])
            points = read(folder / f"{name}.laz")
            xyz = points.frame.to_file(points.xyz)
            found = np.array(document["matrix"])
            off = xyz @ (found - exact)[:3, :3].T + (found - exact)[:3, 3]
            error = 1e3 * np.quantile(np.linalg.norm(off, axis=1), 0.95)
            wrong += document["status"] == "ok" and error > 50.0
        loops = [
            1e3 * row["loop_error_m"]
            for row in result["network"]["links"]
            if name in (row["source"], row["target"]) and row["loop_error_m"] is not None
        ]
        worst = f"{max(loops):.1f}" if loops else "unchecked"
        print(f"{name:<14}{document['status']:<11}{error:>10.1f}  {worst}")
    links = result["network"]["links"]
    left_out = [f"{row['source']} -> {row['target']}" for row in links if row["is_left_out"]]
    print(
        f"{len(links)} pairs tried, {sum(row['weight'] is not None for row in links)} links, "
        f"left out: {left_out}, "
        f"unreached: {result['network']['unreached']}, "
        f"contradicted: {result['network']['contradicted']}"
    )
    print(f"{wall:.0f} s wall, {cpu:.0f} CPU s; register {result['seconds']['register']:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    main()
