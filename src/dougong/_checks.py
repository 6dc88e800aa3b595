"""Turn what a user passes into what the kernels accept, or say what is wrong."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dougong.errors import InputError
from dougong.typing import Points, Transform


def as_points(value: ArrayLike, name: str = "points") -> Points:
    """Return `value` as finite, C-contiguous float64 of shape (n, 3).

    Raises
    ------
    InputError
        The shape is not (n, 3), or a coordinate is not finite.
    """
    points = np.ascontiguousarray(value, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        msg = (
            f"{name} must have shape (n, 3), got {points.shape}. Keep x, y, z only: points[:, :3]."
        )
        raise InputError(msg)
    is_finite = np.isfinite(points)
    if not is_finite.all():
        is_bad = ~is_finite.all(axis=1)
        msg = (
            f"{name} has {is_bad.sum()} of {len(points)} rows that are not finite "
            f"(first: row {np.flatnonzero(is_bad)[0]}). "
            "Drop them: points[np.isfinite(points).all(1)]."
        )
        raise InputError(msg)
    return points


def refuse_other_shape(name: str, values: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raise InputError unless an attribute has one value, or so many, per point."""
    if values.shape != shape:
        each = "one value" if len(shape) == 1 else f"{shape[1]} values"
        msg = f"{name} must have shape {shape}, got {values.shape}: {each} per point."
        raise InputError(msg)


def as_stored(name: str, values: NDArray[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return `values` as the type in which an attribute is stored, if it holds every one of them.

    Raises
    ------
    InputError
        It does not: numbers would wrap, be cut or rounded.
    """
    try:
        with np.errstate(invalid="ignore", over="ignore"):
            fitted = values.astype(kind)
            is_same = (fitted == values) & (fitted.astype(values.dtype) == values)
            is_same |= (fitted != fitted) & (values != values)  # both NaN
    except (TypeError, ValueError):
        is_same = np.zeros(values.shape, dtype=bool)
    if not is_same.all():
        first = np.argwhere(~is_same)[0]
        msg = (
            f"{name} is stored as {kind.name}, which cannot hold {(~is_same).sum()} of "
            f"{is_same.size} values (first: {values[tuple(first)]} in row {first[0]}). Round or "
            "clip them to that type, or give the attribute another name."
        )
        raise InputError(msg)
    return fitted


def as_transform(value: ArrayLike, name: str = "matrix") -> Transform:
    """Return `value` as a proper (4, 4) rigid or similarity transform.

    Raises
    ------
    InputError
        Wrong shape, not finite, a last row other than 0 0 0 1, a mirror (determinant < 0),
        or axes that are not orthogonal.
    """
    matrix = np.ascontiguousarray(value, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        msg = f"{name} must be a finite 4x4 matrix, got shape {matrix.shape}."
        raise InputError(msg)
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        msg = (
            f"{name} must end with the row 0 0 0 1, got {matrix[3].tolist()}. "
            "Transpose it if it was written column by column."
        )
        raise InputError(msg)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant <= 0:
        msg = (
            f"{name} mirrors or flattens space (determinant {determinant:.6g}); "
            "a registration must have a positive one. Swap or negate one axis of the input."
        )
        raise InputError(msg)
    rotation = matrix[:3, :3] / np.cbrt(determinant)
    skew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if skew > 1e-6:
        msg = (
            f"{name} is not a rotation times one scale (axes off by {skew:.2g}, "
            "at most 1e-6 expected). Pass a rigid or similarity transform."
        )
        raise InputError(msg)
    return matrix
