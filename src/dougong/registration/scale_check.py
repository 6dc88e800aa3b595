"""Whether two clouds that lie on each other are of one size: where not, no rigid pose is right.

A drone cloud that took its scale from the camera's position is off by parts of a per cent. The fit
then lies well where most of the shared surface is, the rest within what a robust loss forgives, and
the ends of the building are decimetres off.
"""

import numpy as np

from dougong.registration.icp import Icp
from dougong.registration.prepare import Prepared
from dougong.registration.similarity_fit import fit_similarity
from dougong.typing import Transform

_SIGMAS = 3.3
"""1 in 1000 by chance."""
_REACH = 2.0
"""Of the root-mean-square radius of the shared surface: hardly any of it lies farther out."""


def size_doubt(
    source: Prepared, target: Prepared, T: Transform, icp: Icp, most_m: float
) -> tuple[str, float] | None:
    """Fit the scale as well; return why the rigid pose is in doubt, and by how many metres.

    Parameters
    ----------
    source, target : Prepared
        In metres, each as far as its file says.
    T : ndarray, shape (4, 4)
        The rigid pose, source local -> target local.
    icp : Icp
    most_m : float
        What a difference in size may move the ends of the shared surface by.

    Returns
    -------
    tuple of str and float, or None
        None: they are of one size, or what they share does not hold a scale.
    """
    fit = fit_similarity(source, target, T, "target", icp, 5 if icp.dof == 4 else 7)
    if fit is None or not fit.holds_scale or fit.covariance is None:
        return None
    off = float(np.log(fit.factor))
    sigma = float(np.sqrt(fit.covariance[6, 6]))
    moved = abs(off) * _REACH * fit.length_m
    if abs(off) <= _SIGMAS * sigma or moved <= most_m:
        return None
    less = "smaller" if off > 0.0 else "larger"
    return (
        f"the clouds are not of one size: the target is {100 * abs(off):.2g} % {less} than the "
        f"source (sigma {100 * sigma:.2g} %), which moves the ends of what they share by "
        f"{moved:.2g} m, at most {most_m:.2g} m expected. Correct the scale of the wrong one, or "
        "have it fitted (--dof 7).",
        moved,
    )
