"""From a cloud on disk to its tiles, through the octree voxel grid where one is asked for.

A tile is a node of the voxels' own octree, so no voxel lies in two tiles and the kept points are
those of the whole cloud.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from dougong.cloud import Records
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, Root, octree_voxel_grid, root_cube_of
from dougong.formats.faults import (
    copies_in,
    faults_in_words,
    points_beyond,
    sample_step,
    wide_box,
)
from dougong.threads import ahead
from dougong.tiles.cloud import POINTS, Arrays, Tile, TiledCloud, name_of, tile_of, write_arrays
from dougong.tiles.folder import Folder
from dougong.tiles.grid import grid_for
from dougong.tiles.spool import Spool, cut
from dougong.tiles.store import RowFile, Rows
from dougong.typing import Index, Points


def partition(
    spool: Spool,
    params: OctreeVoxelGrid | None,
    folder: Folder,
    most: int,
    most_kept: int,
    told: Mapping[str, Any] | None = None,
) -> TiledCloud:
    """Return a cloud as tiles in `folder`: those of its points that `octree_voxel_grid` keeps.

    Parameters
    ----------
    spool : Spool
        What grows by appending stays on its disk.
    params : OctreeVoxelGrid or None
        None keeps every point.
    folder : Folder
    most : int
        At most so many points are decimated at once.
    most_kept : int
        At most so many points make a tile of the result.
    told : mapping, optional
        Plain data that is kept with the tiles.

    Notes
    -----
    Memory: about 150 bytes per point of a tile, and 32 of the next one, which is read meanwhile.
    Disk: 32 bytes per point, twice 36 per kept one.
    """
    root = root_cube_of(spool.coordinates, spool.points, params or OctreeVoxelGrid())
    sample, far = _sample_and_far(spool)
    kept = RowFile(spool.folder / "kept.rows", is_thinned=True)
    copies = points = 0
    grid = grid_for(root.low, root.edge_m, root.voxel_m, spool.points, most)
    for rows, same in ahead(_with_copies(spool.cut(grid, most))):
        copies += same
        chosen = _chosen(rows, spool, params, root)
        kept.append(chosen)
        points += len(chosen.row)
    grid = grid_for(root.low, root.edge_m, root.voxel_m, points, most_kept)
    tiles = tuple(
        _saved(name, rows, folder, is_decimated=params is not None)
        for name, rows in ahead(_named(cut(kept, grid, most_kept)))
    )
    assert spool.first is not None
    faults = faults_in_words(
        spool.first.frame, points=spool.points, copies=copies, far=far, sample=sample
    )
    facts = {
        "points_in": spool.points,
        "faults": faults,
        "origin": spool.first.frame.origin.tolist(),
    }
    tiled = TiledCloud(folder, tiles, {**(told or {}), **facts})
    tiled.save()
    return tiled


def _with_copies(parts: Iterator[RowFile]) -> Iterator[tuple[Rows, int]]:
    """Yield what parts hold, and how many of its points lie exactly on another one."""
    for _, rows in _named(parts):
        yield rows, copies_in(rows.xyz)


def _named(parts: Iterator[RowFile]) -> Iterator[tuple[str, Rows]]:
    """Yield the names of parts and what they hold; their files are removed."""
    for part in parts:
        rows = part.read()
        part.remove()
        yield part.path.stem, rows


def _sample_and_far(spool: Spool) -> tuple[Points, int]:
    """Return the sample that shapes the cloud's box, and how many points lie far from it."""
    step, start = sample_step(spool.points), 0
    parts = []
    for xyz in spool.coordinates():
        parts.append(xyz[-start % step :: step].copy())
        start += len(xyz)
    sample = np.concatenate(parts)
    box = wide_box(sample)
    return sample, sum(points_beyond(xyz, *box) for xyz in spool.coordinates())


def _chosen(rows: Rows, spool: Spool, params: OctreeVoxelGrid | None, root: Root) -> Rows:
    """Return the kept points of a tile, with how many each stands for."""
    if params is None:
        return rows._replace(stands_for=np.ones(len(rows.row), np.int32))

    def records_at(places: Index) -> Records:
        return spool.records_at(rows.row[places])

    selection = octree_voxel_grid(rows.xyz, params, records=records_at, root=root)
    return rows._replace(stands_for=selection.attributes["voxel_count"]).take(selection.is_kept)


def _saved(name: str, rows: Rows, folder: Folder, *, is_decimated: bool) -> Tile:
    """Write a tile in the order of the cloud, and return it."""
    rows = rows.take(np.argsort(rows.row))
    tile = tile_of(name, rows.xyz)
    arrays: Arrays = {"xyz": rows.xyz, "row": rows.row}
    if is_decimated:
        assert rows.stands_for is not None
        arrays["voxel_count"] = rows.stands_for
    write_arrays(folder, name_of(tile, POINTS), arrays, {})
    return tile
