"""Slow twin of the protective rule, written from docs/denoising.md in plain numpy."""

import math

import numpy as np

from reference.filters import distances


def spacing(points, own, edge):
    """Return B-spline weighted count and mean log2 (n,) of `own` over cells of `edge`."""
    cells = {}
    for i, cell in enumerate(map(tuple, np.floor(points / edge).astype(int))):
        cells.setdefault(cell, []).append(math.log2(own[i]))
    count, mean = np.zeros(len(points)), np.zeros(len(points))
    for i, point in enumerate(points):
        here = np.floor(point / edge).astype(int)
        t = point / edge - here - 0.5
        spline = np.array([0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2])
        total = weight = 0.0
        for by in np.ndindex(3, 3, 3):
            inside = cells.get(tuple(here + np.array(by) - 1), [])
            w = np.prod([spline[by[axis], axis] for axis in range(3)])
            weight += w * len(inside)
            total += w * sum(inside)
        count[i], mean[i] = 8.0 * weight, total / weight
    return count, mean


def frames(points, order, table, alpha, gamma, reach, neighbours):
    """Return neighbours, axes (n, 3, 3) by rising variance and divisors (n, 3)."""
    near, axes, divisors = [], [], []
    for i in range(len(points)):
        mine = [j for j in order[i, :neighbours] if table[i, j] <= reach]
        near.append(mine)
        group = points[[i, *mine]]
        if len(group) < 4:
            axes.append(np.eye(3))
            divisors.append((1.0, 1.0, 1.0))
            continue
        values, vectors = np.linalg.eigh(np.cov(group.T, bias=True))
        least, middle = np.maximum(values[:2], 0) / values.sum()
        flat, line = 1 - math.tanh(gamma * least), 1 - math.tanh(gamma * (least + middle))
        axes.append(vectors)
        divisors.append(
            (1 + alpha * flat * (1 - line), 1 + alpha * max(flat, line), 1 + alpha * line)
        )
    return near, np.array(axes), np.array(divisors)


def groups(links, n):
    """Return the group number (n,) of every point."""
    group = np.arange(n)
    changed = True
    while changed:
        changed = False
        for i, j in links:
            if group[i] != group[j]:
                group[group == max(group[i], group[j])] = min(group[i], group[j])
                changed = True
    return group


def judge(points, alpha, gamma, limits, rule, reach=0.5):
    """Return margin (n,) and spacing (n,); `rule` is the module that holds the constants."""
    n, table = len(points), distances(points)
    order = np.argsort(table, axis=1, kind="stable")
    ranked = np.sort(table, axis=1)
    eighth = ranked[:, rule.TESTS - 1] if n > rule.TESTS else np.full(n, np.inf)
    own = np.maximum(np.minimum(eighth, reach) * math.sqrt(math.pi / rule.TESTS), 2.0**-14)
    held, near_log = spacing(points, own, rule.NEAR_CELLS * reach)
    _, far_log = spacing(points, own, rule.FAR_CELLS * reach)
    usual = np.exp2((held * near_log + rule.FEW * far_log) / (held + rule.FEW))
    args = (alpha, gamma, reach, rule.NEIGHBOURS)
    near, axes, divisors = frames(points, order, table, *args)
    margin, links = np.full(n, np.inf), []
    for i in range(n):
        reached = []
        for j in near[i]:
            part = axes[j].T @ (points[i] - points[j])
            reached.append(np.linalg.norm(part / (1.0, divisors[j, 0], divisors[j, 1])) / usual[j])
            if np.linalg.norm(part / (1, 1, divisors[j, 2])) <= rule.LINK * max(usual[i], usual[j]):
                links.append((i, j))
        if len(reached) >= rule.TESTS:
            margin[i] = (np.sort(reached)[: rule.TESTS] / limits).max()
    group = groups(links, n)
    extent = {g: np.ptp(points[group == g], axis=0).max() for g in set(group.tolist())}
    held = {g: (group == g).sum() for g in extent}
    is_large = {g: extent[g] > rule.GROUP * reach or held[g] >= rule.MANY for g in extent}
    large = np.array([is_large[g] for g in group])
    for g in set(group.tolist()):
        mine = group == g
        if is_large[g]:
            continue
        gap = min(rule.GROUP * reach, table[np.ix_(mine, large)].min() if large.any() else np.inf)
        size = max(usual[mine].mean() * math.sqrt(mine.sum()), extent[g])
        margin[mine] = np.maximum(margin[mine], gap / size)
    return margin, usual
