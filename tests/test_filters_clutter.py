"""Clutter: clusters as the plain definition has them, kinds by size and shape, and no accidents."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dougong.errors import InputError
from dougong.evaluation import clutter_things as things
from dougong.evaluation.mesh import join
from dougong.evaluation.solids import block
from dougong.filters import wires
from dougong.filters.cloth_simulation import GROUND, ClothSimulation, cloth_simulation
from dougong.filters.clusters import clusters_of, eighth_nearest
from dougong.filters.clutter import Clutter, clutter
from dougong.filters.clutter_kinds import ClutterKind
from dougong.filters.clutter_search import Whole, search
from dougong.filters.clutter_shapes import shape_of
from dougong.filters.neighbourhood import build_index
from dougong.kernels import clusters as kernels
from dougong.threads import get_threads, set_threads
from dougong.tiles.engine import local_engine
from dougong.tiles.stages import TileBench
from reference import clusters as reference
from test_tiles_stages import states, tiled


def sampled(mesh, per_m2=900.0, seed=0):
    rng = np.random.default_rng(seed)
    points, face = mesh.samples(int(per_m2 * mesh.areas().sum()), rng)
    return points + rng.normal(0, 0.002, points.shape), mesh.labels[face]


def kinds_of(points, params=None):
    """Return the kinds of points over level ground at 0, those near it left out as the cloth's."""
    up = points[points[:, 2] > 0.09]
    return up, clutter(up, params, height_above_ground=up[:, 2])


