"""Picked pairs as a CSV file: the columns of a control file, one row per place."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from dougong.errors import InputError
from dougong.params import Parameters
from dougong.pipeline.outputs import write_text
from dougong.pipeline.provenance import sha256
from dougong.registration.picked_pairs import PickedPairs

COORDINATES = ("source_x", "source_y", "source_z", "target_x", "target_y", "target_z")
HEADER = ("name", "cloud", *COORDINATES, "sigma_m", "role")
"""The header of control files: `cloud` is the source, `role` is control (used) or check (not)."""
_NUMBERS = (*COORDINATES, "sigma_m")
_STEP = 1e-4
"""Coordinates are written to this."""

_Number = Annotated[float, Field(allow_inf_nan=False)]


class PickedPair(Parameters):
    """One place in two clouds, in the coordinates of their files."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    source: tuple[_Number, _Number, _Number]
    target: tuple[_Number, _Number, _Number]


class PickedSet(Parameters):
    """What a page sends that picked pairs."""

    pairs: Annotated[tuple[PickedPair, ...], Field(max_length=10_000)]


def write_pairs(path: Path, cloud: str, pairs: Sequence[PickedPair]) -> None:
    """Write pairs as a control file, to a tenth of a millimetre where units are metres.

    Rows that `read_pairs` leaves out (of other clouds, of role check) stay as they are, and so do
    those of pairs that were not moved, with their sigma_m.

    Parameters
    ----------
    path : Path
        Replaced as a whole where it exists.
    cloud : str
        Name of the source.
    pairs : sequence of PickedPair

    Raises
    ------
    InputError
        The file that exists is not one of pairs.
    """
    new = list(pairs)
    rows: list[dict[str, str]] = []
    for number, row in enumerate(csv_rows(path) if path.exists() else [], 2):
        if not (_is_of(row, cloud) and _is_used(row)):
            rows.append(row)
            continue
        at = coordinates_in(path, number, row)
        same = next((p for p in new if np.allclose((*p.source, *p.target), at, 0.0, _STEP)), None)
        if same is not None:
            new.remove(same)
            rows.append(row | {"name": same.name})
    for pair in new:
        places = [f"{value:.4f}" for value in (*pair.source, *pair.target)]
        known = {"name": pair.name, "cloud": cloud, "sigma_m": "", "role": "control"}
        rows.append(known | dict(zip(COORDINATES, places, strict=True)))
    text = io.StringIO()
    columns = dict.fromkeys((*HEADER, *(name for row in rows for name in row)))
    table = csv.DictWriter(text, list(columns), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_text(path, text.getvalue())


def _is_of(row: dict[str, str], cloud: str) -> bool:
    return (row.get("cloud") or cloud) == cloud


def _is_used(row: dict[str, str]) -> bool:
    return (row.get("role") or "control").strip().lower() != "check"


def read_pairs(path: Path, source: str) -> PickedPairs:
    """Read the pairs of one source cloud.

    Parameters
    ----------
    path : Path
        A CSV file with the six columns `COORDINATES`; `name`, `cloud` and `role` are optional.
    source : str
        The source's name: rows of other clouds are left out, as are rows of role check.

    Raises
    ------
    InputError
        The file cannot be read, a column is missing, a value is no number, or no row is left.
    """
    rows = csv_rows(path)
    of_cloud = [row for row in rows if _is_of(row, source)]
    if rows and not of_cloud:
        others = ", ".join(sorted({str(row.get("cloud")) for row in rows}))
        msg = (
            f"{path.name} has no pair of {source}: its column cloud names {others}. Give the "
            "clouds in the order in which they were picked, or leave the column empty."
        )
        raise InputError(msg)
    used = [row for row in of_cloud if _is_used(row)]
    values = np.array([coordinates_in(path, number, row) for number, row in enumerate(used, 2)])
    values = values.reshape(-1, 6)
    return PickedPairs(
        names=tuple((row.get("name") or str(index)) for index, row in enumerate(used, 1)),
        source=values[:, :3],
        target=values[:, 3:],
        where=path.name,
        record={"file": str(path), "sha256": sha256(path)},
    )


def csv_rows(path: Path, needed: Sequence[str] = COORDINATES) -> list[dict[str, str]]:
    """Return the rows of a file with the columns of a control file, keys in lower case.

    Raises
    ------
    InputError
        It cannot be read, or one of the `needed` columns is missing.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        msg = (
            f"there is no file {path}. Name a CSV file of places; "
            "`dougong view SOURCE TARGET --pairs FILE` writes one of picked pairs."
        )
        raise InputError(msg) from None
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path} cannot be read as text ({error}). Give a CSV file in UTF-8."
        raise InputError(msg) from None
    head = text.lstrip().partition("\n")[0].strip()
    # Excel writes lists so where a comma is the decimal sign.
    delimiter = ";" if ";" in head and "," not in head else ","
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True, delimiter=delimiter)
    named = [name.strip().lower() for name in reader.fieldnames or ()]
    reader.fieldnames = named
    missing = [name for name in needed if name not in named]
    if missing:
        msg = (
            f"{path.name} has no column {', '.join(missing)}; its first line is "
            f"{head[:80]!r}. Expected: {','.join(HEADER)}"
            f"{_may_lack(needed)}, separated by commas or semicolons."
        )
        raise InputError(msg)
    rows = []
    for row in reader:
        if None in row:
            msg = (
                f"{path.name}, line {reader.line_num}: it has more values than the first line has "
                "names. Write numbers with a decimal point, or separate all values by semicolons."
            )
            raise InputError(msg)
        if any((value or "").strip() for value in row.values()):
            rows.append(row)
    return rows if delimiter == "," else _with_points(path, rows)


def _with_points(path: Path, rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return rows that semicolons part, with decimal commas as points.

    Raises
    ------
    InputError
        Commas stand beside points, or twice in a number: one of both parts thousands.
    """
    numbers = [text for row in rows for name in _NUMBERS if (text := (row.get(name) or "").strip())]
    with_comma = next((text for text in numbers if "," in text), None)
    if with_comma is None:
        return rows
    odd = next((text for text in numbers if "." in text or text.count(",") > 1), None)
    if odd is not None:
        seen = " and ".join(repr(text) for text in dict.fromkeys((with_comma, odd)))
        msg = (
            f"{path.name} is separated by semicolons, and {seen} do not tell which sign is the "
            "decimal one. Write all numbers with one decimal sign, and thousands without any."
        )
        raise InputError(msg)
    return [
        row | {name: row[name].replace(",", ".") for name in _NUMBERS if row.get(name)}
        for row in rows
    ]


def _may_lack(needed: Sequence[str]) -> str:
    others = [name for name in HEADER if name not in needed]
    return f" ({', '.join(others)} may be left out)" if others else ""


def coordinates_in(
    path: Path, number: int, row: dict[str, str], names: Sequence[str] = COORDINATES
) -> list[float]:
    """Return the numbers of the columns `names` of row `number` (the first is 2).

    Raises
    ------
    InputError
        One is no finite number.
    """
    found = []
    for name in names:
        text = (row.get(name) or "").strip()
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            msg = (
                f"{path.name}, pair {row.get('name') or number - 1}: {name} is {text!r}; a number "
                "with a decimal point is expected."
            )
            raise InputError(msg)
        found.append(value)
    return found
