"""A cloud on disk in the order it was decoded, and its cutting into tiles."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud
from dougong.tiles.grid import TileGrid, leaves_of
from dougong.tiles.store import RowFile, RowFileMaker, Rows, make_row_file
from dougong.typing import Points


class Spool:
    """A cloud on disk in the order it was decoded."""

    def __init__(self, clouds: Iterable[Cloud], folder: Path) -> None:
        """Write `clouds`, which share one frame and one layout, to `folder`."""
        self.make = make_row_file(folder)
        self.points = 0
        self._file: RowFile | None = None
        for cloud in clouds:
            if self._file is None:
                self.first = cloud.select(np.arange(0))
                self._file = self.make("spool", cloud.records.dtype)
            rows = np.arange(self.points, self.points + len(cloud))
            self._file.append(Rows(rows, cloud.xyz, cloud.records))
            self.points += len(cloud)

    def pieces(self) -> Iterator[Rows]:
        """Yield the cloud from its beginning."""
        assert self._file is not None
        return self._file.pieces()

    def blocks(self) -> Iterator[Points]:
        """Yield the coordinates from the beginning."""
        assert self._file is not None
        return self._file.coordinates()

    def cut(self, grid: TileGrid, most: int) -> Iterator[RowFile]:
        """Cut the cloud into tiles, see `cut`. The spool is used up."""
        assert self._file is not None
        yield from cut(self._file, grid, most, self.make)


def cut(file: RowFile, grid: TileGrid, most: int, make: RowFileMaker) -> Iterator[RowFile]:
    """Cut the rows of `file` into tiles of at most `most` points and yield them one by one.

    The file is used up. Tiles are yielded in the order of their coordinates; whoever takes one
    removes it. A tile of one voxel is never halved, however many points lie in it.
    """
    leaves = leaves_of(file.coordinates(), grid, most)
    tiles: dict[int, RowFile] = {}
    for rows in file.pieces():
        parts = leaves.part(rows.xyz)
        for index, leaf in enumerate(parts.tiles.tolist()):
            chosen = parts.order[parts.starts[index] : parts.starts[index + 1]]
            if leaf not in tiles:
                name = "_".join(map(str, leaves.names[leaf]))
                tiles[leaf] = make(name, file.layout)
            tiles[leaf].append(rows.take(chosen))
    file.remove()
    for leaf in sorted(tiles):
        level = leaves.names[leaf][0]
        if leaves.counts[leaf] > most and level > 0:
            yield from cut(tiles[leaf], grid._replace(level=level - 1), most, make)
        else:
            yield tiles[leaf]
