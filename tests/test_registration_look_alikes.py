"""What stands about and the ground tell a place from its copy."""

from dataclasses import replace

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.evaluation.copies import COPIES, make_trial
from dougong.evaluation.metrics import pose_errors
from dougong.registration import register
from dougong.registration.deciding_part import deciding_part
from dougong.registration.evidence import hear, summon
from dougong.registration.ground_relief import relief
from dougong.registration.prepare import prepare
from dougong.registration.shown_sides import lacks_opposite_sides
from dougong.registration.standing_things import Telling, things_of
from dougong.registration.verdict import Verdict

SPOTS = [
    (-9.0, -7.0),
    (-3.0, 8.0),
    (6.0, -9.0),
    (9.0, 4.0),
    (-11.0, 5.0),
    (2.0, -4.0),
    (11.0, -3.0),
]
SIZES = [(0.8, 0.8, 2.6), (1.5, 1.5, 1.0), (0.5, 1.2, 0.9), (2.0, 0.4, 0.8)]


def box(rng, at, size):
    """Points on the sides and the top of a box that stands on z = 0."""
    points = rng.random((int(900 * size[2]) + 300, 3)) * size
    face = rng.integers(0, 5, len(points))
    axis = np.array([0, 0, 1, 1, 2])[face]
    points[np.arange(len(points)), axis] = np.array([0, 1, 0, 1, 1])[face] * np.array(size)[axis]
    return points + [at[0] - size[0] / 2, at[1] - size[1] / 2, 0.0]


