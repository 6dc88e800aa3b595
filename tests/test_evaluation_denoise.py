"""The denoising benchmark: its labels and distances are true, its figures mean what they say."""

import json

import numpy as np
import pytest

from dougong.evaluation import denoise, denoise_noise, denoise_real
from dougong.evaluation.denoise_shapes import SHAPES
from dougong.evaluation.mesh import FINE, SURFACE, VEGETATION, Tracer, join
from dougong.evaluation.solids import block, lathe


def sample(name="rods", pattern="scan", seed=2, density=400.0):
    shape = SHAPES[name](np.random.default_rng(seed))
    return denoise.make_sample(name, shape, density=density, pattern=pattern, seed=seed)


def test_distance_from_a_box_is_that_of_geometry():
    mesh = block((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    asked = np.array([[0, 0, 1.3], [0.9, 0, 0.5], [0.8, 0.9, 0.5], [0, 0, 0.4], [0.6, 0.6, 1.1]])
    expected = [0.3, 0.4, 0.5, 0.4, 0.03**0.5]
    found = denoise_noise.surface_distance(asked, mesh, np.random.default_rng(0))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("name", list(SHAPES))
@pytest.mark.parametrize("pattern", ["poisson", "gradient", "scan"])
def test_clean_points_lie_on_the_shape(name, pattern):
    rng = np.random.default_rng(1)
    shape = SHAPES[name](rng)
    points, labels, normals = denoise_noise.clean_points(
        shape, 150.0, pattern, rng, Tracer(shape.mesh)
    )
    chosen = rng.choice(len(points), min(200, len(points)), replace=False)
    off = denoise_noise.surface_distance(points[chosen], shape.mesh, rng)
    # Never too small; too large where the nearest triangle is not among those looked at.
    assert np.median(off) < 1e-9
    assert off.max() < 4e-3
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    assert set(labels.tolist()) <= {SURFACE, FINE, VEGETATION}
    assert (labels == FINE).any()


def test_a_sample_repeats_and_labels_what_it_adds():
    first, again = sample(), sample()
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.labels, again.labels)
    assert not np.array_equal(first.points[:50], sample(seed=3).points[:50])
    for label in denoise_noise.NOISE_KINDS:
        assert (first.labels == label).any()
    assert not first.is_separable[~first.is_noise].any()
    assert 0.3 < first.is_separable[first.is_noise].mean() < 1.0


def test_spacing_is_that_of_a_grid():
    x, z = np.meshgrid(np.arange(60) * 0.02, np.arange(60) * 0.02)
    grid = np.stack([x.ravel(), np.zeros(3600), z.ravel()], axis=1)
    spacing = denoise_noise.local_spacing(grid, np.array([[0.6, 0.3, 0.6]]))
    assert spacing[0] == pytest.approx(0.02, rel=0.1)


def test_rates_count_what_they_name():
    given = sample("tree")
    everything = denoise.rates(np.ones(len(given.points), bool), given)
    assert everything["noise"] == everything["separable"] == 0
    assert everything["feature"] == everything["flat"] == everything["vegetation"] == 100
    assert everything["worst_patches"] == 100
    perfect = denoise.rates(~given.is_noise, given)
    assert perfect["noise"] == perfect["separable"] == perfect["feature"] == 100
    assert perfect["separable_isolated"] == 100


def test_one_lost_patch_shows_in_the_worst_and_hardly_in_the_mean():
    given = sample("inscription", "poisson", density=4000.0)
    lost = (np.abs(given.points[:, [0, 2]] - 0.375) < 0.06).all(axis=1)
    row = denoise.rates(~lost, given)
    assert row["flat"] > 97
    assert row["worst_patches"] < 85


def test_the_curve_of_a_perfect_score_is_perfect():
    given = sample()
    points = denoise.curve(given.is_noise.astype(float), given)
    assert [p["separable"] for p in points] == [100.0] * len(denoise.LEVELS)
    blind = denoise.curve(np.arange(len(given.points), dtype=float), given)
    # A score that knows nothing takes as large a share of the noise as of the carving.
    assert blind[0]["separable"] == pytest.approx(10, abs=6)


def test_on_the_paper_s_facade_ours_takes_most_at_every_feature_retention():
    given = denoise.facade_sample(300.0, 0.02, 1)
    curves = {name: denoise.curve(score, given) for name, score in denoise.scores(given).items()}
    ours = curves.pop("CWASF protective")
    for level, mine in enumerate(ours):
        for name, other in curves.items():
            # At 99.9 % SOR is as good, at the price of more of the walls.
            slack = 1.0 if mine["feature"] < 99.8 else 3.0
            assert mine["separable"] >= other[level]["separable"] - slack, (name, level)
            assert mine["flat"] >= other[level]["flat"] - 0.1, (name, level)
    row = denoise.rates(denoise.METHODS[2].is_kept(given.points), given)
    assert denoise.METHODS[2].name == "CWASF protective"
    assert row["separable"] > 95
    assert row["feature"] > 97
    assert row["flat"] > 98
    assert row["worst_patches"] > 90


def test_the_study_is_plain_rows_and_ours_dominates_on_them():
    rows = denoise.study(("facade", "statue"), ("scan",), (1,))
    np.testing.assert_equal(json.loads(json.dumps(rows)), rows)
    curved = len(denoise.scores(denoise.facade_sample(60.0, 0.02, 1)))
    assert len(rows) == 2 * (len(denoise.METHODS) + curved)
    for name in ("facade, scan", "statue, scan"):
        mine = [row for row in rows if row["sample"] == name]
        at = {row["filter"]: row for row in mine if "noise" in row}
        ours, paper = at["CWASF protective"], at["CWASF paper"]
        assert ours["separable"] > paper["separable"] + 5
        assert ours["flat"] > paper["flat"] + 1
        curves = {row["filter"]: row["curve"] for row in mine if "curve" in row}
        level = denoise.LEVELS.index(0.97)
        best = max(c[level]["separable"] for n, c in curves.items() if n != "CWASF protective")
        assert curves["CWASF protective"][level]["separable"] >= best
    table = denoise.summary([r for r in rows if "noise" in r], "filter", ("noise", "vegetation"))
    first, second = (r["noise"] for r in rows if r["filter"] == "CWASF paper" and "noise" in r)
    assert first != second
    expected = (first + second) / 2, abs(first - second) / 2
    assert table["CWASF paper"][0] == pytest.approx(expected)
    assert np.isnan(table["CWASF paper"][1][0])


def test_the_study_is_a_command(tmp_path, capsys, monkeypatch):
    from dougong.cli import call
    from dougong.evaluation.studies import denoise as study

    monkeypatch.setattr(study, "QUICK_SHAPES", ("facade",))
    job = ["evaluate", "denoise", "--quick", "--out", str(tmp_path / "s"), "--json", "--quiet"]
    assert call(job) == 0
    said = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "s" / "denoise.json").read_text(encoding="utf-8"))
    assert said["table"] == written["table"]
    everything = {row["filter"]: row for row in written["table"] if row["sample"] == "all"}
    assert everything["CWASF protective"]["separable_isolated_percent"] > 95
    assert everything["CWASF protective"]["separable_clustered_percent"] > 80
    assert {row["sample"] for row in written["rows"]} == {"facade, scan"}
    table = (tmp_path / "s" / "denoise.csv").read_text(encoding="utf-8").splitlines()
    assert len(table) == 1 + len(said["table"])
    assert (tmp_path / "s" / "denoise.png").read_bytes().startswith(b"\x89PNG")
    assert call(job) == 2
    assert "--overwrite" in capsys.readouterr().out
    job[job.index("--quick")] = "--data=" + str(tmp_path / "none")
    assert call([*job, "--overwrite"]) == 2
    assert "is not a folder" in capsys.readouterr().out


