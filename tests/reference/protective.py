"""Slow twin of the protective rule, written from docs/denoising.md in plain numpy."""

import math

import numpy as np
from scipy.stats import binom

from dougong.filters import local_spacing
from dougong.filters.groups import BETWEEN, FLAT, GROUP, LINK, MANY, PIECE, SOLID
from dougong.filters.octree_voxel_grid import robust_low
from reference.filters import distances


def spacing(points, own, edge, low):
    """Return B-spline weighted count and mean log2 (n,) of `own` over cells of `edge`."""
    points = points - low + edge / 2
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


def frames(points, order, table, alpha, gamma, reach, neighbours, usual, stretch):
    """Return neighbours, variation (n,), axes (n, 3, 3) by rising variance, divisors (n, 3)."""
    near, axes, divisors, variation = [], [], [], np.zeros(len(points))
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
        variation[i] = least
        flat, line = 1 - math.tanh(gamma * least), 1 - math.tanh(gamma * (least + middle))
        axes.append(vectors)
        excuse = 1 + alpha * line
        if len(group) >= 8:
            pitch = math.sqrt(12 * max(values[2], 0) / (len(group) ** 2 - 1))
            excuse = max(excuse, line * stretch * pitch / usual[i])
        divisors.append((1 + alpha * flat * (1 - line), max(1 + alpha * flat, excuse), excuse))
    return near, variation, np.array(axes), np.array(divisors)


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


def pieces_joined(group, points, usual, table, are_large):
    """Return the group number (n,) after pieces of one thing became one group."""
    members = {g: group == g for g in set(group.tolist())}
    size = {
        g: max(usual[m].mean() * math.sqrt(m.sum()), np.ptp(points[m], axis=0).max())
        for g, m in members.items()
    }
    large = are_large(group)
    pieces = [g for g, m in members.items() if m.sum() > PIECE and not large[g]]
    joined = group.copy()
    for a in pieces:
        for b in pieces:
            gap = table[np.ix_(members[a], members[b])].min()
            if a < b and gap <= BETWEEN * min(size[a], size[b]):
                joined[joined == joined[members[b]][0]] = joined[members[a]][0]
    return joined


def in_row(points, spacing, rule, radius):
    """Return the logarithm (n,) of how many such rows chance makes, at most 0."""
    n, table = len(points), distances(points)
    order = np.argsort(table, axis=1, kind="stable")
    best = np.zeros(n)
    for i in range(n):
        near = [j for j in order[i, : rule.ROW_NEIGHBOURS] if table[i, j] <= radius]
        if len(near) < 3:
            continue
        half = rule.ROW_WIDTH * spacing[i]
        p = (
            4
            * half
            / (math.pi * (table[i, near[-1]] if len(near) == rule.ROW_NEIGHBOURS else radius))
        )
        if p >= 0.5:
            continue
        off = points[near] - points[i]
        for j in range(len(near)):
            length = np.linalg.norm(off[j])
            if length < spacing[i]:
                continue
            t = off @ off[j] / length
            aside = np.maximum((off**2).sum(axis=1) - t**2, 0.0)
            count, last = 0, -math.inf
            for place in np.sort(t[aside <= half**2]):
                if place - last >= half and abs(place) >= half:
                    count, last = count + 1, place
            tail = binom.sf(count - 2, len(near) - 1, p)
            best[i] = min(best[i], math.log(len(near)) + math.log(max(tail, 1e-300)))
    return best


def judge(points, alpha, gamma, limits, rule, reach=0.5):
    """Return margin (n,) and spacing (n,); `rule` holds the constants."""
    n, table = len(points), distances(points)
    order = np.argsort(table, axis=1, kind="stable")
    ranked = np.sort(table, axis=1)
    eighth = ranked[:, rule.TESTS - 1] if n > rule.TESTS else np.full(n, np.inf)
    own = np.maximum(np.minimum(eighth, reach) * math.sqrt(math.pi / rule.TESTS), 2.0**-14)
    low = robust_low(points)
    held, near_log = spacing(points, own, local_spacing.NEAR_CELLS * reach, low)
    _, far_log = spacing(points, own, local_spacing.FAR_CELLS * reach, low)
    usual = np.exp2((held * near_log + local_spacing.FEW * far_log) / (held + local_spacing.FEW))
    args = (alpha, gamma, reach, rule.NEIGHBOURS, usual, math.pi / 2 * limits[-1])
    near, variation, axes, divisors = frames(points, order, table, *args)
    margin, links = np.full(n, np.inf), []
    for i in range(n):
        reached = []
        for j in near[i]:
            part = axes[j].T @ (points[i] - points[j])
            lift = 1.0 + rule.CHARGE * (divisors[j, 0] - 1.0)
            protected = part * (lift, 1.0, 1.0) / (1.0, divisors[j, 0], divisors[j, 1])
            reached.append(np.linalg.norm(protected) / usual[j])
            if np.linalg.norm(part / (1, 1, divisors[j, 2])) <= LINK * max(usual[i], usual[j]):
                links.append((i, j))
        found = np.sort(reached)[: rule.TESTS]
        margin[i] = (found / limits[: len(found)]).max(initial=0.0)
        if len(found) < rule.TESTS:
            margin[i] = max(margin[i], 1.0 + reach / (usual[i] * limits[len(found)]))

    def are_large(group):
        large = {}
        for g in set(group.tolist()):
            extent = np.ptp(points[group == g], axis=0).max()
            flat = ((group == g) & (variation < FLAT)).sum()
            is_solid = flat >= SOLID and extent > 0
            large[g] = extent > GROUP * reach or (group == g).sum() >= MANY or is_solid
        return large

    group = pieces_joined(groups(links, n), points, usual, table, are_large)
    is_large = are_large(group)
    extent = {g: np.ptp(points[group == g], axis=0).max() for g in set(group.tolist())}
    large = np.array([is_large[g] for g in group])
    for g in set(group.tolist()):
        mine = group == g
        if is_large[g]:
            continue
        gap = min(GROUP * reach, table[np.ix_(mine, large)].min() if large.any() else np.inf)
        size = max(usual[mine].mean() * math.sqrt(mine.sum()), extent[g])
        margin[mine] = np.maximum(margin[mine], gap / size)
    gone = np.flatnonzero(margin > 1)
    if len(gone):
        log = in_row(
            points[gone],
            np.minimum(usual[gone], rule.ROW_REACH * reach),
            rule,
            GROUP * reach,
        )
        sure = gone[log < 0]
        excused = math.log(rule.ROW_ACCIDENTS) / log[log < 0]
        margin[sure] = np.minimum(margin[sure], excused)
    return margin, usual
