"""Compare the cloth with the published one: 15 ISPRS filter test sites, and a building.

    python benchmarks/csf_conformance.py [--data DIR] [--sites 11 12] [--json]

Columns: share of points with equal labels, ours against the published filter on one thread, with
slope smoothing, without, and with smoothing and heights moved by up to 10 micrometres (heights on
a centimetre lattice often tie with its 0.3 m slope threshold, and rounding decides). Then its
agreement with itself on two threads, repeated on two, with the points shuffled, and with heights
moved. Then our errors with the default parameters against the sites' labels: type I (ground
lost), type II (objects taken for ground), total; its total at the parameters compared.

The building is the scan of a generated hall, as it is and with 1.5 % more points spread evenly
over its plan and down to 6 m below the ground: labels that agree, and the share of the ground that
each finds, at the default parameters of `ClothSimulation`.
"""

import argparse
import json
import sys
from pathlib import Path

import laspy
import numpy as np

from dougong.evaluation.mesh import GROUND
from dougong.evaluation.scenes import make_scene
from dougong.filters.cloth_simulation import ClothSimulation, cloth_simulation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from reference.cloth import published

SITES = (11, 12, 21, 22, 23, 24, 31, 41, 42, 51, 52, 53, 54, 61, 71)
CONFORMANCE = ClothSimulation(
    cloth_resolution_m=2.0,
    rigidness=2,
    class_threshold_m=0.5,
    slope_smoothing=True,
    particle_height="nearest",
    support_distance_m=None,
    guard=None,
)


def read_site(folder, site):
    """Return (points, is_ground) of one site, near the origin."""
    las = laspy.read(folder / f"samp{site}-utm.laz")
    points = np.column_stack([las.x, las.y, las.z]).astype(np.float64)
    return points - np.floor(points.min(axis=0)), np.asarray(las.classification) == 2


def is_ground(points, params):
    """Return our labels."""
    return cloth_simulation(points, params).attributes["is_ground"].astype(bool)


def compare(points, truth, params=CONFORMANCE):
    """Return the row of the table for one site."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(points))
    moved = (
        points
        + np.column_stack([np.zeros((len(points), 2)), rng.uniform(-1, 1, len(points))]) * 1e-5
    )
    once = published(points, params)[0]
    there = published(moved, params)[0]
    twice = [published(points, params, threads=2)[0] for _ in range(2)]
    shuffled = np.empty(len(points), bool)
    shuffled[order] = published(points[order], params)[0]
    plain = params.model_copy(update={"slope_smoothing": False})
    found = is_ground(points, ClothSimulation())
    return {
        "points": len(points),
        "agree": float((is_ground(points, params) == once).mean()),
        "agree_plain": float((is_ground(points, plain) == published(points, plain)[0]).mean()),
        "agree_10um": float((is_ground(moved, params) == there).mean()),
        "own_threads": float((once == twice[0]).mean()),
        "own_repeat": float((twice[0] == twice[1]).mean()),
        "own_order": float((once == shuffled).mean()),
        "own_10um": float((once == there).mean()),
        "type_1": float((truth & ~found).sum() / truth.sum()),
        "type_2": float((~truth & found).sum() / (~truth).sum()),
        "total": float((truth != found).mean()),
        "their_total": float((truth != once).mean()),
    }


def building(outliers, depth=6.0):
    """Return (points, is_ground) of a hall's scan with a share of `outliers` added."""
    cloud = make_scene("hall", 0, lidar_points=200_000, photogrammetry_points=50_000).lidar
    points, truth = cloud.xyz, cloud.attribute("truth_label") == GROUND
    rng = np.random.default_rng(0)
    low, high = points[truth].min(axis=0), points[truth].max(axis=0)
    level = np.median(points[truth, 2])
    added = rng.uniform(
        [*low[:2], level - depth], [*high[:2], level], (int(outliers * len(points)), 3)
    )
    return np.concatenate([points, added]), np.append(truth, np.zeros(len(added), bool))


def compare_building(outliers):
    """Return the row of the second table."""
    points, truth = building(outliers)
    params = ClothSimulation()
    found, theirs = is_ground(points, params), published(points, params)[0]
    equal = params.model_copy(update={"guard": None, "support_distance_m": None})
    return {
        "points": len(points),
        "agree": float((is_ground(points, equal) == theirs).mean()),
        "ground_found": float(found[truth].mean()),
        "their_ground_found": float(theirs[truth].mean()),
        "objects_taken": float(found[~truth].mean()),
        "their_objects_taken": float(theirs[~truth].mean()),
    }


def show(name, row, *, is_first):
    """Print a row, and the head of the table before its first one."""
    if is_first:
        print("site", *row, sep="\t")
    values = (f"{v:.4f}" if isinstance(v, float) else v for v in row.values())
    print(name, *values, sep="\t", flush=True)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data" / "isprs_filter"
    )
    parser.add_argument("--sites", type=int, nargs="*", default=SITES)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = {}
    for site in arguments.sites:
        rows[site] = compare(*read_site(arguments.data, site))
        if not arguments.json:
            show(site, rows[site], is_first=len(rows) == 1)
    for name, outliers in (("hall", 0.0), ("hall, 1.5 % outliers", 0.015)):
        rows[name] = compare_building(outliers)
        if not arguments.json:
            show(name, rows[name], is_first=not outliers)
    if arguments.json:
        print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
