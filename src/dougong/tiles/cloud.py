"""A cloud on disk as tiles: what every tile holds, and what stages of work have said of it.

A tile is a few files in one folder: its points, then one file per finished stage, named by the
stage's key. A file that is there is whole, see `Folder`.
"""

import json
import os
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import corners_of
from dougong.tiles.folder import Folder
from dougong.typing import Points

Arrays = dict[str, NDArray[Any]]
Record = dict[str, Any]
POINTS = "points"
"""The stage that holds ``xyz``, ``row`` and, after a voxel grid, ``voxel_count``."""
INDEX = "tiles.json"
"""The file that says that the tiles are whole: it is written last."""
_RECORD = "record"
_HEADER_BYTES, _NAME_AND_EXTRA = 30, 26
"""Of a member of a zip file, and where it says how long its name and what follows are."""


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

    folder: Folder
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
        self.folder.write(INDEX, lambda file: file.write(json.dumps(told).encode()))


def load_tiles(folder: Folder) -> TiledCloud | None:
    """Return the tiles that an earlier run left whole in `folder`, or None."""
    try:
        with folder.open(INDEX) as file:
            told = json.load(file)
    except FileNotFoundError:
        return None
    tiles = (Tile(name, n, tuple(low), tuple(high)) for name, n, low, high in told["tiles"])
    return TiledCloud(folder, tuple(tiles), told["facts"])


def tile_of(name: str, xyz: Points) -> Tile:
    """Return the tile of at least one point."""
    low, high = corners_of(xyz)
    return Tile(name, len(xyz), tuple(low.tolist()), tuple(high.tolist()))


def name_of(tile: Tile, stage: str) -> str:
    """Return the name of the file of one stage of a tile."""
    return f"{tile.name}.{stage}.npz"


def read_arrays(
    folder: Folder, tile: Tile, stage: str, *names: str, if_there: bool = False
) -> Arrays:
    """Return the arrays `names` of a stage, or all of them."""
    return read_file(folder, name_of(tile, stage), *names, if_there=if_there)


def read_file(folder: Folder, file_name: str, *names: str, if_there: bool = False) -> Arrays:
    """Return the arrays `names` of a file, or all of them; `if_there`: those that it has."""
    with folder.open(file_name) as file, zipfile.ZipFile(file) as stored:
        there = {info.filename.removesuffix(".npy"): info for info in stored.infolist()}
        wanted = [name for name in names or there if name in there or not if_there]
        return {name: _read_member(file, there[name]) for name in wanted if name != _RECORD}


def _read_member(file: IO[bytes], info: zipfile.ZipInfo) -> NDArray[Any]:
    """Return an array of a file of arrays, straight from where it is stored.

    A third of the time that `zipfile` takes: tiles read their neighbours again and again.
    """
    assert info.compress_type == zipfile.ZIP_STORED
    file.seek(info.header_offset)
    header = file.read(_HEADER_BYTES)
    file.seek(sum(struct.unpack_from("<HH", header, _NAME_AND_EXTRA)), os.SEEK_CUR)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def read_record(folder: Folder, file_name: str) -> Record | None:
    """Return what a finished stage recorded; None where it is not finished."""
    try:
        # The record is the last of what is in the file, so its end is enough.
        with (
            folder.open_end(file_name) as file,
            zipfile.ZipFile(file) as stored,
            stored.open(f"{_RECORD}.npy") as member,
        ):
            record: Record = json.loads(str(np.lib.format.read_array(member)))
    except FileNotFoundError:
        return None
    return record


def write_arrays(
    folder: Folder, file_name: str, arrays: Mapping[str, NDArray[Any]], record: Record
) -> None:
    """Write a stage of a tile.

    Raises
    ------
    OutputError
        The disk is full or the folder cannot be written.
    """
    told: dict[str, Any] = {**arrays, _RECORD: np.array(json.dumps(record))}
    folder.write(file_name, lambda file: np.savez(file, **told))
