"""``--memory``: what fits is done in memory, a larger laser scan on tiles, the rest is refused."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from dougong.errors import InputError
from dougong.formats import describe

# Rounded up from measured peaks: a demo (1.0e6 + 0.6e6 points) 1.08 GB, the lidar recipe on 3e6
# points 0.83 GB. Base: libraries and the thinned clouds of the registration; per point of the
# largest cloud: records, coordinates, neighbours; of those that wait: records, coordinates.
BASE_BYTES = 800_000_000
BYTES_PER_POINT = 230
BYTES_PER_WAITING_POINT = 110
BYTES_PER_REDUCED_POINT = 130
"""Of a cloud on disk, as the registration and the distances hold it."""
_BYTES_PER_TILE_POINT = 250
LEAST_TILE_POINTS = 100_000
_MOST_TILE_POINTS = 20_000_000
"""Larger tiles gain nothing."""
_SHARE = 0.8


@dataclass(frozen=True, slots=True)
class Room:
    """How much memory a job may use."""

    bytes: float
    is_asked: bool
    """True: the user said so. False: most of what is free now, to choose a way, not to refuse."""

    @classmethod
    def of(cls, memory_bytes: int | None) -> "Room":
        """Return the room of ``--memory``, or four fifths of what is free on this machine."""
        if memory_bytes is not None:
            return cls(float(memory_bytes), True)
        return cls(_SHARE * _free_bytes(), False)

    def holds(self, points: int, waiting: int = 0) -> bool:
        """Say whether a cloud of `points` fits beside clouds of `waiting` points in all."""
        return estimated_bytes([points, waiting]) <= self.bytes

    def most_tile_points(self, waiting: int) -> int | None:
        """Return how many points a tile may have; None: there is no room for any."""
        left = max(self.bytes - tiles_bytes(0, waiting), 0.0)
        most = int(min(left / _BYTES_PER_TILE_POINT, _MOST_TILE_POINTS))
        return most if most >= LEAST_TILE_POINTS else None

    def holds_tiles(self, points: int, waiting: int) -> bool:
        """Say whether tiles that are there, `points` of which are worked on at once, fit.

        What is free changes by the moment: where nobody said how much, all of it may be used
        rather than the tiles be cut again.
        """
        most = self.bytes if self.is_asked else self.bytes / _SHARE
        return tiles_bytes(points, waiting) <= most

    def held_points(self, waiting: int = 0) -> int:
        """Return how many points of an output may be held beside those that wait."""
        return self.most_tile_points(waiting) or LEAST_TILE_POINTS

    def tile_points(self, points: int, waiting: int) -> int:
        """Return how many points a tile of a cloud of `points` may have.

        Raises
        ------
        InputError
            There is no room for any tile worth the name.
        """
        most = self.most_tile_points(waiting)
        if most is None:
            need = tiles_bytes(LEAST_TILE_POINTS, waiting)
            msg = (
                f"{points:,} points need about {need / 1e9:.1f} GB even on tiles, more than "
                f"{self.name()}. Raise it, or give the clouds one by one."
            )
            raise InputError(msg)
        return most

    def name(self) -> str:
        """Return the room in words, for messages."""
        asked = f"--memory {self.bytes / 1e9:.1f} GB"
        return asked if self.is_asked else f"the {self.bytes / 1e9:.1f} GB that may be used"


def tiles_bytes(tile_points: int, waiting: int = 0) -> int:
    """Return the memory that a cloud of any size needs on tiles of at most `tile_points`."""
    tile = tile_points * _BYTES_PER_TILE_POINT
    return BASE_BYTES + waiting * BYTES_PER_WAITING_POINT + tile


def registering_bytes(reduced: int, waiting: int) -> int:
    """Return the memory of a registration of clouds of `reduced` points beside those that wait."""
    return BASE_BYTES + waiting * BYTES_PER_WAITING_POINT + reduced * BYTES_PER_REDUCED_POINT


def _free_bytes() -> float:
    """Return how much memory is free on this machine; infinity where it does not tell."""
    try:
        with Path("/proc/meminfo").open(encoding="ascii") as file:
            lines = dict(line.split(":", 1) for line in file)
        return 1024.0 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        pass
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def estimated_bytes(points: Iterable[int]) -> int:
    """Return the memory a job needs that works on clouds of `points` in turn and keeps them."""
    counts = sorted(points, reverse=True)
    if not counts:
        return BASE_BYTES
    return BASE_BYTES + counts[0] * BYTES_PER_POINT + sum(counts[1:]) * BYTES_PER_WAITING_POINT


def refuse_whole_output(output: Path, points: int, room: Room) -> None:
    """Refuse a file of `points` that is written as a whole and needs more than ``--memory``.

    Raises
    ------
    InputError
        It does.
    """
    if output.suffix.lower() == ".e57" and room.is_asked and not room.holds(points):
        msg = (
            f"{output.name} is held as a whole while it is written: {points:,} points need about "
            f"{estimated_bytes([points]) / 1e9:.1f} GB, more than {room.name()}. Raise it, or "
            "write .laz or .ply, which are written in pieces."
        )
        raise InputError(msg)


def refuse_too_large(files: Iterable[Path], memory_bytes: int | None) -> None:
    """Refuse a job whose estimated need exceeds ``--memory``.

    Raises
    ------
    InputError
        It does.
    """
    if memory_bytes is None:
        return
    points = [describe(file).points for file in files]
    need = estimated_bytes(points)
    if need > memory_bytes:
        msg = (
            f"{sum(points):,} points need about {need / 1e9:.1f} GB, more than --memory "
            f"{memory_bytes / 1e9:.1f} GB. Raise it, or decimate the clouds first."
        )
        raise InputError(msg)
