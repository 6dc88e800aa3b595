"""Numbers out of text lines: blocks of whole lines through pyarrow, odd lines one by one."""

from __future__ import annotations

import io
import re
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dougong.formats.stream import opened

COMMENTS = (b"#", b"//", b"%", b"!")
_BLOCK_BYTES = 1 << 26
_FEW_LINES = 64
_ENOUGH_LINES = 20
_LAST_BYTES = 1 << 12
_MISSING = ["nan", "NaN", "NAN", "-nan", "-nan(ind)", "", "null", "NULL", "NA", "None", "-", "*"]
_PATIENCE_S = 5.0
_COUNT_LINE = re.compile(rb"^[ \t]*(\d+)[ \t]*\r?$", re.MULTILINE)
_ASCII = bytes(range(128)) + b"?" * 128
"""No number has other characters, and pyarrow stumbles over bytes that are not UTF-8."""


@dataclass(frozen=True, slots=True)
class RowFormat:
    """How the numbers of one line are told apart."""

    columns: int
    """Fields in a line; a line with another number of them is no row."""
    delimiter: str = " "
    """One character; a blank stands for any run of blanks and tabs."""
    has_decimal_comma: bool = False
    used: tuple[int, ...] | None = None
    """Which fields hold numbers; None: all. The others are passed over."""
    has_old_line_ends: bool = False
    """Lines end with a carriage return alone."""

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return self.columns if self.used is None else len(self.used)


def parse_rows(
    path: Path, start: int, count: int | None, layout: RowFormat, rows: int
) -> Iterator[NDArray[np.float64]]:
    """Yield tables (m, layout.width) of the lines from byte `start` on, at most `rows` lines each.

    Stops after `count` rows where that is given. A line that is no row is all NaN. Memory is
    bounded by `rows` and 64 MB of text.
    """
    left = np.inf if count is None else count
    with opened(path) as file:
        file.seek(start)
        for data in _lines(file, int(min(rows, left)), layout.has_old_line_ends):
            table = table_of(data, layout)
            for first in range(0, len(table), rows):
                if left <= 0:
                    return
                piece = table[first : first + int(min(rows, left))]
                left -= len(piece)
                if len(piece):
                    yield piece


def _lines(file: IO[bytes], rows: int, has_old_line_ends: bool) -> Iterator[bytes]:
    """Yield whole lines in blocks of about `rows` lines."""
    size = int(min(_BLOCK_BYTES, max(1 << 14, rows * 40)))
    rest = b""
    while data := file.read(size):
        if has_old_line_ends:
            data = data.replace(b"\r", b"\n")
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            rest += data
            continue
        yield rest + data[:cut]
        rest = data[cut:]
    if rest.strip():
        yield rest


def further_counts(path: Path, start: int, has_old_line_ends: bool) -> list[int]:
    """Return the count lines of a PTS file from byte `start` on: of all blocks but the first."""
    with opened(path) as file:
        file.seek(start)
        return [
            int(line)
            for data in _lines(file, _BLOCK_BYTES, has_old_line_ends)
            for line in _COUNT_LINE.findall(data)
        ]


def is_last_number_cut(path: Path, sample: Sequence[bytes], layout: RowFormat) -> bool:
    """Say whether a file that does not end its last line ends it within its last number.

    That is seen where all rows of the `sample`, from its beginning, have as many decimals there.
    """
    with opened(path) as file:
        file.seek(max(file.seek(0, io.SEEK_END) - _LAST_BYTES, 0))
        end = file.read()
    if end.endswith((b"\n", b"\r")):
        return False
    last = _decimals_at_end(re.split(rb"[\r\n]", end)[-1], layout)
    usual = [_decimals_at_end(line, layout) for line in sample[:-1]]
    known = {decimals for decimals in usual if decimals is not None}
    if last is None or len(known) != 1 or len(usual) < _ENOUGH_LINES:
        return False
    return last < known.pop()


