"""Finished filter steps on disk, so that a cancelled run goes on where it was.

A step is known by the hash of its input file, its parameters and our version; a changed
registration setting therefore does not filter again, and a changed filter setting does.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import dougong
from dougong.cloud import Cloud
from dougong.errors import OutputError
from dougong.filters.selection import Reason
from dougong.params import Parameters
from dougong.pipeline.outputs import write_text
from dougong.pipeline.steps import Filtered, StageCount
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
    """A folder of finished steps."""

    def __init__(self, folder: Path, *, is_temporary: bool) -> None:
        self.folder = folder
        self.is_temporary = is_temporary

    def key(self, digest: str, station: int, kind: Kind, params: Parameters) -> str:
        """Return the name of a step: a hash of everything its result depends on."""
        facts = [dougong.__version__, digest, station, kind, params.model_dump(mode="json")]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:32]

    def load(self, key: str) -> Books | None:
        """Return the books of a finished step, or None."""
        books = self.folder / f"{key}.json"
        arrays = self.folder / f"{key}.npz"
        # The books are written last: where they are, the arrays are whole.
        if not books.is_file() or not arrays.is_file():
            return None
        told = json.loads(books.read_text(encoding="utf-8"))
        with np.load(arrays) as stored:
            codes, ground = stored["codes"], stored["ground_class"]
            details = {name: stored[name] for name in stored.files if name not in _ALWAYS}
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
        part = self.folder / f"{key}.part-{os.getpid()}.npz"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            arrays: dict[str, Any] = {
                "codes": filtered.codes,
                "ground_class": filtered.ground_class,
                **filtered.details,
            }
            np.savez(part, **arrays)
            part.replace(self.folder / f"{key}.npz")
        except OSError as error:
            with suppress(OSError):
                part.unlink()
            msg = (
                f"{self.folder} could not be written: {error.strerror or error}. "
                "Free some space or pass another --work."
            )
            raise OutputError(msg) from error
        books = {
            "stages": [asdict(stage) for stage in filtered.stages],
            "notes": list(filtered.notes),
            "noticed": list(noticed),
        }
        write_text(self.folder / f"{key}.json", json.dumps(books))

    def finish(self) -> None:
        """Forget everything once the run is done, unless the user named the folder."""
        if self.is_temporary:
            shutil.rmtree(self.folder, ignore_errors=True)
