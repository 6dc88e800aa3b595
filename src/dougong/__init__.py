"""Heritage point clouds: filter, register, prove.

>>> import dougong
>>> dougong.__version__.count(".")
2

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from dougong.app import filter_cloud as filter
    from dougong.app import register_clouds as register
    from dougong.cloud import Cloud, Frame
    from dougong.errors import (
        DataWarning,
        DougongError,
        FormatError,
        FrameError,
        InputError,
        OutputError,
        RegistrationError,
    )
    from dougong.filters.cloth_simulation import ClothSimulation
    from dougong.filters.clutter import Clutter
    from dougong.filters.curvature_weighted import CurvatureWeighted
    from dougong.filters.low_outliers import LowOutliers
    from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
    from dougong.filters.pass_through import PassThrough
    from dougong.filters.radius import Radius
    from dougong.filters.statistical import Statistical
    from dougong.formats import check, describe, read, write
    from dougong.registration import Register

_HOME = {
    "Cloud": "cloud",
    "Frame": "cloud",
    "read": "formats",
    "write": "formats",
    "describe": "formats",
    "check": "formats",
    "filter": "app",
    "register": "app",
    "Register": "registration",
    "ClothSimulation": "filters",
    "Clutter": "filters",
    "CurvatureWeighted": "filters",
    "LowOutliers": "filters",
    "OctreeVoxelGrid": "filters",
    "PassThrough": "filters",
    "Radius": "filters",
    "Statistical": "filters",
    "DataWarning": "errors",
    "DougongError": "errors",
    "FormatError": "errors",
    "FrameError": "errors",
    "InputError": "errors",
    "OutputError": "errors",
    "RegistrationError": "errors",
}
_NAME_AT_HOME = {"filter": "filter_cloud", "register": "register_clouds"}

__all__ = [
    "ClothSimulation",
    "Cloud",
    "Clutter",
    "CurvatureWeighted",
    "DataWarning",
    "DougongError",
    "FormatError",
    "Frame",
    "FrameError",
    "InputError",
    "LowOutliers",
    "OctreeVoxelGrid",
    "OutputError",
    "PassThrough",
    "Radius",
    "Register",
    "RegistrationError",
    "Statistical",
    "__version__",
    "check",
    "describe",
    "filter",
    "read",
    "register",
    "write",
]


def __getattr__(name: str) -> Any:
    """Import the room of a public `name` when it is first asked for."""
    if name not in _HOME:
        msg = f"module 'dougong' has no attribute {name!r}"
        raise AttributeError(msg)
    value = getattr(import_module(f"dougong.{_HOME[name]}"), _NAME_AT_HOME.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted(__all__)
