"""A cloud on disk as tiles: what every tile holds, and what stages of work have said of it.

A tile is a few files in one folder: its points, then one file per finished stage, named by the
stage's key. Files are written beside and renamed, so a file that is there is whole.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import corners_of
from dougong.errors import OutputError
from dougong.typing import Points

Arrays = dict[str, NDArray[Any]]
Record = dict[str, Any]
POINTS = "points"
"""The stage that holds ``xyz``, ``row`` and, after a voxel grid, ``voxel_count``."""
INDEX = "tiles.json"
"""The file that says that the tiles are whole: it is written last."""
_RECORD = "record"


class Tile(NamedTuple):
    """One tile: its name, its points, and the box that they span (local metres)."""

    name: str
    points: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def is_near(self, other: "Tile", distance_m: float) -> bool:
        """Say whether points of `other` may lie within `distance_m` of this one's, per axis."""
        return all(
            low - distance_m <= far and near <= high + distance_m
            for low, high, near, far in zip(self.low, self.high, other.low, other.high, strict=True)
        )


@dataclass(frozen=True, slots=True)
class TiledCloud:
    """The tiles of one cloud in `folder`."""

    folder: Path
    tiles: tuple[Tile, ...]
    facts: Mapping[str, Any]
    """What was learnt while the cloud was cut, as plain data."""

    @property
    def points(self) -> int:
        """Points of all tiles."""
        return sum(tile.points for tile in self.tiles)

    def blocks(self) -> Iterator[Points]:
        """Yield the coordinates tile by tile."""
        return (read_arrays(self.folder, tile, POINTS, "xyz")["xyz"] for tile in self.tiles)

    def near(self, tile: Tile, distance_m: float) -> tuple[Tile, ...]:
        """Return the other tiles with points that may lie within `distance_m` of the tile's."""
        return tuple(t for t in self.tiles if t != tile and tile.is_near(t, distance_m))

    def save(self) -> None:
        """Write down that the tiles are whole."""
        told = {"tiles": self.tiles, "facts": dict(self.facts)}
        _replace(self.folder / INDEX, lambda part: part.write_text(json.dumps(told), "utf-8"))


def load_tiles(folder: Path) -> TiledCloud | None:
    """Return the tiles that an earlier run left whole in `folder`, or None."""
    index = folder / INDEX
    if not index.is_file():
        return None
    told = json.loads(index.read_text(encoding="utf-8"))
    tiles = (Tile(name, n, tuple(low), tuple(high)) for name, n, low, high in told["tiles"])
    return TiledCloud(folder, tuple(tiles), told["facts"])


def tile_of(name: str, xyz: Points) -> Tile:
    """Return the tile of at least one point."""
    low, high = corners_of(xyz)
    return Tile(name, len(xyz), tuple(low.tolist()), tuple(high.tolist()))


def path_of(folder: Path, tile: Tile, stage: str) -> Path:
    """Return the file of one stage of a tile."""
    return folder / f"{tile.name}.{stage}.npz"


def read_arrays(folder: Path, tile: Tile, stage: str, *names: str) -> Arrays:
    """Return the arrays `names` of a stage, or all of them."""
    with np.load(path_of(folder, tile, stage)) as stored:
        return {name: stored[name] for name in names or stored.files if name != _RECORD}


def read_record(path: Path) -> Record | None:
    """Return what a finished stage of a tile recorded; None where it is not finished."""
    if not path.is_file():
        return None
    with np.load(path) as stored:
        record: Record = json.loads(str(stored[_RECORD]))
    return record


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], record: Record) -> None:
    """Write a stage of a tile.

    Raises
    ------
    OutputError
        The disk is full or the folder cannot be written.
    """
    told: dict[str, Any] = {**arrays, _RECORD: np.array(json.dumps(record))}

    def write(part: Path) -> None:
        with part.open("wb") as file:
            np.savez(file, **told)

    _replace(path, write)


def _replace(path: Path, write: Callable[[Path], Any]) -> None:
    part = path.with_name(f"{path.name}.part-{os.getpid()}")
    try:
        write(part)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        msg = (
            f"{path.parent} could not be written: {error.strerror or error}. "
            "Free some space or pass another --work."
        )
        raise OutputError(msg) from error
