"""Every filter on tiles keeps what it keeps on the whole cloud, to the bit."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dougong.cloud import Cloud
from dougong.errors import OutputError, TileError
from dougong.filters import FILTERS
from dougong.filters.neighbourhood import build_index
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.radius import Radius
from dougong.filters.selection import Reason, details_of
from dougong.filters.statistical import nearest_distances
from dougong.tiles import nearest, work
from dougong.tiles.cloud import load_tiles, read_arrays, read_file
from dougong.tiles.engine import Task, local_engine
from dougong.tiles.folder import LocalFolder
from dougong.tiles.partition import partition
from dougong.tiles.parts import Job
from dougong.tiles.spool import Spool
from dougong.tiles.stages import TileBench

JOBS = [
    ("low_outliers", {}),
    ("cloth_simulation", {}),
    ("radius", {"radius_m": 0.3}),
    ("statistical", {}),
    ("statistical", {"radius_m": 0.4}),
    ("curvature_weighted", {"reach_m": 0.5}),
    ("curvature_weighted", {}),
    ("curvature_weighted", {"rule": "paper"}),
    ("curvature_weighted", {"rule": "global"}),
    ("pass_through", {"x_m": (-5.0, 9.0)}),
]


def site(seed, count=3000):
    """Ground, a wall, a box, noise round them, a pair and a clump far off, points far away."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-12, 12, (count, 2)), 0.01 * rng.normal(size=count)])
    wall = np.column_stack(
        [rng.uniform(-9, 9, count), 0.01 * rng.normal(size=count), 4 * rng.random(count)]
    )
    noise = rng.uniform([-12, -12, -4], [12, 12, 9], (150, 3))
    clump = rng.normal([0, 11, 6], 0.1, (30, 3))
    far = rng.uniform(300, 900, (3, 3))
    points = np.vstack([ground, wall, noise, clump, far, wall[:20]])
    return np.round(points[rng.permutation(len(points))], 3)


def tiled(points, folder, most, grid=None, chunk=1111):
    whole = Cloud.from_points(points)
    pieces = (
        whole.select(np.arange(a, min(a + chunk, len(points))))
        for a in range(0, len(points), chunk)
    )
    return partition(Spool(pieces, folder), grid, LocalFolder(folder), most, most), whole


def of_filter(notes):
    """Return what a filter says itself: whole places that were taken are told by the pipeline."""
    return tuple(note for note in notes if not note.startswith("took most of the points in"))


def states(bench, points):
    """Return an array of the state over all points, by its name."""
    found = {}
    for tile in bench.cloud.tiles:
        row = read_arrays(bench.cloud.folder, tile, "points", "row")["row"]
        for name, values in read_arrays(bench.cloud.folder, tile, bench.state).items():
            if len(values) == len(row):
                found.setdefault(name, np.zeros(points, values.dtype))[row] = values
    return found


@pytest.mark.parametrize(("name", "values"), JOBS)
@pytest.mark.parametrize("most", [500, 10**9])
def test_tiles_judge_as_the_whole(tmp_path, name, values, most):
    spec = FILTERS[name]
    cloud, whole = tiled(site(0, 1500), tmp_path, most)
    assert (len(cloud.tiles) > 8) == (most < 1000)
    params = spec.params(**values)
    expected = spec.verb(whole.xyz, params)
    with local_engine() as engine:
        bench = TileBench(cloud, engine)
        done = bench.apply(name, params)
    found = states(bench, len(whole.xyz))
    np.testing.assert_array_equal(found["code"] == Reason.KEPT, expected.is_kept)
    assert of_filter(done.notes) == expected.notes
    assert (done.asked, done.taken) == (len(whole.xyz), int((~expected.is_kept).sum()))
    for detail, wanted in details_of(expected).items():
        np.testing.assert_array_equal(found[detail], wanted)
    if name == "cloth_simulation":
        np.testing.assert_array_equal(found["ground"], expected.attributes["ground_class"])
        np.testing.assert_array_equal(found["height"], expected.attributes["height_above_ground"])


