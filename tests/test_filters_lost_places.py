"""Whole places that a noise filter took are told, with where they were; thin noise is not."""

import numpy as np

from dougong.cloud import Cloud
from dougong.filters.lost_places import lost_places
from dougong.filters.statistical import Statistical
from dougong.params import Parameters
from dougong.pipeline.progress import Silent
from dougong.pipeline.steps import Bench, Step, run_step
from dougong.tiles.engine import local_engine
from dougong.tiles.folder import LocalFolder
from dougong.tiles.partition import partition
from dougong.tiles.spool import Spool
from dougong.tiles.stages import TileBench

ORIGIN = np.array([500_000.0, 4_000_000.0, 100.0])


def said(taken, asked, parts=1):
    return lost_places(
        lambda: np.array_split(taken, parts), lambda: np.array_split(asked, parts), ORIGIN
    )


def scene(seed=0):
    """Return ground and thin noise, and a stele of 600 points at (5, 5)."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(0, 20, (20_000, 2)), np.zeros(20_000)])
    stele = rng.uniform([5.05, 5.05, 0.55], [5.45, 5.15, 0.95], (600, 3))
    return ground, stele, rng.uniform([0, 0, 1], [20, 20, 6], (800, 3))


def test_a_stele_that_was_taken_is_told_with_its_place():
    ground, stele, noise = scene()
    everything = np.concatenate([ground, stele, noise])
    for parts in (1, 7):
        note = said(np.concatenate([stele, noise]), everything, parts)
        assert note is not None
        assert "one place of 0.5 m, 600 in all, most at x 500,005.2, y 4,000,005.2, z 100.8" in note


def test_thin_noise_is_not_told():
    ground, stele, noise = scene()
    assert said(noise, np.concatenate([ground, stele, noise])) is None
    assert said(noise[:0], ground) is None


def test_a_few_points_of_a_place_are_not_the_place():
    ground, stele, noise = scene()
    assert said(stele[:300], np.concatenate([ground, stele, noise])) is None


def test_far_points_do_not_matter():
    ground, stele, _ = scene()
    far = np.array([[1e12, 0, 0], [-1e12, 5.0, 1e9]])
    note = said(np.concatenate([far, stele]), np.concatenate([ground, stele, far]))
    assert note is not None
    assert "600 in all" in note


def test_places_at_both_ends_of_the_world_are_told_whatever_the_parts():
    ground, stele, _ = scene()
    taken = np.concatenate([stele, stele + [3e6, 3e6, 3e6]])
    asked = np.concatenate([ground, taken])
    notes = {said(taken, asked, parts) for parts in (1, 2, 5)}
    (note,) = notes
    assert note is not None
    assert "2 places of 0.5 m, 1,200 in all" in note


def test_one_far_stray_beside_an_ordinary_one_is_no_place():
    ground, _, _ = scene()
    strays = np.array([[2.0, 2.0, 40.0], [1e6, 2.0, 40.0]])
    assert said(strays, np.concatenate([ground, strays])) is None


def test_tiles_say_it_as_the_whole_does(tmp_path):
    rng = np.random.default_rng(1)
    wall = rng.uniform([0, 0, 0], [20, 0, 4], (60_000, 3))
    sparse = rng.uniform([4, 3, 0], [9, 3, 2], (1500, 3))
    cloud = Cloud.from_points(np.concatenate([wall, sparse]))
    bench = Bench(cloud, Silent())
    params: Parameters = Statistical(multiplier=1.0)
    run_step(bench, Step("statistical", params))
    (whole,) = (note for note in bench.notes if "took most of the points" in note)
    pieces = (cloud.select(np.arange(a, min(a + 9999, len(cloud)))) for a in range(0, 61_500, 9999))
    told = {"origin": cloud.frame.origin.tolist()}
    tiled = partition(Spool(pieces, tmp_path), None, LocalFolder(tmp_path), 5000, 5000, told)
    with local_engine() as engine:
        done = TileBench(tiled, engine).apply("statistical", params)
    assert len(tiled.tiles) > 4
    assert done.notes[-1] == whole.split(": ", 1)[1]
