"""The protective rule of CWASF on tiles: points are tested tile by tile, things are seen as wholes.

Every point is tested by its surroundings and linked with others into groups of its tile. Groups
that links join across borders become one, and pieces of one thing; every tile then says how near
its large things come to what hovers. The points in doubt are few and are settled all at once.
"""

from collections.abc import Sequence

import numpy as np

from dougong._boxes import are_within, corners_of
from dougong.filters import protective
from dougong.filters.clusters import distance_to
from dougong.filters.curvature_weighted import CurvatureWeighted, protective_choice
from dougong.filters.groups import GROUP, Sizes, joined, sizes_of
from dougong.filters.neighbourhood import build_index
from dougong.filters.protective import Doubtful, Things
from dougong.filters.selection import Reason
from dougong.filters.statistical import nearest_distances
from dougong.filters.surroundings import HALO, TESTS, Taken, test_part
from dougong.tiles.cloud import POINTS, Arrays, Record, Tile, read_arrays, read_file
from dougong.tiles.folder import Folder
from dougong.tiles.parts import Job, asked_of, asked_points, cloud_of, with_halo
from dougong.tiles.work import booked
from dougong.typing import Index

_SLACK = 1.0 + 1e-9
"""What rounding may do to a border, and more."""
_LINKS = ("link_group", "link_tile", "link_place")
_GROUPS = tuple(f"groups_{name}" for name in Sizes._fields)
_FEW = tuple(f"few_{name}" for name in Doubtful._fields)


def eighth_within(job: Job) -> tuple[Arrays, Record]:
    """Distance to the eighth nearest other, infinite beyond a limit; known: the limit."""
    part = with_halo(job, job.known * _SLACK)
    index = build_index(part.points)
    return {"largest": nearest_distances(index, TESTS, part.own, job.known)[1]}, {}


def test_points(job: Job) -> tuple[Arrays, Record]:
    """Test a tile's points; known: the step of `eighth_within`, and the reach.

    Leaves of every point what the tests say and its group, and tables of the groups, of the links
    across the border, and of the points that may go.
    """
    assert isinstance(job.params, CurvatureWeighted)
    step, reach = job.known
    part = with_halo(job, HALO * reach * _SLACK, step=step, found="largest")
    tested = test_part(part.points, part.more["largest"], part.own, reach, job.params.tests)
    own = part.points[: part.own]
    sizes = sizes_of(own, tested.spacing_m, tested.curvature, tested.group)
    place = protective.doubtful_of(tested, sizes.are_large(reach))
    few = protective.doubtful(own, tested, place)
    group, halo = tested.across.T
    links = (group, part.tile[halo], part.place[halo])
    return {
        "margin": tested.margin,
        "spacing": tested.spacing_m,
        "curvature": tested.curvature,
        "group": tested.group.astype(np.int32),
        "few_place": place,
        **dict(zip(_FEW, few, strict=True)),
        **dict(zip(_GROUPS, sizes, strict=True)),
        **dict(zip(_LINKS, links, strict=True)),
    }, {}


def things_of(
    folder: Folder, tiles: Sequence[Tile], step: str, reach_m: float, *, is_whole: bool
) -> Arrays:
    """Return the things of a whole cloud and the points in doubt, by what `test_points` left."""
    tables = [read_arrays(folder, t, step, *_GROUPS, *_FEW, *_LINKS) for t in tiles]
    group_start = _starts([len(table["groups_held"]) for table in tables])
    few_start = _starts([len(table["few_group"]) for table in tables])
    for table, start in zip(tables, group_start, strict=False):
        table["few_group"] += start
        table["link_group"] += start
    sizes = Sizes(*(np.concatenate([table[name] for table in tables]) for name in _GROUPS))
    few = Doubtful(*(np.concatenate([table[name] for table in tables]) for name in _FEW))
    links = [np.concatenate([table[name] for table in tables]) for name in _LINKS]
    other = _groups_at(folder, tiles, step, links[1], links[2], group_start)
    into = joined(len(sizes.held), links[0], other)
    few = few._replace(group=into[few.group])
    things = protective.things_of(few, sizes.merged(into), reach_m, is_whole=is_whole)
    return {
        **dict(zip(_FEW, few, strict=True)),
        **things._asdict(),
        "hovers": ~things.are_large[things.into[few.group]],
        "is_large": things.are_large[things.into[into]],
        "few_start": few_start,
        "group_start": group_start,
    }


