"""A drone cloud in a map projection, scans in ground metres: with and without the grid factor.

    python benchmarks/grid_factor.py --scenes hall,wall --epsg 32650 --height 1500

Errors are against the exact truth, computed point by point through the projection. TRE95: against
the best motion of the map's true scale; total95: against the (bent) drone cloud itself, heights,
which no projection scales, included.
"""

import argparse
import time

from dougong.evaluation.metrics import pose_errors
from dougong.evaluation.scenes import Map, make_scene
from dougong.pipeline.registering import register
from dougong.registration import Register


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", default="hall,wall")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--epsg", type=int, default=32650)
    parser.add_argument("--height", type=float, default=None, help="of the site, metres")
    parser.add_argument("--points", type=int, default=250_000, help="of the scan; drone: 0.6 of it")
    options = parser.parse_args()
    print("| scene | seed | grid factor | status | scale | scale error ppm | rotation deg "
          "| TRE95 mm | total95 mm | floor95 mm | CPU s |")  # fmt: skip
    print("|" + "---|" * 11)
    for name in options.scenes.split(","):
        for seed in map(int, options.seeds.split(",")):
            scene = make_scene(
                name,
                seed,
                lidar_points=options.points,
                photogrammetry_points=int(0.6 * options.points),
                on_map=Map(epsg=options.epsg, height_m=options.height),
            )
            for setting in ("auto", "off"):
                start = time.process_time()
                result = register(scene.lidar, scene.photogrammetry, Register(grid_scale=setting))
                spent = time.process_time() - start
                row = f"| {name} | {seed} | {setting} | {result.status} | {result.scale:.7f} "
                if result.matrix is None:
                    print(f"{row}| no pose: {result.reason} |", flush=True)
                    continue
                errors = pose_errors(result.matrix, scene.truth)
                print(
                    f"{row}| {errors.scale_error_ppm:+.2f} | {errors.rotation_error_deg:.4f} "
                    f"| {1e3 * errors.tre95_m:.1f} | {1e3 * errors.total95_m:.1f} "
                    f"| {1e3 * errors.bending_floor95_m:.1f} | {spent:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
