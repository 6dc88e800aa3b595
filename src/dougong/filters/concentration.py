"""Whether a noise filter takes more from fine geometry than from plain surfaces, in words.

Noise does not prefer carving: it lies round brackets as round walls. A filter whose removal
concentrates there takes the carving for noise, and nobody would see it in its total.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.filters.octree_voxel_grid import summed_cells
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
_STEPS = 1 << 30
"""Steps per unit of surface variation, so that sums are exact."""


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
    return note_of(tally(points, is_kept, variation, spacing_m))


class Tally(NamedTuple):
    """Some cells, and what was taken in each."""

    cells: Points
    """(m, 3) whole numbers of cells, each once."""
    counts: NDArray[np.int64]
    """(m, 3): points there were, points kept, steps of surface variation of the kept ones."""


def tally(points: Points, is_kept: Mask, variation: Values, spacing_m: float) -> Tally:
    """Return the cells of a cloud, or of a part of one, and what was taken in them."""
    kept = is_kept.astype(np.int64)
    bends = np.rint(variation * _STEPS).astype(np.int64) * kept
    counts = np.stack([np.ones_like(kept), kept, bends], axis=1)
    return Tally(*summed_cells(np.floor(points / (CELL_SPACINGS * spacing_m)), counts))


def together(parts: Sequence[Tally]) -> Tally:
    """Return the tallies of all parts of a cloud, at least one, as one: they may share cells."""
    cells = np.concatenate([part.cells for part in parts])
    return Tally(*summed_cells(cells, np.concatenate([part.counts for part in parts])))


def note_of(found: Tally) -> str | None:
    """Return what is to be said of the cells of a whole cloud, see `concentration_note`."""
    held, kept, bends = found.counts.T
    counted = kept >= LEAST_KEPT
    is_fine = counted & (bends > FINE_VARIATION * _STEPS * kept)
    is_plain = counted & ~is_fine
    if is_fine.sum() < LEAST_CELLS or is_plain.sum() < LEAST_CELLS:
        return None
    fine = 1.0 - kept[is_fine].sum() / held[is_fine].sum()
    plain = 1.0 - kept[is_plain].sum() / held[is_plain].sum()
    if fine <= RATIO * plain or fine <= plain + BEYOND:
        return None
    return (
        f"took {100 * fine:.1f} % of the points on fine geometry and {100 * plain:.1f} % "
        "elsewhere: it may take carving (or leaves) for noise. Look at them with --mark and "
        "loosen it."
    )
