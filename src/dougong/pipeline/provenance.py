"""Where a result comes from: input hashes, versions, seconds, peak memory."""

import hashlib
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import dougong
from dougong.errors import FormatError
from dougong.formats.stream import opened
from dougong.kernels import _jit

_LIBRARIES = ("numpy", "scipy", "numba", "lazrs", "pye57", "opencv-python-headless")


Stamp = tuple[int, int]
"""Bytes of a file, and when it was last written, nanoseconds."""


def sha256(path: Path) -> str:
    """Return the SHA-256 of a cloud's file; see `identified`."""
    return identified(path)[0]


def identified(path: Path) -> tuple[str, Stamp]:
    """Return the SHA-256 of a cloud's file, read in blocks of 4 MiB, and its stamp before that.

    Raises
    ------
    FormatError
        It is missing, a folder, empty, or may not be read.
    """
    digest = hashlib.sha256()
    with opened(path) as file:
        stamp = stamp_of(path)
        while block := file.read(1 << 22):
            digest.update(block)
    return digest.hexdigest(), stamp


def stamp_of(path: Path) -> Stamp:
    """Return what differs when a file was written again, or another put in its place.

    Raises
    ------
    FormatError
        It is not there.
    """
    try:
        found = path.stat()
    except OSError as error:
        msg = f"{path} cannot be read any more: {error.strerror}. Put it back."
        raise FormatError(msg) from error
    return found.st_size, found.st_mtime_ns


def require_unchanged(path: Path, before: Stamp) -> None:
    """Refuse to go on with a file that was replaced since `before`: what is known is the old one's.

    Raises
    ------
    FormatError
        It was, or it is gone.
    """
    now = stamp_of(path)
    if now == before:
        return
    was, is_now = (
        f"{size:,} bytes of {datetime.fromtimestamp(time_ns / 1e9):%Y-%m-%d %H:%M:%S}"
        for size, time_ns in (before, now)
    )
    msg = (
        f"{path} was changed or replaced while it was worked on: it was {was} and is {is_now} "
        "now. Leave it as it is, and give the same command again."
    )
    raise FormatError(msg)


def software() -> dict[str, Any]:
    """Return our version and those of the libraries that could change a number."""
    found = {}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return {
        "dougong": dougong.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "libraries": found,
    }


def peak_memory_bytes() -> int | None:
    """Return the largest resident memory of this process so far; None where it is not told."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)


def kernels_are_compiled() -> bool:
    """Say whether an earlier run of this version left its compiled kernels."""
    return _jit.is_warm()


class Clock:
    """Seconds per named stage, summed where a name comes back: of the wall and of the processor."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}
        """Of all threads of this process."""
        self._start = time.perf_counter()

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the seconds of the ``with`` block to `name`."""
        start, cpu = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            spent = time.process_time() - cpu
            self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + spent

    def total(self) -> float:
        """Return the seconds since the clock was made."""
        return time.perf_counter() - self._start
