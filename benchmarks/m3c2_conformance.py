"""Our M3C2 beside py4dgeo's, on the same clouds, core points, normals and scales.

py4dgeo brings scikit-learn and seaborn, so it is in no extra: `pip install py4dgeo`, then

    python benchmarks/m3c2_conformance.py --dump DIR      # with dougong
    python benchmarks/m3c2_conformance.py --compare DIR   # with py4dgeo, anywhere
"""

import argparse
from pathlib import Path

import numpy as np


def dump(folder: Path) -> None:
    """Survey a generated city wall, measure it, and write what py4dgeo needs."""
    from dougong.evaluation.scenes import make_scene
    from dougong.registration.distances import Distances, signed_distances

    made = make_scene("wall", 3, lidar_points=150_000, photogrammetry_points=100_000, outliers=0.0)
    target = made.photogrammetry
    source = made.lidar.moved(made.truth.T_best, target.frame).xyz
    params = Distances(
        statistic="mean", min_points=2, normal_scale_m=0.5, projection_scale_m=0.5,
        max_distance_m=0.3, core_spacing_m=0.5,
    )  # fmt: skip
    found = signed_distances(source, target.xyz, params)
    # py4dgeo 1.2 miscounts a cylinder whose core point is one of the cloud's own: moved by 0.1 mm.
    core = found.core + 1e-4 * np.array([0.48, 0.6, 0.64])
    found = signed_distances(source, target.xyz, params, core=core, normals=found.normals)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "m3c2.npz", source=source, target=target.xyz, core=found.core,
        normals=found.normals, distance=found.distance_m, lod=found.lod95_m,
        n_source=found.count_source, n_target=found.count_target,
    )  # fmt: skip


def compare(folder: Path) -> None:
    """Run py4dgeo on the dumped clouds and print how far the two are apart."""
    import py4dgeo

    data = np.load(folder / "m3c2.npz")
    known = np.isfinite(data["normals"][:, 0])
    core, normals = data["core"][known], data["normals"][known]
    # Distances there are second epoch minus first, along the given normals.
    clouds = [np.ascontiguousarray(data[name]) for name in ("target", "source")]
    epochs = tuple(py4dgeo.Epoch(cloud) for cloud in clouds)
    run = py4dgeo.M3C2(
        epochs=epochs, corepoints=core, cyl_radius=0.25, max_distance=0.3,
        corepoint_normals=normals, registration_error=0.0,
    )  # fmt: skip
    distance, uncertainty = run.run()
    ours, lod = data["distance"][known], data["lod"][known]
    n1, n2 = (np.asarray(uncertainty[f"num_samples{i}"]) for i in (1, 2))
    both = np.isfinite(ours) & np.isfinite(distance) & (n1 >= 2) & (n2 >= 2)
    same = (n1 == data["n_target"][known]) & (n2 == data["n_source"][known])
    gap = np.abs(ours - distance)
    lod_gap = np.abs(lod - np.asarray(uncertainty["lodetection"]))
    print(f"core points {len(core)}, with a distance in both {both.sum()}")
    print(f"same points in both cylinders: {100 * same[both].mean():.2f} %")
    print(f"distances, largest difference there: {gap[both & same].max():.2e} m")
    print(f"LoD95, largest difference there: {np.nanmax(lod_gap[both & same]):.2e} m")
    print(f"distances, 99 % of all differences below: {np.quantile(gap[both], 0.99):.2e} m")


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dump", type=Path)
    parser.add_argument("--compare", type=Path)
    args = parser.parse_args()
    if args.dump is not None:
        dump(args.dump)
    if args.compare is not None:
        compare(args.compare)


if __name__ == "__main__":
    main()
