"""A folder on storage that several machines reach, through fsspec: S3 and what speaks like it.

Stages go over the tiles again and again, so a process may keep copies of what it has read.
"""

import hashlib
import io
import os
import shutil
import socket
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from dougong.errors import InputError, OutputError
from dougong.formats.unfinished import part_of
from dougong.tiles.folder import Fill, Folder, LocalFolder

_END_BYTES = 1 << 16
_LEAST_FREE = 0.1
"""Of a disk: less is not left to the others for the sake of copies."""
_OBJECT_STORES = ("s3", "memory")
"""Storage whose files appear whole. Memory: of this process, for tests."""
_CHECK = (
    "Check that the bucket is there, and AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID and "
    "AWS_SECRET_ACCESS_KEY."
)

_copies: Path | None = None


def keep_copies(folder: Path | None) -> None:
    """Have this process keep copies of what it reads from shared storage; None: no longer.

    Stages go over the tiles again and again.
    """
    global _copies
    _copies = folder


@contextmanager
def copies_in(folder: Path) -> Iterator[None]:
    """Have this process keep copies until the block ends, then delete them."""
    # Those of a killed run may be of what is no longer there.
    shutil.rmtree(folder, ignore_errors=True)
    keep_copies(folder)
    try:
        yield
    finally:
        keep_copies(None)
        shutil.rmtree(folder, ignore_errors=True)


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
        copy = self._copy_of(name)
        if copy is not None and copy.exists():
            return copy.open("rb")
        with self._told("read"):
            system, path = self._system()
            if copy is None or not _has_room(copy.parent):
                return io.BytesIO(system.cat_file(f"{path}/{name}"))
            part = part_of(copy)
            try:
                system.get_file(f"{path}/{name}", str(part))
                part.replace(copy)
            finally:
                part.unlink(missing_ok=True)
        return copy.open("rb")

    def open_end(self, name: str) -> IO[bytes]:
        """Open the copy of a file, or fetch its end."""
        copy = self._copy_of(name)
        if copy is not None and copy.exists():
            return copy.open("rb")
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
        """Send a file whole; its copy, where one is made, is sent piece by piece."""
        copy = self._copy_of(name)
        if copy is None or not _has_room(copy.parent):
            buffer = io.BytesIO()
            fill(buffer)
            with self._told("written"):
                system, path = self._system()
                system.pipe_file(f"{path}/{name}", buffer.getvalue())
            return
        LocalFolder(copy.parent).write(name, fill)
        try:
            with self._told("written"):
                system, path = self._system()
                system.put_file(str(copy), f"{path}/{name}")
        except BaseException:
            copy.unlink(missing_ok=True)
            raise

    def remove(self) -> None:
        """Delete all objects under the prefix."""
        if _copies is not None:
            shutil.rmtree(self._copies(_copies), ignore_errors=True)
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

    def _copy_of(self, name: str) -> Path | None:
        """Return where the copy of a file goes, if it never changes and copies are kept."""
        if _copies is None or not name.endswith(".npz"):
            return None
        return self._copies(_copies) / name

    def _copies(self, folder: Path) -> Path:
        return folder / hashlib.sha256(self.url.encode()).hexdigest()[:16]

    def _system(self) -> tuple[Any, str]:
        """Return who reaches the storage, and the prefix as it names it."""
        from fsspec.core import url_to_fs

        # Others write there too, so no listing is remembered. Large files go in pieces, of which
        # one at a time is in memory.
        found: tuple[Any, str] = url_to_fs(self.url, use_listings_cache=False, max_concurrency=1)
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
            # A worker elsewhere has an environment of its own.
            msg = f"{self.url} could not be {done} from {socket.gethostname()}: {reason}. {_CHECK}"
            raise OutputError(msg) from error


def _has_room(folder: Path) -> bool:
    """Make a folder for copies and say whether its disk has room for some."""
    folder.mkdir(parents=True, exist_ok=True)
    disk = shutil.disk_usage(folder)
    return disk.free > _LEAST_FREE * disk.total


def folder_of(place: str | Path) -> Folder:
    """Return the folder that ``--work`` names: a path, or a URL such as s3://bucket/prefix.

    Raises
    ------
    InputError
        The URL names no bucket, or storage that is not known, or s3fs is not here.
    OutputError
        The storage cannot be used.
    """
    scheme, mark, rest = str(place).partition("://")
    if not mark:
        return LocalFolder(Path(place))
    rest = rest.strip("/")
    if scheme not in _OBJECT_STORES:
        msg = (
            f"--work knows folders and s3://BUCKET/PREFIX, got {str(place)!r}. "
            "Mount other storage as a folder."
        )
        raise InputError(msg)
    if not rest:
        msg = f"--work {place} names no bucket. Write {scheme}://BUCKET/PREFIX."
        raise InputError(msg)
    if set(rest) & set("*?[]#"):
        msg = f"--work {place}: a prefix holds none of * ? [ ] # here. Choose another."
        raise InputError(msg)
    _refuse_missing_package(scheme)
    folder = SharedFolder(f"{scheme}://{rest}")
    folder.refuse_unusable()
    return folder


def _refuse_missing_package(scheme: str) -> None:
    from fsspec import get_filesystem_class

    try:
        get_filesystem_class(scheme)
    except ImportError as error:
        msg = f"--work {scheme}://... needs s3fs, which is not here: pip install 'dougong[s3]'."
        raise InputError(msg) from error
