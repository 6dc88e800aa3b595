"""Fast point feature histograms (Rusu 2009) and exact search among them."""

import math

import numpy as np

from dougong.kernels._arrays import Floats, Ints
from dougong.kernels._jit import kernel

BINS = 11
"""Bins per angle; three angles make a feature of 33 numbers."""


@kernel
def _bin(value: float, low: float, high: float) -> int:
    """Return the bin of `value` in low .. high; both ends belong."""
    place = math.floor((value - low) / (high - low) * BINS)
    return min(max(place, 0), BINS - 1)


@kernel
def _count_pair(
    points: Floats, normals: Floats, i: int, j: int, is_oriented: bool, histogram: Floats
) -> float:
    """Count the three angles of points i and j into histogram (33,); 0 where they have none.

    The frame stands at the point whose normal is nearer to the line between them: u its normal,
    v = d x u, w = u x v; alpha = v . n, phi = u . d, theta = atan2(w . n, u . n) with n the other
    normal (Rusu 2009, eq. 1). Without oriented normals the angles are folded so that the sign of
    either normal changes nothing: |alpha|, |phi|, atan2(|w . n|, |u . n|).
    """
    dx, dy, dz = (
        points[j, 0] - points[i, 0],
        points[j, 1] - points[i, 1],
        points[j, 2] - points[i, 2],
    )
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length == 0.0:
        return 0.0
    dx, dy, dz = dx / length, dy / length, dz / length
    at, to = i, j
    phi = normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz
    other = normals[j, 0] * dx + normals[j, 1] * dy + normals[j, 2] * dz
    if abs(other) > abs(phi):
        at, to = j, i
        dx, dy, dz = -dx, -dy, -dz
        phi = -other
    ux, uy, uz = normals[at, 0], normals[at, 1], normals[at, 2]
    nx, ny, nz = normals[to, 0], normals[to, 1], normals[to, 2]
    vx, vy, vz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
    size = math.sqrt(vx * vx + vy * vy + vz * vz)
    if not size > 1e-9:
        return 0.0
    vx, vy, vz = vx / size, vy / size, vz / size
    wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    alpha = vx * nx + vy * ny + vz * nz
    across = wx * nx + wy * ny + wz * nz
    along = ux * nx + uy * ny + uz * nz
    if is_oriented:
        histogram[_bin(alpha, -1.0, 1.0)] += 1.0
        histogram[BINS + _bin(phi, -1.0, 1.0)] += 1.0
        histogram[2 * BINS + _bin(math.atan2(across, along), -math.pi, math.pi)] += 1.0
    else:
        histogram[_bin(abs(alpha), 0.0, 1.0)] += 1.0
        histogram[BINS + _bin(abs(phi), 0.0, 1.0)] += 1.0
        folded = math.atan2(abs(across), abs(along))
        histogram[2 * BINS + _bin(folded, 0.0, 0.5 * math.pi)] += 1.0
    return 1.0


@kernel
def simple_histograms(
    points: Floats, normals: Floats, places: Ints, first: int, is_oriented: bool, out: Floats
) -> None:
    """Fill out[first:first + m] (n, 33) with the simplified histograms (SPFH) of sorted points.

    places (m, k): neighbours as places, -1 where missing. Each angle's bins sum to 100, or are
    all zero where no neighbour has angles.
    """
    for row in range(places.shape[0]):
        histogram = out[first + row]
        histogram[:] = 0.0
        count = 0.0
        for column in range(places.shape[1]):
            j = places[row, column]
            if j < 0:
                break
            count += _count_pair(points, normals, first + row, j, is_oriented, histogram)
        if count > 0.0:
            for b in range(histogram.shape[0]):
                histogram[b] *= 100.0 / count


@kernel
def weighted_histograms(
    places: Ints, distance2: Floats, radius: float, first: int, simple: Floats, out: Floats
) -> None:
    """Fill out[first:first + m] (n, 33) with SPFH(p) + 1/k sum SPFH(p_j) / w_j (Rusu 2009, eq. 2).

    w_j is the distance in radii, so that the unit of length changes nothing; neighbours at the
    same place are left out. Each angle's bins are scaled to sum 100.
    """
    for row in range(places.shape[0]):
        feature = out[first + row]
        feature[:] = 0.0
        count = 0
        for column in range(places.shape[1]):
            j = places[row, column]
            if j < 0:
                break
            if distance2[row, column] <= 0.0:
                continue
            weight = radius / math.sqrt(distance2[row, column])
            count += 1
            for b in range(feature.shape[0]):
                feature[b] += weight * simple[j, b]
        for b in range(feature.shape[0]):
            feature[b] = simple[first + row, b] + feature[b] / max(count, 1)
        for angle in range(3):
            total = 0.0
            for b in range(angle * BINS, (angle + 1) * BINS):
                total += feature[b]
            if total > 0.0:
                for b in range(angle * BINS, (angle + 1) * BINS):
                    feature[b] *= 100.0 / total


@kernel
def nearest_features(queries: Floats, features: Floats, places: Ints, distance2: Floats) -> None:
    """Find the k nearest of features (n, d) for each of queries (m, d), nearest first.

    places (m, k) int64, -1 where there are fewer; distance2 (m, k). Exact: a candidate is given
    up only once the part of its distance that is summed exceeds the worst kept one, so put the
    columns that vary most first. Equal distances go to the smaller place.
    """
    n, d = features.shape
    k = places.shape[1]
    for q in range(queries.shape[0]):
        places[q, :] = -1
        distance2[q, :] = np.inf
        for i in range(n):
            worst = distance2[q, k - 1]
            total = 0.0
            b = 0
            while b < d and total < worst:
                stop = min(b + 4, d)
                while b < stop:
                    gap = queries[q, b] - features[i, b]
                    total += gap * gap
                    b += 1
            if total >= worst:
                continue
            at = k - 1
            while at > 0 and distance2[q, at - 1] > total:
                distance2[q, at] = distance2[q, at - 1]
                places[q, at] = places[q, at - 1]
                at -= 1
            distance2[q, at] = total
            places[q, at] = i
