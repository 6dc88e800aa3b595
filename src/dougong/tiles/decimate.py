"""The octree voxel grid on a cloud that never is in memory as a whole.

The cloud is written to disk as it is decoded, its extent is found, it is cut into tiles, and every
tile is decimated by itself. A tile is a node of the voxels' own octree, so no voxel lies in two
tiles and the kept points are those of the whole cloud.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.filters.octree_voxel_grid import (
    OctreeVoxelGrid,
    Root,
    octree_voxel_grid,
    root_cube_of,
)
from dougong.formats.faults import (
    copies_in,
    faults_in_words,
    points_beyond,
    robust_box,
    sample_step,
)
from dougong.tiles.grid import TileGrid, grid_for, part
from dougong.tiles.store import RowFile, Rows, concatenate, make_row_file
from dougong.typing import Index, Points


@dataclass(frozen=True, slots=True, kw_only=True)
class Decimated:
    """The kept points of a cloud of `points_in`, in its order."""

    cloud: Cloud
    row: Index
    """(k,) their places in the whole cloud."""
    voxel_count: NDArray[np.int32]
    """(k,) how many points each stands for."""
    points_in: int
    faults: tuple[str, ...]
    """Of the whole cloud, as `formats.faults_of` says them."""


class Spool:
    """A cloud on disk in the order it was decoded."""

    def __init__(self, clouds: Iterable[Cloud], folder: Path) -> None:
        """Write `clouds`, which share one frame and one layout, to `folder`."""
        self._make = make_row_file(folder)
        self.points = 0
        self._file: RowFile | None = None
        for cloud in clouds:
            if self._file is None:
                self.first = cloud.select(np.arange(0))
                self._file = self._make("spool", cloud.records.dtype)
            rows = np.arange(self.points, self.points + len(cloud))
            self._file.append(Rows(rows, cloud.xyz, cloud.records))
            self.points += len(cloud)

    def pieces(self) -> Iterator[Rows]:
        """Yield the cloud from its beginning."""
        assert self._file is not None
        return self._file.pieces()

    def blocks(self) -> Iterator[Points]:
        """Yield the coordinates from the beginning."""
        return (rows.xyz for rows in self.pieces())

    def cut(self, grid: TileGrid, most: int) -> Iterator[RowFile]:
        """Cut the cloud into tiles of at most `most` points and yield them one by one.

        The spool is used up. Tiles are yielded in the order of their coordinates; whoever takes one
        removes it. A tile of one voxel is never halved, however many points lie in it.
        """
        assert self._file is not None
        yield from self._cut(self._file, grid, most)

    def _cut(self, file: RowFile, grid: TileGrid, most: int) -> Iterator[RowFile]:
        tiles: dict[tuple[int, ...], RowFile] = {}
        counts: dict[tuple[int, ...], int] = {}
        for rows in file.pieces():
            parts = part(rows.xyz, grid)
            for index, key in enumerate(map(tuple, parts.tiles.tolist())):
                chosen = parts.order[parts.starts[index] : parts.starts[index + 1]]
                if key not in tiles:
                    name = "_".join(map(str, (grid.level, *key)))
                    tiles[key] = self._make(name, file.layout)
                tiles[key].append(rows.take(chosen))
                counts[key] = counts.get(key, 0) + len(chosen)
        file.remove()
        for key in sorted(tiles):
            if counts[key] > most and grid.level > 0:
                yield from self._cut(tiles[key], grid.children(), most)
            else:
                yield tiles[key]


def decimate(spool: Spool, params: OctreeVoxelGrid, tile_points: int) -> Decimated:
    """Return the kept points of a cloud on disk: those of `octree_voxel_grid` on the whole.

    Parameters
    ----------
    spool : Spool
        Used up.
    params : OctreeVoxelGrid
    tile_points : int
        At most so many points are worked on at once.

    Notes
    -----
    Memory: about 150 bytes per point of a tile, and the kept points. Disk: twice the records and
    32 bytes per point, less what compression saves.
    """
    root = root_cube_of(spool.blocks, spool.points, params)
    sample, far = _sample_and_far(spool)
    grid = grid_for(root.low, root.edge_m, root.voxel_m, spool.points, tile_points)
    kept: list[Rows] = []
    voxel_counts: list[NDArray[np.int32]] = []
    copies = 0
    for tile in spool.cut(grid, tile_points):
        rows = tile.read()
        tile.remove()
        copies += copies_in(rows.xyz)
        chosen, counts = _chosen(rows, params, root)
        kept.append(rows.take(chosen))
        voxel_counts.append(counts)
    rows = concatenate(kept)
    order = np.argsort(rows.row)
    rows = rows.take(order)
    return Decimated(
        cloud=replace(spool.first, xyz=rows.xyz, records=rows.records),
        row=rows.row,
        voxel_count=np.concatenate(voxel_counts)[order],
        points_in=spool.points,
        faults=faults_in_words(
            spool.first.frame, points=spool.points, copies=copies, far=far, sample=sample
        ),
    )


def _sample_and_far(spool: Spool) -> tuple[Points, int]:
    """Return the sample that shapes the cloud's box, and how many points lie far from it."""
    step = sample_step(spool.points)
    sample = np.concatenate([rows.xyz[rows.row % step == 0] for rows in spool.pieces()])
    box = robust_box(sample)
    return sample, sum(points_beyond(xyz, *box) for xyz in spool.blocks())


def _chosen(
    rows: Rows, params: OctreeVoxelGrid, root: Root
) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
    """Return which points of a tile are kept (n,), and how many each kept one stands for (k,)."""
    selection = octree_voxel_grid(rows.xyz, params, records=rows.records, root=root)
    counts: NDArray[np.int32] = selection.attributes["voxel_count"][selection.is_kept]
    return selection.is_kept, counts
