"""From a project's entries to the clouds that move: read, filtered, named."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.formats import describe, faults_of, in_system, read, read_stations
from dougong.formats.faults import NO_SYSTEM
from dougong.formats.model import Hold
from dougong.formats.unfinished import sole_user
from dougong.pipeline.books import Books
from dougong.pipeline.kept import Kept
from dougong.pipeline.marking import marks_clutter, with_clutter
from dougong.pipeline.memory import Room
from dougong.pipeline.movers import Mover, Source
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import Entry, files_of
from dougong.pipeline.provenance import Clock, Stamp, identified, require_unchanged
from dougong.pipeline.recipes import Recipe, filter_cloud, steps_of
from dougong.pipeline.removed import removed_sample
from dougong.pipeline.spooling import spooled
from dougong.pipeline.steps import Filtered
from dougong.pipeline.store import Store
from dougong.pipeline.tiled import (
    filter_chunks,
    is_too_large,
    stations_of,
    tiled_job,
)
from dougong.registration.free_scale import ScaleSearch, with_unit, without_unit
from dougong.registration.free_scale_result import refusal


@dataclass(slots=True, kw_only=True)
class Loader:
    """Reads and filters; remembers the hash of every file."""

    folder: Path
    recipe: Recipe
    store: Store
    progress: Progress
    clock: Clock
    shown: Callable[[Path], str]
    room: Room
    scratch: Path
    """Gets what is of use to this run only."""
    inputs: dict[Path, dict[str, Any]] = field(default_factory=dict)
    stamps: dict[Path, Stamp] = field(default_factory=dict)
    """Of each file as it was when its hash was taken."""
    waiting: int = 0
    """Filtered points that wait in memory."""
    units: dict[str, float | None] = field(default_factory=dict)
    """Metres per unit of the project's clouds whose scale was searched; None: none was found."""
    saved: set[str] = field(default_factory=set)
    """Keys of the filtered clouds that this run has put into its store."""

    def hold(self) -> Hold:
        """Return how many points may be held beside those that wait, and where the others go."""
        return Hold(self.room.held_points(self.waiting), self.scratch)

    def movers(self, entry: Entry, scale: ScaleSearch | None = None) -> list[Mover]:
        """Return what moves as one of a project's cloud, read and filtered.

        A cloud without a unit is filtered in the metres of `scale`; where that has none, it stays
        as it is.
        """
        if scale is not None:
            is_found = refusal(scale) is None
            self.units[entry.name] = scale.candidates[0].metres_per_unit if is_found else None
        sources = [
            source for file in files_of(entry, self.folder) for source in self._sources(entry, file)
        ]
        groups = [tuple(sources)] if entry.registered else [(source,) for source in sources]
        digits = len(str(len(groups)))
        return [
            Mover(
                name=entry.name if len(groups) == 1 else f"{entry.name}-{index:0{digits}d}",
                entry=entry.name,
                kind=entry.kind,
                sources=group,
                scale=scale,
            )
            for index, group in enumerate(groups, 1)
        ]

    def _sources(self, entry: Entry, file: Path) -> Iterator[Source]:
        self.progress.stage(f"reading {file.name}")
        with self.clock.measure("read"):
            digest, self.stamps[file] = identified(file)
        if entry.name in self.units and self.units[entry.name] is None:
            found = self._unfiltered(entry, file)
        elif is_too_large(file, self.room, self.waiting):
            found = self._on_tiles(entry, file, digest)
        else:
            found = self._whole(entry, file, digest)
        twin = next((other for other, of in self.inputs.items() if of["sha256"] == digest), None)
        self.inputs[file] = {"path": self.shown(file), "sha256": digest, "points": 0}
        for source in _naming(file, found):
            if twin is not None:
                said = f"{file.name} is a copy of {twin.name}: the same points are given twice"
                source = replace(source, notes=(*source.notes, said))
            self.inputs[file]["points"] += source.points_in
            self.waiting += source.kept.points if source.kept.is_held else 0
            yield source

    def require_unchanged(self, file: Path) -> None:
        """Refuse a file that was replaced since its hash was taken; see `provenance`."""
        require_unchanged(file, self.stamps[file])

    def _placed(self, entry: Entry, cloud: Cloud) -> Cloud:
        """Return a cloud in the system that its entry names, or in the unit that was found."""
        if entry.name not in self.units:
            return in_system(cloud, entry.crs)
        said = "has a coordinate system, which is not believed: its scale is not known"
        notes = (*cloud.notes, said) if cloud.frame.crs is not None else cloud.notes
        bare = replace(without_unit(cloud), notes=notes)
        return with_unit(bare, self.units[entry.name] or 1.0)

    def _noticed(self, entry: Entry, cloud: Cloud) -> tuple[str, ...]:
        """Return what is odd about a cloud; that it names no system is not, where it has a unit."""
        said = (*cloud.notes, *faults_of(cloud))
        return tuple(n for n in said if entry.name not in self.units or n != NO_SYSTEM)

    def _unfiltered(self, entry: Entry, file: Path) -> Iterator[Source]:
        """Read the file and leave it as it is: its unit is not known, and filters need metres."""
        with self.clock.measure("read"):
            cloud = self._placed(entry, read(file))
        self.require_unchanged(file)
        nothing = np.zeros(len(cloud), dtype=np.uint8)
        filtered = Filtered(cloud=cloud, codes=nothing, ground_class=nothing, stages=())
        noticed = (*self._noticed(entry, cloud), "not filtered, since its scale is not known")
        removed = cloud.select(np.arange(0))
        yield self._source(entry, file, -1, Kept.of(cloud), Books.of(filtered, noticed), removed)

    def _whole(self, entry: Entry, file: Path, digest: str) -> Iterator[Source]:
        """Read the file, then filter its clouds one by one."""
        with self.clock.measure("read"):
            clouds = [read(file)] if entry.registered else read_stations(file)
            clouds = [self._placed(entry, cloud) for cloud in clouds]
        self.require_unchanged(file)
        for station in range(len(clouds)):
            # Each raw cloud is let go as soon as it is filtered.
            cloud, clouds[station] = clouds[station], clouds[station].select(np.arange(0))
            key = self._key(entry, digest, station)
            books = self.store.load(key)
            if books is not None and books.points == len(cloud):
                self._say_known(cloud.name, key)
                ((_, filtered),) = books.along((cloud,))
            else:
                with self.clock.measure("filter"):
                    noticed = self._noticed(entry, cloud)
                    filtered = filter_cloud(cloud, entry.kind, self.recipe, self.progress)
                books = Books.of(filtered, noticed)
                self._save(key, books)
            removed = removed_sample(cloud, filtered.codes, details=filtered.details)
            kept = Kept.of(self._kept(entry, filtered))
            yield self._source(entry, file, station, kept, books, removed)

    def _on_tiles(self, entry: Entry, file: Path, digest: str) -> Iterator[Source]:
        """Filter the clouds of a file that does not fit in memory; what is left stays on disk."""
        self.progress.note(f"{file.name} is larger than memory: it is filtered on tiles")
        job = tiled_job(steps_of(entry.kind, self.recipe))
        points = describe(file).points
        for station, raw in enumerate(stations_of(file, split=not entry.registered)):
            key = self._key(entry, digest, station)
            name = f"tiles-{self._tiles_key(entry, digest, station)}"
            folder, scratch = self.store.folder / name, self.scratch / name
            chunks = self._chunks(entry, file, raw)
            spool = None
            if self.store.load(key) is not None:
                self._say_known(file.stem, key)
            else:
                alone = nullcontext() if folder.local is None else sole_user(folder.local)
                with alone, self.clock.measure("filter"):
                    books, spool = filter_chunks(
                        chunks,
                        job,
                        points=points,
                        room=self.room,
                        waiting=self.waiting,
                        folder=folder,
                        scratch=scratch,
                        progress=self.progress,
                    )
                self._save(key, books)
                if self.store.is_temporary:
                    folder.remove()
            known = self.store.load(key)
            assert known is not None
            self.progress.stage(f"{file.stem}: reading what is left")
            with self.clock.measure("read"):
                kept, removed = spooled(
                    chunks if spool is None else spool.pieces(),
                    known,
                    self.scratch / f"kept-{key[:16]}",
                    lambda part: self._kept(entry, part),
                )
            shutil.rmtree(scratch, ignore_errors=True)
            yield self._source(entry, file, station, kept, known, removed)

    def _chunks(self, entry: Entry, file: Path, raw: Iterator[Cloud]) -> Iterator[Cloud]:
        """Yield the chunks of a cloud where its entry puts it, if the file stays meanwhile."""
        for chunk in raw:
            yield self._placed(entry, chunk)
        self.require_unchanged(file)

    def _kept(self, entry: Entry, filtered: Filtered) -> Cloud:
        """Return the kept points, with what they were taken for where that is wanted."""
        steps = steps_of(entry.kind, self.recipe)
        return with_clutter(filtered) if any(marks_clutter(s) for s in steps) else filtered.cloud

    def _tiles_key(self, entry: Entry, digest: str, station: int) -> str:
        """Return the name of the tiles: a hash of what they depend on, not of later filters."""
        grid = tiled_job(steps_of(entry.kind, self.recipe)).grid
        facts = f"{self._points(entry, digest)} for {entry.kind}"
        return self.store.key(facts, station, entry.kind, grid or Recipe())[:16]

    def _key(self, entry: Entry, digest: str, station: int) -> str:
        params = self.recipe.lidar if entry.kind == "lidar" else self.recipe.photogrammetry
        station = -1 if entry.registered else station
        return self.store.key(self._points(entry, digest), station, entry.kind, params)

    def _points(self, entry: Entry, digest: str) -> str:
        """Return what says where the points of a file are in metres: its hash, system and unit."""
        system = f" in {entry.crs}" if entry.crs is not None else ""
        unit = f" at {self.units[entry.name]!r} m" if entry.name in self.units else ""
        return digest + system + unit

    def _save(self, key: str, books: Books) -> None:
        self.store.save(key, books)
        self.saved.add(key)

    def _say_known(self, name: str, key: str) -> None:
        when = "before, from its copy" if key in self.saved else "in an earlier run"
        self.progress.note(f"{name}: filtered {when}; not filtered again")

    def _source(
        self,
        entry: Entry,
        file: Path,
        station: int,
        kept: Kept,
        books: Books,
        removed: Cloud,
    ) -> Source:
        return Source(
            file=file,
            station=-1 if entry.registered else station,
            kept=kept,
            tally=books.tally(),
            stages=books.stages,
            points_in=books.points,
            removed=removed,
            notes=(
                *(f"{file.name}: {note}" for note in books.noticed),
                *(f"{kept.name}, {note}" for note in books.notes),
            ),
        )


def _naming(file: Path, found: Iterator[Source]) -> Iterator[Source]:
    """Yield what is found of a file; a setting that does not go with it is said with its name."""
    try:
        yield from found
    except InputError as error:
        if file.name in str(error):
            raise
        raise InputError(f"{file.name}: {error}") from error
