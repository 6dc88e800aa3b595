"""The machine on which something was measured, and what memory a piece of work takes on it."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import dougong

_DISTRIBUTIONS = {
    "CSF": "cloth-simulation-filter",
    "small_gicp": "small-gicp",
    "kiss_matcher": "kiss-matcher",
}


def machine() -> dict[str, Any]:
    """Return the processor's name, the cores of the machine and its memory."""
    return {"processor": _processor(), "cores": os.cpu_count(), "memory_gb": _memory_gb()}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _memory_gb() -> int | None:
    if not hasattr(os, "sysconf"):
        return None
    return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9)


def version_of(package: str) -> str:
    """Return the version of an installed package, by the name it is imported with."""
    try:
        return version(_DISTRIBUTIONS.get(package, package))
    except PackageNotFoundError:
        return "unknown"


def code_hash(rooms: Iterable[str]) -> str:
    """Return the hash of our own source in `rooms` and beside them: what a measurement depends on.

    What lies beside the rooms (threads, sorting, clouds) is of use in all of them.
    """
    digest = hashlib.sha256()
    package = Path(dougong.__file__).parent
    beside = sorted(package.glob("*.py"))
    for path in [*beside, *(p for room in rooms for p in sorted((package / room).rglob("*.py")))]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def resident_bytes(field: str) -> int:
    """Return a memory figure of this process by its name; 0 where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(field)), 0)


def forget_peak() -> None:
    """Let the peak of resident memory start from what is resident now (Linux)."""
    clear = Path("/proc/self/clear_refs")
    if clear.exists():
        clear.write_text("5", encoding="ascii")


@contextmanager
def memory_beyond() -> Iterator[dict[str, int | None]]:
    """Measure the peak of resident memory beyond what is held on entering: key ``bytes``.

    None where the system does not tell.
    """
    forget_peak()
    held = resident_bytes("VmRSS")
    found: dict[str, int | None] = {"bytes": None}
    yield found
    if held:
        found["bytes"] = max(0, resident_bytes("VmHWM") - held)
