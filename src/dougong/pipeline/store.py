"""Finished filter steps on disk, so that a cancelled run goes on where it was.

A step is known by the hash of its input file, its parameters and our version; a changed
registration setting therefore does not filter again, and a changed filter setting does.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import dougong
from dougong.errors import OutputError
from dougong.params import Parameters
from dougong.pipeline.books import Books, Page
from dougong.pipeline.outputs import behind_link, claim_folder, leave_folder
from dougong.pipeline.steps import StageCount
from dougong.tiles.folder import Folder, LocalFolder
from dougong.typing import Kind


class Store:
    """A folder of finished steps, and of what only the run that goes on needs."""

    def __init__(self, folder: Folder, scratch: Path, out: Path, *, is_temporary: bool) -> None:
        self.folder = folder
        self.scratch = scratch
        """On a disk of this machine."""
        run = hashlib.sha256(str(out.absolute()).encode(errors="surrogateescape")).hexdigest()[:8]
        self.of_run = scratch / f"dougong-run-{run}"
        """Gets what is of use to the run into this result only."""
        self.is_temporary = is_temporary

    @classmethod
    def beside(cls, out: Path) -> "Store":
        """Return one on the disk of the result, which is deleted once the run is done."""
        place = behind_link(out)
        # What lies beside a mount point is on another disk, in a container one that is lost.
        is_mounted = os.path.ismount(place)
        scratch = place / ".work" if is_mounted else place.with_name(f"{place.name}.work")
        return cls(LocalFolder(scratch), scratch, out, is_temporary=True)

    @classmethod
    def kept(cls, folder: Folder, out: Path) -> "Store":
        """Return one in a folder that stays; where that is on no disk, scratch is beside `out`."""
        return cls(folder, folder.local or cls.beside(out).scratch, out, is_temporary=False)

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Hold the folder that is deleted once the run is done: nobody else's, and not for nothing.

        Raises
        ------
        OutputError
            Somebody else's files are in it.
        """
        if not self._is_scratch_ours:
            yield
            return
        claim_folder(self.scratch)
        try:
            yield
        finally:
            leave_folder(self.scratch)

    @contextmanager
    def resumable(self) -> Iterator[None]:
        """Have an error of writing say what stays on the disk, and why.

        Raises
        ------
        OutputError
            As in the block.
        """
        try:
            yield
        except OutputError as error:
            raise OutputError(" ".join([str(error), *self._stays()])) from error

    def _stays(self) -> list[str]:
        """Return in words which steps stay for the run that goes on; nothing where none do."""
        if not any(name.endswith(_COVER) for name in self.folder.names()):
            return []
        place = self.folder.local
        files = [] if place is None else [path for path in place.rglob("*") if path.is_file()]
        size = f" ({sum(file.stat().st_size for file in files) / 1e6:,.1f} MB)" if files else ""
        return [
            f"Finished filter steps stay in {self.folder}{size}: the same command goes on from "
            "there; delete it if you do not."
        ]

    @property
    def _is_scratch_ours(self) -> bool:
        """False: it is the folder that the user named, which stays."""
        return self.is_temporary or self.folder.local is None

    def key(self, digest: str, station: int, kind: Kind, params: Parameters) -> str:
        """Return the name of a step: a hash of everything its result depends on."""
        facts = [dougong.__version__, digest, station, kind, params.model_dump(mode="json")]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:32]

    def load(self, key: str) -> Books | None:
        """Return the books of a finished step, or None."""
        try:
            # The books are written last: where they are, the pages are whole.
            with self.folder.open(_cover(key)) as file:
                told = json.load(file)
        except FileNotFoundError:
            return None

        def page(number: int) -> Page:
            with self.folder.open(_page(key, number)) as file, np.load(file) as stored:
                return Page.of(dict(stored))

        return Books(
            points=told["points"],
            page=page,
            page_points=told["page_points"],
            stages=tuple(StageCount(**stage) for stage in told["stages"]),
            notes=tuple(told["notes"]),
            noticed=tuple(told["noticed"]),
        )

    def save(self, key: str, books: Books) -> None:
        """Keep a finished step.

        Raises
        ------
        OutputError
            The disk is full or the folder cannot be written.
        """
        for number, page in enumerate(books.pages()):
            columns: dict[str, Any] = page.columns
            self.folder.write(_page(key, number), partial(np.savez, **columns))
        cover = {
            "points": books.points,
            "page_points": books.page_points,
            "stages": [asdict(stage) for stage in books.stages],
            "notes": list(books.notes),
            "noticed": list(books.noticed),
        }
        self.folder.write(_cover(key), lambda file: file.write(json.dumps(cover).encode()))

    def finish(self) -> None:
        """Forget everything once the run is done, or what is not in the folder that stays."""
        if self._is_scratch_ours:
            shutil.rmtree(self.scratch, ignore_errors=True)


_COVER = ".books.json"


def _cover(key: str) -> str:
    return f"{key}{_COVER}"


def _page(key: str, number: int) -> str:
    return f"{key}.books.{number}.npz"
