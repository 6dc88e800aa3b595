"""Read points from text: XYZ, PTS, CSV, TXT, ASC.

The first lines decide delimiter, header, the number of columns (what most of them have), which
hold numbers and what these mean; what was assumed is noted. A line that is not a row of numbers
becomes a row of NaN, to be dropped and counted like any other without coordinates.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import BitField
from dougong.errors import FormatError
from dougong.formats.stream import Block, opened, stem_of, usable_rows
from dougong.formats.text_columns import column_names, named_columns
from dougong.formats.text_rows import (
    COMMENTS,
    RowFormat,
    further_counts,
    is_last_number_cut,
    is_remark,
    number_in,
    parse_rows,
    split_line,
    table_of,
)

_SAMPLE_BYTES = 1 << 16
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class TextHeader:
    """How a text file was read."""

    delimiter: str
    columns: tuple[str, ...]
    source: Path | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a text file start and how they are told apart."""

    start: int
    """File position of the first row."""
    rows: RowFormat
    names: tuple[str, ...] | None
    """Of the columns used, from the header line, if there is one."""
    passed_over: tuple[str, ...]
    """Columns of words, by name or number."""
    count: int | None
    """From a PTS count line."""
    sample: NDArray[np.float64] = field(repr=False)


@dataclass
class TextScan:
    """The rows of one text file."""

    path: Path
    name: str
    layout: Layout
    names: tuple[str, ...]
    header: TextHeader
    notes: tuple[str, ...]
    crs: str | None = None
    bits: dict[str, BitField] = field(default_factory=dict)
    lacking: str = "no finite coordinates or another number of columns"
    _dtype: np.dtype[np.void] | None = None
    _kept: list[NDArray[np.float64]] = field(default_factory=list)

    def load(self, rows: int) -> None:
        """Parse the file now and keep its numbers for the next pass, which lets go of them."""
        tables = list(self.tables(rows))
        self._kept = tables
        self.dtype(rows)

    def tables(self, rows: int) -> Iterator[NDArray[np.float64]]:
        """Yield the numbers of the file in blocks of at most `rows`."""
        if self._kept:
            yield from self._kept
            return
        done = 0
        for table in parse_rows(self.path, self.layout.start, None, self.layout.rows, rows):
            done += len(table)
            # Columns behind the last name are empty fields after a trailing delimiter.
            yield table[:, : len(self.names)]
        if self.layout.count is not None and done != self.layout.count:
            self._compare(self.layout.count, done)

    def _compare(self, count: int, done: int) -> None:
        """Compare the rows found with those that the count lines of all PTS blocks promise."""
        more = further_counts(self.path, self.layout.start, self.layout.rows.has_old_line_ends)
        count, lines = count + sum(more), "count lines say" if more else "count line says"
        if done < count:
            msg = (
                f"{self.path.name}: its {lines} {count:,} points, file ends after {done:,}. "
                "Copy it again."
            )
            raise FormatError(msg)
        note = f"its {lines} {count:,} points, wrongly: {done:,} rows follow, and all are read."
        if done > count and note not in self.notes:
            self.notes = (*self.notes, note)

    def dtype(self, rows: int) -> np.dtype[np.void]:
        """Return the record layout: whole-numbered columns become integers.

        One pass over the file, so that every block gets the same.
        """
        if self._dtype is None:
            low = np.full(len(self.names), np.inf)
            high = -low
            is_whole = np.ones(len(self.names), dtype=bool)
            axes = [self.names.index(axis) for axis in "xyz"]
            for every in self.tables(rows):
                # Rows that will be dropped have no say.
                table = every[usable_rows(every[:, axes])]
                with np.errstate(invalid="ignore"):
                    low = np.fmin(low, np.fmin.reduce(table, axis=0, initial=np.inf))
                    high = np.fmax(high, np.fmax.reduce(table, axis=0, initial=-np.inf))
                    is_whole &= (table == np.rint(table)).all(axis=0) & (np.abs(table) < 2**53).all(
                        axis=0
                    )
            kinds = [
                _kind(name, low[i], high[i]) if is_whole[i] else "<f8"
                for i, name in enumerate(self.names)
            ]
            self._dtype = np.dtype(list(zip(self.names, kinds, strict=True)))
        return self._dtype

    def _released(self) -> Iterator[NDArray[np.float64]]:
        while self._kept:
            yield self._kept.pop(0)

    def blocks(self, rows: int) -> Iterator[Block]:
        """Yield the rows in blocks."""
        dtype = self.dtype(rows)
        for table in self._released() if self._kept else self.tables(rows):
            records = np.empty(len(table), dtype=dtype)
            with np.errstate(invalid="ignore"):  # rows without coordinates will be dropped
                for index, name in enumerate(self.names):
                    records[name] = table[:, index]
            yield Block(
                records, np.ascontiguousarray(table[:, [self.names.index(a) for a in "xyz"]])
            )


