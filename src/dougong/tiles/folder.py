"""Where tiles and finished steps are kept: a folder of whole files, on a disk or on shared storage.

A file is there whole or not at all, whenever its writer is killed: on a disk it is written beside
and renamed; an object store shows what it is sent in one request only when it has all of it.
"""

import hashlib
import io
import os
import shutil
import socket
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from dougong.errors import InputError, OutputError

Fill = Callable[[IO[bytes]], object]
"""Writes what a file shall hold."""
_END_BYTES = 1 << 16
_LEAST_FREE = 0.1
"""Of a disk: less is not left to the others for the sake of copies."""
_OBJECT_STORES = {"s3": "s3fs", "gs": "gcsfs", "abfs": "adlfs", "memory": "fsspec"}
"""Storage whose files appear whole, and the package that reaches it. Memory: of this process."""
_SETTINGS = {
    "s3": "Check that the bucket is there, and AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID and "
    "AWS_SECRET_ACCESS_KEY."
}


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
        part = path.with_name(f"{name}.part-{socket.gethostname()}-{os.getpid()}")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with part.open("wb") as file:
                fill(file)
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


_copies: Path | None = None


@contextmanager
def copies_in(folder: Path) -> Iterator[None]:
    """Have this process keep copies of what it reads from shared storage, until the block ends.

    Stages go over the tiles again and again.
    """
    global _copies
    before, _copies = _copies, folder
    try:
        yield
    finally:
        _copies = before
        shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True, slots=True)
class _Copies:
    """Copies of the files of a shared folder; None: there are none."""

    folder: Path | None

    def open(self, name: str) -> IO[bytes]:
        """Open a copy to read."""
        if self.folder is None:
            raise FileNotFoundError(name)
        return (self.folder / name).open("rb")

    def keep(self, name: str, content: bytes) -> None:
        """Make a copy, unless the disk gets full: the file itself is elsewhere."""
        if self.folder is None:
            return
        with suppress(OutputError):
            LocalFolder(self.folder).write(name, lambda file: file.write(content))
            disk = shutil.disk_usage(self.folder)
            if disk.free < _LEAST_FREE * disk.total:
                self.remove()

    def remove(self) -> None:
        """Delete the copies."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


@dataclass(frozen=True, slots=True)
class SharedFolder:
    """Objects under a prefix of shared storage, through fsspec.

    Keys of access do not travel with it: every machine has its own, in its environment.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    @property
    def local(self) -> None:
        """Nothing: it is on no disk of this machine."""
        return

    def __truediv__(self, name: str) -> "SharedFolder":
        return SharedFolder(f"{self.url}/{name}")

    def names(self) -> set[str]:
        """Return the names in it."""
        with self._told("read"):
            system, path = self._system()
            try:
                return {item.rsplit("/", 1)[-1] for item in system.ls(path, detail=False)}
            except FileNotFoundError:
                return set()

    def open(self, name: str) -> IO[bytes]:
        """Open the copy of a file, or fetch it: one request."""
        copies = self._copies(name)
        with suppress(FileNotFoundError):
            return copies.open(name)
        with self._told("read"):
            system, path = self._system()
            content = system.cat_file(f"{path}/{name}")
        copies.keep(name, content)
        return io.BytesIO(content)

    def open_end(self, name: str) -> IO[bytes]:
        """Open the copy of a file, or fetch its end."""
        with suppress(FileNotFoundError):
            return self._copies(name).open(name)
        with self._told("read"):
            system, path = self._system()
            size = system.size(f"{path}/{name}")
            return io.BytesIO(
                system.cat_file(f"{path}/{name}", start=max(0, size - _END_BYTES), end=size)
            )

    def stamp(self, name: str) -> Hashable:
        """Return what the storage knows a version of the file by."""
        with self._told("read"):
            system, path = self._system()
            stamp: str = system.ukey(f"{path}/{name}")
            return stamp

    def write(self, name: str, fill: Fill) -> None:
        """Send a file whole."""
        buffer = io.BytesIO()
        fill(buffer)
        with self._told("written"):
            system, path = self._system()
            system.pipe_file(f"{path}/{name}", buffer.getvalue())
        self._copies(name).keep(name, buffer.getvalue())

    def remove(self) -> None:
        """Delete all objects under the prefix."""
        self._copies(".npz").remove()
        with self._told("cleared"), suppress(FileNotFoundError):
            system, path = self._system()
            system.rm(path, recursive=True)

    def refuse_unusable(self) -> None:
        """Write a small object and delete it again: a job should not find out after hours.

        Raises
        ------
        OutputError
            The bucket is not there, the keys are missing or refused, nobody answers.
        """
        probe = f"probe-{socket.gethostname()}-{os.getpid()}"
        self.write(probe, lambda file: file.write(b"dougong"))
        with self._told("read"), self.open(probe):
            pass
        with self._told("cleared"):
            system, path = self._system()
            system.rm_file(f"{path}/{probe}")

    def _copies(self, name: str) -> "_Copies":
        """Return where copies are, of files that never change once they are there."""
        kept = _copies if name.endswith(".npz") else None
        return _Copies(kept and kept / hashlib.sha256(self.url.encode()).hexdigest()[:16])

    def _system(self) -> tuple[Any, str]:
        """Return who reaches the storage, and the prefix as it names it."""
        from fsspec.core import url_to_fs

        # Others write there too, so no listing is remembered.
        found: tuple[Any, str] = url_to_fs(self.url, use_listings_cache=False)
        return found

    @contextmanager
    def _told(self, done: str) -> Iterator[None]:
        """Say in one sentence why something could not be `done`; a missing file may be no error."""
        try:
            yield
        except OutputError:
            raise
        except Exception as error:  # every storage's library has errors of its own
            if isinstance(error, FileNotFoundError) and done == "read":
                raise
            reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
            more = _SETTINGS.get(self.url.partition("://")[0], "Check its settings.")
            msg = f"{self.url} could not be {done}: {reason}. {more}"
            raise OutputError(msg) from error


def folder_of(place: str | Path) -> Folder:
    """Return the folder that ``--work`` names: a path, or a URL such as s3://bucket/prefix.

    Raises
    ------
    InputError
        The URL names no bucket, or storage that is not known, or whose package is not here.
    OutputError
        The storage cannot be used.
    """
    scheme, mark, rest = str(place).partition("://")
    if not mark:
        return LocalFolder(Path(place))
    rest = rest.strip("/")
    if scheme not in _OBJECT_STORES:
        msg = (
            f"--work knows folders and the storage of {', '.join(_public())}, got {str(place)!r}. "
            "Mount other storage as a folder."
        )
        raise InputError(msg)
    if not rest:
        msg = f"--work {place} names no bucket. Write {scheme}://BUCKET/PREFIX."
        raise InputError(msg)
    if set(rest) & set("*?[]#"):
        msg = f"--work {place}: a prefix holds none of * ? [ ] # here. Choose another."
        raise InputError(msg)
    folder = SharedFolder(f"{scheme}://{rest}")
    _refuse_missing_package(scheme)
    folder.refuse_unusable()
    return folder


def _public() -> list[str]:
    return [f"{scheme}://" for scheme in _OBJECT_STORES if scheme != "memory"]


def _refuse_missing_package(scheme: str) -> None:
    from fsspec import get_filesystem_class

    package = _OBJECT_STORES[scheme]
    try:
        get_filesystem_class(scheme)
    except ImportError as error:
        named = "'dougong[s3]'" if scheme == "s3" else package
        msg = f"--work {scheme}://... needs {package}, which is not here: pip install {named}."
        raise InputError(msg) from error
