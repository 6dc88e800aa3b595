"""What moves as one in a project, after its filters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud, Frame
from dougong.errors import FrameError
from dougong.formats import is_same_crs
from dougong.pipeline.books import Tally
from dougong.pipeline.kept import Kept
from dougong.pipeline.reduced import Reduced, most_points, reduced
from dougong.pipeline.steps import StageCount
from dougong.registration.free_scale import ScaleSearch
from dougong.typing import Kind


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One file (or one station in it) after its filters."""

    file: Path
    station: int
    kept: Kept
    tally: Tally
    stages: tuple[StageCount, ...]
    points_in: int
    notes: tuple[str, ...]

    removed: Cloud
    """A sample of what the filters took out, see `removed_sample`."""

    @property
    def is_scan(self) -> bool:
        """True: one scan of an E57 or PTX file, which moves by itself."""
        return self.station >= 0 and hasattr(self.kept.first.header, "station")


@dataclass(frozen=True, slots=True, kw_only=True)
class Mover:
    """What moves as one: a cloud of the project, or one station of it."""

    name: str
    entry: str
    kind: Kind
    sources: tuple[Source, ...]
    scale: ScaleSearch | None = None
    """What brought its clouds to metres; None: their unit was known."""

    @property
    def frame(self) -> Frame:
        """The frame of its first file."""
        return self.sources[0].kept.frame

    @property
    def points_in(self) -> int:
        """Points before the filters."""
        return sum(source.points_in for source in self.sources)

    @property
    def points_out(self) -> int:
        """Points after the filters."""
        return sum(source.kept.points for source in self.sources)

    def reduced(self, most: int) -> Reduced:
        """Return all points as one cloud for the registration, see `pipeline.reduced`.

        Of several files coordinates only.

        Raises
        ------
        FrameError
            The files differ in coordinate system or unit.
        """
        kept = [source.kept for source in self.sources]
        if len(kept) == 1:
            found = reduced(kept[0].pieces, self.points_out, most)
            return replace(found, cloud=replace(found.cloud, name=self.name))
        require_one_system([one.first for one in kept], self.name)

        def pieces() -> Iterator[Cloud]:
            for one in kept:
                yield from (bare(piece, self.frame, self.name) for piece in one.pieces())

        return reduced(pieces, self.points_out, most)


class ReducedClouds:
    """The clouds of a project as the registration works on them: each is reduced once."""

    def __init__(self, movers: Sequence[Mover]) -> None:
        self._movers = {mover.name: mover for mover in movers}
        self._most = most_points(len(movers))
        self._held: dict[str, Reduced] = {}

    def of(self, name: str) -> Reduced:
        """Return what the cloud of a mover was reduced to."""
        if name not in self._held:
            self._held[name] = self._movers[name].reduced(self._most)
        return self._held[name]


def bare(cloud: Cloud, frame: Frame, name: str) -> Cloud:
    """Return the coordinates of a cloud in `frame`, which has its system."""
    records = np.zeros(len(cloud), dtype=[("file", "<u2")])
    return Cloud(xyz=cloud.rebased(frame.origin).xyz, records=records, frame=frame, name=name)


def require_one_system(clouds: list[Cloud], name: str) -> None:
    """Refuse files of one cloud that do not go together.

    Raises
    ------
    FrameError
        They differ in coordinate system or unit.
    """
    first = clouds[0].frame
    for cloud in clouds[1:]:
        if not is_same_crs(cloud.frame.crs, first.crs) or cloud.frame.unit_m != first.unit_m:
            msg = (
                f"cloud {name!r}: {clouds[0].name} and {cloud.name} differ in coordinate "
                "system or unit. Reproject one, or list them as clouds of their own."
            )
            raise FrameError(msg)
