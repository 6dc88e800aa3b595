"""Whether a noise filter takes more from fine geometry than from plain surfaces, in words.

Noise does not prefer carving: it lies round brackets as round walls. A filter whose removal
concentrates there takes the carving for noise, and nobody would see it in its total.
"""

import numpy as np

from dougong.typing import Mask, Points, Values

CELL_SPACINGS = 6.0
"""Edge of the cells that are compared, in spacings: a plain one holds about 36 points."""
LEAST_KEPT = 12
"""Cells with fewer kept points say nothing about the geometry in them."""
FINE_VARIATION = 0.1
"""Kept points of a fine cell have a mean surface variation above this (METHOD.md section 5)."""
LEAST_CELLS = 20
"""Of either sort there must be so many."""
RATIO, BEYOND = 3.0, 0.03
"""Said where the share taken in fine cells exceeds so many times that in plain ones, and is this
much larger."""


def concentration_note(
    points: Points, is_kept: Mask, variation: Values, spacing_m: float
) -> str | None:
    """Return what is to be said where removal concentrates on fine geometry, else None.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Metres.
    is_kept : ndarray, shape (n,)
    variation : ndarray, shape (n,)
        Surface variation (METHOD.md eq. 3).
    spacing_m : float
        Usual spacing of the cloud.
    """
    if not len(points) or not spacing_m > 0:
        return None
    cells = np.floor(points / (CELL_SPACINGS * spacing_m)).astype(np.int64)
    cells -= cells.min(axis=0)
    span = cells.max(axis=0) + 1
    if float(span[0]) * float(span[1]) * float(span[2]) > 2.0**62:
        return None
    keys = (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2]
    _, cell = np.unique(keys, return_inverse=True)
    held = np.bincount(cell)
    kept = np.bincount(cell[is_kept], minlength=len(held))
    bends = np.bincount(cell[is_kept], weights=variation[is_kept], minlength=len(held))
    counted = kept >= LEAST_KEPT
    is_fine = counted & (bends > FINE_VARIATION * kept)
    is_plain = counted & ~is_fine
    if is_fine.sum() < LEAST_CELLS or is_plain.sum() < LEAST_CELLS:
        return None
    fine = 1.0 - kept[is_fine].sum() / held[is_fine].sum()
    plain = 1.0 - kept[is_plain].sum() / held[is_plain].sum()
    if fine <= RATIO * plain or fine <= plain + BEYOND:
        return None
    return (
        f"took {fine:.1%} of the points on fine geometry and {plain:.1%} elsewhere: it may take "
        "carving (or leaves) for noise. Look at them with --mark and loosen it."
    )
