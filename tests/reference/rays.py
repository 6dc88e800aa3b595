"""Rays against triangles, every pair tried: the slow twin of dougong.kernels.rays."""

import numpy as np


def cast(corners, rays, reach):
    """Return distance (n,) and triangle (n,) by solving o + t d = a + u e1 + v e2 for every pair.

    corners (m, 3, 3), rays (n, 6), reach (n,). Ties go to the triangle with the smallest number.
    """
    distance, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for i, ray in enumerate(rays):
        for k, (a, b, c) in enumerate(corners):
            matrix = np.column_stack([b - a, c - a, -ray[3:]])
            if abs(np.linalg.det(matrix)) < 1e-14:
                continue
            u, v, t = np.linalg.solve(matrix, ray[:3] - a)
            inside = u >= 0 and v >= 0 and u + v <= 1
            if inside and 0 < t < reach[i] and t < distance[i] - 1e-12:
                distance[i], face[i] = t, k
    return distance, face
