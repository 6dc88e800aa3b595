"""How well every point is held by its neighbours: the kernels of the protective rule.

Points come in the order of a box tree; a frame (9,) of a point holds its normal, its long axis,
and how much its neighbourhood excuses gaps across, along, and along as a line (see `frames`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._arrays import Floats, Ints, Small
from dougong.kernels._jit import kernel
from dougong.kernels.boxtree import box_distance2
from dougong.kernels.disjoint import join, root_of
from dougong.kernels.moments import eigen3

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]

LINE = 8
"""So many points in a row are no accident: their own pitch counts along them."""


@kernel
def drop_far(points: Floats, places: Small, limit2: float, start: int, stop: int) -> None:
    """Set places (n, k) of neighbours beyond the limit to -1, for points start .. stop - 1.

    Nearest first, so what follows one that is too far is too far as well.
    """
    for i in range(start, stop):
        for k in range(places.shape[1] - 1, -1, -1):
            j = places[i, k]
            if j < 0:
                continue
            dx = points[j, 0] - points[i, 0]
            dy = points[j, 1] - points[i, 1]
            dz = points[j, 2] - points[i, 2]
            if dx * dx + dy * dy + dz * dz <= limit2:
                break
            places[i, k] = -1


@kernel
def _covariance(points: Floats, places: Small, i: int, a: Floats) -> int:
    """Fill a (3, 3) with the covariance of point i and its neighbours; return how many they are."""
    held = 1
    mean = np.zeros(3, np.float64)
    a[:, :] = 0.0
    for column in range(places.shape[1]):
        j = places[i, column]
        if j < 0:
            break
        held += 1
        for r in range(3):
            dr = points[j, r] - points[i, r]
            mean[r] += dr
            for c in range(r, 3):
                a[r, c] += dr * (points[j, c] - points[i, c])
    for r in range(3):
        for c in range(r, 3):
            a[r, c] = a[r, c] / held - mean[r] / held * (mean[c] / held)
            a[c, r] = a[r, c]
    return held


@kernel
def frames(
    points: Floats,
    places: Small,
    alpha: float,
    gamma: float,
    spacing: Floats,
    stretch: float,
    start: int,
    stop: int,
    variation: Floats,
    out: Singles,
) -> None:
    """Fill variation (n,) and out (n, 9) for sorted points start .. stop - 1 from their places.

    out: unit normal, unit long axis, then the divisors (at least 1) of distances along the middle
    axis, along the long axis, and along the long axis where links are made (lines only). A line
    of at least `LINE` points excuses `stretch` times its own pitch. places (n, k) int32, -1 where
    missing; spacing (n,).
    """
    a = np.empty((3, 3), np.float64)
    v = np.empty((3, 3), np.float64)
    for i in range(start, stop):
        held = _covariance(points, places, i, a)
        variation[i] = 0.0
        out[i, :6] = 0.0
        out[i, 6:] = 1.0
        if held < 4:
            continue
        small, middle, large = eigen3(a, v)
        least, next_least = max(a[small, small], 0.0), max(a[middle, middle], 0.0)
        total = least + next_least + max(a[large, large], 0.0)
        if total <= 0.0:
            continue
        variation[i] = least / total
        flat = 1.0 - math.tanh(gamma * least / total)
        line = 1.0 - math.tanh(gamma * (least + next_least) / total)
        for axis in range(3):
            out[i, axis] = v[axis, small]
            out[i, 3 + axis] = v[axis, large]
        excuse = 1.0 + alpha * line
        if held >= LINE:
            # Evenly spaced points have this pitch for their variance.
            pitch = math.sqrt(12.0 * max(a[large, large], 0.0) / (held * held - 1.0))
            excuse = max(excuse, line * stretch * pitch / spacing[i])
        out[i, 6] = 1.0 + alpha * flat * (1.0 - line)
        out[i, 7] = max(1.0 + alpha * flat, excuse)
        out[i, 8] = excuse


@kernel
def _parts2(points: Floats, frame: Singles, i: int, j: int) -> tuple[float, float, float]:
    """Return squared parts of p_i - p_j along the normal, the middle and the long axis of j."""
    dx = points[i, 0] - points[j, 0]
    dy = points[i, 1] - points[j, 1]
    dz = points[i, 2] - points[j, 2]
    whole = dx * dx + dy * dy + dz * dz
    up = dx * frame[j, 0] + dy * frame[j, 1] + dz * frame[j, 2]
    along = dx * frame[j, 3] + dy * frame[j, 4] + dz * frame[j, 5]
    return up * up, max(whole - up * up - along * along, 0.0), along * along


@kernel
def support(
    points: Floats,
    places: Small,
    frame: Singles,
    spacing: Floats,
    limits: Floats,
    reach: float,
    charge: float,
    start: int,
    stop: int,
    margin: Floats,
    decisive: Bytes,
) -> None:
    """Fill margin (n,) and decisive (n,) for sorted points start .. stop - 1.

    margin: the largest over k of (k-th least protected distance) / limits[k - 1], distances being
    divided by the spacing (n,) round the neighbour; above 1 is too far. decisive: that k. What is
    excused along a plane is charged across it, times `charge`. Where fewer are in reach than there
    are limits, decisive is 0 and the margin 1 plus what the first missing one has at least.
    """
    tests = limits.shape[0]
    best = np.empty(tests, np.float64)
    for i in range(start, stop):
        best[:] = np.inf
        for column in range(places.shape[1]):
            j = places[i, column]
            if j < 0:
                break
            up, across, along = _parts2(points, frame, i, j)
            lift = 1.0 + charge * (frame[j, 6] - 1.0)
            d2 = lift * lift * up
            d2 += across / (frame[j, 6] * frame[j, 6]) + along / (frame[j, 7] * frame[j, 7])
            d2 /= spacing[j] * spacing[j]
            if d2 >= best[tests - 1]:
                continue
            at = tests - 1
            while at > 0 and best[at - 1] > d2:
                best[at] = best[at - 1]
                at -= 1
            best[at] = d2
        margin[i] = -1.0
        for k in range(tests):
            if best[k] == np.inf:
                margin[i] = max(margin[i], 1.0 + reach / (spacing[i] * limits[k]))
                decisive[i] = 0
                break
            ratio = math.sqrt(best[k]) / limits[k]
            if ratio > margin[i]:
                margin[i] = ratio
                decisive[i] = k + 1


@kernel
def link(
    points: Floats,
    places: Small,
    frame: Singles,
    spacing: Floats,
    reach: float,
    is_own: NDArray[np.bool_],
    parent: Ints,
    across: Ints,
) -> int:
    """Join, in parent (n,), own points that are neighbours within `reach` spacings of each other.

    Along a line the distance is divided as its frame says. parent comes as 0 .. n - 1 and leaves
    with the root of every own point's group. Returns how many links go from an own point to one
    that is not; as many as there is room for fill across (m, 2).
    """
    n = points.shape[0]
    links = 0
    for i in range(n):
        if not is_own[i]:
            continue
        for column in range(places.shape[1]):
            j = places[i, column]
            if j < 0:
                break
            up, other, along = _parts2(points, frame, i, j)
            far = reach * max(spacing[i], spacing[j])
            if up + other + along / (frame[j, 8] * frame[j, 8]) > far * far:
                continue
            if is_own[j]:
                join(parent, i, j)
                continue
            if links < across.shape[0]:
                across[links, 0], across[links, 1] = i, j
            links += 1
    for i in range(n):
        parent[i] = root_of(parent, i)
    return links


@kernel
def measure(
    points: Floats, steps: Ints, group: Ints, held: Ints, sums: Ints, boxes: Floats
) -> None:
    """Fill, for every group: held (g,) points, sums (g,) of their steps (n,), boxes (g, 6).

    group (n,) of each point, a place among them.
    """
    n = points.shape[0]
    boxes[:, :3] = np.inf
    boxes[:, 3:] = -np.inf
    for i in range(n):
        root = group[i]
        held[root] += 1
        sums[root] += steps[i]
        for axis in range(3):
            boxes[root, axis] = min(boxes[root, axis], points[i, axis])
            boxes[root, 3 + axis] = max(boxes[root, 3 + axis], points[i, axis])


@kernel
def flag_nodes(chosen: NDArray[np.bool_], nodes: NDArray[np.bool_]) -> None:
    """Fill nodes (2 leaves,): whether any point under the node is chosen (n,)."""
    n = chosen.shape[0]
    leaves = nodes.shape[0] // 2
    for leaf in range(leaves):
        nodes[leaves + leaf] = chosen[leaf * n // leaves : (leaf + 1) * n // leaves].any()
    for node in range(leaves - 1, 0, -1):
        nodes[node] = nodes[2 * node] or nodes[2 * node + 1]


@kernel
def gaps(
    points: Floats,
    boxes: Floats,
    chosen: NDArray[np.bool_],
    nodes: NDArray[np.bool_],
    limit2: float,
    queries: Floats,
    out: Floats,
) -> None:
    """Fill out (m,): squared distance from queries (m, 3) to the nearest chosen; limit2 if none."""
    n = points.shape[0]
    leaves = boxes.shape[0] // 2
    stack = np.empty(64, np.int64)
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        best = limit2
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            if not nodes[node] or box_distance2(boxes, node, x, y, z) >= best:
                continue
            if node < leaves:
                left = box_distance2(boxes, 2 * node, x, y, z)
                right = box_distance2(boxes, 2 * node + 1, x, y, z)
                far = 2 * node if left > right else 2 * node + 1
                stack[height] = far
                stack[height + 1] = 4 * node + 1 - far
                height += 2
                continue
            leaf = node - leaves
            for j in range(leaf * n // leaves, (leaf + 1) * n // leaves):
                if chosen[j]:
                    dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                    best = min(best, dx * dx + dy * dy + dz * dz)
        out[q] = best


@kernel
def _log_tail(trials: int, hits: int, p: float) -> float:
    """Return the logarithm of the chance of at least `hits` among `trials` of probability p."""
    if hits <= 0:
        return 0.0
    total = 0.0
    for k in range(hits, trials + 1):
        log = math.lgamma(trials + 1.0) - math.lgamma(k + 1.0) - math.lgamma(trials - k + 1.0)
        total += math.exp(log + k * math.log(p) + (trials - k) * math.log1p(-p))
    return math.log(max(total, 1e-300))


@kernel
def _in_row(along: Floats, held: int, step: float) -> int:
    """Return how many of the first `held` places lie at least `step` apart, and from place 0."""
    ordered = np.sort(along[:held])
    count = 0
    last = -np.inf
    for place in ordered:
        if place - last >= step and abs(place) >= step:
            count += 1
            last = place
    return count


@kernel
def rows(
    points: Floats,
    places: Ints,
    spacing: Floats,
    width: float,
    reach: float,
    start: int,
    accident: Floats,
) -> None:
    """Fill accident (m,): how many rows like the best through each point chance would make there.

    The logarithm; of the points from `start` on. A row is a strip, `width` spacings to either side
    of a line through the point and one of its places (m, k); chance throws the others evenly on a
    disc of their reach.
    """
    along = np.empty(places.shape[1], np.float64)
    for row in range(places.shape[0]):
        i = start + row
        accident[row] = 0.0
        held = 0
        far2 = 0.0
        for column in range(places.shape[1]):
            j = places[row, column]
            if j < 0:
                break
            held += 1
            far2 = 0.0
            for axis in range(3):
                far2 += (points[j, axis] - points[i, axis]) ** 2
        if held < 3:
            continue
        radius = reach if held < places.shape[1] else math.sqrt(far2)
        half = width * spacing[i]
        p = 4.0 * half / (math.pi * radius)
        if p >= 0.5:
            continue
        for column in range(held):
            j = places[row, column]
            ux = points[j, 0] - points[i, 0]
            uy = points[j, 1] - points[i, 1]
            uz = points[j, 2] - points[i, 2]
            length = math.sqrt(ux * ux + uy * uy + uz * uz)
            if length < spacing[i]:
                continue
            count = 0
            for other in range(held):
                k = places[row, other]
                x = points[k, 0] - points[i, 0]
                y = points[k, 1] - points[i, 1]
                z = points[k, 2] - points[i, 2]
                t = (x * ux + y * uy + z * uz) / length
                if x * x + y * y + z * z - t * t <= half * half:
                    along[count] = t
                    count += 1
            aligned = _in_row(along, count, half)
            log = math.log(held) + _log_tail(held - 1, aligned - 1, p)
            accident[row] = min(accident[row], log)
