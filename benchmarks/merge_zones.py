"""What the merged cloud gains and loses where the better source stands in for the other one.

    python benchmarks/merge_zones.py --scenes hall,pagoda,wall
    python benchmarks/merge_zones.py --mesh ../shared/data/nuyda_house/nuyda.ply

The clouds lie at the best pose there is, so that only the merging is measured. *covered*: share of
the true surface that both sensors saw with a point within 5 and 10 cm, before and after; *gap*: a
left-out point to the nearest kept one, 99.9 %; *thickness*: standard deviation across the plane in
the flat 25 cm zones that hold points of both sensors before, median, before and after.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from dougong.evaluation.scenes import Scene, make_scene, scan_mesh
from dougong.pipeline.merging import Merge, Part, choose
from dougong.pipeline.zones import grid_over, zones_of


def measured(scene: Scene, params: Merge) -> str:
    """Return one row of the table."""
    lidar = scene.lidar.moved(scene.truth.T_best, scene.photogrammetry.frame)
    drone = scene.photogrammetry
    parts = [
        Part(cloud=lidar, source_id=1, name="scan", kind="lidar"),
        Part(cloud=drone, source_id=2, name="drone", kind="photogrammetry"),
    ]
    start = time.process_time()
    chosen = choose(parts, params)
    spent = time.process_time() - start
    kept, left = (
        np.vstack([part.cloud.xyz[mask if is_kept else ~mask]
                   for part, mask in zip(parts, chosen.kept, strict=True)])
        for is_kept in (True, False)
    )  # fmt: skip
    before = np.vstack([lidar.xyz, drone.xyz])
    surface = scene.truth.surface_bent - drone.frame.origin
    covered = []
    for points in (before, kept):
        distance = cKDTree(points).query(surface)[0]
        covered += [100 * float((distance < reach).mean()) for reach in (0.05, 0.10)]
    gap = np.quantile(cKDTree(kept).query(left)[0], 0.999) if len(left) else 0.0
    grid = grid_over([before], 0.25)
    zones = [zones_of(points, grid) for points in (lidar.xyz, drone.xyz, before, kept)]
    both = np.intersect1d(zones[0].keys[zones[0].counts >= 12], zones[1].keys[zones[1].counts >= 6])
    thick = [1e3 * float(np.nanmedian(z.noise_m[z.find(both)[0]])) for z in zones[2:]]
    rows = chosen.document(parts)["sources"]
    return (
        f"| {scene.name} | {len(lidar):,} + {len(drone):,} "
        f"| {rows['scan']['left_out']:,} + {rows['drone']['left_out']:,} "
        f"| {covered[0]:.1f}, {covered[1]:.1f} % | {covered[2]:.1f}, {covered[3]:.1f} % "
        f"| {1e3 * gap:.0f} mm | {thick[0]:.1f} mm | {thick[1]:.1f} mm | {spent:.1f} |"
    )


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", default="hall,pagoda,wall")
    parser.add_argument("--mesh", type=Path, help="a PLY mesh, surveyed in place of the scenes")
    parser.add_argument("--points", type=int, default=1_000_000, help="of the scan; drone: 0.6")
    options = parser.parse_args()
    print("| scene | points, scan + drone | left out | covered before | covered after | gap "
          "| thickness before | after | CPU s |")  # fmt: skip
    print("|" + "---|" * 9)
    counts = {
        "lidar_points": options.points,
        "photogrammetry_points": int(0.6 * options.points),
        "outliers": 0.0,
    }
    if options.mesh is not None:
        from plyfile import PlyData

        data = PlyData.read(options.mesh)
        vertices = np.column_stack([data["vertex"][axis] for axis in "xyz"])
        faces = np.vstack(data["face"].data["vertex_indices"])
        print(measured(scan_mesh(vertices, faces, name=options.mesh.stem, **counts), Merge()))
        return
    for name in options.scenes.split(","):
        print(measured(make_scene(name, 0, **counts), Merge()), flush=True)


if __name__ == "__main__":
    main()
