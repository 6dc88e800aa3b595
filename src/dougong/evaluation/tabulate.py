"""What every study's tables and figures share: spreads, text for a terminal, an empty figure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from dougong.errors import InputError

Row = Mapping[str, Any]


def chosen(rows: Iterable[Row], **values: Any) -> list[Row]:
    """Return the rows that have all these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in values.items())]


def distinct(rows: Iterable[Row], *keys: str) -> list[tuple[Any, ...]]:
    """Return every combination of the values of `keys`, in the order they come."""
    return list(dict.fromkeys(tuple(row.get(key) for key in keys) for row in rows))


def numbers(rows: Iterable[Row], key: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the values of a column that are numbers."""
    values = [row.get(key) for row in rows]
    return np.array([value for value in values if value is not None], dtype=np.float64)


def spread(rows: Iterable[Row], key: str, digits: int = 3) -> dict[str, float | None]:
    """Return median, smallest and largest of a column: ``KEY``, ``KEY_min`` and ``KEY_max``."""
    values = numbers(rows, key)
    values = values[np.isfinite(values)]
    if not len(values):
        return {key: None, f"{key}_min": None, f"{key}_max": None}
    three = float(np.median(values)), float(values.min()), float(values.max())
    return {
        name: round(value, digits)
        for name, value in zip((key, f"{key}_min", f"{key}_max"), three, strict=True)
    }


def as_text(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """Return the columns (key: heading) of rows, aligned, for a terminal."""
    cells = [list(columns.values())]
    cells += [[_cell(row.get(key)) for key in columns] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(columns))]
    is_number = [any(isinstance(row.get(key), int | float) for row in rows) for key in columns]
    lines = []
    for line in cells:
        parts = (
            text.rjust(width) if right else text.ljust(width)
            for text, width, right in zip(line, widths, is_number, strict=True)
        )
        lines.append("  ".join(parts).rstrip())
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) and abs(value) >= 10_000:
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure, inches, that can be saved without a screen.

    Raises
    ------
    InputError
        Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        msg = "the figures of studies need matplotlib: pip install 'dougong[evaluate]'."
        raise InputError(msg) from error
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
