"""FPFH and feature search, written from the definition, one pair at a time."""

import numpy as np

BINS = 11


def angles(p, n, q, m, is_oriented):
    """Return (alpha, phi, theta) of two oriented points, None where there are none."""
    d = q - p
    length = np.linalg.norm(d)
    if length == 0:
        return None
    d = d / length
    if abs(m @ d) > abs(n @ d):
        n, m, d = m, n, -d
    v = np.cross(d, n)
    if np.linalg.norm(v) <= 1e-9:
        return None
    v = v / np.linalg.norm(v)
    w = np.cross(n, v)
    alpha, phi = v @ m, n @ d
    if is_oriented:
        return alpha, phi, np.arctan2(w @ m, n @ m)
    return abs(alpha), abs(phi), np.arctan2(abs(w @ m), abs(n @ m))


def simple(points, normals, neighbours, i, is_oriented):
    ranges = (
        [(-1, 1), (-1, 1), (-np.pi, np.pi)] if is_oriented else [(0, 1), (0, 1), (0, np.pi / 2)]
    )
    found = [angles(points[i], normals[i], points[j], normals[j], is_oriented) for j in neighbours]
    found = [a for a in found if a is not None]
    if not found:
        return np.zeros(3 * BINS)
    columns = np.array(found).T
    parts = [np.histogram(c, BINS, r)[0] for c, r in zip(columns, ranges, strict=True)]
    return np.concatenate(parts) * 100.0 / len(found)


def fpfh(points, normals, radius, most, is_oriented):
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(gaps, np.inf)
    near = [[j for j in np.argsort(row, kind="stable")[:most] if row[j] <= radius] for row in gaps]
    first = [simple(points, normals, near[i], i, is_oriented) for i in range(len(points))]
    out = []
    for i, neighbours in enumerate(near):
        apart = [j for j in neighbours if gaps[i, j] > 0]
        total = sum((first[j] * radius / gaps[i, j] for j in apart), np.zeros(3 * BINS))
        feature = first[i] + total / max(len(apart), 1)
        for block in feature.reshape(3, BINS):
            if block.sum() > 0:
                block *= 100.0 / block.sum()
        out.append(feature)
    return np.array(out)


def nearest_features(queries, features, k):
    gaps = np.linalg.norm(queries[:, None] - features, axis=2)
    places = np.argsort(gaps, axis=1, kind="stable")[:, :k]
    return places, np.take_along_axis(gaps, places, axis=1)
