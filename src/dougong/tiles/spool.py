"""A cloud on disk in the order it was decoded, and its cutting into tiles."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud
from dougong.threads import ahead
from dougong.tiles.grid import Leaves, TileGrid, leaves_of
from dougong.tiles.store import CloudFile, RowFile, Rows

_NAME = "spool"


class Spool(CloudFile):
    """A cloud on disk in the order it was decoded."""

    def __init__(self, clouds: Iterable[Cloud], folder: Path) -> None:
        """Write `clouds`, at least one, which share one frame and one layout, to `folder`."""
        super().__init__(folder, _NAME)
        self.folder = folder
        for cloud in ahead(clouds):
            self.append(cloud)

    def cut(self, grid: TileGrid, most: int) -> Iterator[RowFile]:
        """Cut the cloud into tiles of at most `most` points, see `cut`. It stays as it is."""
        leaves = leaves_of(self.coordinates(), grid, most)
        tiles = _dealt(self._rows(), leaves, self.folder, is_thinned=False)
        return _halved(tiles, leaves, grid, most)

    def _rows(self) -> Iterator[Rows]:
        done = 0
        for xyz in self.coordinates():
            yield Rows(np.arange(done, done + len(xyz)), xyz)
            done += len(xyz)


def remove_spool(folder: Path) -> None:
    """Delete what a run that was killed left of a spool in `folder`."""
    for file in folder.glob(f"{_NAME}.*"):
        file.unlink()


def cut(file: RowFile, grid: TileGrid, most: int) -> Iterator[RowFile]:
    """Cut the rows of `file` into tiles of at most `most` points and yield them one by one.

    The file is used up. Tiles are yielded in the order of their coordinates; whoever takes one
    removes it. A tile of one voxel is never halved, however many points lie in it.
    """
    leaves = leaves_of(file.coordinates(), grid, most)
    tiles = _dealt(file.pieces(), leaves, file.path.parent, is_thinned=file.is_thinned)
    file.remove()
    yield from _halved(tiles, leaves, grid, most)


def _dealt(
    pieces: Iterator[Rows], leaves: Leaves, folder: Path, *, is_thinned: bool
) -> dict[int, RowFile]:
    """Write rows into a file in `folder` for each tile, by its place in `leaves.names`."""
    tiles: dict[int, RowFile] = {}
    for rows, parts in ahead((rows, leaves.part(rows.xyz)) for rows in pieces):
        for index, leaf in enumerate(parts.tiles.tolist()):
            chosen = parts.order[parts.starts[index] : parts.starts[index + 1]]
            if leaf not in tiles:
                name = "_".join(map(str, leaves.names[leaf]))
                tiles[leaf] = RowFile(folder / f"{name}.rows", is_thinned=is_thinned)
            tiles[leaf].append(rows.take(chosen))
    return tiles


def _halved(
    tiles: dict[int, RowFile], leaves: Leaves, grid: TileGrid, most: int
) -> Iterator[RowFile]:
    """Yield tiles in order, those of too many points cut again."""
    for leaf in sorted(tiles):
        level = leaves.names[leaf][0]
        if leaves.counts[leaf] > most and level > 0:
            yield from cut(tiles[leaf], grid._replace(level=level - 1), most)
        else:
            yield tiles[leaf]
