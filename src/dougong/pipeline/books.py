"""What the filters decided about every point of a file, in pages: never all of it at once."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.selection import Reason
from dougong.pipeline.removed import detail_counts, ground_kept, reason_counts
from dougong.pipeline.steps import Filtered, StageCount
from dougong.tiles.store import told
from dougong.typing import Index

PAGE_POINTS = 1 << 21
_CODES, _GROUND = "codes", "ground_class"


class Page(NamedTuple):
    """What was decided about some points of a file, in its order; see `Filtered`."""

    codes: NDArray[np.uint8]
    ground_class: NDArray[np.uint8]
    details: Mapping[str, NDArray[Any]]

    @classmethod
    def of(cls, columns: Mapping[str, NDArray[Any]]) -> Page:
        """Return the page of these columns, by their names."""
        details = {n: held for n, held in columns.items() if n not in (_CODES, _GROUND)}
        return cls(columns[_CODES], columns[_GROUND], details)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """All that it holds, by name."""
        return {_CODES: self.codes, _GROUND: self.ground_class, **self.details}

    def part(self, rows: slice) -> Page:
        """Return the page of some of its points."""
        return Page.of({name: values[rows] for name, values in self.columns.items()})

    def followed_by(self, other: Page) -> Page:
        """Return the page of its points and those of the next one."""
        more = other.columns
        return Page.of({n: np.concatenate([held, more[n]]) for n, held in self.columns.items()})


class Tally(NamedTuple):
    """What became of the points of a file, counted."""

    reasons: Counter[str]
    details: Counter[str]
    """What the curvature-weighted filter took them for; empty where it gave no details."""
    ground: int
    """Kept points on the ground."""

    @property
    def kept(self) -> int:
        """Points that every filter kept."""
        return self.reasons[Reason.KEPT.name.lower()]


@dataclass(frozen=True, slots=True, kw_only=True)
class Books:
    """What a finished step decided about every point of its input."""

    points: int
    page: Callable[[int], Page]
    """Opens a page by its number."""
    stages: tuple[StageCount, ...]
    notes: tuple[str, ...]
    """What the filters said; of which cloud, who shows it says: kept books outlive its name."""
    noticed: tuple[str, ...]
    """What reading the input said."""
    page_points: int = PAGE_POINTS

    @classmethod
    def of(cls, filtered: Filtered, noticed: Sequence[str]) -> Books:
        """Return the books of a cloud that is held: one page."""
        page = Page(filtered.codes, filtered.ground_class, filtered.details)
        return cls(
            points=len(filtered.codes),
            page=lambda _: page,
            stages=filtered.stages,
            notes=filtered.notes,
            noticed=tuple(noticed),
            page_points=max(len(filtered.codes), 1),
        )

    def pages(self) -> Iterator[Page]:
        """Yield the pages in the order of the file."""
        return (self.page(number) for number in range(-(-self.points // self.page_points)))

    def along(self, chunks: Iterable[Cloud]) -> Iterator[tuple[Cloud, Filtered]]:
        """Yield the chunks of the input with what was decided about each.

        Raises
        ------
        InputError
            The books are of another cloud.
        """
        pages = self.pages()
        held, done = next(pages), 0
        for chunk in chunks:
            done += len(chunk)
            while len(held.codes) < len(chunk):
                more = next(pages, None)
                if more is None:
                    raise InputError(self._of_another(f"{done:,} or more"))
                held = held.followed_by(more)
            mine, held = held.part(slice(len(chunk))), held.part(slice(len(chunk), None))
            yield chunk, self._filtered(chunk, mine)
        if done != self.points:
            raise InputError(self._of_another(f"{done:,}"))

    def _filtered(self, cloud: Cloud, page: Page) -> Filtered:
        return Filtered(
            cloud=cloud.select(np.flatnonzero(page.codes == Reason.KEPT)),
            codes=page.codes,
            ground_class=page.ground_class,
            stages=self.stages,
            notes=self.notes,
            details=page.details,
        )

    def _of_another(self, points: str) -> str:
        return (
            f"the finished step that --work keeps is of {self.points:,} points, the cloud has "
            f"{points}. Delete the --work folder."
        )

    def tally(self) -> Tally:
        """Count what was decided."""
        counts = np.zeros(len(Reason), np.int64)
        details: Counter[str] = Counter()
        ground = 0
        for page in self.pages():
            counts += reason_counts(page.codes)
            for name, points in detail_counts(page.codes, page.details).items():
                details[name] += points
            ground += ground_kept(page.codes, page.ground_class)
        reasons = zip(Reason, counts.tolist(), strict=True)
        return Tally(Counter({reason.name.lower(): n for reason, n in reasons}), details, ground)


class Binder:
    """Sorts what tiles say of their points into the pages of a file, on disk."""

    def __init__(self, folder: Path, points: int) -> None:
        """Begin with empty pages for so many `points`."""
        self.folder = folder
        self._points = points
        self._layout: dict[str, np.dtype[Any]] = {}
        with told(folder):
            # What a killed run left is of no use.
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)

    def add(self, row: Index, columns: Mapping[str, NDArray[Any]]) -> None:
        """Write down what is known of the points at the ascending places `row` (n,) of the file.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        layout = {name: values.dtype for name, values in columns.items()}
        self._layout |= layout
        block = np.empty(len(row), [("row", row.dtype), *layout.items()])
        block["row"] = row
        for name, values in columns.items():
            block[name] = values
        page = row // PAGE_POINTS
        starts = np.flatnonzero(np.diff(page, prepend=-1))
        for number, part in zip(page[starts].tolist(), np.split(block, starts[1:]), strict=True):
            path = self._path(number)
            with told(path), path.open("ab") as file:
                np.save(file, part)

    def page(self, number: int) -> Page:
        """Return a page; points that no tile had were decimated."""
        first = number * PAGE_POINTS
        points = min(PAGE_POINTS, self._points - first)
        columns = {name: np.zeros(points, dtype) for name, dtype in self._layout.items()}
        columns[_CODES].fill(Reason.DECIMATED)
        path = self._path(number)
        if path.exists():
            with path.open("rb") as file:
                while file.peek(1):
                    block = np.lib.format.read_array(file, allow_pickle=False)
                    for name in columns.keys() & set(block.dtype.names or ()):
                        columns[name][block["row"] - first] = block[name]
        return Page.of(columns)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number}.rows"
