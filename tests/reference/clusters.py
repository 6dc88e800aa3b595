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


def runs_of_wires(points, height, least_m, reach_m, rule):
    """Return how far a wire goes on from each point (n,), by looking at every other point.

    The 8th nearest is looked for within `reach_m`. `rule` is the module with the constants.
    """
    lines = {}
    for i in np.flatnonzero(height >= least_m):
        direction = _thin_line(points, i, reach_m, rule)
        if direction is not None:
            lines[i] = direction
    run = np.zeros(len(points))
    steps = int(rule.AHEAD_M / rule.STEP_M)
    places = np.array(sorted(lines), dtype=int)
    for i, direction in lines.items():
        off = points[places] - points[i]
        d2, along = (off**2).sum(axis=1), off @ direction
        width = rule.THICK_M + rule.SPREAD * np.abs(along)
        is_in = (d2 <= rule.AHEAD_M**2) & (d2 - along**2 <= width**2)
        for side in (along >= 0, along < 0):
            step = (np.abs(along[is_in & side]) / rule.STEP_M).astype(int)
            hit = set(np.minimum(step, steps).tolist())
            reached = 1
            while reached <= steps and reached in hit:
                reached += 1
            run[i] = max(run[i], reached * rule.STEP_M if reached > 1 else 0.0)
    return run


def _thin_line(points, i, reach_m, rule):
    off = points - points[i]
    d2 = (off**2).sum(axis=1)
    ball = np.flatnonzero(d2 <= rule.BALL_M**2)
    eighth = np.sqrt(np.sort(d2)[8]) if len(points) > 8 else np.inf
    eighth = eighth if eighth <= reach_m else np.inf
    usual = 2.0 * rule.BALL_M * 4 / max(eighth, 1e-9)
    if len(ball) < rule.LEAST_POINTS or len(ball) > max(rule.CROWDED * usual, 9):
        return None
    far = min(ball, key=lambda j: (-d2[j], *points[j]))
    length = np.sqrt(d2[far])
    if length < 0.5 * rule.BALL_M or abs(off[far, 2] / length) > rule.STEEPEST:
        return None
    direction = off[far] / length
    stray = d2[ball] - (off[ball] @ direction) ** 2 > rule.THICK_M**2
    return None if stray.sum() > int(rule.STRAY * len(ball)) else direction
