"""Covariances, their eigenvalues and normals of neighbourhoods."""

import math

import numpy as np

from dougong.kernels._arrays import Floats, Ints, Small
from dougong.kernels._jit import kernel

_STEPS = 12
"""Of Newton's, at most: more are not worth it."""
_STEP = 1e-10
"""After one that is shorter than this, what is left is less than a rounding: it is squared."""
_SLOPE = 1e-3
"""Of the polynomial at its first root, at least: its rounding, 1e-16, shifts the root by so much
less than 1e-12."""


@kernel
def add_products(x: np.int64, y: np.int64, z: np.int64, out: Ints) -> None:
    """Add x, y, z, xx, yy, zz, xy, xz, yz to out (9,): sums of whole numbers are exact."""
    out[0] += x
    out[1] += y
    out[2] += z
    out[3] += x * x
    out[4] += y * y
    out[5] += z * z
    out[6] += x * y
    out[7] += x * z
    out[8] += y * z


@kernel
def rotate(a: Floats, v: Floats, p: int, q: int) -> None:
    """Turn the symmetric a (3, 3) and the axes v (columns) so that a[p, q] becomes 0 (Jacobi)."""
    apq = a[p, q]
    if apq == 0.0:
        return
    theta = (a[q, q] - a[p, p]) / (2.0 * apq)
    sign = 1.0 if theta >= 0.0 else -1.0
    t = sign / (abs(theta) + math.sqrt(theta * theta + 1.0))
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    r = 3 - p - q
    apr, aqr = a[p, r], a[q, r]
    a[p, p] -= t * apq
    a[q, q] += t * apq
    a[p, q] = a[q, p] = 0.0
    a[p, r] = a[r, p] = c * apr - s * aqr
    a[q, r] = a[r, q] = s * apr + c * aqr
    for row in range(3):
        vp, vq = v[row, p], v[row, q]
        v[row, p] = c * vp - s * vq
        v[row, q] = s * vp + c * vq


@kernel
def eigen3(a: Floats, v: Floats) -> tuple[int, int, int]:
    """Diagonalise the symmetric a (3, 3) in place; v (3, 3) receives the axes as columns.

    Cyclic Jacobi: small eigenvalues of a covariance keep their digits, unlike with the
    trigonometric formula. Returns the columns of the smallest, middle and largest eigenvalue.
    """
    for row in range(3):
        for column in range(3):
            v[row, column] = 1.0 if row == column else 0.0
    for _ in range(12):
        off = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
        if off <= 1e-17 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        rotate(a, v, 0, 1)
        rotate(a, v, 0, 2)
        rotate(a, v, 1, 2)
    small, middle, large = 0, 1, 2
    if a[small, small] > a[middle, middle]:
        small, middle = middle, small
    if a[middle, middle] > a[large, large]:
        middle, large = large, middle
    if a[small, small] > a[middle, middle]:
        small, middle = middle, small
    return small, middle, large


@kernel
def least_share(a: Floats, total: float) -> float:
    """Return the least eigenvalue of the symmetric a (3, 3), none < 0, as a share of their `total`.

    Newton's steps on the characteristic polynomial, from 0 up to its first root: to 1e-13 where the
    others are well apart from it, as on a surface. -1 where they are not, such as along a line.
    """
    xx, yy, zz = a[0, 0] / total, a[1, 1] / total, a[2, 2] / total
    xy, xz, yz = a[0, 1] / total, a[0, 2] / total, a[1, 2] / total
    minor_x, minor_y, minor_z = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    minors = minor_x + minor_y + minor_z
    determinant = xx * minor_x - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    root = 0.0
    for _ in range(_STEPS):
        slope = (3.0 * root - 2.0) * root + minors
        if slope < _SLOPE:
            return -1.0
        step = (((root - 1.0) * root + minors) * root - determinant) / slope
        root -= step
        if abs(step) < _STEP:
            return float(max(root, 0.0))
    return -1.0


@kernel
def describe(
    a: Floats, v: Floats, row: int, normals: Floats, variation: Floats, planarity: Floats
) -> None:
    """Write normal, surface variation and planarity of the covariance a (3, 3) into `row`.

    The normal points up; a level one towards +x, else +y, whatever the solver's sign.
    """
    small, middle, large = eigen3(a, v)
    l3 = max(a[small, small], 0.0)
    l2 = max(a[middle, middle], 0.0)
    l1 = max(a[large, large], 0.0)
    total = l1 + l2 + l3
    nx, ny, nz = v[0, small], v[1, small], v[2, small]
    flip = nz < -1e-12 or (nz <= 1e-12 and (nx < -1e-12 or (nx <= 1e-12 and ny < 0.0)))
    sign = -1.0 if flip else 1.0
    normals[row, 0] = sign * nx
    normals[row, 1] = sign * ny
    normals[row, 2] = sign * nz
    variation[row] = l3 / total if total > 0.0 else 0.0
    planarity[row] = (l2 - l3) / l1 if l1 > 0.0 else 0.0


@kernel
def describe_neighbours(
    points: Floats,
    places: Ints | Small,
    first: int,
    normals: Floats,
    variation: Floats,
    planarity: Floats,
) -> None:
    """Describe the neighbourhood of each sorted point first .. first + m - 1, itself included.

    places (m, k): its neighbours as places, -1 where missing. normals (n, 3), variation (n,) and
    planarity (n,) are filled at those points. With fewer than two neighbours: NaN.
    """
    a = np.empty((3, 3), np.float64)
    v = np.empty((3, 3), np.float64)
    for row in range(places.shape[0]):
        i = first + row
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        count = 1.0
        sx = sy = sz = xx = yy = zz = xy = xz = yz = 0.0
        for column in range(places.shape[1]):
            j = places[row, column]
            if j < 0:
                break
            # About the point itself: no large numbers, whatever the coordinates.
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            count += 1.0
            sx += dx
            sy += dy
            sz += dz
            xx += dx * dx
            yy += dy * dy
            zz += dz * dz
            xy += dx * dy
            xz += dx * dz
            yz += dy * dz
        if count < 3.0:
            normals[i, :] = np.nan
            variation[i] = planarity[i] = np.nan
            continue
        mx, my, mz = sx / count, sy / count, sz / count
        a[0, 0], a[1, 1], a[2, 2] = xx / count - mx * mx, yy / count - my * my, zz / count - mz * mz
        a[0, 1] = a[1, 0] = xy / count - mx * my
        a[0, 2] = a[2, 0] = xz / count - mx * mz
        a[1, 2] = a[2, 1] = yz / count - my * mz
        describe(a, v, i, normals, variation, planarity)