def _kind(name: str, low: float, high: float) -> str:
    """Return the smallest integer type for a whole-numbered column; coordinates stay floats."""
    if name in ("x", "y", "z"):
        return "<f8"
    types = ("u1", "<u2", "<u4") if low >= 0 else ("<i2", "<i4")
    if low > high:
        return "<f8"
    for kind in types:
        if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
            return kind
    return "<f8"


def open_text(path: Path) -> TextScan:
    """Look at the first lines of a text file and decide how to read it.

    Raises
    ------
    FormatError
        Not text, no numbers, or fewer than three columns.
    """
    with opened(path) as file:
        sample = file.read(_SAMPLE_BYTES)
    _refuse_other_than_text(path, sample)
    layout = _layout(path, sample, is_whole=len(sample) < _SAMPLE_BYTES)
    if layout.names is not None:
        is_trailing = len(layout.names) > 3 and not layout.names[-1]
        names, assumed = named_columns(layout.names[:-1] if is_trailing else layout.names)
    else:
        names, assumed = column_names(
            layout.sample, is_pts=layout.count is not None or path.suffix.lower() == ".pts"
        )
    notes = [assumed] if assumed else []
    if is_last_number_cut(path, sample[layout.start :].split(b"\n"), layout.rows):
        notes.append(
            "its last line has no end, and fewer decimals than the others: it may be cut within "
            "its last number. Compare the file with where it came from."
        )
    if layout.passed_over:
        notes.append(f"columns of words were not read: {', '.join(layout.passed_over)}.")
    if not {"x", "y", "z"} <= set(names):
        msg = (
            f"{path.name} has columns {', '.join(names)}; x, y and z were expected. "
            "Name them in a header line."
        )
        raise FormatError(msg)
    return TextScan(
        path=path,
        name=stem_of(path),
        layout=layout,
        names=names,
        header=TextHeader(layout.rows.delimiter, names, source=path),
        notes=tuple(notes),
    )


def _refuse_other_than_text(path: Path, sample: bytes) -> None:
    if sample.startswith(_UTF_16):
        msg = f"{path.name} is text of two bytes a character (UTF-16). Save it as UTF-8."
        raise FormatError(msg)
    if b"\0" in sample:
        msg = f"{path.name} is not text (it has zero bytes). Rename it to what it is."
        raise FormatError(msg)


