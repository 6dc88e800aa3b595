"""The things of a cloud in tiles: groups that no tile sees whole, and what hovers before them.

A group is known by its tile and its number there. Most are small and end within their tile: these
stay there. Only the others, which may be parts of something larger, are put together for the whole
cloud, so memory follows the things of a site and not its points, however much noise it has.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dougong._boxes import are_within, corners_of
from dougong.filters import protective
from dougong.filters.clusters import distance_to
from dougong.filters.groups import GROUP, PIECE, Sizes, are_pieces, joined, piece_links
from dougong.filters.neighbourhood import build_index
from dougong.filters.surroundings import SLACK
from dougong.tiles.cloud import Arrays, Record, Tile, read_arrays, read_file
from dougong.tiles.folder import Folder
from dougong.tiles.parts import Job, asked_points, cloud_of
from dougong.typing import Index, Mask, Points, Values

SIZES = tuple(f"groups_{name}" for name in Sizes._fields)
"""What the tests leave of the groups of a tile."""
LINKS = ("link_group", "link_tile", "link_place")
"""And of the links across its border: its group; the other's tile, and place there."""


class _Groups(NamedTuple):
    """What is known of the g groups of one tile."""

    thing: Index
    """(g,) what each is a part of in the whole cloud; -1: it ends within the tile."""
    is_large: Mask
    """(g,) whether that is large."""
    size_m: Values
    """(g,) how large that is."""


def open_groups(
    folder: Folder, tiles: Sequence[Tile], tested: str, reach_m: float
) -> tuple[Arrays, Record]:
    """Return the groups that are more than their tile can settle, those joined that links join.

    Which they are of each tile, ``open_group`` from ``open_start`` on; what each becomes a part
    of, ``into``; the `Sizes` of these. Recorded: the most points of a group that is not here.
    """
    linked = _linked(folder, tiles, tested)
    found: list[Index] = []
    tables: list[Sizes] = []
    most_beside = 0
    for number, tile in enumerate(tiles):
        sizes = _sizes_of(folder, tile, tested)
        is_open = (sizes.held > PIECE) | sizes.are_large(reach_m)
        for side in linked:
            is_open[side[side[:, 0] == number, 1]] = True
        most_beside = max(most_beside, int(sizes.held[~is_open].max(initial=0)))
        found.append(np.flatnonzero(is_open))
        tables.append(Sizes._make(values[is_open] for values in sizes))
    start = _starts([len(mine) for mine in found])
    one, other = (_numbers_of(side, found, start) for side in linked)
    into = joined(int(start[-1]), one, other)
    sizes = Sizes._make(map(np.concatenate, zip(*tables, strict=True))).merged(into)
    group = np.concatenate(found)
    arrays = {"open_start": start, "open_group": group, "into": into}
    return arrays | dict(zip(SIZES, sizes, strict=True)), {"most_beside": most_beside}


def _linked(folder: Folder, tiles: Sequence[Tile], tested: str) -> tuple[Index, Index]:
    """Return the groups at both ends of the links across borders: tile and number there (m, 2)."""
    tables = [read_arrays(folder, tile, tested, *LINKS) for tile in tiles]
    group, far_tile, far_place = (np.concatenate([t[name] for t in tables]) for name in LINKS)
    near_tile = np.repeat(np.arange(len(tiles)), [len(table["link_group"]) for table in tables])
    far_group = np.empty(len(far_place), np.int64)
    for number in np.unique(far_tile).tolist():
        rows = np.flatnonzero(far_tile == number)
        held = read_arrays(folder, tiles[number], tested, "group")["group"]
        far_group[rows] = held[far_place[rows]]
    both = np.unique(np.column_stack([near_tile, group, far_tile, far_group]), axis=0)
    return both[:, :2], both[:, 2:]


def _sizes_of(folder: Folder, tile: Tile, tested: str) -> Sizes:
    return _sizes_in(read_arrays(folder, tile, tested, *SIZES))


def _sizes_in(held: Arrays) -> Sizes:
    return Sizes._make(held[name] for name in SIZES)


def _numbers_of(side: Index, found: Sequence[Index], start: Index) -> Index:
    """Return the place among all open groups of those of (m, 2) tiles and numbers there."""
    number = np.empty(len(side), np.int64)
    for tile in np.unique(side[:, 0]).tolist():
        rows = np.flatnonzero(side[:, 0] == tile)
        number[rows] = start[tile] + np.searchsorted(found[tile], side[rows, 1])
    return number


def link_pieces(job: Job) -> tuple[Arrays, Record]:
    """Which groups come near as pieces of one thing, seen from a tile; known: tests, groups, reach.

    Every pair of near points is seen from the tile of either.
    """
    tested, file, reach = job.known
    held = read_file(job.folder, file)
    sizes = _sizes_in(held)
    is_piece = are_pieces(sizes, sizes.are_large(reach))

    def pieces_of(tile: Tile) -> tuple[Points, Index]:
        few = read_arrays(job.folder, tile, tested, "few_points", "few_group", "groups_held")
        group = _things_of(job, tile, held, len(few["groups_held"]))[few["few_group"]]
        chosen = (group >= 0) & is_piece[group]
        return few["few_points"][chosen], group[chosen]

    points, group = pieces_of(job.tile)
    if not len(points):
        return {"pairs": np.zeros((0, 2), np.int64)}, {}
    halo = float(sizes.gap_m[group].max()) * SLACK
    low, high = corners_of(points)
    parts = [(points, group)]
    for tile in cloud_of(job).near(job.tile, halo):
        points, group = pieces_of(tile)
        is_near = are_within(points, low - halo, high + halo)
        parts.append((points[is_near], group[is_near]))
    points, group = (np.concatenate(values) for values in zip(*parts, strict=True))
    return {"pairs": piece_links(points, group, sizes.gap_m[group])}, {}


