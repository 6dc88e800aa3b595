"""Scans that are filtered on tiles in tests, and rooms too small for them."""

import json

import numpy as np

from dougong.cli import call
from dougong.cloud import Cloud
from dougong.formats import read, write
from dougong.pipeline import memory

VOXEL = "octree_voxel_grid.voxel_m=0.1"
LITTLE = {
    "BASE_BYTES": 0,
    "BYTES_PER_POINT": 5,
    "BYTES_PER_WAITING_POINT": 1,
    "LEAST_TILE_POINTS": 100,
    "_BYTES_PER_TILE_POINT": 12,
}
"""Estimates by which 190 kB are enough for tiles of some 3000 points and their halo."""


def site(count=30_000, seed=0, stray=True):
    """A wall and ground with density 100:1, repeated places, and one point far away."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack(
        [rng.uniform(0, 8, count), 0.02 * rng.normal(size=count), 3 * rng.random(count) ** 3]
    )
    ground = np.column_stack([rng.uniform(-20, 20, (count // 4, 2)), np.zeros(count // 4)])
    points = np.round(np.vstack([wall, ground, wall[:500]]), 3)
    if stray:
        points = np.vstack([points, [[1e6, -2e6, 40.0]]])
    return Cloud.from_points(points, intensity=rng.integers(0, 9, len(points)).astype("<u2"))


def write_scan(path, count=30_000):
    """Write a LAZ file of a wall, ground and noise that the whole recipe has work with."""
    rng = np.random.default_rng(3)
    noise = rng.uniform([-20, -20, -3], [20, 20, 12], (400, 3))
    points = np.vstack([site(count, stray=False).xyz + [20.0, 20.0, 0.0], noise + [20, 20, 0]])
    write(Cloud.from_points(points + [5e5, 4e6, 100.0]), path)
    return path


def make_little_room(monkeypatch):
    for name, value in LITTLE.items():
        monkeypatch.setattr(memory, name, value)


def filtered_by(path, out, *options):
    voxel = ("--set", VOXEL) if {"lidar", "octree_voxel_grid"} & set(options) else ()
    assert call(["filter", str(path), str(out), *voxel, "--quiet", *options]) == 0
    return read(out), json.loads((out.parent / f"{out.name}.json").read_text())


KILLED = """
import os, sys
from dougong.cli import main
from dougong.pipeline import memory
from dougong.tiles import engine

memory.BASE_BYTES, memory.BYTES_PER_POINT, memory.LEAST_TILE_POINTS = 0, 5, 100
memory._BYTES_PER_TILE_POINT = 12
left, perform = int(sys.argv[1]), engine.perform

def counted(task):
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), int(os.environ.get("SIGNAL", "9")))
    return perform(task)

engine.perform = counted
sys.argv[:2] = []
sys.argv.insert(0, "dougong")
main()
"""
