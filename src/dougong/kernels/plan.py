"""Kernels of the plan search: rotated splats, scores at a pose, votes for a height."""

import numpy as np
from numpy.typing import NDArray

from dougong.kernels._jit import kernel, summing_kernel


@kernel
def splat(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    values: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Add values (n, k) to the images out (k, rows, columns) at (y, x), wrapped, bilinearly.

    x, y (n,) in cells; column 0's centre is x = 0. The images are periodic, as the FFT is.
    """
    channels, rows, columns = out.shape
    for i in range(len(x)):
        column = np.floor(x[i])
        row = np.floor(y[i])
        fx = np.float32(x[i] - column)
        fy = np.float32(y[i] - row)
        c0 = int(column) % columns
        r0 = int(row) % rows
        c1 = (c0 + 1) % columns
        r1 = (r0 + 1) % rows
        one = np.float32(1.0)
        for k in range(channels):
            value = values[i, k]
            if value != 0.0:
                out[k, r0, c0] += value * (one - fx) * (one - fy)
                out[k, r0, c1] += value * fx * (one - fy)
                out[k, r1, c0] += value * (one - fx) * fy
                out[k, r1, c1] += value * fx * fy


@summing_kernel
def match_at_poses(
    xy: NDArray[np.float64],
    values: NDArray[np.float32],
    field: NDArray[np.float32],
    poses: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill out (p, 3) with the three sums of the masked correlation at each pose.

    xy (n, 2): source cells about their pivot, in field cells. values (n, 2 b + s + 2): per cell
    b cosines, b sines (double wall angle), s signed occupancies, energy, mask. field
    (rows, columns, 2 b + s + 2): the target's the same way. poses (p, 3): yaw in radians, column
    and row of the pivot. b and s are equal: (k - 2) / 3. out: product, source energy under the
    target's mask, target energy under the source's mask. Nearest cell; outside counts as unseen.
    """
    rows, columns, channels = field.shape
    bands = (channels - 2) // 3
    energy = channels - 2
    mask = channels - 1
    for p in range(len(poses)):
        c = np.cos(poses[p, 0])
        s = np.sin(poses[p, 0])
        c2 = np.float32(np.cos(2.0 * poses[p, 0]))
        s2 = np.float32(np.sin(2.0 * poses[p, 0]))
        product = 0.0
        source_energy = 0.0
        target_energy = 0.0
        for i in range(len(xy)):
            column = int(np.floor(c * xy[i, 0] - s * xy[i, 1] + poses[p, 1] + 0.5))
            row = int(np.floor(s * xy[i, 0] + c * xy[i, 1] + poses[p, 2] + 0.5))
            if column < 0 or row < 0 or column >= columns or row >= rows:
                continue
            source_energy += values[i, energy] * field[row, column, mask]
            target_energy += values[i, mask] * field[row, column, energy]
            part = np.float32(0.0)
            for k in range(bands):
                re = values[i, k]
                im = values[i, bands + k]
                if re != 0.0 or im != 0.0:
                    part += (c2 * re - s2 * im) * field[row, column, k]
                    part += (s2 * re + c2 * im) * field[row, column, bands + k]
                part += values[i, 2 * bands + k] * field[row, column, 2 * bands + k]
            product += float(part)
        out[p, 0] = product
        out[p, 1] = source_energy
        out[p, 2] = target_energy


@kernel
def vote_heights(
    cell: NDArray[np.int64],
    z: NDArray[np.float64],
    weight: NDArray[np.float64],
    starts: NDArray[np.int64],
    target_z: NDArray[np.float64],
    target_weight: NDArray[np.float64],
    low: float,
    bin_m: float,
    out: NDArray[np.float64],
) -> None:
    """Add to out (bins,) the votes for target z - source z over shared plan cells.

    cell (n,): flat target cell of each source entry, -1 outside. The target's entries of cell c
    are starts[c]:starts[c + 1]. A vote is the product of the weights, split between two bins.
    """
    for i in range(len(cell)):
        if cell[i] < 0:
            continue
        for j in range(starts[cell[i]], starts[cell[i] + 1]):
            place = (target_z[j] - z[i] - low) / bin_m
            slot = int(np.floor(place))
            if slot < 0 or slot + 1 >= len(out):
                continue
            vote = weight[i] * target_weight[j]
            out[slot] += vote * (slot + 1 - place)
            out[slot + 1] += vote * (place - slot)