def test_real_clouds_keep_their_points_and_know_their_noise():
    rng = np.random.default_rng(2)
    points = rng.random((4000, 3)) * [300.0, 300.0, 0.4]
    given = denoise_real.sample_of("plate", points, 3)
    assert (given.labels < 5).sum() == 4000
    assert 0.02 < given.is_noise.mean() < 0.05
    assert not given.is_separable[~given.is_noise].any()
    again = denoise_real.sample_of("plate", points, 3)
    np.testing.assert_array_equal(given.points, again.points)


def test_a_scanned_building_has_noise_of_every_kind_and_fine_points_where_it_is_curved():
    ball = lathe([(0.2 * np.sin(t), 1.5 - 0.2 * np.cos(t)) for t in np.linspace(0, np.pi, 13)], 24)
    front, far = block((0, 0, 0), (6.0, 3.0, 3.0)), block((90.0, 0, 0), (4.0, 4.0, 2.0))
    mesh = join([front, ball.turned(0.0, (2.0, -2.5, 0.0)), far])
    building = denoise_real.Building("house", "house.ply", False, 300.0, 20.0)
    given = denoise_real.scanned(building, mesh, 1)
    assert set(denoise_noise.NOISE_KINDS) <= set(given.labels.tolist())
    clean = given.points[~given.is_noise]
    # The neighbour 90 m away was left out, and what is seen is the front.
    assert clean[:, 0].max() < 10
    assert np.percentile(clean[:, 1], 95) < 0.1
    assert (given.labels == FINE).sum() == pytest.approx(0.25 * len(clean), rel=0.01)
    on_ball = clean[:, 1] < -2.0
    is_fine = given.labels[~given.is_noise] == FINE
    assert is_fine[on_ball].mean() > 0.95 > 0.3 > is_fine[~on_ball].mean()
