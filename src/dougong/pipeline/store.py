"""Finished filter steps on disk, so that a cancelled run goes on where it was.

A step is known by the hash of its input file, its parameters and our version; a changed
registration setting therefore does not filter again, and a changed filter setting does.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import dougong
from dougong.cloud import Cloud
from dougong.filters.selection import Reason
from dougong.params import Parameters
from dougong.pipeline.steps import Filtered, StageCount
from dougong.tiles.folder import Folder, LocalFolder
from dougong.typing import Kind

_ALWAYS = ("codes", "ground_class")


@dataclass(frozen=True, slots=True, kw_only=True)
class Books:
    """What a finished step decided about every point of its input; see `Filtered`."""

    codes: NDArray[np.uint8]
    ground_class: NDArray[np.uint8]
    stages: tuple[StageCount, ...]
    notes: tuple[str, ...]
    noticed: tuple[str, ...]
    """What reading the input said."""
    details: Mapping[str, NDArray[Any]]

    def part(self, cloud: Cloud, rows: slice) -> Filtered:
        """Return the finished step on a part of its input: `cloud` has its points of `rows`."""
        codes = self.codes[rows]
        return Filtered(
            cloud=cloud.select(np.flatnonzero(codes == Reason.KEPT)),
            codes=codes,
            ground_class=self.ground_class[rows],
            stages=self.stages,
            notes=self.notes,
            details={name: values[rows] for name, values in self.details.items()},
        )

    def on(self, kept: Cloud) -> Filtered:
        """Return the finished step with the points that it kept."""
        return Filtered(
            cloud=kept,
            codes=self.codes,
            ground_class=self.ground_class,
            stages=self.stages,
            notes=self.notes,
            details=self.details,
        )


class Store:
    """A folder of finished steps, and of what only the run that goes on needs."""

    def __init__(self, folder: Folder, scratch: Path, *, is_temporary: bool) -> None:
        self.folder = folder
        self.scratch = scratch
        """On a disk of this machine."""
        self.is_temporary = is_temporary

    @classmethod
    def beside(cls, out: Path) -> "Store":
        """Return one beside the result, which is deleted once the run is done."""
        scratch = out.with_name(f"{out.name}.work")
        return cls(LocalFolder(scratch), scratch, is_temporary=True)

    @classmethod
    def kept(cls, folder: Folder, out: Path) -> "Store":
        """Return one in a folder that stays; where that is on no disk, scratch is beside `out`."""
        return cls(folder, folder.local or cls.beside(out).scratch, is_temporary=False)

    def key(self, digest: str, station: int, kind: Kind, params: Parameters) -> str:
        """Return the name of a step: a hash of everything its result depends on."""
        facts = [dougong.__version__, digest, station, kind, params.model_dump(mode="json")]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:32]

    def load(self, key: str) -> Books | None:
        """Return the books of a finished step, or None."""
        try:
            # The books are written last: where they are, the arrays are whole.
            with self.folder.open(f"{key}.json") as file:
                told = json.load(file)
            with self.folder.open(f"{key}.npz") as file, np.load(file) as stored:
                codes, ground = stored["codes"], stored["ground_class"]
                details = {name: stored[name] for name in stored.files if name not in _ALWAYS}
        except FileNotFoundError:
            return None
        return Books(
            codes=codes,
            ground_class=ground,
            stages=tuple(StageCount(**stage) for stage in told["stages"]),
            notes=tuple(told["notes"]),
            noticed=tuple(told["noticed"]),
            details=details,
        )

    def save(self, key: str, filtered: Filtered | Books, noticed: Sequence[str]) -> None:
        """Keep a finished step.

        Raises
        ------
        OutputError
            The disk is full or the folder cannot be written.
        """
        arrays: dict[str, Any] = {
            "codes": filtered.codes,
            "ground_class": filtered.ground_class,
            **filtered.details,
        }
        self.folder.write(f"{key}.npz", lambda file: np.savez(file, **arrays))
        books = {
            "stages": [asdict(stage) for stage in filtered.stages],
            "notes": list(filtered.notes),
            "noticed": list(noticed),
        }
        self.folder.write(f"{key}.json", lambda file: file.write(json.dumps(books).encode()))

    def finish(self) -> None:
        """Forget everything once the run is done, or what is not in the folder that stays."""
        if self.is_temporary or self.folder.local is None:
            shutil.rmtree(self.scratch, ignore_errors=True)
