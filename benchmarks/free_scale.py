"""Find the scale of a drone cloud that has no unit, and print how far it is from the true one.

    python benchmarks/free_scale.py --scenes hall,pagoda,wall,cave --seeds 0 [--json]
    python benchmarks/free_scale.py --scenes nuyda,street,escultorico
    python benchmarks/free_scale.py --scenes plane,corner,ball

Every pair is registered at each of `--scales` (metres per unit of the drone's file), with seven
degrees of freedom and nothing else known.

Generated scenes and nuyda (a real mesh, surveyed) have an exact truth: the scale of the similarity
that brings the surface both sensors saw nearest to where the bent drone cloud has it. street (two
laser frames) and escultorico (two disjoint random halves of one drone cloud) are real points, whose
truth is the factor that one of them was divided by. plane, corner and ball are surfaces that grow
into themselves, or that hardly hold a scale: `ok` would be wrong there unless the scale is right.

Columns: status; error of the scale; the standard deviation it declares; their ratio; CPU seconds.
*within* = error at most 0.03 % or two declared standard deviations; *wrong* = ok and not within.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from places import DATA, GENERATED, make
from register_scenes import numbers

from dougong.cloud import Cloud
from dougong.evaluation.metrics import best_scale
from dougong.formats import read
from dougong.registration import Register, register
from dougong.typing import Points

WITHIN = 3e-4
SIGMAS = 2.0
POINTS = {"lidar_points": 250_000, "photogrammetry_points": 150_000}


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """A scan and a drone cloud, both as coordinates in metres, and the drone's true scale."""

    scan: Points
    drone: Points
    growth: float = 1.0
    """Lengths in the drone cloud / those of the scan, before it is divided."""


def surveyed(name: str, seed: int) -> Pair:
    """Return a generated scene, or a mesh of a real building, surveyed."""
    scene = make(name, seed, **POINTS)
    scan, drone = scene.lidar, scene.photogrammetry
    return Pair(
        scan=scan.xyz + scan.frame.origin,
        drone=drone.xyz + drone.frame.origin,
        growth=best_scale(scene.truth),
    )


def street(seed: int) -> Pair:
    """Return two laser frames of one street, the first of them turned about the vertical."""
    source, target = (read(DATA / "street_pair" / f"{n}.ply").xyz for n in ("source", "target"))
    return Pair(scan=source @ _turn(seed).T, drone=target)


def escultorico(seed: int) -> Pair:
    """Return two disjoint random samples of one drone cloud, the first of them turned."""
    file = DATA / "espacio_escultorico" / "espacio_escultorico_uav_lod3.laz"
    xyz = read(file).xyz
    half = np.random.default_rng(seed).random(len(xyz))
    return Pair(scan=xyz[half < 0.25] @ _turn(seed).T, drone=xyz[(half > 0.25) & (half < 0.5)])


def _turn(seed: int) -> NDArray[np.float64]:
    angle = np.random.default_rng([seed, 7]).uniform(0.0, 2.0 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def flat(kind: str) -> Callable[[int], Pair]:
    """Return the maker of two noisy samples of a surface that hardly holds a scale."""

    def made(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        one, two = (_sample(kind, rng) for _ in range(2))
        return Pair(scan=one @ _turn(seed).T, drone=two)

    return made


def _sample(kind: str, rng: np.random.Generator) -> Points:
    count = 60_000
    if kind == "ball":
        points = rng.normal(size=(count, 3))
        points *= 6.0 / np.linalg.norm(points, axis=1, keepdims=True)
    else:
        u, v = rng.uniform(0, 14, count), rng.uniform(0, 6, count)
        points = np.column_stack([u, np.zeros(count), v])
        if kind == "corner":
            face = rng.integers(0, 3, count)
            points[face == 1] = points[face == 1][:, [1, 0, 2]]
            points[face == 2] = points[face == 2][:, [0, 2, 1]]
    found: Points = points + rng.normal(0.0, 0.004, points.shape)
    return found


REAL = {"street": street, "escultorico": escultorico}
HARD = {kind: flat(kind) for kind in ("plane", "corner", "ball")}


def pair_of(name: str, seed: int) -> Pair:
    """Return the pair of a name."""
    if name in REAL or name in HARD:
        return (REAL | HARD)[name](seed)
    return surveyed(name, seed)


def one(name: str, seed: int, pair: Pair, metres_per_unit: float) -> dict[str, Any]:
    """Return one row: a pair at one scale, registered and measured."""
    middle = np.floor(np.median(pair.drone, axis=0))
    scan = Cloud.from_points(pair.scan, name="scan")
    drone = Cloud.from_points((pair.drone - middle) / metres_per_unit, name="drone")
    start = time.process_time()
    result = register(scan, drone, Register(dof=7))
    search = result.scale_search or {}
    row: dict[str, Any] = {
        "scene": name,
        "seed": seed,
        "metres_per_unit": metres_per_unit,
        "status": result.status,
        "cpu_seconds": time.process_time() - start,
        "reason": result.reason,
        "found": search.get("metres_per_unit"),
        "sigma_ln": search.get("sigma_ln"),
    }
    if result.matrix is not None and row["found"] is not None:
        error = float(np.log(row["found"] * pair.growth / metres_per_unit))
        row |= {
            "error_ln": error,
            "is_within": abs(error) <= max(WITHIN, SIGMAS * (row["sigma_ln"] or 0.0)),
        }
    row["is_wrong"] = result.status == "ok" and not row.get("is_within", False)
    return row


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    head = f"| {row['scene']} | {row['seed']} | {row['metres_per_unit']:g} | {row['status']} |"
    if "error_ln" in row:
        sigma = row["sigma_ln"] or float("nan")
        head += f" {100 * row['error_ln']:+.4f} | {100 * sigma:.4f} |"
        head += f" {abs(row['error_ln']) / sigma:.1f} |"
    else:
        head += " - | - | - |"
    flag = " **WRONG**" if row["is_wrong"] else ""
    return f"{head} {row['cpu_seconds']:.0f} |{flag}"


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", default=",".join(s for s in GENERATED if s != "tulou"))
    parser.add_argument("--scales", default="0.01,0.37,3.28084,100")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    asked = parser.parse_args()
    say = sys.stderr if asked.json else sys.stdout
    print("| scene | seed | m/unit | status | error % | sigma % | ratio | CPU s |", file=say)
    print("|---|---|---|---|---|---|---|---|", file=say)
    rows = []
    for name in asked.scenes.split(","):
        for seed in numbers(asked.seeds):
            pair = pair_of(name, seed)
            for text in asked.scales.split(","):
                rows.append(one(name, seed, pair, float(text)))
                print(line(rows[-1]), file=say, flush=True)
                if rows[-1]["status"] != "ok":
                    print(f"  {rows[-1]['reason']}", file=sys.stderr, flush=True)
    sure = [row for row in rows if row["status"] == "ok"]
    summary = {
        "pairs": len(rows),
        "ok": len(sure),
        "ok_within": sum(bool(row.get("is_within")) for row in sure),
        "wrong": sum(row["is_wrong"] for row in rows),
    }
    print(json.dumps({"rows": rows, **summary}) if asked.json else summary)


if __name__ == "__main__":
    main()
