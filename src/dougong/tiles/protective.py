"""The protective rule of CWASF on tiles: points are tested tile by tile, things are seen as wholes.

Every point is tested by its surroundings and linked with others into groups of its tile (see
`things` for what becomes of these). What follows concerns the points in doubt only: what their
things say of them, and whether they lie in rows.
"""

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import are_within, corners_of
from dougong.filters import protective
from dougong.filters.curvature_weighted import CurvatureWeighted, protective_choice
from dougong.filters.groups import sizes_of
from dougong.filters.neighbourhood import build_index
from dougong.filters.protective import Doubtful, row_halo_m, rows_excused
from dougong.filters.selection import Reason, spare
from dougong.filters.statistical import nearest_distances, select_near
from dougong.filters.surroundings import HALO, SLACK, TESTS, Taken, test_part
from dougong.tiles import things
from dougong.tiles.cloud import POINTS, Arrays, Record, Tile, read_arrays, read_file
from dougong.tiles.parts import Job, asked_of, cloud_of, with_halo
from dougong.tiles.work import booked
from dougong.typing import Values

_FEW = tuple(f"few_{name}" for name in Doubtful._fields)


def eighth_within(job: Job) -> tuple[Arrays, Record]:
    """Distance to the eighth nearest other, infinite beyond a limit; known: the limit."""
    part = with_halo(job, job.known * SLACK)
    index = build_index(part.points)
    return {"largest": nearest_distances(index, TESTS, part.own, job.known)[1]}, {}


def test_points(job: Job) -> tuple[Arrays, Record]:
    """Test a tile's points; known: the step of `eighth_within`, the reach, the low corner.

    Leaves of every point what the tests say and its group, and tables of the groups, of the links
    across the border, and of the points that may go.
    """
    assert isinstance(job.params, CurvatureWeighted)
    step, reach, low = job.known
    part = with_halo(job, HALO * reach * SLACK, step=step, found="largest")
    eighth, tests = part.more["largest"], job.params.tests
    tested = test_part(part.points, eighth, part.own, reach, tests, np.array(low))
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
        **dict(zip(things.SIZES, sizes, strict=True)),
        **dict(zip(things.LINKS, links, strict=True)),
    }, {}


def hovering(job: Job) -> tuple[Arrays, Record]:
    """Judge a tile's points in doubt by what they are parts of in the whole cloud.

    Known: the steps of the tests and of the gaps, the files of the things and their gaps, the
    reach, the ease.
    """
    tested, measured, file, gaps_file, reach, ease = job.known
    few = _few_of(job, job.tile, tested)
    few = few._replace(margin=protective.eased(few.margin, few.reason, ease))
    groups = things.groups_of(job, job.tile, tested, read_file(job.folder, file))
    gap_m = read_file(job.folder, gaps_file)["gap_m"]
    gap_m = things.gaps_of_groups(job, groups, few.group, measured, gap_m, reach)
    few = protective.hovering(few, gap_m[few.group], groups.size_m[few.group])
    return {"margin": few.margin, "reason": few.reason}, {}


def _few_of(job: Job, tile: Tile, tested: str, judged: str = "") -> Doubtful:
    """Return the points in doubt of a tile, as the tests or a later step left them."""
    held = read_arrays(job.folder, tile, tested, *_FEW)
    few = Doubtful(*(held[name] for name in _FEW))
    return few._replace(**read_arrays(job.folder, tile, judged)) if judged else few


def judge(job: Job) -> tuple[Arrays, Record]:
    """Write down what was found; known: the steps of the tests and of `hovering`, reach and ease.

    The tests are of every point that is left, also where only those off the ground are judged.
    The second is None where there are too few points to judge any.
    """
    assert isinstance(job.params, CurvatureWeighted)
    margin, reason = _verdict(job, *job.known)
    asked = asked_of(job.folder, job.tile, job.before, job.among)
    is_judged = asked[asked_of(job.folder, job.tile, job.before, "left")]
    counts = None
    if job.params.solid_voxel_count is not None:
        stored = read_arrays(job.folder, job.tile, POINTS, "voxel_count", if_there=True)
        if stored:
            counts = stored["voxel_count"][asked]
    chosen = protective_choice(margin[is_judged], reason[is_judged], job.params, counts)
    return booked(job, chosen, Reason.CURVATURE_WEIGHTED)


def judge_spared(job: Job) -> tuple[Arrays, Record]:
    """Take by `Statistical` only what is taken here too.

    Known: the step of the mean distances and the cut, then as for `judge`.
    """
    means, cut, *found = job.known
    chosen = select_near(read_arrays(job.folder, job.tile, means, "mean")["mean"], cut)
    _, reason = _verdict(job, *found)
    return booked(job, spare(chosen, reason == Taken.KEPT), Reason.STATISTICAL)


def _verdict(
    job: Job, tested: str, judged: str | None, reach: float, ease: float
) -> tuple[Values, NDArray[np.uint8]]:
    """Return margin and reason (n,) of every point of the tile that is left."""
    found = read_arrays(job.folder, job.tile, tested, "margin", "few_place")
    margin = found["margin"]
    reason = np.full(len(margin), Taken.KEPT, np.uint8)
    if judged is None:
        margin[:] = 0.0
    else:
        few, own = _with_rows(job, tested, judged, reach)
        place = found["few_place"]
        # Points alone are in doubt.
        margin = margin / ease
        margin[place], reason[place] = rows_excused(few, own, reach), few.reason[:own]
        reason[margin <= 1.0] = Taken.KEPT
    return margin, reason


def _with_rows(job: Job, tested: str, judged: str, reach_m: float) -> tuple[Doubtful, int]:
    """Return a tile's points in doubt, how many, and after them those near that may be in rows."""
    own = _few_of(job, job.tile, tested, judged)
    parts = [own]
    would_go = own.points[own.margin > 1.0]
    if len(would_go):
        halo = row_halo_m(reach_m) * SLACK
        low, high = corners_of(would_go)
        for tile in cloud_of(job).near(job.tile, halo):
            few = _few_of(job, tile, tested, judged)
            is_near = (few.margin > 1.0) & are_within(few.points, low - halo, high + halo)
            parts.append(Doubtful._make(values[is_near] for values in few))
    return Doubtful._make(map(np.concatenate, zip(*parts, strict=True))), len(own.margin)
