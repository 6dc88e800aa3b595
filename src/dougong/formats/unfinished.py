"""Names of what is not finished: they say who writes it, so that what a killed process left goes.

Such a name ends in `-<machine>-<process>`. The next one that writes to the same place removes what
a process of this machine left that runs no longer; it lets be what another machine may be at.
"""

import glob
import os
import platform
import shutil
from pathlib import Path


def own_mark() -> str:
    """Return the end of the names of what this process writes."""
    return f"{platform.node()}-{os.getpid()}"


def part_of(path: Path) -> Path:
    """Return where `path` is written before it is renamed: a name of this process alone."""
    return path.with_name(f"{path.name}.part-{own_mark()}")


def marked(head: Path) -> list[tuple[Path, str]]:
    """Return what lies there whose name begins as `head` does, each with the mark behind that."""
    found = sorted(head.parent.glob(glob.escape(head.name) + "*"))
    return [(path, path.name.removeprefix(head.name)) for path in found]


def is_another_at_it(mark: str) -> bool:
    """Say whether another process writes what has this mark, or may (on another machine)."""
    host, _, process = mark.rpartition("-")
    if os.name != "posix" or host != platform.node() or not process.isdigit():
        return True  # elsewhere, asking whether a process lives would end it
    if int(process) == os.getpid():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def clear_left(head: Path) -> None:
    """Remove what killed processes left whose name is `head` and a mark."""
    for path, mark in marked(head):
        if mark == own_mark() or is_another_at_it(mark):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def clear_parts(path: Path) -> None:
    """Remove what killed processes had written of `path`."""
    clear_left(path.with_name(f"{path.name}.part-"))
