"""Draw the figures of the method page: ``python docs/make_figures.py``; seconds.

Everything on them is worked out by the program, on generated buildings.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dougong.cloud import Cloud
from dougong.evaluation.facade import NOISE_LABELS, bracketed_facade
from dougong.evaluation.trial_pairs import make_pair
from dougong.filters import cloth_simulation, curvature_weighted, octree_voxel_grid
from dougong.filters.cloth_simulation import ClothSimulation
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.registration import hypotheses
from dougong.registration.evidence import hear, summon
from dougong.registration.overlap import apply
from dougong.registration.prepare import Prepare, prepare

OUT = Path(__file__).parent / "images" / "method"
GREY, ORANGE, BLUE = "0.72", "#c2410c", "#1d4ed8"
SYMMETRIC, PLAIN = ("octagon", 8), ("l", 6)
SAVE = {"dpi": 110, "facecolor": "white"}


def voxel_grid() -> None:
    """Draw which points of a thin slice are kept."""
    rng = np.random.default_rng(3)
    x = rng.uniform(0, 1.0, 260)
    points = np.column_stack([x, 0.004 * rng.standard_normal(260), 0.35 + 0.12 * np.sin(6 * x)])
    points[:, 2] += 0.006 * rng.standard_normal(260)
    kept = octree_voxel_grid(points, OctreeVoxelGrid(voxel_m=0.0625)).is_kept
    figure, axes = plt.subplots(figsize=(7.6, 3.0), layout="constrained")
    axes.scatter(points[~kept, 0], points[~kept, 2], s=10, color=GREY, label="left out")
    axes.scatter(points[kept, 0], points[kept, 2], s=26, color=ORANGE, label="kept")
    axes.set_aspect("equal")
    axes.set(xlabel="metres", ylabel="metres", title="One original point per voxel of 62.5 mm")
    axes.legend(loc="upper right", frameon=False)
    figure.savefig(OUT / "voxel_grid.png", **SAVE)


def ground() -> None:
    """Draw a profile of a site, ground and the rest."""
    pair = make_pair(*PLAIN)
    points = pair.target - pair.target.mean(axis=0)
    points[:, 2] += 0.04 * points[:, 0]  # a slope of 4 %
    found = cloth_simulation(points, ClothSimulation(class_threshold_m=0.15))
    is_ground = found.attributes["is_ground"].astype(bool)
    strip = np.abs(points[:, 1] - np.median(points[:, 1])) < 2.0
    figure, axes = plt.subplots(figsize=(7.6, 2.6), layout="constrained")
    for chosen, colour, name in ((is_ground, BLUE, "ground"), (~is_ground, ORANGE, "not ground")):
        at = points[chosen & strip]
        axes.scatter(at[:, 0], at[:, 2], s=3, color=colour, label=name)
    axes.set_aspect("equal")
    axes.set(xlabel="metres", ylabel="metres", title="Ground found by the cloth, on a slope of 4 %")
    axes.legend(loc="upper right", frameon=False, markerscale=4)
    figure.savefig(OUT / "ground.png", **SAVE)


def carving() -> None:
    """Draw the curvature of a facade with brackets, and what the noise filter takes out of it."""
    points, labels = bracketed_facade(density=1500.0)
    is_noise = np.isin(labels, NOISE_LABELS)
    found = curvature_weighted(points)
    curvature, kept = found.attributes["curvature"], found.is_kept
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.4), layout="constrained", sharey=True)
    shown = kept & (np.arange(len(points)) % 2 == 0)
    order = np.argsort(curvature[shown])
    dots = axes[0].scatter(
        *points[shown][order][:, [0, 2]].T, s=0.6, c=curvature[shown][order], cmap="viridis",
        vmax=float(np.quantile(curvature[shown], 0.98)),
    )  # fmt: skip
    axes[0].set_title("curvature: high where there is carving")
    figure.colorbar(dots, ax=axes[0], shrink=0.7)
    axes[1].scatter(*points[shown][:, [0, 2]].T, s=0.3, color=GREY)
    axes[1].scatter(*points[~kept][:, [0, 2]].T, s=3, color=ORANGE)
    axes[1].set_title(f"{(~kept).sum():,} points taken out, of {is_noise.sum():,} strays")
    for panel in axes:
        panel.set_aspect("equal")
        panel.set_xlabel("metres")
    figure.savefig(OUT / "carving.png", **SAVE)


def _pair(kind: str, seed: int) -> tuple:
    pair = make_pair(kind, seed)
    settings = Prepare(min_spacing_m=0.4)
    clouds = [Cloud.from_points(points) for points in (pair.source, pair.target)]
    source = prepare(clouds[0], "lidar", settings)
    target = prepare(clouds[1], "photogrammetry", settings)
    T = pair.truth.T_best.copy()
    T[:3, 3] += T[:3, :3] @ clouds[0].frame.origin - clouds[1].frame.origin
    return source, target, T


def _turned(T: np.ndarray, about: np.ndarray, yaw_deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    turn[:3, 3] = about - turn[:3, :3] @ about
    return turn @ T


def _middle(source: object, T: np.ndarray) -> np.ndarray:
    """Return the middle (3,) of the walls, in the target's frame: what the building turns about."""
    high = source.xyz[source.height_above_ground > 1.0]
    return apply(T, np.array([(high.min(axis=0) + high.max(axis=0)) / 2.0]))[0]


def turning() -> None:
    """Draw the score of the true pose, turned: it does not tell an octagon's poses apart."""
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 2.8), layout="constrained", sharey=True)
    yaws = np.arange(-180.0, 180.1, 3.0)
    for panel, (kind, seed), name in zip(
        axes, (PLAIN, SYMMETRIC), ("an L-shaped house", "an octagonal pavilion"), strict=True
    ):
        source, target, T = _pair(kind, seed)
        about = _middle(source, T)
        scores = [hypotheses.score(_turned(T, about, yaw), source, target) for yaw in yaws]
        panel.plot(yaws, scores, color=ORANGE)
        panel.axvline(0.0, color="0.5", linewidth=0.8, linestyle=":")
        panel.set(title=name, xlabel="turned from the true pose, degrees")
        panel.set_xticks(range(-180, 181, 45))
    axes[0].set_ylabel("score of the pose")
    figure.savefig(OUT / "turning.png", **SAVE)


def blocks() -> None:
    """Draw which parts of the surface prefer the true pose to a turned one."""
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 4.2), layout="constrained")
    for panel, (kind, seed), yaw, name in zip(
        axes, (PLAIN, SYMMETRIC), (180.0, 45.0), ("the L, turned by 180°", "the octagon, by 45°"),
        strict=True,
    ):  # fmt: skip
        source, target, T = _pair(kind, seed)
        court = summon(source, target)
        rival = hear(court, _turned(T, _middle(source, T), yaw))
        difference = rival.loss - hear(court, T).loss
        at = np.vstack([apply(T, court.source.points), court.target.points])
        order = np.argsort(np.abs(difference))
        dots = panel.scatter(
            at[order, 0], at[order, 1], s=5, c=difference[order], cmap="coolwarm", vmin=-1, vmax=1
        )
        panel.set_aspect("equal")
        panel.set(title=name, xlabel="metres")
    bar = figure.colorbar(dots, ax=axes, shrink=0.8)
    bar.set_label("red: for the true pose, blue: for the turned one")
    figure.savefig(OUT / "blocks.png", **SAVE)


if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    for draw in (voxel_grid, ground, carving, turning, blocks):
        draw()
