"""Write a file beside its place and rename it there: a reader sees all of it or nothing.

The part file is `<name>.part-<machine>-<process>`, so that two processes never write into one.
Whatever goes wrong, it is removed, that of a killed process by the next one that writes the same
file; a full disk, a file size limit or a lost permission becomes one `OutputError`.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from dougong.errors import OutputError
from dougong.formats.unfinished import clear_parts, part_of, removed_if_cancelled

_COPY_BYTES = 8 << 20
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class Sink:
    """A binary file that remembers the system error behind a failed write.

    Encoders written in other languages turn an OSError of the file below them into an error of
    their own, without its number; the sink keeps the first one.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write `data` (bytes-like), remembering the system error if that fails."""
        try:
            return self._file.write(data)
        except OSError as error:
            self.error = self.error or error
            raise

    def flush(self) -> None:
        """Hand everything to the system, remembering the error if that fails."""
        try:
            self._file.flush()
        except OSError as error:
            self.error = self.error or error
            raise

    def seek(self, position: int, whence: int = 0) -> int:
        """Move to `position`; flushes, so it can fail as a write does."""
        try:
            return self._file.seek(position, whence)
        except OSError as error:
            self.error = self.error or error
            raise

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _human(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000 or unit == "GB":
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1000
    raise AssertionError


def _explain(error: OSError, path: Path, expected_bytes: int) -> OutputError:
    if error.errno not in _FULL:
        return OutputError(f"{path} cannot be written: {error.strerror}. Check the folder.")
    try:
        free = _human(shutil.disk_usage(path.parent).free)
    except OSError:
        free = "an unknown amount"
    limit = "The file size limit was reached" if error.errno == errno.EFBIG else "The disk is full"
    return OutputError(
        f"{limit}: {path} needs about {_human(expected_bytes)}, {free} are free. "
        "The unfinished file was removed; free some space or write elsewhere."
    )


def refuse_bad_target(path: Path, *, overwrite: bool, source: Path | None = None) -> None:
    """Raise before any work is done where `path` cannot become the output.

    Raises
    ------
    OutputError
        It is the input itself, a folder, exists already, or its folder does not exist.
    """
    if not path.parent.is_dir():
        msg = f"{path.parent} is not a folder, so {path.name} cannot be written there. Create it."
        raise OutputError(msg)
    if path.is_dir():
        raise OutputError(f"{path} is a folder. Name a file in it.")
    if source is not None and path.exists() and source.exists() and path.samefile(source):
        msg = f"{path} is the input itself; inputs are never overwritten. Name another output."
        raise OutputError(msg)
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists already. Pass --overwrite to replace it.")


@contextmanager
def replacing(path: Path, *, expected_bytes: int) -> Iterator[Sink]:
    """Yield a file to fill; it takes the place of `path` only when all went well.

    Parameters
    ----------
    path : Path
    expected_bytes : int
        About how large the file becomes; only named when the disk is full.

    Raises
    ------
    OutputError
        The disk is full, or the folder cannot be written to.
    """
    part = part_of(path)
    clear_parts(path)
    try:
        file = part.open("w+b")
    except OSError as error:
        raise _explain(error, path, expected_bytes) from error
    sink = Sink(file)
    with removed_if_cancelled(part):
        try:
            yield sink
            sink.flush()
            os.fsync(file.fileno())
            file.close()
            part.replace(path)
        except BaseException as error:
            # Closing flushes, which fails again on a full disk; the first error is the one to tell.
            with contextlib.suppress(OSError):
                file.close()
            part.unlink(missing_ok=True)
            cause = sink.error or (error if isinstance(error, OSError) else None)
            if cause is not None:
                raise _explain(cause, path, expected_bytes) from error
            raise
    _sync_folder(path.parent)


def copy_file(source: Path, output: Path) -> None:
    """Copy a file byte by byte: all of it or nothing.

    Raises
    ------
    OutputError
        The disk is full, or the folder cannot be written to.
    """
    with (
        source.open("rb") as file,
        replacing(output, expected_bytes=source.stat().st_size) as sink,
    ):
        while piece := file.read(_COPY_BYTES):
            sink.write(piece)


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable where the system allows folders to be opened."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Network file systems refuse this; the file itself is safe already.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(handle)