def _decimals_at_end(line: bytes, layout: RowFormat) -> int | None:
    """Return the decimals of the last field of a row, None where it is no row or no such number."""
    words = split_line(line.decode("utf-8", "replace"), layout.delimiter)
    point = "," if layout.has_decimal_comma else "."
    whole, _, decimals = words[-1].partition(point) if words else ("", "", "")
    is_plain = whole.lstrip("+-").isdigit() and (decimals.isdigit() or not decimals)
    return len(decimals) if len(words) == layout.columns and is_plain else None


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line, without the blanks and quotes round them."""
    words = line.split() if delimiter == " " else line.split(delimiter)
    return [word.strip().strip('"') for word in words]


def number_in(word: str, *, has_decimal_comma: bool) -> float | None:
    """Return the number a field holds (NaN where it says that there is none), None for text."""
    text = word.replace(",", ".") if has_decimal_comma else word
    if text in _MISSING:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        return None


def is_remark(line: bytes) -> bool:
    """Say whether a line holds no point: a comment, or the count line of a further PTS block."""
    return line.startswith(COMMENTS) or line.isdigit()


def table_of(data: bytes, layout: RowFormat) -> NDArray[np.float64]:
    """Return the numbers of whole lines, (m, width); a row that cannot be read is all NaN."""
    if not data.isascii():
        data = data.translate(_ASCII)
    if layout.delimiter == " ":
        # pyarrow tells fields apart by one character, so runs of blanks become one blank.
        data = data.replace(b"\t", b" ")
        while b"  " in data:
            data = data.replace(b"  ", b" ")
        data = data.replace(b"\n ", b"\n").replace(b" \n", b"\n").replace(b" \r\n", b"\r\n")
        data = data.strip(b" ")
    table = _by_arrow(data, layout)
    if table is not None:
        return table
    # A word stands where a number belongs. Halving keeps all other lines on the fast path.
    middle = data.find(b"\n", len(data) // 2) + 1
    if data.count(b"\n") > _FEW_LINES and 0 < middle < len(data):
        return np.concatenate([table_of(half, layout) for half in (data[:middle], data[middle:])])
    rows = [
        _numbers(line.decode("utf-8", "replace"), layout)
        for line in map(bytes.strip, data.splitlines())
        if line and not is_remark(line)
    ]
    return np.array(rows).reshape(-1, layout.width)


def _numbers(line: str, layout: RowFormat) -> list[float]:
    """Return the numbers of one line, all NaN where it does not hold just so many."""
    words = split_line(line, layout.delimiter)
    bad = [np.nan] * layout.width
    if len(words) != layout.columns:
        return bad
    used = range(layout.columns) if layout.used is None else layout.used
    row = [number_in(words[k], has_decimal_comma=layout.has_decimal_comma) for k in used]
    return bad if None in row else [number for number in row if number is not None]


class _WrongLengths:
    """Counts the lines that have another number of fields, and has pyarrow pass them over."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, row: Any) -> str:
        self.count += not is_remark(row.text.strip().encode())
        return "skip"


def _by_arrow(data: bytes, layout: RowFormat) -> NDArray[np.float64] | None:
    """Return the table, or None where a field is not a number."""
    if not data.strip():
        return np.empty((0, layout.width))
    stream, odd = io.BytesIO(data), _WrongLengths()
    handed: list[weakref.ref[Any]] = [weakref.ref(stream), weakref.ref(odd)]
    table = _arrow_table(stream, layout, odd)
    number = odd.count
    del stream, odd
    _wait_for(lambda: all(ref() is None for ref in handed))
    if table is None:
        return None
    result = np.full((table.num_rows + number, layout.width), np.nan)
    for index, column in enumerate(table.columns):
        result[: table.num_rows, index] = column.to_numpy()
    return result


def _arrow_table(stream: io.BytesIO, layout: RowFormat, odd: _WrongLengths) -> Any:
    import pyarrow as pa
    from pyarrow import csv

    names = [str(index) for index in range(layout.columns)]
    used = names if layout.used is None else [names[index] for index in layout.used]
    try:
        return csv.read_csv(
            stream,
            read_options=csv.ReadOptions(column_names=names, block_size=1 << 22),
            parse_options=csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=odd),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(used, pa.float64()),
                include_columns=used,
                null_values=_MISSING,
                decimal_point="," if layout.has_decimal_comma else ".",
            ),
        )
    except pa.ArrowInvalid:
        return None


def _wait_for(is_done: Callable[[], bool]) -> None:
    """Wait until pyarrow's own threads have let go of the Python objects they were handed.

    They do so a moment after the answer is there. A process that ends in that moment is aborted
    ("terminate called without an active exception", exit code 134), its work done.
    """
    end = time.monotonic() + _PATIENCE_S
    while not is_done() and time.monotonic() < end:
        time.sleep(0.0002)