@pytest.mark.parametrize("most", [2500, 10**9])
def test_a_thin_facade_is_spared_on_tiles_as_in_the_whole(tmp_path, most):
    rng = np.random.default_rng(7)
    ground = np.column_stack([rng.uniform(0, 12, (15_000, 2)), rng.normal(0, 0.01, 15_000)])
    facade = np.column_stack(
        [rng.uniform(0, 12, 1300), 6 + rng.normal(0, 0.01, 1300), rng.uniform(0, 10, 1300)]
    )
    strays = rng.uniform([0, 0, 0.6], [12, 12, 14], (30, 3))
    cloud, whole = tiled(np.vstack([ground, facade, strays]), tmp_path, most)
    params = FILTERS["statistical"].params(spare_places=True)
    expected = FILTERS["statistical"].verb(whole.xyz, params)
    assert "spare_places" in expected.notes[-1]
    with local_engine() as engine:
        bench = TileBench(cloud, engine)
        done = bench.apply("statistical", params)
    found = states(bench, len(whole.xyz))
    np.testing.assert_array_equal(found["code"] == Reason.KEPT, expected.is_kept)
    assert of_filter(done.notes) == expected.notes
    assert done.taken == int((~expected.is_kept).sum())
    for detail, wanted in details_of(expected).items():
        np.testing.assert_array_equal(found[detail], wanted)


def things():
    """What no tile sees whole: wires, chains in pieces, clumps and a stele before a wall."""
    rng = np.random.default_rng(5)
    wall = np.column_stack(
        [rng.uniform(0, 8, 3000), 0.003 * rng.normal(size=3000), rng.uniform(0, 5, 3000)]
    )
    wire = np.column_stack([np.arange(0, 8, 0.02), np.full(400, -1.5), np.full(400, 3.0)])
    links = [rng.normal([x, -1.0, 1.0], 0.02, (14, 3)) for x in np.arange(0.5, 3.5, 0.06)]
    clumps = [rng.normal(c, 0.05, (40, 3)) for c in rng.uniform([0, -2, 0], [8, -0.8, 5], (12, 3))]
    stele = np.column_stack(
        [rng.uniform(5, 5.4, 260), np.full(260, -1.2), rng.uniform(0.5, 1.3, 260)]
    )
    row = np.column_stack([np.arange(0.3, 7, 0.15), np.full(45, -0.9), np.full(45, 4.2)])
    strays = rng.uniform([0, -3, 0], [8, 3, 6], (60, 3))
    return np.vstack([wall, wire, *links, *clumps, stele, row, strays])


SMALL_ALONE = np.vstack(
    [
        np.random.default_rng(1).uniform([0, 0, 0], [0.4, 0.001, 0.4], (400, 3)),
        [[1.5, 0.4, 0.1], [0.2, -1.2, 0.3]],
    ]
)
SPARSE = np.random.default_rng(2).uniform([0, 0, 0], [60, 0.01, 60], (2500, 3))
HEAPED = np.vstack([site(4, 800), np.zeros((2500, 3))])
DENSE = np.random.default_rng(3).uniform([0, 0, 0], [0.3, 0.001, 0.3], (20_000, 3))

THICK = np.vstack(
    [
        things(),
        np.random.default_rng(4).normal([4, 0, 2.5], [2.0, 0.06, 1.2], (12_000, 3)),
    ]
)


