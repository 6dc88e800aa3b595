"""From a project's entries to the clouds that move: read, filtered, named."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import FrameError
from dougong.formats import faults_of, is_same_crs, read, read_stations
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import Entry, files_of
from dougong.pipeline.provenance import Clock, sha256
from dougong.pipeline.recipes import Recipe, filter_cloud
from dougong.pipeline.removed import removed_sample
from dougong.pipeline.steps import Filtered
from dougong.pipeline.store import Store
from dougong.typing import Kind


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One file (or one station in it) after its filters."""

    file: Path
    station: int
    filtered: Filtered
    points_in: int
    notes: tuple[str, ...]

    removed: Cloud
    """A sample of what the filters took out, see `removed_sample`."""

    @property
    def is_scan(self) -> bool:
        """True: one scan of an E57 file, which moves by itself."""
        return self.station >= 0 and hasattr(self.filtered.cloud.header, "station")


@dataclass(frozen=True, slots=True, kw_only=True)
class Mover:
    """What moves as one: a cloud of the project, or one station of it."""

    name: str
    entry: str
    kind: Kind
    sources: tuple[Source, ...]
    scale_known: bool

    @property
    def clouds(self) -> list[Cloud]:
        """The filtered clouds of the files."""
        return [source.filtered.cloud for source in self.sources]

    @property
    def points_in(self) -> int:
        """Points before the filters."""
        return sum(source.points_in for source in self.sources)

    @property
    def points_out(self) -> int:
        """Points after the filters."""
        return sum(len(cloud) for cloud in self.clouds)

    def joined(self) -> Cloud:
        """Return all points as one cloud for the registration: coordinates only.

        Raises
        ------
        FrameError
            The files differ in coordinate system or unit.
        """
        clouds = self.clouds
        if len(clouds) == 1:
            return replace(clouds[0], name=self.name)
        first = clouds[0].frame
        for cloud in clouds[1:]:
            frame = cloud.frame
            if not is_same_crs(frame.crs, first.crs) or frame.unit_m != first.unit_m:
                msg = (
                    f"cloud {self.name!r}: {clouds[0].name} and {cloud.name} differ in coordinate "
                    "system or unit. Reproject one, or list them as clouds of their own."
                )
                raise FrameError(msg)
        xyz = np.concatenate([cloud.rebased(first.origin).xyz for cloud in clouds])
        records = np.zeros(len(xyz), dtype=[("file", "<u2")])
        return Cloud(xyz=xyz, records=records, frame=first, name=self.name)


@dataclass(slots=True, kw_only=True)
class Loader:
    """Reads and filters; remembers the hash of every file."""

    folder: Path
    recipe: Recipe
    store: Store
    progress: Progress
    clock: Clock
    shown: Callable[[Path], str]
    inputs: dict[Path, dict[str, Any]]

    def movers(self, entry: Entry) -> list[Mover]:
        """Return what moves as one of a project's cloud, read and filtered."""
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
                scale_known=entry.scale_known,
            )
            for index, group in enumerate(groups, 1)
        ]

    def _sources(self, entry: Entry, file: Path) -> Iterator[Source]:
        self.progress.stage(f"reading {file.name}")
        with self.clock.measure("read"):
            digest = sha256(file)
            clouds = [read(file)] if entry.registered else read_stations(file)
        self.inputs[file] = {
            "path": self.shown(file),
            "sha256": digest,
            "points": sum(len(cloud) for cloud in clouds),
        }
        for station in range(len(clouds)):
            # Each raw cloud is let go as soon as it is filtered.
            cloud, clouds[station] = clouds[station], clouds[station].select(np.arange(0))
            station_of = station if not entry.registered else -1
            faults = faults_of(cloud)
            with self.clock.measure("filter"):
                filtered = self._filtered(cloud, entry.kind, digest, station_of)
            yield Source(
                file=file,
                station=station_of,
                filtered=filtered,
                points_in=len(cloud),
                removed=removed_sample(cloud, filtered.codes),
                notes=(
                    *(f"{file.name}: {note}" for note in (*cloud.notes, *faults)),
                    *filtered.notes,
                ),
            )

    def _filtered(self, cloud: Cloud, kind: Kind, digest: str, station: int) -> Filtered:
        params = self.recipe.lidar if kind == "lidar" else self.recipe.photogrammetry
        key = self.store.key(digest, station, kind, params)
        known = self.store.load(key, cloud)
        if known is not None:
            self.progress.note(f"{cloud.name}: filtered in an earlier run; not filtered again")
            return known
        filtered = filter_cloud(cloud, kind, self.recipe, self.progress)
        self.store.save(key, filtered)
        return filtered
