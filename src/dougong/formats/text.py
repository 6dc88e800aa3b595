"""Read points from text: XYZ, PTS, CSV, TXT, ASC.

The first lines decide delimiter, header and the meaning of the columns; what was assumed is
noted. pyarrow parses blocks of lines. A line that is not a row of numbers becomes a row of NaN,
to be dropped and counted like any other without coordinates.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import BitField
from dougong.errors import FormatError
from dougong.formats.stream import Block, opened, stem_of
from dougong.formats.text_columns import column_names, has_numbers, named_columns

_BLOCK_BYTES = 1 << 26
_SAMPLE_BYTES = 1 << 16
_FEW_LINES = 64
_COMMENTS = (b"#", b"//", b"%", b"!")
_MISSING = ["nan", "NaN", "NAN", "-nan", "-nan(ind)", "", "null", "NULL", "NA", "None", "-", "*"]


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
    delimiter: str
    has_decimal_comma: bool
    columns: int
    names: tuple[str, ...] | None
    """From the header line, if there is one."""
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
        for table in parse_rows(
            self.path,
            self.layout.start,
            None,
            self.layout.columns,
            rows,
            delimiter=self.layout.delimiter,
            has_decimal_comma=self.layout.has_decimal_comma,
        ):
            done += len(table)
            # Columns behind the last name are empty fields after a trailing delimiter.
            yield table[:, : len(self.names)]
        if self.layout.count is not None and done < self.layout.count:
            msg = (
                f"{self.path.name}: its count line says {self.layout.count:,} points, file ends "
                f"after {done:,}. Copy it again."
            )
            raise FormatError(msg)

    def dtype(self, rows: int) -> np.dtype[np.void]:
        """Return the record layout: whole-numbered columns become integers.

        One pass over the file, so that every block gets the same.
        """
        if self._dtype is None:
            low = np.full(len(self.names), np.inf)
            high = -low
            is_whole = np.ones(len(self.names), dtype=bool)
            for table in self.tables(rows):
                with np.errstate(invalid="ignore"):
                    low = np.fmin(low, np.fmin.reduce(table, axis=0))
                    high = np.fmax(high, np.fmax.reduce(table, axis=0))
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
        if b"\0" in sample:
            msg = f"{path.name} is not text (it has zero bytes). Rename it to what it is."
            raise FormatError(msg)
        is_all = len(sample) < _SAMPLE_BYTES
        layout = _layout(path, sample if is_all else sample[: sample.rfind(b"\n") + 1])
    if layout.names is not None:
        is_trailing = len(layout.names) > 3 and not layout.names[-1]
        names = named_columns(layout.names[:-1] if is_trailing else layout.names)
        assumed = None
    else:
        names, assumed = column_names(layout.sample)
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
        header=TextHeader(layout.delimiter, names, source=path),
        notes=(assumed,) if assumed else (),
    )


def _layout(path: Path, sample: bytes) -> Layout:
    names, count, start = None, None, 0
    position = 3 if sample.startswith(b"\xef\xbb\xbf") else 0
    while position < len(sample):
        end = sample.find(b"\n", position)
        end = len(sample) if end < 0 else end
        line = sample[position:end].strip()
        start, position = position, end + 1
        text = line.decode("utf-8", "replace")
        if not line or (line.startswith(_COMMENTS) and not _is_header(text)):
            continue
        delimiter = _delimiter(text)
        words = _split(text, delimiter)
        if len(words) == 1 and words[0].isdigit() and count is None and names is None:
            count = int(words[0])
            continue
        has_comma = delimiter != "," and any("," in word for word in words)
        if has_numbers(words, has_decimal_comma=has_comma):
            rows = _sample_rows(sample[start:], delimiter, len(words), has_comma)
            return Layout(
                start, delimiter, has_comma, len(words), _fitting(names, words), count, rows
            )
        if names is not None:
            break
        names = tuple(_split(text.lstrip("#/%! "), _delimiter(text.lstrip("#/%! "))))
    found = sample[:40].decode("utf-8", "replace").splitlines()
    msg = (
        f"{path.name} has no rows of at least three numbers; it starts with "
        f"{found[0] if found else ''!r}. Expected x y z in columns."
    )
    raise FormatError(msg)


def _is_header(text: str) -> bool:
    """Say whether a comment line names columns, as in "# x y z" or "//X,Y,Z,Intensity"."""
    words = [w.lower() for w in re.split(r"[\s,;]+", text.lstrip("#/%! ")) if w]
    return {"x", "y", "z"} <= set(words)


def _fitting(names: tuple[str, ...] | None, words: list[str]) -> tuple[str, ...] | None:
    return names if names is not None and len(names) == len(words) else None


def _delimiter(line: str) -> str:
    for delimiter in (";", "\t", ","):
        if delimiter in line and not (delimiter == "," and _commas_are_decimal(line)):
            return delimiter
    return " "


def _commas_are_decimal(line: str) -> bool:
    """Say whether commas stand inside numbers: "1,5 2,5 3,5" has blanks between its numbers."""
    return bool(re.fullmatch(r"\s*[-+]?\d+,\d+(\s+[-+]?\d+(,\d+)?)+\s*", line))


def _split(line: str, delimiter: str) -> list[str]:
    words = line.split() if delimiter == " " else line.split(delimiter)
    return [word.strip().strip('"') for word in words]


def _sample_rows(
    data: bytes, delimiter: str, columns: int, has_decimal_comma: bool
) -> NDArray[np.float64]:
    return _table(data, delimiter, columns, has_decimal_comma, "sample")


def parse_rows(
    path: Path,
    start: int,
    count: int | None,
    columns: int,
    rows: int,
    *,
    delimiter: str = " ",
    has_decimal_comma: bool = False,
) -> Iterator[NDArray[np.float64]]:
    """Yield tables (m, columns) of the lines from byte `start` on, at most `rows` lines each.

    Stops after `count` rows where that is given. Memory is bounded by `rows` and 64 MB of text.
    """
    left = np.inf if count is None else count
    with opened(path) as file:
        file.seek(start)
        for data in _lines(file, rows):
            table = _table(data, delimiter, columns, has_decimal_comma, path.name)
            for first in range(0, len(table), rows):
                if left <= 0:
                    return
                piece = table[first : first + int(min(rows, left))]
                left -= len(piece)
                if len(piece):
                    yield piece


def _lines(file: IO[bytes], rows: int) -> Iterator[bytes]:
    """Yield whole lines in blocks of about `rows` lines."""
    size = int(min(_BLOCK_BYTES, max(1 << 14, rows * 40)))
    rest = b""
    while data := file.read(size):
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            rest += data
            continue
        yield rest + data[:cut]
        rest = data[cut:]
    if rest.strip():
        yield rest


def _table(
    data: bytes, delimiter: str, columns: int, has_decimal_comma: bool, name: str
) -> NDArray[np.float64]:
    """Return the numbers of whole lines, (m, columns); a row that cannot be read is all NaN."""
    if delimiter == " ":
        # pyarrow tells fields apart by one character, so runs of blanks become one blank.
        data = data.replace(b"\t", b" ")
        while b"  " in data:
            data = data.replace(b"  ", b" ")
        data = data.replace(b"\n ", b"\n").replace(b" \n", b"\n").replace(b" \r\n", b"\r\n")
        data = data.strip(b" ")
    table = _by_arrow(data, delimiter, columns, has_decimal_comma)
    if table is not None:
        return table
    # A word stands where a number belongs. Halving keeps all other lines on the fast path.
    middle = data.find(b"\n", len(data) // 2) + 1
    if data.count(b"\n") > _FEW_LINES and 0 < middle < len(data):
        halves = (data[:middle], data[middle:])
        return np.concatenate(
            [_table(half, delimiter, columns, has_decimal_comma, name) for half in halves]
        )
    lines = [line.strip() for line in data.splitlines()]
    rows = [
        _numbers(line.decode("utf-8", "replace"), delimiter, columns, has_decimal_comma)
        for line in lines
        if line and not _is_remark(line)
    ]
    return np.array(rows).reshape(-1, columns)


def _is_remark(line: bytes) -> bool:
    """Say whether a line holds no point: a comment, or the count line of a further PTS block."""
    return line.startswith(_COMMENTS) or line.isdigit()


def _by_arrow(
    data: bytes, delimiter: str, columns: int, has_decimal_comma: bool
) -> NDArray[np.float64] | None:
    """Return the table, or None where a field is not a number."""
    import pyarrow as pa
    from pyarrow import csv

    short_rows: list[int] = []

    def on_wrong_length(row: Any) -> str:
        if not _is_remark(row.text.strip().encode()):
            short_rows.append(1)
        return "skip"

    if not data.strip():
        return np.empty((0, columns))
    names = [str(index) for index in range(columns)]
    try:
        table = csv.read_csv(
            io.BytesIO(data),
            read_options=csv.ReadOptions(column_names=names, block_size=1 << 22),
            parse_options=csv.ParseOptions(
                delimiter=delimiter, invalid_row_handler=on_wrong_length
            ),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.float64()),
                null_values=_MISSING,
                decimal_point="," if has_decimal_comma else ".",
            ),
        )
    except pa.ArrowInvalid:
        return None
    result = np.full((table.num_rows + len(short_rows), columns), np.nan)
    for index, column in enumerate(table.columns):
        result[: table.num_rows, index] = column.to_numpy()
    return result


def _numbers(line: str, delimiter: str, columns: int, has_decimal_comma: bool) -> list[float]:
    """Return the numbers of one line, all NaN where it does not hold just so many."""
    words = _split(line, delimiter)
    bad = [np.nan] * columns
    if len(words) != columns:
        return bad
    row = []
    for word in words:
        text = word.replace(",", ".") if has_decimal_comma else word
        try:
            row.append(np.nan if text in _MISSING else float(text))
        except ValueError:
            return bad
    return row