def court(spots, seed=0, sizes=SIZES, hole=None):
    """A house on level ground with boxes about it, as a prepared cloud; no ground in `hole`."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-16, 16, (40_000, 2)), np.zeros(40_000)])
    is_under = np.zeros(len(ground), bool)
    parts = [box(rng, (0.0, 1.0), (7.0, 4.0, 4.0))]
    for k, spot in enumerate(spots):
        size = sizes[k % len(sizes)]
        parts.append(box(rng, spot, size))
        is_under |= (np.abs(ground[:, :2] - spot) < np.array(size[:2]) / 2).all(axis=1)
    if hole is not None:
        is_under |= np.linalg.norm(ground[:, :2] - hole, axis=1) < 3.0
    points = np.vstack([ground[~is_under], *parts])
    points += rng.normal(0.0, 0.004, points.shape)
    cloud = Cloud.from_points(points)
    found = prepare(cloud, "lidar")
    return replace(found, xyz=found.xyz + cloud.frame.origin)


def things_between(one, two):
    return replace(things_of(summon(one, two), one, two), near_m=0.2)


def shifted(*by):
    T = np.eye(4)
    T[: len(by), 3] = by
    return T


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    return T


def test_things_are_found_where_they_stand_and_gone_elsewhere():
    things = things_between(court(SPOTS), court(SPOTS, 1))
    here, beside = things.fates(np.eye(4)), things.fates(turned(100.0))
    assert len(here.is_found) == 2 * len(SPOTS)
    assert here.is_found.all()
    assert not here.is_gone.any()
    assert beside.is_gone.sum() >= 10
    assert beside.is_found.sum() <= 2
    assert things.telling(np.eye(4)).is_vouched
    assert not things.telling(np.eye(4)).is_refuted
    assert things.telling(turned(100.0)).is_refuted


def test_a_place_without_ground_says_nothing_of_a_thing():
    hidden = court(SPOTS[1:], 1, SIZES[1:] + SIZES[:1], hole=SPOTS[0])
    fates = things_between(court(SPOTS), hidden).fates(np.eye(4))
    assert not fates.is_gone.any()
    bare = court(SPOTS[1:], 1, SIZES[1:] + SIZES[:1])
    assert things_between(court(SPOTS), bare).fates(np.eye(4)).is_gone.sum() == 1


def test_who_walked_away_is_no_witness():
    people = [(0.4, 0.6, 1.7)]
    things = things_between(court(SPOTS, sizes=people), court([]))
    assert things.fates(np.eye(4)).is_gone.sum() == len(SPOTS)
    assert things.telling(np.eye(4)).gone == 0


def test_what_a_rival_finds_too_repeats_and_is_not_asked():
    spots = [(x, y) for a, b in SPOTS[:4] for x, y in ((a, b), (-a, -b))]
    sizes = [size for size in SIZES for _ in range(2)]
    things = things_between(court(spots, sizes=sizes), court(spots, 1, sizes=sizes))
    assert things.telling(np.eye(4)).found == 16
    assert things.telling(np.eye(4), things.found_by([turned(180.0)])).found < 3


def test_things_on_a_part_that_may_have_moved_are_not_asked():
    things = things_between(court(SPOTS), court(SPOTS, seed=1))

    def west_of(x):
        return lambda points: points[:, 0] < x

    every = things.telling(np.eye(4))
    east = things.telling(np.eye(4), things.standing_on(west_of(0.0), np.eye(4)))
    assert every.found == 2 * len(SPOTS)
    assert east.found == 2 * sum(x > 0.0 for x, _ in SPOTS)
    # The part lies in the target's frame, wherever the source's is.
    two = court(SPOTS, seed=1)
    moved = things_between(court(SPOTS), replace(two, xyz=two.xyz + [50.0, 0.0, 0.0]))
    unasked = moved.standing_on(west_of(50.0), shifted(50.0))
    assert moved.telling(shifted(50.0), unasked).found == east.found


def house_with(*extensions, seed=0):
    """Points of a house that equals itself turned by 180 degrees, with extensions."""
    rng = np.random.default_rng(seed)
    parts = [box(rng, (0.0, 0.0), (14.0, 8.0, 5.0)) for _ in range(3)]
    parts += [box(rng, at, (3.0, 2.0, 3.0)) for at in extensions]
    cloud = Cloud.from_points(np.vstack(parts))
    found = prepare(cloud, "lidar")
    return replace(found, xyz=found.xyz + cloud.frame.origin)


@pytest.mark.parametrize(
    ("extensions", "size"),
    [
        # What is left beside one extension fits turned as well as not; two of them hold the house.
        ([(2.0, -5.0)], (4.0, 4.0)),
        ([(2.0, -5.0), (-8.5, 1.0)], None),
    ],
)
def test_the_part_that_decides_alone_is_named(extensions, size):
    one, two = (house_with(*extensions, seed=seed) for seed in (0, 1))
    heard = summon(one, two)
    part = deciding_part(heard, hear(heard, np.eye(4)), hear(heard, turned(180.0)), Verdict())
    if size is None:
        assert part is None
        return
    assert part is not None
    assert max(part.size_m) <= max(size) + 4.0
    assert part.holds(np.array([[*extensions[0], 1.0]])).all()


def test_things_that_stayed_speak_for_the_pose_that_finds_them():
    things = things_between(court(SPOTS), court(SPOTS, 1))
    assert things.speak_for(np.eye(4), turned(100.0)) >= 6
    assert things.speak_for(turned(100.0), np.eye(4)) == 0


@pytest.mark.parametrize(
    ("found", "gone", "chance", "is_vouched", "is_refuted"),
    [
        (0, 0, 0.05, False, False),
        (0, 2, 0.05, False, False),
        (0, 3, 0.05, False, True),
        (3, 0, 0.05, True, False),
        (2, 0, 0.05, False, False),
        (4, 30, 0.10, False, True),
        (12, 30, 0.10, True, False),
    ],
)
def test_telling_weighs_found_and_gone_by_chance(found, gone, chance, is_vouched, is_refuted):
    telling = Telling(found=found, gone=gone, chance=chance)
    assert (telling.is_vouched, telling.is_refuted) == (is_vouched, is_refuted)


def rolling(seed, phase=0.0):
    rng = np.random.default_rng(seed)
    plan = rng.uniform(-20, 20, (30_000, 2))
    x, y = plan.T
    height = 0.10 * np.sin(0.31 * x + 0.2 * y + phase) + 0.07 * np.sin(
        0.5 * y - 0.2 * x + 2 * phase
    )
    return np.column_stack([plan, 5.0 + 0.02 * x + height + rng.normal(0, 0.004, len(x))])


def test_the_ground_vouches_for_its_own_place_only():
    here = relief(rolling(0), rolling(1), np.eye(4))
    assert here.is_vouched
    assert here.alike > 0.99
    turn = turned(180.0)
    turn[2, 3] = 0.0
    elsewhere = relief(rolling(0), rolling(1, phase=2.1), np.eye(4))
    assert not elsewhere.is_vouched
    assert relief(rolling(0), rolling(1), turn).alike < 0.9


def test_level_paving_says_nothing():
    rng = np.random.default_rng(2)
    one, two = (
        np.column_stack([rng.uniform(-20, 20, (20_000, 2)), rng.normal(0, 0.004, 20_000)])
        for _ in range(2)
    )
    found = relief(one, two, np.eye(4))
    assert np.isnan(found.alike)
    assert not found.is_vouched
    assert not found.is_refuted


def test_relief_does_not_change_with_the_frame():
    one, two, T = rolling(0), rolling(1), turned(37.0)
    T[:3, 3] = 120.0, -60.0, 3.0
    moved = (one - T[:3, 3]) @ T[:3, :3]
    assert relief(moved, two, T).alike == pytest.approx(relief(one, two, np.eye(4)).alike, abs=1e-9)


@pytest.mark.parametrize("kind", sorted(COPIES))
def test_a_place_is_made_again_by_its_seed(kind):
    small = {"lidar_points": 3000, "photogrammetry_points": 3000}
    one, two = (make_trial(kind, 5, is_copy=True, things=3, **small) for _ in range(2))
    assert np.array_equal(one.source, two.source)
    assert np.array_equal(one.target, two.target)


@pytest.mark.parametrize(
    ("kind", "seed", "things", "said"),
    [
        ("corners", 2, 0, "both clouds show one side"),
        ("flights", 1, 0, "both clouds show one side"),
        ("flights", 1, 8, "are gone under it and found under another one"),
        ("cloister", 0, 3, "the place repeats"),
        # Posts of the scaffolding stand about and are found: they moved with it.
        ("scaffold", 2, 0, "alone tells which way round"),
        ("scaffold", 40, 0, "alone tells which way round"),
        ("stalls", 2, 2, "this plan repeats every 180 degrees"),
    ],
)
def test_a_copy_that_fits_best_is_not_ok(kind, seed, things, said):
    trial = make_trial(kind, seed, is_copy=True, things=things)
    source, target = (Cloud.from_points(points) for points in (trial.source, trial.target))
    found = register(source, target, source_kind=trial.source_kind, target_kind=trial.target_kind)
    assert found.status == "ambiguous"
    assert said in found.reason
    assert not pose_errors(found.matrix, trial.truth).is_correct


@pytest.mark.parametrize(("kind", "things"), [("cloister", 12), ("flights", 8)])
def test_the_same_part_among_things_is_ok(kind, things):
    trial = make_trial(kind, 1, is_copy=False, things=things)
    source, target = (Cloud.from_points(points) for points in (trial.source, trial.target))
    found = register(source, target, source_kind=trial.source_kind, target_kind=trial.target_kind)
    assert found.status == "ok"
    assert pose_errors(found.matrix, trial.truth).is_correct


def test_another_relief_refutes_a_pose_and_a_bent_flight_does_not():
    assert relief(rolling(0), rolling(1, phase=2.1), np.eye(4)).is_refuted
    paving, bent = rolling(0) * (1, 1, 0.15), rolling(1, phase=2.1) * (1, 1, 0.3)
    found = relief(paving, bent, np.eye(4))
    assert found.alike < 0.3
    assert not found.is_refuted


def test_no_ground_says_nothing():
    found = relief(np.zeros((0, 3)), rolling(0), np.eye(4))
    assert not found.is_vouched
    assert not found.is_refuted


def on_rolling_ground(seed, amplitude):
    """A box of a house, which equals itself turned by 180 degrees, on ground that does not."""
    rng = np.random.default_rng(seed)
    ground = rolling(seed) - [0.0, 0.0, 5.0]
    ground[:, 2] -= 0.02 * ground[:, 0]
    ground[:, 2] *= amplitude
    is_under = (np.abs(ground[:, :2]) < [5.0, 3.0]).all(axis=1)
    walls = box(rng, (0.0, 0.0), (10.0, 6.0, 5.0))
    points = np.vstack([ground[~is_under], walls, box(rng, (0.0, 0.0), (10.0, 6.0, 5.0))])
    return points + rng.normal(0.0, 0.004, points.shape)


@pytest.mark.parametrize(("amplitude", "status"), [(0.35, "ok"), (0.0, "ambiguous")])
def test_the_ground_tells_the_turns_of_a_house_apart(amplitude, status):
    truth = turned(140.0)
    truth[:3, 3] = 30.0, -20.0, 2.0
    one, two = on_rolling_ground(0, amplitude), on_rolling_ground(1, amplitude)
    found = register(
        Cloud.from_points((one - truth[:3, 3]) @ truth[:3, :3]),
        Cloud.from_points(two),
        source_kind="lidar",
        target_kind="lidar",
    )
    assert found.status == status
    if status == "ok":
        assert "relief of the ground" in found.reason
        middle = np.linalg.inv(truth) @ [0.0, 0.0, 3.0, 1.0]
        assert np.linalg.norm(found.matrix @ middle - [0.0, 0.0, 3.0, 1.0]) < 0.05
        assert np.degrees(np.arccos((np.trace(found.matrix[:3, :3] @ truth[:3, :3].T) - 1) / 2)) < 1


def square_hall(spots, seed):
    """A square hall on level paving with boxes about it."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-16, 16, (40_000, 2)), np.zeros(40_000)])
    is_under = (np.abs(ground[:, :2]) < 4.0).all(axis=1)
    parts = [box(rng, (0.0, 0.0), (8.0, 8.0, 5.0)) for _ in range(3)]
    for k, spot in enumerate(spots):
        size = SIZES[k % len(SIZES)]
        parts.append(box(rng, spot, size))
        is_under |= (np.abs(ground[:, :2] - spot) < np.array(size[:2]) / 2).all(axis=1)
    points = np.vstack([ground[~is_under], *parts])
    return points + rng.normal(0.0, 0.004, points.shape)


