"""The table of filters says what the modules say, and costs nothing to read."""

import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest

from dougong import filters
from dougong.errors import InputError
from dougong.filters import neighbourhood

NAMES = list(filters.FILTERS)
INF = float("inf")
# Metres at the defaults: one voxel, the ground window, nothing, unknown until the cloud is known.
HALOS = {
    "octree_voxel_grid": 0.005,
    "low_outliers": 20.0,
    "cloth_simulation": 0.0,
    "curvature_weighted": INF,
    "statistical": INF,
    "radius": 0.1,
    "clutter": 15.8,
    "pass_through": 0.0,
}


@pytest.mark.parametrize("name", NAMES)
def test_a_row_is_what_its_module_declares(name):
    spec = filters.FILTERS[name]
    module = import_module(f"dougong.filters.{name}")
    assert spec.kind == module.KIND
    assert spec.params is getattr(filters, spec.model) is getattr(module, spec.model)
    assert spec.verb is getattr(filters, name) is getattr(module, name)
    assert spec.halo_m(spec.params()) == pytest.approx(HALOS[name])


@pytest.mark.parametrize(
    "verb",
    [filters.FILTERS[name].verb for name in NAMES]
    + [neighbourhood.nearest, neighbourhood.knn, neighbourhood.normals],
)
def test_what_is_refused_is_documented(verb):
    said = verb.__doc__.partition("    Raises\n    ------\n    InputError\n")[2]
    assert "(n, 3)" in said or "(m, 3)" in said


def test_halos_follow_from_the_parameters():
    halo = {name: spec.halo_m for name, spec in filters.FILTERS.items()}
    assert halo["curvature_weighted"](filters.CurvatureWeighted(reach_m=0.1)) == pytest.approx(1.7)
    assert halo["statistical"](filters.Statistical(radius_m=0.15)) == 0.15
    assert halo["octree_voxel_grid"](filters.OctreeVoxelGrid(depth=9)) == INF


@pytest.mark.parametrize("name", NAMES)
def test_every_filter_takes_an_empty_cloud(name):
    inputs = {"height_above_ground": np.empty(0)} if name in ("pass_through", "clutter") else {}
    spec = filters.FILTERS[name]
    chosen = spec.verb(np.empty((0, 3)), spec.params(), **inputs)
    assert chosen.is_kept.shape == (0,)
    assert all(len(values) == 0 for values in chosen.attributes.values())


def test_names_are_found_as_people_write_them():
    assert filters.find("Curvature-Weighted").name == "curvature_weighted"
    with pytest.raises(InputError, match="Did you mean statistical"):
        filters.find("statistcal")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        filters.nothing  # noqa: B018


def test_the_table_loads_no_kernel():
    code = (
        "import sys; from dougong.filters import FILTERS, CurvatureWeighted, Statistical, Radius, "
        "OctreeVoxelGrid, PassThrough; print('numba' in sys.modules, 'scipy' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "False"]