@given(st.integers(0, 2**32 - 1), st.integers(0, 90))
@settings(max_examples=40, deadline=None)
def test_clusters_are_those_of_every_pair(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 2, (count, 3)) * (1, 1, 0.3)
    points[: count // 3] = np.round(points[: count // 3], 1)
    gap = rng.uniform(0.1, 0.4, count)
    index = build_index(points)
    found = clusters_of(index, gap[index.order], 0.1)
    expected = reference.clusters(points, gap)[index.order]
    pairs = {(int(a), int(b)) for a, b in zip(found.root, expected, strict=True)}
    assert len(pairs) == len(set(found.root.tolist())) == len(set(expected.tolist()))


@given(st.integers(0, 2**32 - 1), st.integers(3, 60))
@settings(max_examples=25, deadline=None)
def test_the_rectangle_is_the_least_of_all_angles(seed, count):
    rng = np.random.default_rng(seed)
    plan = rng.normal(size=(count, 2)) * (3.0, 1.0)
    plan = plan[np.lexsort((plan[:, 1], plan[:, 0]))]
    hull = np.empty(2 * count, np.int64)
    length, width = kernels.least_rectangle(plan, hull[: kernels.plan_hull(plan, hull)])
    long, wide = reference.least_rectangle(plan)
    assert length * width <= long * wide * (1 + 1e-9)
    assert length * width >= long * wide - 0.05


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_wires_are_those_of_the_plain_definition(seed):
    rng = np.random.default_rng(seed)
    parts = [rng.uniform(0, 6, (rng.integers(0, 60), 3)) + (0, 0, 2)]
    for _ in range(rng.integers(1, 4)):
        start, stop = rng.uniform(0, 6, (2, 3)) * (1, 1, 0.5) + (0, 0, 2)
        parts.append(start + rng.random((rng.integers(5, 90), 1)) * (stop - start))
    points = np.concatenate(parts)
    points += rng.normal(0, 0.01, points.shape)
    index = build_index(points)
    height = index.points[:, 2]
    lines = wires.thin_lines(index, height, eighth_nearest(index, 0.5), 2.5)
    found = wires.runs_of_wires(index, lines)
    expected = reference.runs_of_wires(points, points[:, 2], 2.5, 0.5, wires)
    np.testing.assert_allclose(found, expected[index.order])


RNG = np.random.default_rng(5)
CASES = {
    "person": (things.visitor(np.random.default_rng(3)), ClutterKind.PERSON),
    "car": (things.vehicle(np.random.default_rng(1)), ClutterKind.VEHICLE),
    "lamp": (things.pole(np.random.default_rng(0)), ClutterKind.POLE),
    "statue": (things.statue(RNG), ClutterKind.NONE),
    "column": (things.column(RNG), ClutterKind.NONE),
    "stele": (things.HERITAGE[things.STELE](RNG), ClutterKind.NONE),
    "lion": (things.HERITAGE[things.LION](RNG), ClutterKind.NONE),
    "burner": (things.HERITAGE[things.BURNER](RNG), ClutterKind.NONE),
    "gate post": (things.gate_post(RNG), ClutterKind.NONE),
    "wall": (block((0, 0, 0), (9.0, 0.4, 3.0)), ClutterKind.NONE),
}


@pytest.mark.parametrize("name", CASES)
def test_a_thing_is_what_its_size_and_shape_say(name):
    mesh, expected = CASES[name]
    _, found = kinds_of(sampled(mesh)[0])
    kinds = found.attributes["clutter_kind"]
    assert np.bincount(kinds, minlength=5).argmax() == expected
    assert found.is_kept.all()
    assert (found.attributes["clutter_margin"][kinds > 0] >= 0).all()


def site():
    """Return points of people, a car, poles with wires, a wall, a lion; and their labels."""
    rng = np.random.default_rng(11)
    tops = np.array([[-9.0, -6, 6.4], [9.0, -6, 6.4]])
    parts = [
        block((0, 6, 0), (16.0, 0.6, 4.0)),
        things.HERITAGE[things.LION](rng).turned(0, (5, 3, 0)),
        things.vehicle(np.random.default_rng(1)).turned(30, (-4, 0, 0)),
        things.wire_pole(6.6).turned(0, (-9, -6, 0)),
        things.wire_pole(6.6).turned(0, (9, -6, 0)),
        things.wire(tops[0], tops[1], 0.3),
        *(
            things.visitor(np.random.default_rng(5 + k)).turned(k * 70, (-2 + 2 * k, -3, 0))
            for k in range(4)
        ),
    ]
    mesh = join(parts)
    points, labels = sampled(mesh, 500.0)
    wire, on_wire = sampled(parts[5], 1000.0, 2)
    return np.concatenate([points, wire]), np.concatenate([labels, on_wire])


def test_a_site_is_sorted_out():
    points, labels = site()
    up = points[:, 2] > 0.09
    _, found = kinds_of(points)
    kinds, labels = found.attributes["clutter_kind"], labels[up]
    assert found.found["person_clusters"] == 4
    assert found.found["vehicle_clusters"] == 1
    assert found.found["pole_clusters"] == 2
    for label, kind in ((things.PERSON, 1), (things.VEHICLE, 2), (things.WIRE, 4)):
        assert (kinds[labels == label] == kind).mean() > 0.85
    assert not kinds[(labels == 0) | (labels == things.LION)].any()
    assert "4 clusters" in found.notes[0]


def test_nothing_depends_on_order_or_place_and_turns_do_no_harm():
    points, _ = site()
    points = np.round(points * 1024) / 1024
    up, found = kinds_of(points)
    kinds = found.attributes["clutter_kind"]
    order = np.random.default_rng(0).permutation(len(up))
    again = clutter(up[order], height_above_ground=up[order, 2])
    for name, values in found.attributes.items():
        np.testing.assert_array_equal(again.attributes[name], values[order])
    before = get_threads()
    set_threads(1)
    alone = clutter(up, height_above_ground=up[:, 2])
    set_threads(before)
    for name, values in found.attributes.items():
        np.testing.assert_array_equal(alone.attributes[name], values)
    moved = clutter(up + (512.0, -1024.0, 64.0), height_above_ground=up[:, 2])
    np.testing.assert_array_equal(moved.attributes["clutter_kind"], kinds)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = up @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    after = clutter(turned, height_above_ground=up[:, 2]).attributes["clutter_kind"]
    assert (after == kinds).mean() > 0.9995


def test_removing_and_choosing_kinds():
    points, _ = site()
    _, marked = kinds_of(points)
    kinds = marked.attributes["clutter_kind"]
    _, found = kinds_of(points, Clutter(action="remove", kinds=("person",)))
    np.testing.assert_array_equal(found.is_kept, kinds != ClutterKind.PERSON)
    _, strict = kinds_of(points, Clutter(min_margin=0.9))
    assert not strict.attributes["clutter_kind"].any()
    _, off = kinds_of(points, Clutter(action="off"))
    assert not off.attributes["clutter_kind"].any()
    assert off.notes == ()


def test_what_cannot_be_known_is_no_clutter():
    points = sampled(CASES["person"][0])[0]
    unknown = np.full(len(points), np.nan)
    assert not clutter(points, height_above_ground=unknown).attributes["clutter_kind"].any()
    with pytest.raises(InputError, match="Run cloth_simulation"):
        clutter(points, height_above_ground=unknown[1:])
    with pytest.raises(ValueError, match="must ascend"):
        Clutter(person_height_m=(2.0, 1.0))


def test_rows_of_a_scanner_are_no_wires():
    along = np.arange(0, 12, 0.05)
    rows = [np.column_stack([along, 0 * along, 0 * along + z]) for z in np.arange(0.2, 9, 0.8)]
    _, found = kinds_of(np.concatenate(rows))
    assert not found.attributes["clutter_kind"].any()
    assert "rows" in found.notes[0]


def test_few_points_of_any_height_are_taken():
    few = np.array([[0.0, 0, 0.1], [3.0, 0, 2.0]])
    for points in (few, few[:1], few[1:], np.repeat(few[1:], 30, axis=0)):
        found = clutter(points, height_above_ground=points[:, 2])
        assert not found.attributes["clutter_kind"].any()


def test_a_pole_under_a_roof_is_a_column():
    pole = sampled(block((0, 0, 0), (0.08, 0.08, 3.0)))[0]
    roof = sampled(block((0, 0, 3.6), (6.0, 6.0, 0.2)), 200.0)[0]
    for points, expected in ((pole, ClutterKind.POLE), (np.concatenate([pole, roof]), 0)):
        _, found = kinds_of(points)
        kinds = found.attributes["clutter_kind"]
        assert kinds.max() == expected


def test_a_shape_of_one_place_is_possible():
    shape = shape_of(np.zeros((20, 3)), np.ones(20))
    assert shape.length_m == shape.width_m == shape.body_m == 0.0


def test_a_part_with_the_feet_alone_knows_whose_they_are():
    points = sampled(things.visitor(np.random.default_rng(3)))[0]
    up = points[points[:, 2] > 0.09]
    params = Clutter()
    feet = (up[:, 2] < params.foot_m) & (up[:, 0] > np.median(up[up[:, 2] < params.foot_m, 0]))
    # The first one by content lies with the feet.
    up[feet, 0] -= 0.01 + up[feet, 0].min() - up[~feet, 0].min()
    whole = search(up, up[:, 2], params)
    assert whole.counts["person_clusters"] == 1
    total = {}
    for mine in (feet, ~feet):
        order = np.argsort(~mine, kind="stable")
        own = int(mine.sum())
        found = search(up[order], up[order, 2], params, Whole(own, has_rows=False))
        np.testing.assert_array_equal(found.kind[:own], whole.kind[mine])
        for name, count in found.counts.items():
            total[name] = total.get(name, 0) + count
    assert total == whole.counts


def on_ground():
    points, labels = site()
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(-14, 14, (6000, 2)), rng.normal(0, 0.003, 6000)])
    keep = rng.random(len(points)) < np.where(labels == things.WIRE, 1.0, 0.25)
    return np.round(np.concatenate([points[keep], ground]), 3)