def _groups_at(
    folder: Folder, tiles: Sequence[Tile], step: str, tile: Index, place: Index, start: Index
) -> Index:
    """Return the groups (m,) of the points at places (m,) of tiles (m,), given by their numbers."""
    groups = np.empty(len(place), np.int64)
    for number in np.unique(tile).tolist():
        rows = np.flatnonzero(tile == number)
        held = read_arrays(folder, tiles[number], step, "group")["group"]
        groups[rows] = start[number] + held[place[rows]]
    return groups


def gaps(job: Job) -> tuple[Arrays, Record]:
    """How far points that hover are from a tile's large things; known: steps, things and reach."""
    step, file, reach = job.known
    held = read_file(job.folder, file, "few_points", "hovers", "is_large", "group_start")
    queries = held["few_points"][held["hovers"]]
    number = cloud_of(job).tiles.index(job.tile)
    is_large = held["is_large"][held["group_start"][number] :]
    chosen = is_large[read_arrays(job.folder, job.tile, step, "group")["group"]]
    if not chosen.any() or not len(queries):
        return {"row": np.zeros(0, np.int64), "gap": np.zeros(0)}, {}
    own = asked_points(job, job.tile)
    low, high = corners_of(own[chosen])
    limit = GROUP * reach
    row = np.flatnonzero(are_within(queries, low - limit * _SLACK, high + limit * _SLACK))
    if not len(row):
        return {"row": row, "gap": np.zeros(0)}, {}
    index = build_index(own)
    return {"row": row, "gap": distance_to(index, chosen[index.order], queries[row], limit)}, {}


def settled(folder: Folder, tiles: Sequence[Tile], step: str, file: str, reach_m: float) -> Arrays:
    """Return what becomes of the points in doubt, by the gaps that the tiles found."""
    held = read_file(folder, file)
    few = Doubtful(*(held[name] for name in _FEW))
    things = Things(*(held[name] for name in Things._fields))
    gap = np.full(np.count_nonzero(held["hovers"]), np.sqrt((GROUP * reach_m) ** 2))
    for tile in tiles:
        found = read_arrays(folder, tile, step)
        gap[found["row"]] = np.minimum(gap[found["row"]], found["gap"])
    margin, reason = protective.settle(few, things, gap, reach_m)
    return {"margin": margin, "reason": reason, "start": held["few_start"]}


def judge(job: Job) -> tuple[Arrays, Record]:
    """Write down what was found; known: the step of the tests, and what was settled or None."""
    assert isinstance(job.params, CurvatureWeighted)
    step, file = job.known
    found = read_arrays(job.folder, job.tile, step, "margin", "few_place")
    margin = found["margin"]
    reason = np.full(len(margin), Taken.KEPT, np.uint8)
    if file is None:
        margin[:] = 0.0
    else:
        few = read_file(job.folder, file)
        number = cloud_of(job).tiles.index(job.tile)
        mine = slice(*few["start"][number : number + 2])
        margin[found["few_place"]] = few["margin"][mine]
        reason[found["few_place"]] = few["reason"][mine]
        reason[margin <= 1.0] = Taken.KEPT
    counts = None
    if job.params.solid_voxel_count is not None:
        stored = read_arrays(job.folder, job.tile, POINTS, "voxel_count", if_there=True)
        if stored:
            asked = asked_of(job.folder, job.tile, job.before, job.among)
            counts = stored["voxel_count"][asked]
    chosen = protective_choice(margin, reason, job.params, counts)
    return booked(job, chosen, Reason.CURVATURE_WEIGHTED)


def _starts(counts: Sequence[int]) -> Index:
    starts: Index = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return starts