@pytest.mark.parametrize(
    ("points", "reach_m", "most"),
    [
        (things(), None, 150),
        (THICK, None, 900),
        (things(), 0.2, 250),
        (SMALL_ALONE, None, 40),
        (SMALL_ALONE, 0.3, 40),
        (SPARSE, None, 150),
        (DENSE, None, 1500),
        (HEAPED, None, 600),
        (SMALL_ALONE[:8], None, 3),
        (SMALL_ALONE[:9], 0.5, 3),
    ],
)
def test_things_across_tiles_are_judged_as_wholes(tmp_path, points, reach_m, most):
    params = FILTERS["curvature_weighted"].params(reach_m=reach_m)
    cloud, whole = tiled(points, tmp_path, most)
    assert len(cloud.tiles) >= min(len(points) // most, 3)
    expected = FILTERS["curvature_weighted"].verb(whole.xyz, params)
    with local_engine() as engine:
        done = TileBench(cloud, engine)
        notes = done.apply("curvature_weighted", params).notes
    found = states(done, len(points))
    for detail, wanted in details_of(expected).items():
        np.testing.assert_array_equal(found[detail], wanted)
    np.testing.assert_array_equal(found["code"] == Reason.KEPT, expected.is_kept)
    assert of_filter(notes) == expected.notes
    assert any("scatter off" in note for note in notes) == (points is THICK)


def test_noise_stays_in_its_tiles(tmp_path):
    rng = np.random.default_rng(6)
    ground = np.column_stack([rng.uniform(0, 30, (20_000, 2)), 0.01 * rng.normal(size=20_000)])
    points = np.vstack([ground, rng.uniform([0, 0, -9], [30, 30, 9], (4000, 3))])
    cloud, _ = tiled(points, tmp_path, 1000)
    with local_engine() as engine:
        done = TileBench(cloud, engine).apply(
            "curvature_weighted", FILTERS["curvature_weighted"].params()
        )
    assert done.taken > 3000
    wholes = [name for name in cloud.folder.names() if name.startswith("whole.")]
    held = [values for name in wholes for values in read_file(cloud.folder, name).values()]
    # What is put together for the whole cloud follows its things and borders, not its noise.
    assert len(wholes) == 3
    assert max(len(np.atleast_1d(values)) for values in held) < done.taken / 10


def test_a_tile_of_few_points_does_not_read_the_site(tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(0, 60, (20_000, 2)), 0.01 * rng.normal(size=20_000)])
    high = np.array([[20.0, 20.0, 14.0], [44.0, 40.0, 18.0], [30.0, 28.0, 15.0]])
    points = np.vstack([ground, high])
    cloud, whole = tiled(points, tmp_path, 4000, OctreeVoxelGrid(voxel_m=0.001))
    read = {}
    with_halo = nearest.with_halo

    def counted(job, halo_m):
        part = with_halo(job, halo_m)
        read[part.own] = len(part.points)
        return part

    monkeypatch.setattr(nearest, "with_halo", counted)
    params = FILTERS["statistical"].params()
    with local_engine() as engine:
        bench = TileBench(cloud, engine)
        bench.apply("statistical", params)
    assert min(read) <= 3
    assert read[min(read)] < 5000
    expected = FILTERS["statistical"].verb(whole.xyz, params)
    found = states(bench, len(points))["code"] == Reason.KEPT
    np.testing.assert_array_equal(found, expected.is_kept)


@settings(max_examples=6, deadline=None, phases=[Phase.generate])
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 6, 20, 90]), st.sampled_from([1, 5, 64]))
def test_strays_find_their_nearest_in_other_tiles(tmp_path_factory, seed, k, few):
    rng = np.random.default_rng(seed)
    strays = rng.normal([0, 0, 0], rng.choice([1, 8, 60], (200, 1)), (200, 3))
    points = np.vstack([site(seed, 1500), strays, strays[:60], strays[:60]])
    cloud, whole = tiled(np.round(points, 3), tmp_path_factory.mktemp("tiles"), 700)
    params = FILTERS["statistical"].params(neighbours=k)
    wanted, _ = nearest_distances(build_index(whole.xyz), k, len(whole.xyz))
    unsure = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nearest, "_FEW", few)
        for tile in cloud.tiles:
            job = Job(cloud.folder, tile, "", params, asked=len(points), known=k)
            found, record = nearest.nearest(job)
            row = read_arrays(cloud.folder, tile, "points", "row")["row"]
            np.testing.assert_array_equal(found["mean"], wanted[row])
            unsure += record["unsure"]
    assert unsure > 20


RECIPE = [
    ("low_outliers", {}, "left"),
    ("cloth_simulation", {"class_threshold_m": 0.1}, "left"),
    ("curvature_weighted", {}, "off_ground"),
    ("pass_through", {"margin_above_top_m": 0.4, "margin_below_ground_m": 1.0}, "left"),
]


