"""The recipes: order, books, ground kept, marks, and the same records out as in."""

import json
from itertools import pairwise

import numpy as np
import pytest

import dougong
from dougong.cli import call
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.selection import NOISE, Reason
from dougong.pipeline.filtering import filter_job
from dougong.pipeline.marking import marked
from dougong.pipeline.recipes import Recipe, filter_cloud
from dougong.pipeline.single import filter_name, filter_single, single_parameters
from dougong.pipeline.steps import GROUND

NO_POINT, SURFACE, LOW, FAR = 0, 1, 2, 3


def site(seed=0, offset=(500_000.0, 4_000_000.0, 30.0)):
    """Return a courtyard with a block on it, isolated outliers and a few points underground."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(0, 20, (20_000, 2)), rng.normal(0, 0.005, 20_000)])
    walls = [
        np.column_stack([np.full(3000, x), rng.uniform(8, 12, 3000), rng.uniform(0, 5, 3000)])
        for x in (8.0, 12.0)
    ]
    top = np.column_stack([rng.uniform(8, 12, (4000, 2)), np.full(4000, 5.0)])
    air = rng.uniform([1, 1, 2], [19, 19, 9], (150, 3))
    low = np.column_stack([rng.uniform(1, 19, (40, 2)), rng.uniform(-5, -1.5, 40)])
    points = np.vstack([floor, *walls, top, air, low])
    label = np.repeat([SURFACE, NO_POINT, LOW], [len(points) - 190, 150, 40]).astype(np.uint8)
    shuffle = rng.permutation(len(points))
    return Cloud.from_points(
        points[shuffle] + offset,
        name="site",
        label=label[shuffle],
        classification=np.full(len(points), 1, np.uint8),
    )


@pytest.fixture(scope="module")
def cloud():
    return site()


@pytest.fixture(scope="module")
def lidar(cloud):
    return filter_cloud(cloud, "lidar")


@pytest.fixture(scope="module")
def drone(cloud):
    return filter_cloud(cloud, "photogrammetry")


def test_marking_twice_keeps_the_classes_of_the_scan(cloud, lidar):
    once = marked(cloud, lidar.codes, lidar.ground_class)
    nothing = np.zeros(len(cloud), np.uint8)
    twice = marked(once, nothing, nothing)
    np.testing.assert_array_equal(twice.attribute("classification_in"), 1)


def test_gravestones_stand_on_the_ground():
    """Judged without the ground that they stand on they hovered: nine of ten points went."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-15, 15, (180_000, 2)), np.zeros(180_000)])
    sides = []
    for x, y in np.stack(np.meshgrid(np.arange(-12, 13, 4), np.arange(-12, 13, 4)), -1).reshape(
        -1, 2
    ):
        along, up = rng.random((2, 160))
        face = np.where(rng.random(160) < 0.5, 0.0, 0.1)
        sides.append(np.column_stack([x + 0.5 * along, y + face, 0.8 * up]))
    stones = np.vstack(sides)
    strays = rng.uniform([-15, -15, 0.15], [15, 15, 1.0], (300, 3))
    points = np.vstack([ground, stones, strays])
    points[:-300, :] += rng.normal(0, 0.002, (len(points) - 300, 3))
    codes = filter_cloud(Cloud.from_points(points), "lidar").codes
    is_kept, is_thinned = codes == Reason.KEPT, codes == Reason.DECIMATED
    mine = slice(len(ground), len(points) - 300)
    assert is_kept[mine][~is_thinned[mine]].mean() > 0.95
    assert is_kept[-300:].mean() < 0.05


def test_stages_run_in_the_order_of_the_method(lidar, drone):
    assert [stage.name for stage in lidar.stages] == [
        "octree_voxel_grid", "low_outliers", "cloth_simulation", "curvature_weighted",
        "pass_through",
    ]  # fmt: skip
    assert [stage.name for stage in drone.stages] == [
        "statistical", "low_outliers", "cloth_simulation", "pass_through",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["lidar", "drone"])
def test_the_books_balance(kind, cloud, request):
    filtered = request.getfixturevalue(kind)
    stages = filtered.stages
    assert stages[0].points_in == len(cloud)
    assert stages[-1].points_out == len(filtered.cloud)
    for before, after in pairwise(stages):
        assert before.points_out == after.points_in
    assert len(filtered.codes) == len(cloud)
    assert int((filtered.codes == Reason.KEPT).sum()) == len(filtered.cloud)
    for stage in stages:
        assert stage.reduction == 1 - stage.points_out / stage.points_in


@pytest.mark.parametrize("kind", ["lidar", "drone"])
def test_kept_points_are_the_inputs_own_records(kind, cloud, request):
    filtered = request.getfixturevalue(kind)
    kept = filtered.codes == Reason.KEPT
    np.testing.assert_array_equal(filtered.cloud.records, cloud.records[kept])
    np.testing.assert_array_equal(filtered.cloud.xyz, cloud.xyz[kept])


