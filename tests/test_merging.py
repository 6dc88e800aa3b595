"""The merged cloud: per zone the better source, no hole at the seams, every point counted."""

import tracemalloc
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from dougong.cloud import Cloud, joined_pieces
from dougong.formats.model import Hold
from dougong.pipeline.left_out import LeftOut, Remaining
from dougong.pipeline.merging import REASON, Merge, Part, better_of, choose
from dougong.pipeline.sides import whole
from dougong.pipeline.zones import grid_over, zones_of

QUICK = Merge(zone_m=0.5, reach_m=0.05)


def better(one, other, params):
    found = better_of(whole(one, other), params)
    masks = [
        Remaining(gone, 0, len(points)).mask(0, len(points))
        for gone, points in zip(found.left_out, (one, other), strict=True)
    ]
    return SimpleNamespace(kept_one=masks[0], kept_other=masks[1], note=found.note)


def kept_of(chosen):
    """One mask per part, over its points."""
    return [remaining.mask(0, remaining.points) for remaining in chosen.remaining]


def wall(rng, length, per_m2, noise, start=0.0, y=0.0):
    """Points of a wall along x, 3 m high."""
    count = int(length * 3 * per_m2)
    return np.column_stack(
        [rng.uniform(start, start + length, count), rng.normal(y, noise, count),
         rng.uniform(0, 3, count)]
    )  # fmt: skip


@pytest.fixture
def seam():
    """A scanner that saw the first 6 m of a wall, a drone that saw it from 3 m on."""
    rng = np.random.default_rng(0)
    return wall(rng, 6, 900, 0.002), wall(rng, 7, 400, 0.012, start=3.0, y=0.006)


def slow_covered(points, by, own, other, params):
    """Point by point, by the words of the module."""
    grid = other.grid
    counts = [dict(zip(zones.keys.tolist(), zones.counts.tolist(), strict=True))
              for zones in (own, other)]  # fmt: skip
    steps = [int(np.dot(step, grid.strides())) for step in product((-1, 0, 1), repeat=3)]
    answer = []
    for p in points:
        key = int(grid.keys(grid.cells(p[None]))[0])
        mine, theirs = (sum(count.get(key + step, 0) for step in steps) for count in counts)
        gap = p - by
        distance = np.linalg.norm(gap, axis=1)
        near = int(distance.argmin())
        if theirs < params.min_density_share * mine or distance[near] > params.reach_m:
            answer.append(False)
            continue
        zone = int(other.find(grid.keys(grid.cells(by[near][None])))[0][0])
        if np.isnan(other.noise_m[zone]):
            answer.append(True)
            continue
        across = abs(gap[near] @ other.normals[zone])
        along = np.sqrt(max(distance[near] ** 2 - across**2, 0.0))
        spacing = params.zone_m / np.sqrt(other.counts[zone])
        answer.append(bool(along <= max(2.0 * spacing, 0.02)))
    return np.array(answer)


def test_equals_the_slow_reference(seam):
    scan, drone = seam
    grid = grid_over([scan, drone], QUICK.zone_m)
    expected = slow_covered(drone, scan, zones_of(drone, grid), zones_of(scan, grid), QUICK)
    found = better(scan, drone, QUICK)
    np.testing.assert_array_equal(found.kept_other, ~expected)
    assert found.kept_one.all()
    assert 0.3 < expected.mean() < 0.6


def test_the_walls_are_the_scanners_and_no_hole_opens_at_the_seam(seam):
    scan, drone = seam
    found = better(scan, drone, QUICK)
    inside = (drone[:, 0] > 3.2) & (drone[:, 0] < 5.8)
    assert found.kept_other[inside].mean() < 0.01
    assert found.kept_other[drone[:, 0] > 6.1].all()
    kept = np.vstack([scan, drone[found.kept_other]])
    places = np.array(list(product(np.arange(0.1, 9.9, 0.05), np.arange(0.1, 2.9, 0.05))))
    near = np.array([np.abs(kept[:, [0, 2]] - place).max(axis=1).min() for place in places[::3]])
    whole = np.vstack([scan, drone])
    before = np.array([np.abs(whole[:, [0, 2]] - place).max(axis=1).min() for place in places[::3]])
    assert near.max() <= before.max() + 0.03


def test_noise_of_zones_is_that_of_the_sensor(seam):
    for points, noise in zip(seam, (0.002, 0.012), strict=True):
        zones = zones_of(points, grid_over(list(seam), 0.5))
        assert zones.typical_noise_m == pytest.approx(noise, rel=0.05)
        flat = np.isfinite(zones.noise_m)
        assert np.abs(zones.normals[flat] @ [0.0, 1.0, 0.0]).min() > 0.99


def test_a_zone_in_which_the_scanner_is_worse_goes_to_the_drone():
    rng = np.random.default_rng(1)
    # The scanner grazes the far part: mixed pixels, 3 cm.
    scan = np.vstack([wall(rng, 6, 900, 0.002), wall(rng, 3, 900, 0.03, start=7.0)])
    drone = wall(rng, 10, 900, 0.010)
    found = better(scan, drone, Merge(zone_m=0.5, reach_m=0.1))
    far = scan[:, 0] > 7.5
    assert found.kept_one[far].mean() < 0.1
    assert found.kept_one[scan[:, 0] < 6.0].all()
    assert found.kept_other[(drone[:, 0] > 7.5) & (drone[:, 0] < 9.5)].all()
    assert found.kept_other[drone[:, 0] < 5.5].mean() < 0.05


def test_a_thin_scan_does_not_push_out_a_dense_drone_cloud():
    rng = np.random.default_rng(2)
    found = better(wall(rng, 5, 60, 0.002), wall(rng, 5, 900, 0.012), QUICK)
    assert found.kept_other.all()
    assert found.kept_one.all()


