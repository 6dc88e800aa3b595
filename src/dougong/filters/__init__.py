"""Filters: each an array function, a parameters model and a declaration.

``filters.curvature_weighted(points, filters.CurvatureWeighted(radius_init_m=0.3))``. A filter's
module is imported when one of its names is asked for, so this package costs nothing until then.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from dougong.filters.registry import FILTERS, FilterSpec, find
from dougong.filters.selection import NOISE, Reason, Selection

if TYPE_CHECKING:
    from dougong.filters.cloth_simulation import ClothSimulation, cloth_simulation
    from dougong.filters.clutter import Clutter, clutter
    from dougong.filters.curvature_weighted import CurvatureWeighted, curvature_weighted
    from dougong.filters.low_outliers import LowOutliers, low_outliers
    from dougong.filters.octree_voxel_grid import OctreeVoxelGrid, octree_voxel_grid
    from dougong.filters.pass_through import PassThrough, pass_through
    from dougong.filters.radius import Radius, radius
    from dougong.filters.statistical import Statistical, statistical

__all__ = [
    "FILTERS",
    "NOISE",
    "ClothSimulation",
    "Clutter",
    "CurvatureWeighted",
    "FilterSpec",
    "LowOutliers",
    "OctreeVoxelGrid",
    "PassThrough",
    "Radius",
    "Reason",
    "Selection",
    "Statistical",
    "cloth_simulation",
    "clutter",
    "curvature_weighted",
    "find",
    "low_outliers",
    "octree_voxel_grid",
    "pass_through",
    "radius",
    "statistical",
]

_HOME = {spec.model: name for name, spec in FILTERS.items()}


class _Package(ModuleType):
    """The name of a filter is its verb, though the module that holds it is called the same."""

    def __setattr__(self, name: str, value: Any) -> None:
        # The import system hangs every imported module on its package; here the verb has the name.
        if name not in FILTERS or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"dougong.filters.{_HOME[name]}"), name)
    if name in FILTERS:
        return FILTERS[name].verb
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