@pytest.mark.parametrize(
    ("spots", "status"),
    [
        ([(-9.0, -7.0), (-3.0, 8.5), (6.0, -9.0), (9.0, 4.0), (-11.0, 5.0)], "ok"),
        # Close together they are one witness: who moves a scaffold moves all of its posts.
        ([(9.0, y) for y in (-6.0, -3.0, 0.0, 3.0, 6.0)], "ambiguous"),
        ([], "ambiguous"),
    ],
)
def test_things_that_stand_apart_tell_the_turns_of_a_hall(spots, status):
    truth = turned(140.0)
    truth[:3, 3] = 30.0, -20.0, 2.0
    one, two = square_hall(spots, 0), square_hall(spots, 1)
    found = register(
        Cloud.from_points((one - truth[:3, 3]) @ truth[:3, :3]),
        Cloud.from_points(two),
        source_kind="lidar",
        target_kind="photogrammetry",
    )
    assert found.status == status, found.reason
    if status == "ok":
        off = np.linalg.norm(
            one
            - ((one - truth[:3, 3]) @ truth[:3, :3] @ found.matrix[:3, :3].T + found.matrix[:3, 3]),
            axis=1,
        )
        assert off.max() < 0.05
        assert "what stands about tells them apart" in found.reason


def walls_and_ground(shown, size=(14.0, 8.0), eaves=0.0):
    """Walls of a house of which the sides in `shown` were seen, and the ground before these."""
    rng = np.random.default_rng(3)
    x, y = np.array(size) / 2
    sides = {"n": (0, 1, x, y), "s": (0, -1, x, y), "e": (1, 0, y, x), "w": (-1, 0, y, x)}
    walls, normals, ground = [], [], []
    for name in shown:
        nx, ny, along, off = sides[name]
        t, z = rng.uniform(-along, along, 60 * int(along)), rng.uniform(0.2, 5, 60 * int(along))
        walls.append(np.column_stack([nx * off + ny * t, ny * off + nx * t, z]))
        # Eaves hang over the ground; normals of clouds have either sign.
        walls[-1][z > 4.5, :2] += eaves * np.array([nx, ny])
        sign = rng.choice([-1.0, 1.0], (len(t), 1))
        normals.append(sign * np.array([nx, ny, 0.0]))
        u, v = rng.uniform(-along, along, 4000), off + rng.uniform(0.0, 10.0, 4000)
        ground.append(np.column_stack([nx * v + ny * u, ny * v + nx * u, 0 * u]))
    return [np.concatenate(parts) for parts in (ground, walls, normals)]


@pytest.mark.parametrize("turn", [0.0, 33.0, 85.0])
@pytest.mark.parametrize("eaves", [0.0, 1.2])
@pytest.mark.parametrize(
    ("shown", "lacks"),
    [("nesw", False), ("n", True), ("ne", True), ("nwe", True), ("ns", False)],
)
def test_walls_tell_whether_opposite_sides_are_shown(shown, lacks, eaves, turn):
    ground, walls, normals = walls_and_ground(shown, eaves=eaves)
    R = turned(turn)[:3, :3].T
    found = lacks_opposite_sides(ground @ R, walls @ R, normals @ R, np.ones(len(walls)))
    assert found is lacks


def test_a_free_standing_wall_and_a_place_without_ground_show_no_lack():
    ground, walls, normals = walls_and_ground("n")
    both = np.vstack([ground, ground * [1, -1, 1] + [0, 8, 0]])
    weights = np.ones(len(walls))
    assert lacks_opposite_sides(ground, walls, normals, weights)
    assert not lacks_opposite_sides(both, walls, normals, weights)
    assert not lacks_opposite_sides(ground[:0], walls, normals, weights)
    assert not lacks_opposite_sides(ground, walls[:0], normals[:0], weights[:0])
