"""Control points: adjusted by their sigmas, decide what clouds cannot, never hide a wrong pose."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong.cli import call
from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.formats import write
from dougong.pipeline.control import control_of, quality_document, quality_notes, read_control
from dougong.pipeline.pairs import HEADER
from dougong.registration import Prepare, Register, register
from dougong.registration.checks import check_error, level_of, reaches
from dougong.registration.control import adjust, local_control
from dougong.registration.control_solve import ControlPoints
from dougong.registration.covariance import displacement95
from dougong.registration.overlap import apply
from dougong.registration.result import FineResult
from registration_sites import SETTINGS, polygon, rectangle, site

MAP = np.array([5e5, 4e6, 100.0])
PLACES = np.array(
    [[-9, -6, 1], [12, -6, 2], [12, 2, 4], [-2, 9, 3], [18, 10, 1], [-20, -18, 0.5], [5, 5, 3.0]]
)


def motion(yaw_deg=33.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [yaw_deg, 0.2, -0.3], degrees=True).as_matrix()
    T[:3, 3] = [4.0, -7.0, 1.5]
    return T


def points(T, sigma=0.003, checks=2, seed=0, places=PLACES):
    """Return control points of places in the target; `T` takes the source to the target."""
    rng = np.random.default_rng(seed)
    back = np.linalg.inv(T)
    count = len(places)
    return ControlPoints(
        names=tuple(f"P{k}" for k in range(count)),
        source=apply(back, places) + rng.normal(0, sigma / 2**0.5, (count, 3)),
        target=places + rng.normal(0, sigma / 2**0.5, (count, 3)),
        sigma_m=np.full(count, sigma),
        is_check=np.arange(count) >= count - checks,
    )


def cloud_at_origin(xyz):
    return Cloud.from_points(np.vstack([xyz, [[0, 0, 0], [-30, -30, 0], [30, 30, 8]]]))


def local(control, T):
    """Return the control in the frames of two clouds that surround it."""
    source = cloud_at_origin(apply(np.linalg.inv(T), PLACES))
    target = cloud_at_origin(PLACES)
    return local_control(control, source, target), source, target


def spoilt(control, name, by):
    target = control.target.copy()
    target[control.names.index(name)] += by
    return ControlPoints(**{**{f: getattr(control, f) for f in FIELDS}, "target": target})


FIELDS = ("names", "source", "target", "sigma_m", "is_check", "where", "record")


def in_file(control, source, target):
    T = np.eye(4)
    T[:3, :3] = control.T_target_source[:3, :3]
    T[:3, 3] = control.T_target_source[:3, 3] + target.frame.origin
    T[:3, 3] -= T[:3, :3] @ source.frame.origin
    return T


def test_control_points_alone_give_the_pose():
    T = motion()
    control, source, target = local(points(T), T)
    off = apply(in_file(control, source, target), apply(np.linalg.inv(T), PLACES)) - PLACES
    assert np.linalg.norm(off, axis=1).max() < 0.01
    assert control.used.tolist() == [True] * 5 + [False] * 2


def test_exact_points_give_the_exact_pose_whatever_the_coordinates():
    T = motion()
    T[:3, 3] += MAP
    exact = points(T, sigma=0.005, places=PLACES + MAP)
    exact = ControlPoints(
        **{
            **{f: getattr(exact, f) for f in FIELDS},
            "target": PLACES + MAP,
            "source": apply(np.linalg.inv(T), PLACES + MAP),
        }
    )
    source = cloud_at_origin(exact.source)
    target = Cloud.from_points(cloud_at_origin(PLACES).xyz - [30, 30, 0] + MAP)
    found = local_control(exact, source, target)
    moved = apply(in_file(found, source, target), exact.source)
    np.testing.assert_allclose(moved, PLACES + MAP, atol=1e-8)


def test_the_power_of_the_test_for_bad_points_is_that_of_its_chance():
    """Three coordinates were held against the quantile of one: 6 sigma passed in half the cases."""
    T, sigma, draws = motion(), 0.003, 60
    alarms = sum(
        not local(points(T, sigma, checks=0, seed=seed), T)[0].used.all() for seed in range(draws)
    )
    assert alarms <= 3  # 7 points, 1 in 1000 each
    named = 0
    for seed in range(draws):
        bad = spoilt(points(T, sigma, checks=0, seed=seed), "P2", [0.0, 0.0, 8.0 * sigma])
        named += not local(bad, T)[0].used[2]
    assert named >= 0.95 * draws


@pytest.mark.parametrize("name", ["P0", "P3"])
def test_a_bad_point_is_found_and_left_out(name):
    T = motion()
    control, _, _ = local(spoilt(points(T), name, [0.0, 0.06, 0.0]), T)
    left = [n for n, used in zip(control.points.names, control.used, strict=True) if used]
    assert name not in left
    assert len(left) == 4


def test_sigmas_that_are_too_small_make_no_third_of_the_points_bad():
    """Three of six sound points were named bad, and the pose rested on the other three."""
    T = motion()
    for seed in range(5):
        sound = points(T, 0.004, checks=0, seed=seed)
        control, _, _ = local(replace(sound, sigma_m=np.full(len(sound), 5e-4)), T)
        assert control.used.all()


@pytest.mark.parametrize(("count", "bad"), [(5, 1), (5, 2), (7, 2), (7, 3)])
def test_blunders_are_found_as_long_as_they_are_few_enough(count, bad):
    T, found = motion(), 0
    for seed in range(20):
        control = points(T, checks=0, seed=seed, places=PLACES[:count])
        for name in control.names[:bad]:
            off = np.random.default_rng((seed, int(name[1:]))).normal(size=3)
            control = spoilt(control, name, off / np.linalg.norm(off))
        used = local(control, T)[0].used
        found += bool(used[bad:].all() and not used[:bad].any())
    assert found >= 16


def test_points_of_another_frame_are_refused():
    T = motion()
    far = points(T)
    far = ControlPoints(**{**{f: getattr(far, f) for f in FIELDS}, "target": far.target + MAP})
    with pytest.raises(InputError, match="outside"):
        local(far, T)


def fit(T, sigma_m=0.005, unobservable=()):
    """Return a fit of clouds whose pose is `T` with `sigma_m` along every axis."""
    return FineResult(
        T_target_source=T,
        method="point-to-plane",
        iterations=1,
        stopped="converged",
        fitness=1.0,
        inlier_rmse_m=0.01,
        max_distance_m=0.1,
        overlap_source=1.0,
        overlap_target=1.0,
        covariance=np.diag([(sigma_m / 15) ** 2] * 3 + [sigma_m**2] * 3),
        covariance_about=np.zeros(3),
        unobservable=unobservable,
    )


def shifted(T, by):
    moved = T.copy()
    moved[:3, 3] += by
    return moved


def test_the_adjustment_weighs_clouds_and_points_by_their_sigmas():
    T = motion()
    control, _, _ = local(points(T, sigma=1e-4), T)
    pose = control.T_target_source
    by_points = adjust(fit(shifted(pose, [0.004, 0, 0]), 0.005), control, 6)
    np.testing.assert_allclose(by_points.fine.T_target_source, pose, atol=2e-4)
    by_clouds = adjust(fit(shifted(pose, [2e-4, 0, 0]), 1e-6), control, 6)
    np.testing.assert_allclose(
        by_clouds.fine.T_target_source, shifted(pose, [2e-4, 0, 0]), atol=2e-5
    )
    assert np.trace(by_points.fine.covariance) < np.trace(fit(pose).covariance)


def test_one_point_among_good_clouds_is_named_when_it_is_mistaken():
    T = motion()
    few = points(T, checks=4)
    control, _, _ = local(spoilt(few, "P1", [0.0, 0.0, 0.2]), T)
    truth, _, _ = local(few, T)
    adjusted = adjust(fit(truth.T_target_source, 0.003), control, 6)
    assert adjusted.used.tolist() == [True, False, True] + [False] * 4


def test_clouds_that_contradict_all_points_do_not_throw_the_points_out():
    T = motion()
    control, _, _ = local(points(T, sigma=0.003), T)
    off = adjust(fit(shifted(control.T_target_source, [0.15, 0.1, 0]), 0.003), control, 6)
    assert off.used.sum() == 5
    assert off.p_value < 1e-6
    assert off.disagreement_m == pytest.approx(np.hypot(0.15, 0.1), abs=0.01)


def test_a_direction_that_the_clouds_leave_free_is_taken_from_the_points():
    T = motion()
    control, _, _ = local(points(T, sigma=0.002), T)
    slide = {"vector": [0, 0, 0, 1.0, 0, 0], "text": "slides along x"}
    pose = control.T_target_source
    adjusted = adjust(fit(shifted(pose, [0.3, 0, 0]), 0.001, (slide,)), control, 6)
    np.testing.assert_allclose(adjusted.fine.T_target_source[:3, 3], pose[:3, 3], atol=3e-3)
    assert adjusted.fine.unobservable == ()
    assert adjusted.p_value > 1e-3


def test_a_levelled_fit_stays_levelled():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 20, degrees=True).as_matrix()
    control, _, _ = local(points(T, sigma=0.01), T)
    adjusted = adjust(fit(T), control, 4)
    np.testing.assert_allclose(adjusted.fine.T_target_source[:2, 2], 0.0, atol=1e-12)


def test_check_error_follows_its_definition():
    rng = np.random.default_rng(1)
    residuals = rng.normal(0, 0.01, (400, 3))
    error = check_error(residuals)
    lengths = np.linalg.norm(residuals, axis=1)
    assert error["check_rmse_m"] == pytest.approx(np.sqrt(np.mean(lengths**2)))
    assert error["error95_m"] == pytest.approx(np.quantile(lengths, 0.95), rel=0.05)
    assert error["upper95_m"] > error["error95_m"]
    assert error["distribution_free95_m"] == lengths.max()
    few = check_error(residuals[:3])
    assert few["upper95_m"] > 1.5 * few["error95_m"]
    assert few["distribution_free95_m"] is None


@pytest.mark.parametrize(
    ("error", "level"),
    [(0.0009, "LOA50"), (0.004, "LOA40"), (0.015, "LOA30"), (0.049, "LOA20"), (0.1, "LOA10"),
     (0.2, None)],
)  # fmt: skip
def test_levels_of_accuracy(error, level):
    assert level_of(error) == level
    assert reaches(level, "LOA20") == (error <= 0.05)


def register_site(outline, control, **options):
    """Register a scan of a building without its surroundings onto a drone cloud of it."""
    T = motion()
    scan = site("lidar", 1, outline=outline, extras=False)
    drone = site("photogrammetry", 2, outline=outline, extras=False)
    return register(
        Cloud.from_points(apply(np.linalg.inv(T), scan)),
        Cloud.from_points(drone),
        Register(filtered=True, prepare=SETTINGS, **options),
        control=control,
    )


OCTAGON = polygon(8, 9.0)


@pytest.fixture(scope="module")
def undecided():
    return register_site(OCTAGON, None)


def test_control_points_decide_what_a_symmetric_building_leaves_open(undecided):
    assert undecided.status == "ambiguous"
    T = motion()
    found = register_site(OCTAGON, points(T))
    assert found.status == "ok", found.reason
    off = apply(found.matrix, apply(np.linalg.inv(T), PLACES)) - PLACES
    assert np.linalg.norm(off, axis=1).max() < 0.02
    assert found.checks["check_points"] == 2
    assert found.checks["check"]["check_rmse_m"] < 0.02
    assert found.checks["bad"] == []


def test_control_points_that_the_clouds_contradict_are_not_followed_in_silence():
    turned = motion(33.0 + 20.0)
    found = register_site(OCTAGON, points(turned))
    assert found.status != "ok", found.reason


def test_control_points_of_another_height_are_said_to_contradict_the_clouds():
    """It was asked whether the clouds show one place, and control points were recommended."""
    raised = motion()
    raised[2, 3] += 3.0
    found = register_site(polygon(4, 9.0) * [1.0, 0.6], points(raised))
    assert found.status != "ok"
    assert "the clouds contradict the control points: a pose elsewhere" in found.reason


def long_wall(seed, noise):
    """A wall that may be slid along itself, on rough grass."""
    rng = np.random.default_rng(seed)
    grass = rectangle(rng, [-40, -12, 0], [80, 0, 0], [0, 24, 0], 15.0)
    grass[:, 2] += rng.normal(0, 0.05, len(grass))
    faces = [rectangle(rng, [-40, y, 0], [80, 0, 0], [0, 0, 5], 25.0) for y in (-1.5, 1.5)]
    top = rectangle(rng, [-40, -1.5, 5], [80, 0, 0], [0, 3, 0], 25.0)
    xyz = np.vstack([grass[np.abs(grass[:, 1]) > 1.5], *faces, top])
    return xyz + rng.normal(0, noise, xyz.shape)


def test_control_points_decide_between_poses_a_hand_apart():
    """Within half a metre of them all poses were theirs, and undecided ones stayed so."""
    rng = np.random.default_rng(1)
    marks = np.array([[-35, -1.5, 4.0], [30, 1.5, 4.5], [0, -1.5, 1.0], [20, -1.5, 3.0]])
    control = ControlPoints(
        names=("A", "B", "C", "D"),
        source=marks + rng.normal(0, 0.003, marks.shape),
        target=marks,
        sigma_m=np.full(4, 0.005),
        is_check=np.zeros(4, bool),
    )
    scan, drone = long_wall(1, 0.004), long_wall(11, 0.012)
    settings = Register(prepare=Prepare(min_spacing_m=0.2))
    for control_given in (None, control):
        found = register(
            Cloud.from_points(scan), Cloud.from_points(drone), settings, control=control_given
        )
        assert (found.status == "ok") == (control_given is not None), found.reason
    off = apply(found.matrix, marks) - marks
    assert np.linalg.norm(off, axis=1).max() < 0.02


def test_only_check_points_change_no_pose(undecided):
    checks = points(motion(), checks=len(PLACES))
    found = register_site(OCTAGON, checks)
    assert found.status == "ambiguous"
    np.testing.assert_array_equal(found.matrix, undecided.matrix)
    assert found.checks["control_points"] == 0


def csv_of(path, control, cloud="scan", **changed):
    rows = [",".join(HEADER)]
    for k, name in enumerate(control.names):
        values = {
            "name": name,
            "cloud": cloud,
            **dict(zip(HEADER[2:5], control.source[k], strict=True)),
            **dict(zip(HEADER[5:8], control.target[k], strict=True)),
            "sigma_m": control.sigma_m[k],
            "role": "check" if control.is_check[k] else "control",
        }
        if k == 0:
            values |= changed
        rows.append(",".join(str(values[column]) for column in HEADER))
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_control_file_is_read_as_it_was_written(tmp_path):
    control = points(motion())
    read = control_of(read_control(csv_of(tmp_path / "c.csv", control)), "scan")
    assert read.names == control.names
    np.testing.assert_array_equal(read.source, control.source)
    np.testing.assert_array_equal(read.is_check, control.is_check)
    assert control_of(read_control(csv_of(tmp_path / "d.csv", control, "")), "any") is not None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"sigma_m": 0}, "point P0: sigma_m is 0"),
        ({"sigma_m": ""}, "sigma_m is empty; the standard deviation of a surveyed point"),
        ({"sigma_m": " "}, "pass places that were picked in the clouds to `register --pairs`"),
        ({"role": "chekc"}, "role is 'chekc'; control"),
        ({"source_x": "1,5"}, "decimal point"),
        ({"source_x": "one"}, "source_x is 'one'"),
        ({"name": "P1"}, "comes twice"),
        ({"name": ""}, "has no name"),
    ],
)
def test_a_wrong_control_file_is_one_sentence(tmp_path, changed, words):
    path = csv_of(tmp_path / "c.csv", points(motion()), **changed)
    with pytest.raises(InputError) as error:
        read_control(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_rows_without_a_cloud_are_not_lost_beside_rows_that_name_it():
    named = replace(points_of(4), names=("a", "b", "c", "d"))
    shared = replace(points_of(3), names=("e", "f", "g"), is_check=np.ones(3, bool))
    both = control_of({"scan": named, "": shared}, "scan-1", "scan")
    assert both is not None
    assert both.names == ("a", "b", "c", "d", "e", "f", "g")
    assert both.is_check.tolist() == [False] * 4 + [True] * 3
    assert both.source.shape == both.target.shape == (7, 3)
    twice = replace(shared, names=("e", "b", "g"))
    with pytest.raises(InputError, match="point b has a row for scan and one without"):
        control_of({"scan": named, "": twice}, "scan")


def points_of(count):
    at = np.arange(3.0 * count).reshape(count, 3)
    no = np.zeros(count, bool)
    return ControlPoints(names=(), source=at, target=at, sigma_m=at[:, 0] + 1.0, is_check=no)


def test_a_missing_column_is_named(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("name,cloud\nA,scan\n")
    with pytest.raises(InputError, match="no column source_x"):
        read_control(path)


def test_quality_needs_every_registration_checked_and_fine_enough():
    def document(name, level):
        checks = None if level is None else {"level": level, "check_points": 3}
        return {"source": name, "checks": checks}

    both = [document("a", "LOA30"), document("b", "LOA10")]
    assert quality_document("LOA20", both)["below_required"] == ["b"]
    assert quality_document("LOA10", both)["is_reached"] is True
    assert quality_document("LOA10", [*both, document("c", None)])["is_reached"] is False
    assert quality_document(None, both)["is_reached"] is None
    assert quality_document("LOA10", [])["is_reached"] is False, "nothing was registered"
    assert quality_notes(quality_document(None, both)) == []
    (said,) = quality_notes(quality_document("LOA20", [*both, document("c", None)]))
    assert said.endswith("NOT reached: check points of b prove LOA10; no check points tell of c")
    assert quality_notes(quality_document("LOA20", []))[0].endswith("nothing was registered")


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """A scan, a drone cloud and a control file, in a folder."""
    folder = tmp_path_factory.mktemp("survey")
    T = motion()
    T[:3, 3] += MAP
    scan = apply(np.linalg.inv(motion()), site("lidar", 1, per_m2=150.0))
    write(Cloud.from_points(scan), folder / "scan.laz")
    write(Cloud.from_points(site("photogrammetry", 2, per_m2=60.0) + MAP), folder / "drone.laz")
    csv_of(folder / "control.csv", points(T, places=PLACES + MAP))
    return folder


def test_register_writes_checks(survey, capsys):
    out = survey / "out"
    files = [str(survey / "scan.laz"), str(survey / "drone.laz")]
    files += ["--target-kind", "photogrammetry", "--filtered"]
    code = call(["register", *files, "--out", str(out), "--control", str(survey / "control.csv")])
    document = json.loads((out / "registration.json").read_text())
    assert code == 0, document["reason"]
    checks = document["checks"]
    assert checks["check"]["points"] == 2
    assert checks["level"] in ("LOA20", "LOA10")
    assert [p["name"] for p in checks["points"]] == [f"P{k}" for k in range(7)]
    assert "check RMSE" in capsys.readouterr().out


PROJECT = """
[[cloud]]
name = "scan"
kind = "lidar"
files = ["scan.laz"]
[[cloud]]
name = "drone"
kind = "photogrammetry"
files = ["drone.laz"]
[register.prepare]
min_spacing_m = 0.2
[quality]
"""


@pytest.mark.parametrize(("level", "code"), [("LOA10", 0), ("LOA50", 3)])
def test_a_project_says_whether_it_reaches_its_level(survey, tmp_path, level, code, capsys):
    project = survey / f"{level}.toml"
    project.write_text(PROJECT + f'control = "control.csv"\nrequired_level = "{level}"\n')
    assert call(["run", str(project), "--out", str(tmp_path / "out"), "--quiet"]) == code
    said = f"note: the required level of accuracy, {level}, is {'NOT ' if code else ''}reached"
    assert said in capsys.readouterr().out
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["status"] == "ok"
    assert result["quality"]["is_reached"] == (code == 0)


def test_control_points_of_a_misspelled_cloud_are_refused(survey, tmp_path, capsys):
    text = (survey / "control.csv").read_text()
    (survey / "typo.csv").write_text(text.replace("scan", "scanX"))
    project = survey / "typo.toml"
    project.write_text(PROJECT + 'control = "typo.csv"\n')
    assert call(["run", str(project), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "there is no cloud 'scanX'" in capsys.readouterr().err


def test_a_level_without_check_points_is_refused(tmp_path, capsys):
    write(Cloud.from_points(site("lidar", 1)), tmp_path / "scan.laz")
    project = tmp_path / "none.toml"
    cloud = '[[cloud]]\nname = "scan"\nkind = "lidar"\nfiles = ["scan.laz"]\n'
    project.write_text(cloud + '[quality]\nrequired_level = "LOA20"\n')
    assert call(["run", str(project), "--out", str(tmp_path / "out")]) == 2
    assert "no check points" in capsys.readouterr().err


def test_the_part_of_the_covariance_that_control_points_bring_is_known():
    T = motion()
    control, _, _ = local(points(T, sigma=0.004), T)
    pose = control.T_target_source
    by_points = adjust(fit(pose, 0.5), control, 6).fine
    np.testing.assert_allclose(by_points.covariance_of_control, by_points.covariance, rtol=1e-2)
    by_clouds = adjust(fit(pose, 1e-5), control, 6).fine
    assert np.trace(by_clouds.covariance_of_control) < 1e-4 * np.trace(by_clouds.covariance)


def test_few_blocks_say_nothing_of_what_control_points_fix():
    covariance = np.diag([2e-4**2] * 3 + [0.003**2] * 3)
    surface = np.random.default_rng(0).uniform(-20, 20, (300, 3))
    known = displacement95(covariance, np.zeros(3), surface, 14, 1.5, covariance)
    normal = displacement95(covariance, np.zeros(3), surface, 1_000_000, 1.0)
    assert known == pytest.approx(normal, rel=0.05)
    # Half from each: between the two, by their variances.
    both = displacement95(2 * covariance, np.zeros(3), surface, 1_000_000, 1.0, covariance)
    assert both == pytest.approx(2**0.5 * normal, rel=0.05)
