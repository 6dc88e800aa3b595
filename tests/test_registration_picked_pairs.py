"""Picked pairs: what they are refused for, what they propose, and that the proof decides."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong.cloud import Cloud
from dougong.errors import InputError, RegistrationError
from dougong.pipeline.control import read_control
from dougong.pipeline.pairs import HEADER, read_pairs
from dougong.registration import Register, register
from dougong.registration.picked_pairs import PickedPairs, bad_pair, fit_pairs, fit_rigid, starts_of
from registration_sites import SETTINGS, motion, moved, polygon, pose_error, rectangle, walls

MAP = np.array([5e5, 4e6, 100.0])
TRUTH = motion(40.0, shift=[*(MAP[:2] + [12.0, -7.0]), 101.0])
TOWERS = ((0.0, 0.0, 6, 7.0, 5.0), (14.0, 9.0, 5, 3.0, 3.0), (-16.0, 11.0, 7, 4.0, 6.0))
"""x, y, number of sides, radius, height."""


def outline(x, y, sides, radius):
    return polygon(sides, radius) + [x, y]


PLACES = np.array(
    [[*outline(*tower[:4])[corner], height] for tower, corner, height in
     zip((*TOWERS, TOWERS[0], TOWERS[2]), (0, 1, 2, 3, 5), (0.0, 3.0, 6.0, 5.0, 0.0), strict=True)]
)  # fmt: skip
"""Corners of the towers, which both surveys show."""


def survey(kind, towers=TOWERS, seed=0):
    """Return points of some towers as one sensor sees them."""
    rng = np.random.default_rng(seed)
    parts = [rectangle(rng, [-25, -25, 0], [50, 0, 0], [0, 50, 0], 10.0)]
    for *place, height in towers:
        parts.append(walls(rng, outline(*place), 0, height, 40.0))
        if kind == "photogrammetry":
            corner = np.array(place[:2]) - 0.7 * place[3]
            side = 1.4 * place[3]
            parts.append(rectangle(rng, [*corner, height], [side, 0, 0], [0, side, 0], 40.0))
    points = np.vstack(parts)
    points += rng.normal(0, 0.003 if kind == "lidar" else 0.01, points.shape)
    return np.vstack([points, PLACES])


def pairs(source, target, name="pairs.csv"):
    names = tuple(f"p{index}" for index in range(1, len(source) + 1))
    return PickedPairs(names=names, source=source, target=target, where=name)


@pytest.fixture(scope="module")
def clouds():
    source = Cloud.from_points(survey("lidar"), name="scan")
    target = Cloud.from_points(moved(survey("photogrammetry", seed=1), TRUTH), name="drone")
    return source, target


def test_the_rigid_fit_finds_a_motion_and_never_a_reflection():
    rng = np.random.default_rng(0)
    for yaw in (0.0, 33.0, 180.0):
        points = rng.normal(0, 20, (3, 3))
        truth = motion(yaw, shift=(500.0, 4e3, 7.0), tilt_deg=4.0)
        assert np.abs(fit_rigid(points, moved(points, truth)) - truth).max() < 1e-9
    flat = np.array([[0.0, 0, 0], [5, 0, 0], [0, 3, 0], [4, 4, 0]])
    found = fit_rigid(flat, flat * [-1.0, 1.0, 1.0])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_the_pair_that_the_others_contradict_is_named_from_four_on():
    rng = np.random.default_rng(1)
    target = moved(PLACES, TRUTH) + rng.normal(0, 0.01, PLACES.shape)
    assert bad_pair(PLACES, target) is None
    target[3] += [2.0, -1.0, 0.0]
    assert bad_pair(PLACES, target) == 3
    assert bad_pair(PLACES[1:4], target[1:4]) is None


def test_the_starts_leave_out_the_bad_pair(clouds):
    target = moved(PLACES, TRUTH)
    target[1] = moved(PLACES, TRUTH)[3]
    fit = fit_pairs(pairs(PLACES, target), *clouds)
    assert fit.bad == 1
    source, drone = clouds
    local = TRUTH.copy()
    local[:3, 3] += TRUTH[:3, :3] @ source.frame.origin - drone.frame.origin
    assert np.abs(starts_of(fit)[0] - local).max() < 1e-6


def far(points, index, shift):
    changed = points.copy()
    changed[index] = changed[index] + shift
    return changed


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda s, t: (s[:2], t[:2]), r"holds 2 pairs; at least 3"),
        (lambda s, t: (s[:0], t[:0]), r"holds 0 pairs"),
        (lambda s, t: (s[[0, 0, 0]], t[[0, 0, 0]]), r"on one line \(or in one place\)"),
        (lambda s, t: (far(s, 1, 300.0), t), r"source point of p2 lies 5\d\d.* from the nearest"),
        (lambda s, t: (s, far(t, 2, [0, 0, 40.0])), r"target point of p3 lies .* of drone"),
        (lambda s, t: (t, s), r"other way round.*lie in drone"),
    ],
)
def test_pairs_that_fix_no_pose_are_refused_in_a_sentence(clouds, make, said):
    source, target = make(PLACES, moved(PLACES, TRUTH))
    with pytest.raises(InputError, match=said) as caught:
        fit_pairs(pairs(source, target), *clouds)
    assert str(caught.value).startswith("pairs.csv")
    assert "\n" not in str(caught.value)


def test_pairs_on_one_line_are_refused(clouds):
    source, target = clouds
    points = source.frame.to_file(source.xyz)
    foot = points[(np.abs(points[:, 1] + 20) < 0.05) & (points[:, 2] < 0.2)]
    line = foot[np.argsort(foot[:, 0])][[0, len(foot) // 2, -1]]
    with pytest.raises(InputError, match="in scan lie on one line"):
        fit_pairs(pairs(line, moved(line, TRUTH)), source, target)


@pytest.mark.parametrize(
    ("factor", "said"),
    [(1000.0, "millimetres"), (1 / 0.3048, "feet"), (1.4, "mixed up")],
)
def test_wrong_units_are_named(clouds, factor, said):
    source, _ = clouds
    target = Cloud.from_points(factor * PLACES, name="drone")
    with pytest.raises(InputError, match=rf"lengths in drone are .* times.*{said}"):
        fit_pairs(pairs(PLACES, factor * PLACES), source, target)


@pytest.fixture
def run():
    def made(source, target, picked, **options):
        params = Register(prepare=SETTINGS, **options)
        return register(source, target, params, pairs=picked)

    return made


def test_rough_pairs_lead_to_the_proved_pose(clouds, run):
    rough = np.random.default_rng(3).normal(0, 0.15, PLACES.shape)
    target = moved(PLACES, TRUTH) + rough * [1, 1, 0]
    target[4] = moved(PLACES[4] - [0.0, 4.0, 0.0], TRUTH)
    result = run(*clouds, pairs(PLACES, target), coarse="none")
    assert result.status == "ok", result.reason
    yaw, plan, up = pose_error(result.matrix, TRUTH)
    assert max(plan, up) < 0.02
    assert yaw < 0.05
    assert result.coarse_method == "pairs"
    assert result.pairs["bad"] == "p5"
    residuals = {row["name"]: row["residual_m"] for row in result.pairs["pairs"]}
    assert residuals["p5"] > 2.5 > 0.6 > residuals["p1"]
    assert "picked pairs lie" in result.reason


def test_pairs_cannot_make_a_wrong_pose_ok(clouds, run):
    """The picks fit each other to a millimetre, on the ground, half a turn from the truth."""
    source, target = clouds
    ground = np.array([[-24.0, -24, 0], [24, -23, 0], [20, 23, 0], [-23, 22, 0]])
    picked = pairs(ground, moved(ground, TRUTH @ motion(180.0)))
    alone = run(source, target, picked, coarse="none")
    assert alone.status != "ok"
    searched = run(source, target, picked)
    assert searched.status == "ambiguous"
    assert "the clouds and the picked pairs disagree" in searched.reason
    assert pose_error(searched.matrix, TRUTH)[1] < 0.05


def test_what_the_clouds_cannot_tell_the_pairs_do_not_either(run):
    source = Cloud.from_points(survey("lidar", TOWERS[:1]), name="scan")
    target = Cloud.from_points(moved(survey("photogrammetry", TOWERS[:1], 1), TRUTH), name="drone")
    corners = np.column_stack([outline(*TOWERS[0][:4])[[0, 2, 3]], [0.0, 5.0, 0.0]])
    results = [
        run(source, target, pairs(corners, moved(corners, TRUTH @ motion(turn))), coarse="none")
        for turn in (0.0, 120.0)
    ]
    assert [result.status for result in results] == ["ambiguous", "ambiguous"]
    words = " ".join(result.reason for result in results)
    assert "--yaw-hint" in words


def test_a_source_that_lies_on_its_side_is_levelled_by_the_pairs(clouds, run):
    _, target = clouds
    lay = np.eye(4)
    lay[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    lay[:3, 3] = [3.0, 8.0, -2.0]
    source = Cloud.from_points(moved(survey("lidar"), lay), name="scan")
    result = run(source, target, pairs(moved(PLACES, lay), moved(PLACES, TRUTH)), coarse="none")
    assert result.status == "ok", result.reason
    truth = TRUTH @ np.linalg.inv(lay)
    assert max(pose_error(result.matrix, truth, moved(PLACES, lay).mean(axis=0))[1:]) < 0.02
    assert "90.0 deg from the vertical by the pairs" in result.notes[0]
    assert np.abs(result.hypotheses[0].T_target_source - result.matrix).max() < 1e-9


COLUMNS = ",".join(HEADER)
SEMICOLONS = ";".join(HEADER)


def write(path, rows, header=COLUMNS):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_the_file_is_a_control_file(tmp_path):
    path = write(
        tmp_path / "p.csv",
        ["a,scan,1,2,3,4,5,6,0.01,control", "b,scan,1.5,2,3,4,5,6,0.01,check",
         "c,other,9,9,9,9,9,9,,control", ",,7,8,9,500000.125,4000000.5,3,,"],
    )  # fmt: skip
    found = read_pairs(path, "scan")
    assert found.names == ("a", "2")
    assert found.source.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert found.target[1].tolist() == [500000.125, 4000000.5, 3]
    assert len(found.record["sha256"]) == 64


@pytest.mark.parametrize("sign", [",", "."])
def test_a_file_of_a_european_spreadsheet_is_read(tmp_path, sign):
    row = "Ecke, Süd;scan;-1,5;2;3;500000,125;4000000,5;6;0,003;control".replace(",", sign)
    path = write(tmp_path / "p.csv", [row, ";;;;;;;;;"], "\ufeff" + SEMICOLONS)
    found = read_pairs(path, "scan")
    assert found.source.tolist() == [[-1.5, 2, 3]]
    assert found.target.tolist() == [[500000.125, 4000000.5, 6]]
    assert found.names == (f"Ecke{sign} Süd",)
    assert read_control(path)["scan"].sigma_m.tolist() == [0.003]


@pytest.mark.parametrize(
    ("rows", "header", "said"),
    [
        (["a,scan,1,2,x,4,5,6,,"], COLUMNS, "pair a: source_z is 'x'; a number"),
        (["a,scan,1,2,nan,4,5,6,,"], COLUMNS, "source_z is 'nan'"),
        (["a,hall,1,2,3,4,5,6,,"], COLUMNS, "no pair of scan.*names hall"),
        (["1;2;3"], "x;y;z", "no column source_x.*'x;y;z'.*separated by commas or semicolons"),
        (["a,scan,1,5,2,3,4,5,6,,"], COLUMNS, "line 2: .*separate all values by semicolons"),
        (["a;scan;1,5;2;3;4.5;5;6;;"], SEMICOLONS, "'1,5' and '4.5' do not tell which"),
        (["a;scan;1,5;2;3;4;4.000.031,5;6;;"], SEMICOLONS, "'1,5' and '4.000.031,5'"),
        (["a;scan;1,234,567;2;3;4;5;6;;"], SEMICOLONS, "'1,234,567' do not tell"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused(tmp_path, rows, header, said):
    with pytest.raises(InputError, match=said):
        read_pairs(write(tmp_path / "p.csv", rows, header), "scan")
    with pytest.raises(InputError, match="there is no file"):
        read_pairs(tmp_path / "gone.csv", "scan")


def test_without_pairs_nothing_changes_and_refusals_stay(clouds):
    with pytest.raises(RegistrationError, match="usable points"):
        register(Cloud.from_points(PLACES), clouds[1])


def test_the_scale_of_a_cloud_that_lies_askew_is_checked_where_its_pairs_lay_it():
    """The check began at the pose of the levelled cloud, and said it could not be made."""
    size, turn = 1.01, Rotation.from_euler("x", 25.0, degrees=True).as_matrix()
    drone = survey("photogrammetry", seed=1)
    source, places = (size * points @ turn.T for points in (survey("lidar"), PLACES))
    found = register(
        Cloud.from_points(source, name="scan"),
        Cloud.from_points(drone, name="drone"),
        Register(prepare=SETTINGS),
        pairs=pairs(places, PLACES),
        unscaled="source",
    )
    assert found.status == "ok", found.reason
    assert np.cbrt(np.linalg.det(found.matrix[:3, :3])) == pytest.approx(1.0 / size, abs=3e-4)
    moved_places = places @ found.matrix[:3, :3].T + found.matrix[:3, 3]
    assert np.linalg.norm(moved_places - PLACES, axis=1).max() < 0.02
