"""What the columns of a text file mean: from a header line, or from the numbers themselves."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

_SYNONYMS = {
    "x": {"x", "east", "easting", "x_coord", "coord_x", "cartesianx", "rechtswert"},
    "y": {"y", "north", "northing", "y_coord", "coord_y", "cartesiany", "hochwert"},
    "z": {
        "z", "height", "elevation", "elev", "alt", "altitude", "z_coord", "coord_z",
        "cartesianz", "h",
    },
    "intensity": {"intensity", "i", "int", "reflectance", "remission"},
    "red": {"red", "r", "rf"},
    "green": {"green", "g", "gf"},
    "blue": {"blue", "b", "bf"},
    "nx": {"nx", "normal_x", "normalx"},
    "ny": {"ny", "normal_y", "normaly"},
    "nz": {"nz", "normal_z", "normalz"},
    "classification": {"classification", "class", "label"},
}  # fmt: skip
_UNIT = re.compile(r"\s*[\[(](m|metres?|meters?)[\])]$")
_FEW_ROWS = 20
_RGB = ("red", "green", "blue")
_NORMAL = ("nx", "ny", "nz")


def named_columns(words: tuple[str, ...]) -> tuple[tuple[str, ...], str | None]:
    """Return attribute names from the words of a header line, each once, and what was assumed.

    A name that is written out counts before any synonym of it, wherever it stands.
    """
    keys = [_UNIT.sub("", word.strip().lower().removeprefix("scalar_")) for word in words]
    found: dict[str, int] = {}
    for column, key in enumerate(keys):
        if key in _SYNONYMS:
            found.setdefault(key, column)
    assumed = []
    for column, key in enumerate(keys):
        name = next((name for name, same in _SYNONYMS.items() if key in same), None)
        if name is not None and name not in found:
            found[name] = column
            assumed.append(f"{words[column].strip()} as {name}")
    known = {column: name for name, column in found.items()}
    names: list[str] = []
    for column, word in enumerate(words):
        name = known.get(column) or word.strip() or "field"
        unique, number = name, 2
        while unique in names or (unique in found and found[unique] != column):
            unique, number = f"{name}_{number}", number + 1
        names.append(unique)
    return tuple(names), f"columns were taken: {', '.join(assumed)}." if assumed else None


def _is_whole(columns: NDArray[np.float64], most: float) -> bool:
    known = columns[np.isfinite(columns).all(axis=1)]
    return bool(len(known) and ((known >= 0) & (known <= most) & (known == np.rint(known))).all())


def _is_unit(columns: NDArray[np.float64]) -> bool:
    known = columns[np.isfinite(columns).all(axis=1)]
    length = np.linalg.norm(known, axis=1)
    return bool(len(known) and (np.abs(length - 1) < 0.01).mean() > 0.95)


def column_names(
    sample: NDArray[np.float64], *, is_pts: bool = False
) -> tuple[tuple[str, ...], str | None]:
    """Return names for the columns of a headerless file, and in words what was assumed.

    Parameters
    ----------
    sample : ndarray, shape (m, k)
        The first rows, k >= 3.
    is_pts : bool
        The file is a PTS file, whose fourth column of four or seven is the intensity.

    Notes
    -----
    x y z come first. Then, where they fit: three whole numbers in 0..255 are red green blue,
    three that form unit vectors a normal, a single column before a colour or alone intensity.
    """
    count = sample.shape[1]
    while count > 3 and np.isnan(sample[:, count - 1]).all() and len(sample):
        count -= 1  # an empty field behind a trailing delimiter
    names = ["x", "y", "z"]
    at = 3
    while at < count:
        three = sample[:, at : at + 3]
        if is_pts and at == 3 and count in (4, 7):
            names.append("intensity")
            at += 1
        elif at + 3 <= count and "red" not in names and _is_whole(three, 255):
            names += _RGB
            at += 3
        elif at + 3 <= count and "nx" not in names and _is_unit(three):
            names += _NORMAL
            at += 3
        elif "intensity" not in names and _is_intensity(sample, at, count):
            names.append("intensity")
            at += 1
        else:
            names.append(f"field_{at + 1}")
            at += 1
    if count == 3:
        return tuple(names), None
    said = f"no header line: columns were taken as {' '.join(names)}."
    if not is_pts and _counts_rows(sample):
        said += (
            f" The first goes up by one from row to row ({sample[0, 0]:.0f}, {sample[1, 0]:.0f}, "
            "...): if it only numbers the points, it is wrongly read as x. Name the columns in a "
            "header line."
        )
    return tuple(names), said


def _counts_rows(sample: NDArray[np.float64]) -> bool:
    """Say whether the first column numbers the rows; a line of a grid has one y, too."""
    first, second = sample[:, 0], sample[:, 1]
    has_many = len(sample) >= _FEW_ROWS
    return has_many and bool((np.diff(first) == 1.0).all() and (second != second[0]).any())


def _is_intensity(sample: NDArray[np.float64], at: int, count: int) -> bool:
    """Say whether column `at` stands alone: at the end, or right before a colour or a normal."""
    three = sample[:, at + 1 : at + 4]
    before_three = at + 4 <= count and (_is_whole(three, 255) or _is_unit(three))
    return at + 1 == count or before_three
