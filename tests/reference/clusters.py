"""Single linkage by every pair, and the least rectangle by every angle: slow and plain."""

import numpy as np


def clusters(points, gap):
    """Return a cluster number (n,) per point: pairs within the smaller of their gaps join."""
    n = len(points)
    group = np.arange(n)
    for i in range(n):
        for j in range(i):
            near = np.linalg.norm(points[i] - points[j]) <= min(gap[i], gap[j])
            if near and group[i] != group[j]:
                group[group == group[i]] = group[j]
    return group


def least_rectangle(plan, steps=3600):
    """Return the sides, longer first, of the least rectangle over `steps` angles."""
    angle = np.linspace(0.0, np.pi / 2, steps, endpoint=False)[:, None]
    along = np.cos(angle) * plan[:, 0] + np.sin(angle) * plan[:, 1]
    across = np.cos(angle) * plan[:, 1] - np.sin(angle) * plan[:, 0]
    sides = np.stack([np.ptp(along, axis=1), np.ptp(across, axis=1)], axis=1)
    best = sides[np.argmin(sides.prod(axis=1))]
    return max(best), min(best)
