"""What is not finished: its names say who writes it, so that what a killed process left goes.

Also who works where (`sole_user`), and what is removed when a job is cancelled.

Such a name ends in `-<machine>-<process>`. The next one that writes to the same place removes what
a process of this machine left that runs no longer; it lets be what another machine may be at.
"""

import glob
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from dougong.errors import OutputError

_PART = ".part-"
_ELSEWHERE = "Free some space or pass another --work."
_begun: set[Path] = set()
_removed: set[Path] = set()
"""Of `_begun`, since the process is about to end."""


def own_mark() -> str:
    """Return the end of the names of what this process writes."""
    return f"{platform.node()}-{os.getpid()}"


def part_of(path: Path) -> Path:
    """Return where `path` is written before it is renamed: a name of this process alone."""
    return path.with_name(f"{path.name}{_PART}{own_mark()}")


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


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _remove_left(path: Path, mark: str) -> None:
    if mark != own_mark() and not is_another_at_it(mark):
        _remove(path)


def clear_left(head: Path) -> None:
    """Remove what killed processes left whose name is `head` and a mark."""
    for path, mark in marked(head):
        _remove_left(path, mark)


def clear_parts(path: Path) -> None:
    """Remove what killed processes had written of `path`."""
    clear_left(path.with_name(f"{path.name}{_PART}"))


@lru_cache(maxsize=4096)
def clear_all_parts(folder: Path) -> None:
    """Remove what killed processes had written of any file in `folder`, once in this process.

    For folders of so many files that looking for the parts of each one costs more than writing it.
    """
    for path in folder.glob(f"*{_PART}*"):
        _remove_left(path, path.name.rpartition(_PART)[2])


@contextmanager
def removed_if_cancelled(*paths: Path) -> Iterator[None]:
    """Have `paths` removed should the process be cancelled in the block."""
    _begun.update(paths)
    _removed.difference_update(paths)
    try:
        yield
    finally:
        _begun.difference_update(paths)


@contextmanager
def watched(*paths: Path) -> Iterator[None]:
    """Have the unfinished forms of `paths` removed should the block be cancelled."""
    with removed_if_cancelled(*map(part_of, paths)):
        yield


def remove_unfinished() -> None:
    """Remove what was being written. Called when the process is about to end at once."""
    _removed.update(_begun)
    for path in list(_begun) * 2:  # a thread may have been writing there the first time
        _remove(path)


def refuse_removed(path: Path) -> None:
    """Refuse to make anew what was removed: a thread may still be at it while the process ends.

    Raises
    ------
    OutputError
        `path` is, or is in, what was removed.
    """
    if any(path.is_relative_to(gone) for gone in _removed):
        raise OutputError(f"{path} is not written any more: the job was cancelled.")


@contextmanager
def passing_folder(head: Path) -> Iterator[Path]:
    """Yield a folder, `head` and our mark, that is removed at the end, however the block ends.

    It is not made. What a killed process left under the same head goes first.
    """
    folder = head.with_name(head.name + own_mark())
    clear_left(head)
    # Our own number from an earlier life: containers count from 1 each time.
    shutil.rmtree(folder, ignore_errors=True)
    with removed_if_cancelled(folder):
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def refuse_another(head: Path, at: str, otherwise: str, mine: Path | None = None) -> None:
    """Refuse to begin `head` and our mark beside another process; clear what a killed one left.

    Parameters
    ----------
    head : Path
    at, otherwise : str
        What another one is at, and what to do but wait for it, for the message.
    mine : Path, optional
        Our own mark, where it is there already: only who was there before it is another one.

    Raises
    ------
    OutputError
        Another process is at it, or may be (on another machine).
    """
    if os.name != "posix":
        return
    for path, mark in marked(head):
        if mine is not None and (path == mine or _was_first(mine, path)):
            continue
        # Our own number from an earlier life (containers count from 1 each time) is stale too.
        if path not in _begun and not is_another_at_it(mark):
            _remove(path)
            continue
        host, _, process = mark.rpartition("-")
        msg = (
            f"{at} by another dougong (process {process} on {host or 'a host'}). "
            f"Wait for it or {otherwise}; if it is gone, delete {path}."
        )
        raise OutputError(msg)


def _was_first(one: Path, other: Path) -> bool:
    """Say whether `one` was made before `other`, or that is gone; of two at once, by their names.

    Both processes come to the same answer.
    """
    try:
        made = other.stat().st_mtime_ns
    except FileNotFoundError:
        return True
    return (one.stat().st_mtime_ns, one.name) < (made, other.name)


@contextmanager
def sole_user(folder: Path) -> Iterator[None]:
    """Have no other process work in `folder` until the block ends.

    Raises
    ------
    OutputError
        Another one does, or may (on another machine); or the mark cannot be written.
    """
    head = folder.with_name(f"{folder.name}.user-")
    mark = head.with_name(head.name + own_mark())
    at, otherwise = f"{folder} is being worked in", "pass another --work"
    refuse_another(head, at, otherwise)
    with removed_if_cancelled(mark):
        try:
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()
        except OSError as error:
            msg = f"{folder.parent} could not be written: {error.strerror or error}. {_ELSEWHERE}"
            raise OutputError(msg) from error
        try:
            # Once more: of two that begin at once each sees the other's mark now.
            refuse_another(head, at, otherwise, mine=mark)
            yield
        finally:
            mark.unlink(missing_ok=True)
