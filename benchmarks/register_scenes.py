"""Register generated scenes with known truth and print how far each pose is from it.

    python benchmarks/register_scenes.py --scenes hall,pagoda --seeds 0-9 [--json]
    python benchmarks/register_scenes.py --scenes nuyda,monastery --seeds 0-4

The second surveys two meshes of real and modelled monuments from the folder of test data.

Columns: status; TRE95 [A], the 95 % displacement between the found pose and the best rigid pose
over the surface that both sensors saw; its rotation error; the floor [B] that bending alone
leaves; seconds for the registration. "wrong" is status ok with TRE95 above 50 mm.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

from places import GENERATED, MESHES, make

from dougong.evaluation.metrics import pose_errors
from dougong.registration import Register, register

ALL = GENERATED


def one(kind: str, seed: int, params: Register, **options: Any) -> dict[str, Any]:
    """Return one row: a scene, made with `options`, registered and measured."""
    scene = make(kind, seed, **options)
    start = time.perf_counter()
    result = register(scene.lidar, scene.photogrammetry, params)
    row: dict[str, Any] = {
        "scene": kind,
        "seed": seed,
        "status": result.status,
        "seconds": time.perf_counter() - start,
        "steps": dict(result.seconds),
        "probability": result.probability,
        "margin": result.margin,
        "reason": result.reason,
    }
    if result.matrix is not None:
        errors = pose_errors(result.matrix, scene.truth)
        row |= {
            "tre95_m": errors.tre95_m,
            "rotation_error_deg": errors.rotation_error_deg,
            "bending_floor95_m": errors.bending_floor95_m,
            "is_correct": errors.is_correct,
            "is_accurate": errors.is_accurate,
            "is_wrong": result.status == "ok" and not errors.is_correct,
        }
    return row


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    head = f"{row['scene']:<7}{row['seed']:>5}  {row['status']:<10}"
    if "tre95_m" in row:
        head += (
            f"{1e3 * row['tre95_m']:>10.1f}{row['rotation_error_deg']:>10.4f}"
            f"{1e3 * row['bending_floor95_m']:>9.1f}"
        )
    else:
        head += f"{'-':>10}{'-':>10}{'-':>9}"
    flag = "  WRONG" if row.get("is_wrong") else ""
    return f"{head}{row['seconds']:>8.1f}{row['probability']:>7.3f}{row['margin']:>7.2f}{flag}"


def numbers(text: str) -> list[int]:
    """Return [0, 1, 2, 5] for "0-2,5"."""
    found: list[int] = []
    for part in text.split(","):
        low, _, high = part.partition("-")
        found += range(int(low), int(high or low) + 1)
    return found


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--scenes", default=",".join(ALL), help=f"by commas; also {', '.join(MESHES)}"
    )
    parser.add_argument("--seeds", default="0-9")
    parser.add_argument("--coarse", default="auto")
    parser.add_argument("--isolated", action="store_true", help="the building without its site")
    parser.add_argument("--lidar-points", type=int, default=1_000_000)
    parser.add_argument("--photogrammetry-points", type=int, default=600_000)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    params = Register(coarse=asked.coarse)
    options = {
        "site": not asked.isolated,
        "lidar_points": asked.lidar_points,
        "photogrammetry_points": asked.photogrammetry_points,
    }
    rows = []
    if not asked.json:
        print("scene   seed  status      TRE95 mm   rot deg floor mm seconds      p margin")
    for kind in asked.scenes.split(","):
        for seed in numbers(asked.seeds):
            rows.append(one(kind, seed, params, **options))
            print(line(rows[-1]), file=sys.stderr if asked.json else sys.stdout, flush=True)
            if rows[-1]["status"] != "ok" and not asked.json:
                print(f"        {rows[-1]['reason']}", flush=True)
    correct = sum(bool(r.get("is_correct") and r["status"] == "ok") for r in rows)
    accurate = sum(bool(r.get("is_accurate") and r["status"] == "ok") for r in rows)
    wrong = sum(bool(r.get("is_wrong")) for r in rows)
    summary = {"pairs": len(rows), "correct": correct, "accurate": accurate, "ok_but_wrong": wrong}
    print(json.dumps({"rows": rows, **summary}) if asked.json else summary)


if __name__ == "__main__":
    main()