def things_of(
    folder: Folder,
    tiles: Sequence[Tile],
    file: str,
    linked: str,
    reach_m: float,
    most_beside: int | None,
) -> Arrays:
    """Return the things of the whole cloud, by the groups in `file` and the pairs of `link_pieces`.

    most_beside: what was recorded with the groups; None where small things never count as large.
    """
    held = read_file(folder, file)
    sizes = _sizes_in(held)
    pairs = np.concatenate([read_arrays(folder, tile, linked, "pairs")["pairs"] for tile in tiles])
    into = joined(len(sizes.held), pairs[:, 0], pairs[:, 1])
    things = protective.things_of(sizes.merged(into), reach_m, most_beside)
    return {
        "open_start": held["open_start"],
        "open_group": held["open_group"],
        "into": into[held["into"]],
        **{name: np.asarray(value) for name, value in things._asdict().items()},
    }


def _things_of(job: Job, tile: Tile, held: Arrays, groups: int) -> Index:
    """Return what the groups of a tile are parts of (g,), -1 where they end within it."""
    number = cloud_of(job).tiles.index(tile)
    mine = slice(*held["open_start"][number : number + 2])
    thing = np.full(groups, -1, np.int64)
    thing[held["open_group"][mine]] = held["into"][mine]
    return thing


def groups_of(job: Job, tile: Tile, tested: str, held: Arrays) -> _Groups:
    """Return what is known of the groups of a tile, `held` being the things of the cloud."""
    sizes = _sizes_of(job.folder, tile, tested)
    thing = _things_of(job, tile, held, len(sizes.held))
    is_large, size_m = sizes.held == held["large_from"], sizes.size_m
    is_open = thing >= 0
    is_large[is_open] = held["are_large"][thing[is_open]]
    size_m[is_open] = held["size_m"][thing[is_open]]
    return _Groups(thing, is_large, size_m)


def gaps(job: Job) -> tuple[Arrays, Record]:
    """How far what hovers is from a tile's large things; known: the tests, the things, the reach.

    Of points in doubt: their ``tile`` and ``row`` there, their ``thing`` and the ``gap``.
    """
    tested, file, reach = job.known
    held = read_file(job.folder, file)
    mine = groups_of(job, job.tile, tested, held)
    chosen = mine.is_large[read_arrays(job.folder, job.tile, tested, "group")["group"]]
    rows = [np.zeros((0, 3), np.int64)]
    queries = [np.zeros((0, 3))]
    limit = GROUP * reach
    if chosen.any():
        own = asked_points(job, job.tile)
        low, high = corners_of(own[chosen])
        for number, tile in enumerate(cloud_of(job).tiles):
            if not job.tile.is_near(tile, limit * SLACK):
                continue
            few = read_arrays(job.folder, tile, tested, "few_points", "few_group")
            groups = mine if tile == job.tile else groups_of(job, tile, tested, held)
            group, points = few["few_group"], few["few_points"]
            is_asked = ~groups.is_large[group]
            is_asked &= are_within(points, low - limit * SLACK, high + limit * SLACK)
            row = np.flatnonzero(is_asked)
            rows.append(np.column_stack([np.full(len(row), number), row, groups.thing[group[row]]]))
            queries.append(points[row])
    asked = np.concatenate(queries)
    gap = np.full(len(asked), np.inf)
    if len(asked):
        index = build_index(own)
        gap = distance_to(index, chosen[index.order], asked, limit)
    is_found = gap < _farthest(reach)
    tile_row_thing = np.concatenate(rows)[is_found].T
    return dict(zip(("tile", "row", "thing"), tile_row_thing, strict=True)) | {
        "gap": gap[is_found]
    }, {}


def _farthest(reach_m: float) -> float:
    """Return the distance that stands for anything farther, rounded as measured ones are."""
    return float(np.sqrt((GROUP * reach_m) ** 2))


def gaps_of_things(
    folder: Folder, tiles: Sequence[Tile], file: str, measured: str, reach_m: float
) -> Arrays:
    """Return how far the things of the whole cloud are from the nearest large one (t,)."""
    things = read_file(folder, file, "are_large")
    gap_m = np.where(things["are_large"], 0.0, _farthest(reach_m))
    for tile in tiles:
        found = read_arrays(folder, tile, measured, "thing", "gap")
        is_open = found["thing"] >= 0
        np.minimum.at(gap_m, found["thing"][is_open], found["gap"][is_open])
    return {"gap_m": gap_m}


def gaps_of_groups(
    job: Job, groups: _Groups, group: Index, measured: str, gap_m: Values, reach_m: float
) -> Values:
    """Return how far the groups of a tile, or the things they are parts of, are from large ones.

    group (m,) of the points in doubt; gap_m (t,) of the things of the whole cloud.
    """
    cloud = cloud_of(job)
    number = cloud.tiles.index(job.tile)
    mine = np.full(len(groups.thing), _farthest(reach_m))
    # A little wider still: of two tiles each must find the other near where one does.
    halo = GROUP * reach_m * SLACK**2
    for tile in (job.tile, *cloud.near(job.tile, halo)):
        found = read_arrays(job.folder, tile, measured)
        is_mine = found["tile"] == number
        np.minimum.at(mine, group[found["row"][is_mine]], found["gap"][is_mine])
    is_open = groups.thing >= 0
    mine[is_open] = gap_m[groups.thing[is_open]]
    mine[groups.is_large] = 0.0
    return mine


def _starts(counts: Sequence[int]) -> Index:
    starts: Index = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return starts
