"""What a pass over a file found, kept as long as the file stays as it is.

Several steps of a job ask the same of a file, and each answer may be a pass over terabytes.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

_MOST = 256
_SETTLED_NS = 2_000_000_000
"""A file written later than this ago may be written again with the same time of writing."""

T = TypeVar("T")
Stamp = tuple[int, int, int]


class Remembered(Generic[T]):
    """One answer per file; a file that was written again, or replaced, is asked again."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[Stamp, T]] = {}

    def of(self, path: Path, ask: Callable[[], T]) -> T:
        """Return what `ask` says of the file, or what it said of it before."""
        name = os.path.abspath(path)  # noqa: PTH100 - a link may lead elsewhere tomorrow
        before = _stamp(path)
        known = self._known.get(name)
        if known is not None and known[0] == before:
            return known[1]
        answer = ask()
        if before is not None and before == _stamp(path) and _is_settled(before):
            self._known.pop(name, None)
            while len(self._known) >= _MOST:
                self._known.pop(next(iter(self._known)), None)
            self._known[name] = (before, answer)
        return answer


def _stamp(path: Path) -> Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None  # whoever opens it says so
    return found.st_size, found.st_mtime_ns, found.st_ino


def _is_settled(stamp: Stamp) -> bool:
    return time.time_ns() - stamp[1] > _SETTLED_NS