def _layout(path: Path, sample: bytes, *, is_whole: bool) -> Layout:
    has_old_line_ends = b"\n" not in sample and b"\r" in sample
    if has_old_line_ends:
        sample = sample.replace(b"\r", b"\n")
    shown = sample[:80].decode("utf-8", "replace")
    if not is_whole:
        sample = sample[: sample.rfind(b"\n") + 1]
    names, count, odd = None, None, ""
    position = 3 if sample.startswith(b"\xef\xbb\xbf") else 0
    while position < len(sample):
        end = sample.find(b"\n", position)
        end = len(sample) if end < 0 else end
        line = sample[position:end].strip()
        start, position = position, end + 1
        text = line.decode("utf-8", "replace")
        if not line or (line.startswith(COMMENTS) and not _is_header(text)):
            continue
        delimiter = _delimiter(text)
        words = split_line(text, delimiter)
        if len(words) == 1 and words[0].isdigit() and count is None and names is None:
            count = int(words[0])
            continue
        if _has_numbers(words):
            return _from_rows(sample[start:], start, delimiter, names, count, has_old_line_ends)
        # Of several lines before the numbers the last one names the columns.
        odd = odd or (text if names is not None else "")
        text = text.lstrip("#/%! ")
        names = tuple(split_line(text, _delimiter(text)))
    found = odd or next(iter(shown.splitlines()), "")
    msg = (
        f"{path.name} has no rows of at least three numbers; {'after one line' if odd else 'it'} "
        f"{'comes' if odd else 'starts with'} {found[:60]!r}. Expected x y z in columns."
    )
    raise FormatError(msg)


def _has_numbers(words: list[str]) -> bool:
    """Say whether a line holds three numbers, missing ones (NaN, NULL) included; blanks do not."""
    found = [w for w in words if w and number_in(w, has_decimal_comma=True) is not None]
    return len(found) >= 3


def _from_rows(
    data: bytes,
    start: int,
    delimiter: str,
    names: tuple[str, ...] | None,
    count: int | None,
    has_old_line_ends: bool,
) -> Layout:
    """Return the layout that most of the first rows have."""
    lines = [line.strip() for line in data.split(b"\n")]
    rows = [
        split_line(line.decode("utf-8", "replace"), delimiter)
        for line in lines
        if line and not is_remark(line)
    ]
    sizes = Counter(len(row) for row in rows)
    # Of equally frequent sizes the header's, else that of the first row.
    columns = max(sizes, key=lambda n: (sizes[n], names is not None and n == len(names)))
    fitting = [row for row in rows if len(row) == columns]
    has_comma = delimiter != "," and any(
        "," in word and number_in(word, has_decimal_comma=True) is not None
        for row in fitting
        for word in row
    )
    used = tuple(k for k in range(columns) if _is_numeric([row[k] for row in fitting], has_comma))
    layout = RowFormat(
        columns=columns,
        delimiter=delimiter,
        has_decimal_comma=has_comma,
        used=None if len(used) == columns else used,
        has_old_line_ends=has_old_line_ends,
    )
    fits = names is not None and len(names) == columns
    words = names if names is not None and fits else tuple(map(str, range(1, columns + 1)))
    return Layout(
        start=start,
        rows=layout,
        names=tuple(words[k] for k in used) if fits else None,
        passed_over=tuple(words[k] for k in range(columns) if k not in used),
        count=count,
        sample=table_of(data, layout),
    )


def _is_numeric(words: list[str], has_decimal_comma: bool) -> bool:
    """Say whether a column holds numbers: at least half of its fields do."""
    known = [number_in(word, has_decimal_comma=has_decimal_comma) is not None for word in words]
    return 2 * sum(known) >= len(known)


def _is_header(text: str) -> bool:
    """Say whether a comment line names columns, as in "# x y z" or "//X,Y,Z,Intensity"."""
    words = [w.lower() for w in re.split(r"[\s,;]+", text.lstrip("#/%! ")) if w]
    return {"x", "y", "z"} <= set(words)


def _delimiter(line: str) -> str:
    words = line.split()
    has_gaps = "\t\t" in line or line.endswith("\t")
    are_numbers = all(number_in(word, has_decimal_comma=True) is not None for word in words)
    if are_numbers and not has_gaps and ("," not in line or _commas_are_decimal(line)):
        return " "  # blanks and tabs in any mixture
    for delimiter in (";", "\t", ","):
        if delimiter in line and not (delimiter == "," and _commas_are_decimal(line)):
            return delimiter
    return " "


def _commas_are_decimal(line: str) -> bool:
    """Say whether commas stand inside numbers: "1,5 2,5 3,5" has blanks between its numbers."""
    return bool(re.fullmatch(r"\s*[-+]?\d+,\d+(\s+[-+]?\d+(,\d+)?)+\s*", line))
