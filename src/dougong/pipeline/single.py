"""One filter alone: ``dougong filter --only NAME``."""

from collections.abc import Callable, Mapping
from typing import Any

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.cloth_simulation import ClothSimulation
from dougong.filters.curvature_weighted import CurvatureWeighted
from dougong.filters.low_outliers import LowOutliers
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.pass_through import PassThrough
from dougong.filters.radius import Radius
from dougong.filters.statistical import Statistical
from dougong.formats import require_metric
from dougong.params import Parameters
from dougong.pipeline import steps
from dougong.pipeline.progress import Progress, Silent
from dougong.pipeline.settings import module_name, suggestion, validated
from dougong.pipeline.steps import Bench, Filtered

_RUN: dict[str, tuple[type[Parameters], Callable[[Bench, Any], None]]] = {
    "octree_voxel_grid": (OctreeVoxelGrid, steps.run_octree_voxel_grid),
    "low_outliers": (LowOutliers, steps.run_low_outliers),
    "cloth_simulation": (ClothSimulation, steps.run_cloth),
    "curvature_weighted": (CurvatureWeighted, steps.run_curvature_weighted),
    "statistical": (Statistical, steps.run_statistical),
    "radius": (Radius, steps.run_radius),
    "pass_through": (PassThrough, steps.run_pass_through),
}


def filter_name(text: str) -> str:
    """Return the module name of a filter, however it was spelled.

    Raises
    ------
    InputError
        There is no such filter.
    """
    name = module_name(text)
    if name not in _RUN:
        msg = f"there is no filter {text!r}{suggestion(name, _RUN)} Filters: {', '.join(_RUN)}."
        raise InputError(msg)
    return name


def single_fields(name: str) -> list[str]:
    """Return the fields of filter `name`."""
    return list(_RUN[name][0].model_fields)


def single_parameters(name: str, values: Mapping[str, Any]) -> Parameters:
    """Return the parameters of filter `name` with `values` set."""
    return validated(_RUN[name][0], values, name)


def filter_single(
    cloud: Cloud, name: str, params: Parameters, progress: Progress | None = None
) -> Filtered:
    """Run one filter on a whole cloud.

    The cloth classifies: it takes points only where its ``keep`` asks for one side.

    Raises
    ------
    InputError
        The filter left no point.
    FrameError
        The cloud is in degrees or earth-centred coordinates.
    """
    require_metric(cloud)
    bench = Bench(cloud, progress or Silent())
    if isinstance(params, PassThrough) and params.needs_height:
        # Heights are counted from the ground, which only the cloth knows.
        steps.run_cloth(bench, ClothSimulation())
    _RUN[name][1](bench, params)
    return bench.result()
