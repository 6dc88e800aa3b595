"""Small sites made of rectangles, seen by a scanner (no roofs) or a drone (no eave undersides)."""

import numpy as np

from dougong.cloud import Cloud
from dougong.registration.prepare import Prepare

SETTINGS = Prepare(min_spacing_m=0.2)


def rectangle(rng, corner, u, v, per_m2):
    u, v = np.asarray(u, float), np.asarray(v, float)
    count = int(np.linalg.norm(np.cross(u, v)) * per_m2)
    return np.asarray(corner) + rng.random((count, 1)) * u + rng.random((count, 1)) * v


def walls(rng, outline, low, high, per_m2):
    """Return points on the walls over a closed plan outline."""
    outline = np.asarray(outline, float)
    parts = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        parts.append(rectangle(rng, [*a, low], [*(b - a), 0], [0, 0, high - low], per_m2))
    return np.vstack(parts)


def polygon(sides, radius):
    angle = 2 * np.pi * np.arange(sides) / sides
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


L_PLAN = [(-10, -6), (12, -6), (12, 2), (-2, 2), (-2, 9), (-10, 9)]


def site(kind, seed=0, outline=L_PLAN, extras=True, size=30.0, height=5.0, per_m2=40.0):
    """Return points of a building on level ground, with a garden wall and a kiosk beside it."""
    rng = np.random.default_rng(seed)
    outline = np.asarray(outline, float)
    ground = rectangle(rng, [-size, -size, 0], [2 * size, 0, 0], [0, 2 * size, 0], per_m2 / 4)
    inside = _inside(ground[:, :2], outline)
    parts = [ground[~inside], walls(rng, outline, 0, height, per_m2)]
    if extras:
        parts.append(walls(rng, [(18, 10), (21, 10), (21, 14), (18, 14)], 0, 3, per_m2))
        parts.append(walls(rng, [(-20, -18), (5, -18), (5, -18.3), (-20, -18.3)], 0, 2, per_m2))
    if kind == "photogrammetry":
        low, high = outline.min(axis=0) - 1, outline.max(axis=0) + 1
        roof = rectangle(
            rng, [*low, height], [high[0] - low[0], 0, 0], [0, high[1] - low[1], 0], per_m2
        )
        roof = roof[_inside(roof[:, :2], outline * 1.08)]
        parts.append(roof)
        if extras:
            parts.append(rectangle(rng, [17.5, 9.5, 3], [4, 0, 0], [0, 5, 0], per_m2))
    noise = 0.003 if kind == "lidar" else 0.012
    points = np.vstack(parts)
    return points + rng.normal(0, noise, points.shape)


def _inside(plan, outline):
    x, y = plan.T
    inside = np.zeros(len(plan), bool)
    for (x1, y1), (x2, y2) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y1 != y2:
            crosses = ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
            inside ^= crosses
    return inside


def motion(yaw_deg, shift=(0.0, 0.0, 0.0), tilt_deg=0.0):
    yaw, tilt = np.radians([yaw_deg, tilt_deg])
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ lean
    matrix[:3, 3] = shift
    return matrix


def moved(points, matrix):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def as_cloud(points):
    return Cloud.from_points(points)


def local_truth(matrix, source, target):
    """Return a matrix between file coordinates as one between the clouds' local frames."""
    local = matrix.copy()
    local[:3, 3] += matrix[:3, :3] @ source.frame.origin - target.frame.origin
    return local


def pose_error(found, truth, centre=(0.0, 0.0, 0.0)):
    """Return (yaw deg, plan m, z m) between two poses at a source point."""
    turn = found[:3, :3] @ truth[:3, :3].T
    offset = moved(np.asarray(centre, float)[None], found) - moved(
        np.asarray(centre, float)[None], truth
    )
    yaw = np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))
    return abs(float(yaw)), float(np.hypot(*offset[0, :2])), abs(float(offset[0, 2]))