def parts_of(scan, drone):
    points = np.array_split(scan, 2)
    clouds = [Cloud.from_points(p + [5e5, 4e6, 30], name=f"scan {k}") for k, p in enumerate(points)]
    clouds.append(Cloud.from_points(drone + [5e5, 4e6, 30], name="drone"))
    return [
        part_of(clouds[0], source_id=1, name="scans", kind="lidar"),
        part_of(clouds[1], source_id=1, name="scans", kind="lidar"),
        part_of(clouds[2], source_id=2, name="drone", kind="photogrammetry"),
    ]


def part_of(cloud, **told):
    """A part that comes in two pieces."""
    halves = np.array_split(np.arange(len(cloud)), 2)
    pieces = lambda: (cloud.select(half) for half in halves)  # noqa: E731
    return Part(frame=cloud.frame, points=len(cloud), pieces=pieces, **told)


def test_the_choice_knows_no_order_of_parts_or_points_and_no_offset(seam):
    scan, drone = seam
    parts = parts_of(scan, drone)
    kept = kept_of(choose(parts, QUICK))
    np.testing.assert_array_equal(kept[2], better(scan, drone, QUICK).kept_other)
    np.testing.assert_array_equal(kept_of(choose(parts[::-1], QUICK))[0], kept[2])
    turn = np.random.default_rng(3).permutation(len(drone))
    cloud = joined_pieces(parts[2].pieces).select(turn)
    mixed = [*parts[:2], replace(parts[2], pieces=lambda: (cloud,))]
    np.testing.assert_array_equal(kept_of(choose(mixed, QUICK))[2], kept[2][turn])


def test_tiles_with_halos_choose_as_the_whole(seam, tmp_path):
    rng = np.random.default_rng(5)
    # A far part where the drone is the better one, so that either side loses points.
    scan = np.vstack([seam[0], wall(rng, 3, 900, 0.03, start=7.0)])
    drone = np.vstack([seam[1], wall(rng, 4, 500, 0.01, start=6.0)])
    parts = parts_of(scan, drone)
    one, other = choose(parts, Merge()), choose(parts, Merge(), Hold(3000, tmp_path / "t"))
    assert one.reach_m == other.reach_m
    for kept, again in zip(kept_of(one), kept_of(other), strict=True):
        np.testing.assert_array_equal(kept, again)
    assert not kept_of(one)[1].all()
    assert not kept_of(one)[2].all()
    assert other.document(parts) == one.document(parts)
    assert len(list(tmp_path.rglob("*.points.npz"))) >= 4


@pytest.mark.parametrize("is_on_disk", [False, True])
def test_places_in_pages_are_those_of_a_mask(tmp_path, monkeypatch, is_on_disk):
    monkeypatch.setattr("dougong.pipeline.left_out.PAGE_POINTS", 100)
    rng, n = np.random.default_rng(0), 1234
    gone = rng.permutation(n)[:400]
    left_out = LeftOut(tmp_path / "a" if is_on_disk else None)
    for part in (*np.array_split(gone, 7), gone[:0]):
        left_out.add(part)
    expected = np.ones(n, dtype=bool)
    expected[gone] = False
    for first, points in ((0, n), (0, 0), (250, 700), (99, 2), (100, 100)):
        part = Remaining(left_out, first, points)
        here = expected[first : first + points]
        np.testing.assert_array_equal(part.mask(0, points), here)
        np.testing.assert_array_equal(part.mask(points // 3, points // 2),
                                      here[points // 3 : points // 2])  # fmt: skip
        assert part.gone() == np.count_nonzero(~here)


def test_merging_on_tiles_holds_no_mask_of_all_points(seam, tmp_path):
    """Two bytes a point were held whatever --memory said: 2 GB of a thousand million points."""
    few = parts_of(*seam)
    # A part of which nothing is ever read stands for the thousand million.
    far = replace(few[0], points=10**9, pieces=lambda: (), name="far")
    parts = [*few, far]
    tracemalloc.start()
    try:
        chosen = choose(parts, QUICK, Hold(3000, tmp_path / "t"))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 50e6
    assert chosen.document(parts)["sources"]["far"] == {"points": 10**9, "left_out": 0}
    held = choose(few, QUICK)
    for kept, again in zip(kept_of(held), kept_of(replace(chosen, remaining=chosen.remaining[:3])),
                           strict=True):  # fmt: skip
        np.testing.assert_array_equal(kept, again)


def test_every_point_is_counted_and_comes_back(seam):
    parts = parts_of(*seam)
    books = choose(parts, QUICK).document(parts)
    assert books["left_out_reason"] == REASON
    assert books["sources"]["scans"] == {"points": len(seam[0]), "left_out": 0}
    drone = books["sources"]["drone"]
    assert drone["points"] + drone["left_out"] == len(seam[1])
    assert books["left_out"] == drone["left_out"] > 0
    assert books["noise_m"]["lidar"] < books["noise_m"]["photogrammetry"]
    every = choose(parts, Merge(mode="all")).document(parts)
    assert (every["left_out"], every["points"]) == (0, len(seam[0]) + len(seam[1]))


def test_one_kind_of_sensor_is_kept_whole(seam):
    parts = [replace(part, kind="lidar") for part in parts_of(*seam)]
    chosen = choose(parts, Merge())
    assert all(kept.all() for kept in kept_of(chosen))
    assert "one kind" in chosen.note


def test_clouds_without_a_plane_are_kept_whole():
    rng = np.random.default_rng(4)
    found = better(rng.uniform(0, 9, (500, 3)), rng.uniform(0, 9, (500, 3)), QUICK)
    assert found.kept_one.all()
    assert found.kept_other.all()
    assert "no flat zone" in found.note
