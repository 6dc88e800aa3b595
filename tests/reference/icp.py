"""Normal equations of plane distances, written from the definition."""

import numpy as np


def normal_equations(points, normals, residuals, weights, block, blocks):
    H, g = np.zeros((blocks, 6, 6)), np.zeros((blocks, 6))
    for p, n, r, w, b in zip(points, normals, residuals, weights, block, strict=True):
        row = np.concatenate([np.cross(p, n), n])
        H[b] += w * np.outer(row, row)
        g[b] += w * row * r
    return H, g