def kept_places(points, folder, most, steps=RECIPE):
    """Return the kept points, sorted, after a voxel grid and a whole recipe."""
    cloud, whole = tiled(points, folder, most, OctreeVoxelGrid(voxel_m=0.1))
    with local_engine() as engine:
        bench = TileBench(cloud, engine)
        for name, values, among in steps:
            bench.apply(name, FILTERS[name].params(**values), among)
    is_kept = states(bench, len(points))["code"] == Reason.KEPT
    rows = np.concatenate(
        [read_arrays(cloud.folder, t, "points", "row")["row"] for t in cloud.tiles]
    )
    chosen = np.zeros(len(points), bool)
    chosen[rows] = True
    kept = whole.xyz[is_kept & chosen] + whole.frame.origin
    return np.round(kept[np.lexsort(kept.T)], 3), [done.taken for done in bench.done]


@settings(max_examples=2, deadline=None, phases=[Phase.generate])
@given(st.integers(0, 2**32 - 1), st.integers(200, 2500))
def test_a_recipe_is_the_same_on_any_tiles_in_any_order(tmp_path_factory, seed, most):
    points = site(seed, 1500)
    order = np.random.default_rng(seed).permutation(len(points))
    whole, taken = kept_places(points, tmp_path_factory.mktemp("whole"), 10**9)
    again, same = kept_places(points[order], tmp_path_factory.mktemp("tiles"), most)
    assert taken == same
    np.testing.assert_array_equal(again, whole)


def test_finished_tiles_are_not_done_again(tmp_path, monkeypatch):
    from dougong.tiles import engine as engines

    kept_places(site(1), tmp_path, 1500)
    cloud = load_tiles(LocalFolder(tmp_path))
    done, perform = [], engines.perform
    monkeypatch.setattr(engines, "perform", lambda task: done.append(task.work) or perform(task))

    def again(steps):
        done.clear()
        with local_engine() as engine:
            bench = TileBench(cloud, engine)
            for name, values, among in steps:
                bench.apply(name, FILTERS[name].params(**values), among)
        return {work.__name__ for work in done}

    assert again(RECIPE) == set()
    changed = [*RECIPE[:3], ("pass_through", {"z_m": (0.0, 3.0)}, "left")]
    assert again(changed) == {"judge_pass_through"}


def test_a_failing_tile_is_tried_again_then_named_and_the_rest_completes(tmp_path, monkeypatch):
    cloud, _ = tiled(site(2), tmp_path, 1500)
    bad, tries, judge = cloud.tiles[1].name, [], work.judge_radius

    def failing(job):
        if job.tile.name == bad:
            tries.append(job)
            raise MemoryError("no room")
        return judge(job)

    monkeypatch.setattr(work, "judge_radius", failing)
    with local_engine() as engine, pytest.raises(TileError, match=rf"1 of .*{bad}.*no room"):
        TileBench(cloud, engine).apply("radius", Radius())
    assert len(tries) == 2
    monkeypatch.setattr(work, "judge_radius", judge)
    finished = len(list(tmp_path.glob("*.npz"))) - len(cloud.tiles)
    assert finished == len(cloud.tiles) - 1
    with local_engine() as engine:
        assert TileBench(cloud, engine).apply("radius", Radius()).asked == cloud.points


def test_who_does_not_see_the_tiles_is_told_where_to_put_them(tmp_path):
    cloud, _ = tiled(site(2), tmp_path, 1500)
    for path in tmp_path.glob("*.npz"):
        path.rename(path.with_suffix(".gone"))  # as on a machine that has no such folder
    job = Job(cloud.folder, cloud.tiles[0], "", Radius())
    task = Task(cloud.tiles[0].name, cloud.folder, "done.npz", work.judge_radius, job)
    with local_engine() as engine, pytest.raises(TileError, match=r"Every worker must see .*s3://"):
        engine.run([task])


def test_no_more_tiles_are_begun_once_the_disk_is_full(tmp_path, monkeypatch):
    cloud, _ = tiled(site(2), tmp_path, 200)
    tries = []

    def full(job):
        tries.append(job.tile)
        raise OutputError("The disk is full.")

    monkeypatch.setattr(work, "judge_radius", full)
    with local_engine() as engine, pytest.raises(OutputError, match="full"):
        TileBench(cloud, engine).apply("radius", Radius())
    assert len(cloud.tiles) > engine.width == len(tries)  # those that were begun at once
