"""Where a binary PLY file's elements end: rows with lists vary in length and must be walked.

Most meshes are of triangles, so rows of one length are taken in runs; where lengths change
often they are walked one by one.
"""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

Element = tuple[str, int, list[list[str]]]
"""Name, count, the words of each property line."""
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_RUN_ROWS = 65_536
_WALKED_ROWS = 4096
_SHORT_RUN = 64
"""Runs below this cost more to look for than their rows cost one by one."""

Part = tuple[int, int, bool]
"""Bytes of a scalar, or of a list's count; bytes of a list's item, 0 for a scalar; count signed."""


def end_of(path: Path, start: int, elements: Sequence[Element], order: str) -> int | str | None:
    """Return the byte behind all elements of a binary file that begin at `start`.

    Where the file ends inside an element (or a list there has a negative length), its name; None
    where an element has a type that is not known, or a length that is no whole number.
    """
    parts = [_parts(properties) for _, _, properties in elements]
    size = path.stat().st_size
    at = start
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for (name, count, _), row in zip(elements, parts, strict=True):
            if row is None:
                return None
            if any(item for _, item, _ in row):
                at = _walk(data, at, count, row, order)
            else:
                at += count * sum(scalar for scalar, _, _ in row)
            if not 0 <= at <= size:
                return name
    return at


def _parts(properties: Sequence[Sequence[str]]) -> list[Part] | None:
    """Return what a row is made of; None where a type is not known."""
    found: list[Part] = []
    for words in properties:
        types = words[1:3] if words[0] == "list" else words[:1]
        codes = [TYPES.get(word, "") for word in types]
        if not all(codes) or (len(codes) == 2 and codes[0][0] == "f"):
            return None
        sizes = [int(code[1]) for code in codes]
        found.append((sizes[0], sizes[1] if len(sizes) == 2 else 0, codes[0][0] == "i"))
    return found


def _walk(data: mmap.mmap, at: int, rows: int, parts: list[Part], order: str) -> int:
    """Return the byte behind so many rows with lists; -1 where the file ends before."""
    while rows:
        done, at = _run(data, at, rows, parts, order)
        rows -= done
        if done < _SHORT_RUN:
            for _ in range(min(rows, _WALKED_ROWS)):
                if at < 0:
                    break
                at = _row(data, at, parts, order)[0]
                rows -= 1
        if at < 0:
            return -1
    return at


def _row(data: mmap.mmap, at: int, parts: list[Part], order: str) -> tuple[int, list[int]]:
    """Return the byte behind one row, -1 where there is none, and where its lists' lengths lie."""
    start, lengths = at, []
    for size, item, is_signed in parts:
        if item:
            lengths.append(at - start)
            told = data[at : at + size]
            count = int.from_bytes(told, "big" if order == ">" else "little", signed=is_signed)
            if count < 0:
                return -1, lengths
            at += count * item
        at += size
    return (at if at <= len(data) else -1), lengths


def _run(data: mmap.mmap, at: int, rows: int, parts: list[Part], order: str) -> tuple[int, int]:
    """Return how many rows from `at` on are as long as the first one, and the byte behind them."""
    end, lengths = _row(data, at, parts, order)
    if end < 0:
        return 0, -1
    stride = end - at
    most = min(rows, _RUN_ROWS, (len(data) - at) // stride)
    table = np.frombuffer(data, dtype=np.uint8, count=most * stride, offset=at)
    table = table.reshape(most, stride)
    is_alike = np.ones(most, dtype=bool)
    sizes = [size for size, item, _ in parts if item]
    for offset, size in zip(lengths, sizes, strict=True):
        told = table[:, offset : offset + size]
        is_alike &= (told == told[0]).all(axis=1)
    run = most if is_alike.all() else int(np.argmin(is_alike))
    del table, told
    return run, at + run * stride