def test_tiles_offer_what_the_whole_offers(tmp_path):
    points = on_ground()
    params = Clutter(action="remove")
    cloud, whole = tiled(points, tmp_path, 8000)
    assert len(cloud.tiles) > 3
    ground = cloth_simulation(whole.xyz, ClothSimulation())
    asked = np.flatnonzero(ground.attributes["ground_class"] != GROUND)
    height = ground.attributes["height_above_ground"][asked]
    expected = clutter(whole.xyz[asked], params, height_above_ground=height)
    with local_engine() as engine:
        bench = TileBench(cloud, engine)
        bench.apply("cloth_simulation", ClothSimulation())
        done = bench.apply("clutter", params, "off_ground")
    found = states(bench, len(points))
    kind = np.zeros(len(points), np.uint8)
    kind[asked] = expected.attributes["clutter_kind"]
    assert set(kind.tolist()) == {0, 1, 2, 3, 4}
    np.testing.assert_array_equal(found["dougong_clutter"], kind)
    margin = np.zeros(len(points), np.float32)
    margin[asked] = expected.attributes["clutter_margin"]
    np.testing.assert_array_equal(found["dougong_clutter_margin"], margin)
    np.testing.assert_array_equal(found["code"] == 0, kind == 0)
    assert done.found == dict(expected.found)
    assert done.notes == expected.notes