@pytest.mark.parametrize("kind", ["lidar", "drone"])
def test_noise_goes_and_ground_stays(kind, cloud, request):
    filtered = request.getfixturevalue(kind)
    label = cloud.records["label"]
    is_noise = np.isin(filtered.codes, [int(reason) for reason in NOISE])
    assert is_noise[label == LOW].all()
    assert is_noise[label == NO_POINT].mean() > 0.9
    floor = (label == SURFACE) & (cloud.xyz[:, 2] < cloud.xyz[label == SURFACE, 2].min() + 0.03)
    assert filtered.is_ground.sum() > 0.9 * (floor & (filtered.codes == 0)).sum()
    # What the cloth calls ground is taken by noise filters before it, never after it.
    after = [Reason.CURVATURE_WEIGHTED, Reason.PASS_THROUGH]
    assert not np.isin(filtered.codes[filtered.ground_class == GROUND], after).any()


def test_point_order_and_map_offset_change_nothing(cloud, lidar):
    order = np.random.default_rng(1).permutation(len(cloud))
    again = filter_cloud(cloud.select(order), "lidar")
    np.testing.assert_array_equal(again.codes, lidar.codes[order])
    moved = filter_cloud(site(offset=(500_064.0, 4_000_128.0, 30.0)), "lidar")
    np.testing.assert_array_equal(moved.codes, lidar.codes)


def test_marks_keep_every_point_and_undo(cloud, lidar):
    all_points = marked(cloud, lidar.codes, lidar.ground_class, lidar.details)
    assert len(all_points) == len(cloud)
    np.testing.assert_array_equal(all_points.attribute("classification_in"), 1)
    np.testing.assert_array_equal(all_points.attribute("dougong_reason"), lidar.codes)
    detail, margin = (all_points.attribute(name) for name in ("dougong_detail", "dougong_margin"))
    by_curvature = lidar.codes == Reason.CURVATURE_WEIGHTED
    np.testing.assert_array_equal(detail > 0, by_curvature)
    np.testing.assert_array_equal(margin > 1, by_curvature)
    assert (margin[lidar.codes == Reason.DECIMATED] == 0).all()
    assert np.isfinite(margin).all()
    new = all_points.attribute("classification")
    is_noise = np.isin(lidar.codes, [int(reason) for reason in NOISE])
    assert (new[is_noise] == 7).all()
    assert (new[lidar.codes == Reason.DECIMATED] == 1).all()
    kept = lidar.codes == Reason.KEPT
    assert ((new == 2) == (kept & (lidar.ground_class == GROUND))).all()


def test_each_sensor_keeps_its_own_threshold_when_another_field_is_set():
    recipe = Recipe.model_validate({"lidar": {"cloth_simulation": {"rigidness": 2}}})
    assert recipe.lidar.cloth_simulation.class_threshold_m == 0.09
    assert recipe.lidar.cloth_simulation.rigidness == 2
    assert Recipe().photogrammetry.cloth_simulation.class_threshold_m == 0.15


def test_recipes_survive_being_written_down_and_read_again():
    recipe = Recipe.model_validate({"lidar": {"octree_voxel_grid": {"depth": 14}}})
    assert Recipe.model_validate(recipe.model_dump(mode="json")) == recipe


def test_settings_reach_the_filters_and_an_alternative_replaces_the_default():
    job = filter_job("lidar", None, ["octree-voxel-grid.depth=9", "curvature_weighted.rule=paper"])
    assert job.params.octree_voxel_grid.depth == 9
    assert job.params.octree_voxel_grid.voxel_m is None
    with pytest.raises(InputError, match="--kind is missing"):
        filter_job(None, None, [])
    with pytest.raises(InputError, match="there is no filter 'statistical' here"):
        filter_job("lidar", None, ["statistical.multiplier=2"])
    with pytest.raises(InputError, match=r"octree_voxel_grid: voxel_m, got -1: .*greater than 0"):
        filter_job("lidar", None, ["octree_voxel_grid.voxel_m=-1"])


@pytest.mark.parametrize(
    "name", ["octree_voxel_grid", "cloth_simulation", "curvature_weighted", "statistical",
             "radius", "pass_through", "low_outliers"],
)  # fmt: skip
def test_every_filter_runs_alone(name, cloud):
    values = {"radius": {"radius_m": 0.5, "min_neighbours": 3}}.get(name, {})
    filtered = filter_single(cloud, name, single_parameters(name, values))
    assert [stage.name for stage in filtered.stages] == [name]
    assert 0 < len(filtered.cloud) <= len(cloud)


def test_unknown_filters_get_a_suggestion():
    assert filter_name("Curvature-Weighted") == "curvature_weighted"
    with pytest.raises(InputError, match="did you mean 'statistical'"):
        filter_name("statistcal")


def test_crops_are_given_in_the_files_own_coordinates(cloud):
    params = single_parameters("pass_through", {"x_m": [500_000, 500_010]})
    filtered = filter_single(cloud, "pass_through", params)
    assert filtered.cloud.records["x"].max() <= 500_010
    assert 0.3 * len(cloud) < len(filtered.cloud) < 0.7 * len(cloud)


