"""Slow twins of the filters, written from the definitions of METHOD.md section 1 in plain numpy."""

import numpy as np

from dougong.filters.octree_voxel_grid import robust_low


def octree_voxel_grid(points, low, voxel_m, records=None):
    """Return (is_kept, voxel_count): per voxel the point nearest the centre, ties by content.

    Coordinates are rounded to the voxel's edge halved until a step is below a micrometre.
    """
    steps = 1
    while voxel_m / steps >= 1e-6 and steps < 2**30:
        steps *= 2
    place = np.rint((points - low) / (voxel_m / steps)).astype(int)
    is_kept = np.zeros(len(points), bool)
    count = np.zeros(len(points), int)
    voxels = {}
    for i, cell in enumerate(map(tuple, place // steps)):
        voxels.setdefault(cell, []).append(i)
    for cell, members in voxels.items():
        rank = ((place[members] - steps * np.array(cell) - steps // 2) ** 2).sum(1)
        content = [b"" if records is None else records[i].tobytes() for i in members]
        keys = zip(rank, points[members].tolist(), content, members, strict=True)
        is_kept[min(keys)[-1]] = True
        count[members] = len(members)
    return is_kept, count


def distances(points):
    """Return all distances (n, n), inf on the diagonal."""
    table = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(table, np.inf)
    return table


def statistical(points, multiplier, neighbours=None, radius_m=None):
    """Return is_kept by the mean distance to k neighbours or to those within a radius."""
    table = distances(points)
    if neighbours is not None:
        mean = np.sort(table, axis=1)[:, :neighbours].mean(1)
    else:
        mean = np.array(
            [r[r <= radius_m].mean() if (r <= radius_m).any() else np.inf for r in table]
        )
    known = mean[np.isfinite(mean)]
    return mean <= known.mean() + multiplier * known.std() if len(known) else mean < np.inf


def ball(points, i, radius_m, kind="exact"):
    """Return which points (n,) lie in the ball of point i, exact or made of cells."""
    if kind == "exact":
        return np.linalg.norm(points - points[i], axis=1) <= radius_m
    edge = 2.0 ** np.floor(np.log2(radius_m / 16))
    cells = np.floor((points - robust_low(points)) / edge)
    return ((cells - cells[i]) ** 2).sum(1) <= (radius_m / edge) ** 2


def curvature(points, radius_m, every=1, kind="exact"):
    """Return surface variation in the ball of each point, itself included (eq. 1 to 3)."""
    result = []
    for i in range(0, len(points), every):
        inside = points[ball(points, i, radius_m, kind)]
        centred = inside - inside.mean(0)
        values = np.linalg.eigvalsh(centred.T @ centred / len(inside))
        result.append(max(values[0], 0) / values.sum() if values.sum() > 0 else 0.0)
    return np.array(result)


def curvature_weighted(points, p):
    """Return is_kept by eq. 4 to 6 in the reading `p.rule`."""
    kappa = curvature(points, p.radius_init_m, kind=p.balls)
    swing = (1 - np.cos(2 * np.pi * p.tau_period * kappa)) / 2
    tau = p.tau_min + (p.tau_max - p.tau_min) * swing
    weight = 1 + p.alpha * np.tanh(p.gamma * kappa)
    rise = 1 + np.exp(-p.beta * (kappa - p.curvature_0))
    radius = p.radius_min_m + (p.radius_max_m - p.radius_min_m) / rise
    table = distances(points)
    least = np.where(table <= radius[:, None], table * weight, np.inf).min(1)
    is_known = np.isfinite(least)
    is_kept = np.zeros(len(points), bool)
    for i in np.flatnonzero(is_known):
        in_ball = ball(points, i, p.radius_init_m, p.balls)
        sample = least[is_known & (in_ball if p.rule == "paper" else True)]
        is_kept[i] = least[i] <= sample.mean() + tau[i] * sample.std()
    return is_kept
