"""Register real scans: overlapping, resampled, moved parts of one cloud, and a pair with truth.

    python benchmarks/register_real.py [--sets espacio,isprs,street,lion] [--cuts half40,concentric]
                                       [--seeds 0,1]

A part takes no point that the other part has, so both sample the surface anew; the source is then
turned, tilted and shifted, and the motion back is the truth. Cuts of a cloud:

    half40, half30   strips along a direction drawn by the seed; 40 % or 30 % of the length in both
    concentric       all within 60 % of the radius, and all beyond 35 % of it
    thin5            half40, the source with one point in five

Status `ok` with TRE95 (95 % displacement over what both parts show) above 50 mm is WRONG. The
street pair's truth is known to about 0.1 m: `ok` farther off than that, or than 0.5 deg, is WRONG.
The lion's two range scans (30 % overlap, no known up) come with an estimate by trimmed ICP, itself
good to about a degree: `ok` more than 2 deg or 2 % of the lion away from it is WRONG.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.evaluation.hard_trials import pose
from dougong.evaluation.metrics import Truth, pose_errors
from dougong.formats import read
from dougong.registration import Register, register, register_object
from dougong.registration.overlap import apply, inverse
from dougong.typing import Points

DATA = Path(os.environ.get("DOUGONG_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
CUTS = ("half40", "half30", "concentric", "thin5")


def cut(points: Points, name: str, rng: np.random.Generator) -> tuple[Any, Any]:
    """Return which points (n,) may go to the source, and which to the target."""
    middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    off = points[:, :2] - middle
    if name == "concentric":
        radius = np.hypot(*off.T)
        reach = np.quantile(radius, 0.98)
        return radius < 0.6 * reach, radius > 0.35 * reach
    share = 0.3 if name == "half30" else 0.4
    towards = rng.uniform(0.0, 2 * np.pi)
    along = off @ [np.cos(towards), np.sin(towards)]
    low, high = np.quantile(along, [0.01, 0.99])
    a, b = low + np.array([0.5 - share / 2, 0.5 + share / 2]) * (high - low)
    return along < b, along > a


def parts(points: Points, name: str, seed: int) -> tuple[Points, Points, Truth]:
    """Return source, target and the truth between them."""
    rng = np.random.default_rng([seed, *name.encode()])
    in_source, in_target = cut(points, name, rng)
    is_source = rng.random(len(points)) < (0.2 if name == "thin5" else 0.5)
    T = pose(rng)
    shared = points[in_source & in_target]
    shared = shared[:: max(1, len(shared) // 20_000)]
    truth = Truth(
        T_target_source=inverse(T),
        T_best=inverse(T),
        surface_points=apply(T, shared),
        surface_bent=shared,
    )
    source = points[in_source & is_source]
    return apply(T, source), points[in_target & ~is_source], truth


def pairs(sets: list[str], cuts: list[str], seeds: list[int]) -> Iterator[tuple[Any, ...]]:
    """Yield set, cut, seed, source, target, truth and the sensor of both."""
    files = {
        "espacio": [DATA / "espacio_escultorico/espacio_escultorico_uav_lod3.laz"],
        "isprs": sorted((DATA / "isprs_filter").glob("*.laz")),
    }
    for name in sets:
        for file in files.get(name, []):
            points = read(file).xyz
            points = points - np.round(points.mean(axis=0))
            kind = "photogrammetry" if name == "espacio" else "lidar"
            for how in cuts:
                for seed in seeds:
                    yield file.stem[-14:], how, seed, *parts(points, how, seed), kind


def line(
    what: tuple[Any, ...], status: str, tre: float | None, angle: float, cpu: float, verdict: str
) -> str:
    """Return a row of the table."""
    far = "-" if tre is None else f"{1e3 * tre:.1f}"
    return (
        f"{what[0]:<16}{what[1]:<12}{what[2]:>4}  {status:<10}{far:>9}{angle:>9.3f}{cpu:>7.1f}"
        f"  {verdict}"
    )


def turn_deg(one: Points, other: Points) -> float:
    """Return the angle between two poses (4, 4)."""
    turn = one[:3, :3] @ other[:3, :3].T
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


def street() -> tuple[str, float, float, float, str]:
    """Return status, shift and turn from the truth, CPU seconds and the reason."""
    truth = np.loadtxt(DATA / "street_pair/T_target_source.txt")
    source, target = (read(DATA / f"street_pair/{n}.ply") for n in ("source", "target"))
    start = time.process_time()
    found = register(source, target, Register(dof=6), target_kind="lidar")
    cpu = time.process_time() - start
    if found.matrix is None:
        return found.status, np.inf, np.inf, cpu, found.reason
    off = float(np.linalg.norm(found.matrix[:3, 3] - truth[:3, 3]))
    return found.status, off, turn_deg(found.matrix, truth), cpu, found.reason


def lion() -> tuple[str, float, float, float, str]:
    """Return status, shift (share of the lion) and turn from the estimate, CPU s and the reason."""
    estimate = np.loadtxt(DATA / "lion_scans/reference_T.txt")
    target, source = (np.loadtxt(DATA / f"lion_scans/lionscan{n}.xyz")[:, :3] for n in (1, 2))
    start = time.process_time()
    found = register_object(source, target)
    cpu = time.process_time() - start
    if found.T_target_source is None:
        return found.status, np.inf, np.inf, cpu, found.reason
    middle = np.r_[source.mean(axis=0), 1.0]
    off = np.linalg.norm((found.T_target_source - estimate) @ middle)
    share = float(off / np.ptp(target, axis=0).max())
    return found.status, share, turn_deg(found.T_target_source, estimate), cpu, found.reason


ONE_PAIR = {
    "street": (street, ("street_pair", "dof 6", 0), 0.1, 0.5),
    "lion": (lion, ("lion_scans", "1/1000 long", 0), 0.02, 2.0),
}
"""Sets of one pair with a truth: what registers it, its row, and how far off `ok` is WRONG."""


def main() -> None:
    """Run what the command line asks for; exit 1 when any pair is WRONG."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sets", default="espacio,isprs,street,lion")
    parser.add_argument("--cuts", default=",".join(CUTS))
    parser.add_argument("--seeds", default="0", help="numbers, by commas")
    asked = parser.parse_args()
    sets, verdicts = asked.sets.split(","), []
    print("cloud           cut         seed  status    TRE95 mm  rot deg  CPU s  verdict")
    for registered, what, most_off, most_deg in (ONE_PAIR[s] for s in ONE_PAIR if s in sets):
        status, off, angle, cpu, reason = registered()
        is_wrong = status == "ok" and (off > most_off or angle > most_deg)
        verdicts.append("WRONG" if is_wrong else "right" if status == "ok" else status)
        print(line(what, status, off, angle, cpu, verdicts[-1]))
        print("    " + reason, flush=True)
    seeds = [int(text) for text in asked.seeds.split(",")]
    for name, how, seed, source, target, truth, kind in pairs(sets, asked.cuts.split(","), seeds):
        start = time.process_time()
        one, two = Cloud.from_points(source), Cloud.from_points(target)
        found = register(one, two, Register(), source_kind=kind, target_kind=kind)
        cpu, tre, angle, verdict = time.process_time() - start, None, np.nan, found.status
        if found.matrix is not None:
            errors = pose_errors(found.matrix, truth)
            tre, angle = errors.tre95_m, errors.rotation_error_deg
            if found.status == "ok":
                verdict = "right" if errors.is_correct else "WRONG"
        verdicts.append(verdict)
        print(line((name, how, seed), found.status, tre, angle, cpu, verdict))
        print("    " + found.reason, flush=True)
    counts = {v: verdicts.count(v) for v in ("right", "ambiguous", "failed", "WRONG")}
    print({"pairs": len(verdicts), **counts})
    sys.exit(1 if counts["WRONG"] else 0)


if __name__ == "__main__":
    main()