def test_heights_above_ground_work_alone(cloud):
    params = single_parameters("pass_through", {"height_m": [1.0, 100.0]})
    filtered = filter_single(cloud, "pass_through", params)
    assert 4000 < len(filtered.cloud) < 11_000


def test_a_filter_that_takes_everything_says_which(cloud):
    params = single_parameters("pass_through", {"x_m": [0, 1]})
    with pytest.raises(InputError, match=r"kept none of .*pass_through 0"):
        filter_single(cloud, "pass_through", params)


class TestCommand:
    """``dougong filter`` on files."""

    @pytest.fixture
    def path(self, cloud, tmp_path):
        path = tmp_path / "site.laz"
        dougong.write(cloud, path)
        return path

    def run(self, capsys, *tokens):
        code = call(["filter", *map(str, tokens), "--quiet", "--json"])
        return code, json.loads(capsys.readouterr().out)

    def test_writes_the_cloud_and_its_books(self, path, tmp_path, capsys):
        out = tmp_path / "clean.laz"
        code, document = self.run(capsys, path, out, "--kind", "lidar")
        assert code == 0
        assert json.loads((tmp_path / "clean.laz.json").read_text()) == document
        clean = dougong.read(out)
        assert len(clean) == document["points_written"] == document["points_kept"]
        assert sum(row["points"] for row in document["reasons"].values()) == document["points_in"]
        assert document["parameters"]["cloth_simulation"]["class_threshold_m"] == 0.09
        assert len(document["input"]["sha256"]) == 64
        raw = dougong.read(path).records
        assert np.isin(clean.records, raw).all()

    def test_does_not_overwrite_unless_told(self, path, tmp_path, capsys):
        out = tmp_path / "clean.laz"
        out.write_text("mine")
        code, document = self.run(capsys, path, out, "--only", "statistical")
        assert (code, out.read_text()) == (2, "mine")
        assert "exists already" in document["error"]["message"]
        code, _ = self.run(capsys, path, out, "--only", "statistical", "--overwrite")
        assert code == 0
        assert len(dougong.read(out)) > 10_000

    def test_mark_keeps_every_point(self, path, tmp_path, capsys):
        out = tmp_path / "marked.laz"
        code, document = self.run(capsys, path, out, "--kind", "photogrammetry", "--mark")
        result = dougong.read(out)
        assert code == 0
        assert len(result) == document["points_in"]
        assert {2, 7} <= set(result.attribute("classification").tolist())
        assert (result.attribute("classification_in") == 1).all()

    def test_the_cloth_alone_classifies(self, path, tmp_path, capsys):
        out = tmp_path / "ground.laz"
        code, document = self.run(capsys, path, out, "--only", "cloth-simulation")
        result = dougong.read(out)
        assert (code, len(result)) == (0, document["points_in"])
        assert (result.attribute("classification") == 2).sum() == document["ground_points"] > 15_000
        only = tmp_path / "only.laz"
        code, document = self.run(
            capsys,
            path,
            only,
            "--only",
            "cloth_simulation",
            "--set",
            "cloth_simulation.keep=ground",
        )
        assert len(dougong.read(only)) == document["ground_points"]

    def test_a_bad_suffix_is_refused_before_the_work(self, path, tmp_path, capsys):
        code, document = self.run(capsys, path, tmp_path / "a.xyz", "--kind", "lidar")
        assert code == 2
        assert ".xyz" in document["error"]["message"]


def test_a_filter_that_takes_much_for_noise_is_doubted(cloud, lidar):
    """A cloud too sparse for the radii loses half of itself: not silently."""
    assert not any("far more than surveys hold" in note for note in lidar.notes)
    sparse = cloud.select(np.arange(len(cloud)) % 40 == 0)
    params = single_parameters("curvature_weighted", {"rule": "paper"})
    found = filter_single(sparse, "curvature_weighted", params)
    (note,) = [note for note in found.notes if "far more than surveys hold" in note]
    taken = len(sparse) - len(found.cloud)
    assert f"took {taken} of {len(sparse)} points" in note
    ours = filter_single(sparse, "curvature_weighted", single_parameters("curvature_weighted", {}))
    assert not any("far more than surveys hold" in note for note in ours.notes)


def test_what_is_said_of_marked_points(cloud, tmp_path, capsys):
    """All are written, and the reduction is said to be what the filters would do."""
    dougong.write(cloud, tmp_path / "site.laz")
    job = ["filter", str(tmp_path / "site.laz"), str(tmp_path / "out.laz")]
    assert call([*job, "--only", "statistical", "--mark", "--quiet"]) == 0
    said = capsys.readouterr().out
    kept = json.loads((tmp_path / "out.laz.json").read_text())["points_kept"]
    assert f"all {len(cloud):,} points with their marks, {kept:,} of them kept" in said
