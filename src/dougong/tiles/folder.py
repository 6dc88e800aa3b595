"""Where tiles and finished steps are kept: a folder of whole files, on a disk or on shared storage.

A file is there whole or not at all, whenever its writer is killed: on a disk it is written beside,
synced and renamed; an object store shows what it is sent in one request only when it has all of it.
"""

import os
import shutil
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

from dougong.errors import OutputError
from dougong.formats.unfinished import clear_all_parts, part_of, refuse_removed

Fill = Callable[[IO[bytes]], object]
"""Writes what a file shall hold."""


class Folder(Protocol):
    """A folder of whole files. It travels: whoever has it reaches the same files."""

    def __hash__(self) -> int:
        """Two of one place are equal."""

    @property
    def local(self) -> Path | None:
        """Its path, where it is on a disk."""

    def __truediv__(self, name: str) -> "Folder":
        """Return the folder `name` in it."""

    def names(self) -> set[str]:
        """Return the names in it; none where there is no such folder."""

    def open(self, name: str) -> IO[bytes]:
        """Open a file to read all or most of it.

        Raises
        ------
        FileNotFoundError
            It is not there.
        """

    def open_end(self, name: str) -> IO[bytes]:
        """Open a file of which only the last few kB are read; elsewhere it may be cut short."""

    def stamp(self, name: str) -> Hashable:
        """Return what differs when the file was written again."""

    def write(self, name: str, fill: Fill) -> None:
        """Write a file in place of what was there.

        Raises
        ------
        OutputError
            The folder cannot be written, or its disk is full.
        """

    def remove(self) -> None:
        """Delete the folder with all that is in it, where it is there."""


@dataclass(frozen=True, slots=True)
class LocalFolder:
    """A folder on a disk of this machine, or one that is mounted."""

    path: Path

    def __post_init__(self) -> None:
        # Another process that works on it may have been started elsewhere.
        object.__setattr__(self, "path", self.path.absolute())

    def __str__(self) -> str:
        return str(self.path)

    @property
    def local(self) -> Path:
        """Its path."""
        return self.path

    def __truediv__(self, name: str) -> "LocalFolder":
        return LocalFolder(self.path / name)

    def names(self) -> set[str]:
        """Return the names in it."""
        try:
            return set(os.listdir(self.path))  # noqa: PTH208 - no path is made of them
        except FileNotFoundError:
            return set()

    def open(self, name: str) -> IO[bytes]:
        """Open a file to read."""
        return (self.path / name).open("rb")

    def open_end(self, name: str) -> IO[bytes]:
        """Open a file to read."""
        return self.open(name)

    def stamp(self, name: str) -> Hashable:
        """Return the time of its writing."""
        return (self.path / name).stat().st_mtime_ns

    def write(self, name: str, fill: Fill) -> None:
        """Write a file beside its place and rename it there."""
        path = self.path / name
        refuse_removed(path)
        part = part_of(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            clear_all_parts(self.path)
            with part.open("wb") as file:
                fill(file)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        except BaseException as error:
            # The first error is the one to tell, not that of cleaning up after it.
            with suppress(OSError):
                part.unlink()
            if not isinstance(error, OSError):
                raise
            msg = (
                f"{self.path} could not be written: {error.strerror or error}. "
                "Free some space or pass another --work."
            )
            raise OutputError(msg) from error

    def remove(self) -> None:
        """Delete the folder with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
