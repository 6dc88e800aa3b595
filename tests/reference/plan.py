"""Slow twins of kernels.plan, written from the definitions."""

import numpy as np


def splat(x, y, values, shape):
    """Spread each value over the four periodic cells around (x, y) by area."""
    out = np.zeros((values.shape[1], *shape))
    for i in range(len(x)):
        for row in range(shape[0]):
            for column in range(shape[1]):
                across = abs((x[i] - column + shape[1] / 2) % shape[1] - shape[1] / 2)
                down = abs((y[i] - row + shape[0] / 2) % shape[0] - shape[0] / 2)
                out[:, row, column] += values[i] * max(0, 1 - across) * max(0, 1 - down)
    return out


def match_at_pose(xy, values, field, pose):
    """Sum products of source and target channels cell by cell; wall directions are complex."""
    rows, columns, channels = field.shape
    bands = (channels - 2) // 3
    sums = np.zeros(3)
    for place, value in zip(xy, values, strict=True):
        moved = complex(*place) * np.exp(1j * pose[0]) + complex(pose[1], pose[2])
        column, row = round(moved.real), round(moved.imag)
        if not (0 <= row < rows and 0 <= column < columns):
            continue
        there = field[row, column]
        wall = (value[:bands] + 1j * value[bands : 2 * bands]) * np.exp(2j * pose[0])
        other = there[:bands] + 1j * there[bands : 2 * bands]
        sums[0] += (wall * other.conj()).real.sum()
        sums[0] += value[2 * bands : 3 * bands] @ there[2 * bands : 3 * bands]
        sums[1] += value[-2] * there[-1]
        sums[2] += value[-1] * there[-2]
    return sums


def vote_heights(cell, z, weight, starts, target_z, target_weight, low, bin_m, bins):
    """Histogram all differences of shared cells, each split between the two nearest bins."""
    votes = np.zeros(bins)
    for c, height, w in zip(cell, z, weight, strict=True):
        if c < 0:
            continue
        for other, v in zip(
            target_z[starts[c] : starts[c + 1]],
            target_weight[starts[c] : starts[c + 1]],
            strict=True,
        ):
            for k in range(bins):
                share = max(0.0, 1 - abs((other - height - low) / bin_m - k))
                votes[k] += w * v * share
    return votes
