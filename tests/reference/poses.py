"""Scores of poses and pairs at a distance, written from the definition."""

import numpy as np


def closest(field, x):
    cell = np.floor((x - field.low) / field.cell_m).astype(int)
    if (cell < 0).any() or (cell >= field.cells.shape).any():
        return -1
    return int(field.cells[tuple(cell)])


def score(pose, points, normals, field, reach):
    turn, shift = pose[:9].reshape(3, 3), pose[9:]
    total = 0.0
    for p, n in zip(points, normals, strict=True):
        x = turn @ p + shift
        j = closest(field, x)
        if j < 0:
            continue
        d2 = ((field.view.points[j] - x) ** 2).sum()
        if d2 < reach**2:
            total += (1 - d2 / reach**2) * ((turn @ n) @ field.view.normals[j]) ** 2
    return total / len(points)


def shifted(pose, points, field, reach, steps):
    pose = pose.copy()
    for _ in range(steps):
        weight, offset = 0.0, np.zeros(3)
        for p in points:
            x = pose[:9].reshape(3, 3) @ p + pose[9:]
            j = closest(field, x)
            if j < 0:
                continue
            d = field.view.points[j] - x
            share = max(0.0, 1 - d @ d / reach**2)
            weight, offset = weight + share, offset + share * d
        if weight == 0:
            break
        pose[9:] += offset / weight
    return pose


def pairs_at_distance(points, normals, length, tolerance, cosine, cosine_tolerance):
    return [
        (i, j)
        for i in range(len(points))
        for j in range(len(points))
        if i != j
        and abs(np.linalg.norm(points[i] - points[j]) - length) <= tolerance
        and abs(abs(normals[i] @ normals[j]) - cosine) <= cosine_tolerance
    ]
