"""The two recipes: which filters a sensor's cloud passes, in which order (METHOD.md section 1).

lidar: octree voxel grid -> low outliers -> cloth -> CWASF on what is not ground -> (clutter) ->
pass-through. photogrammetry: statistical -> low outliers -> cloth -> (clutter) -> pass-through.
Clutter is looked for where its ``action`` is not off.
The ground is a branch and is never thrown away: only noise below it and a crop take ground points.
"""

from typing import Any

from pydantic import model_validator

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.cloth_simulation import ClothSimulation
from dougong.filters.clutter import Clutter
from dougong.filters.curvature_weighted import CurvatureWeighted
from dougong.filters.low_outliers import LowOutliers
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.pass_through import PassThrough
from dougong.filters.statistical import Statistical
from dougong.formats import require_metric
from dougong.params import Parameters
from dougong.pipeline.progress import Progress, Silent
from dougong.pipeline.steps import Bench, Filtered, Step, run_step
from dougong.typing import Kind


class SensorRecipe(Parameters):
    """Filters of one sensor. A table that sets some fields keeps the sensor's other defaults."""

    @model_validator(mode="before")
    @classmethod
    def _keep_sensor_defaults(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        merged = dict(given)
        for name, field in cls.model_fields.items():
            if isinstance(given.get(name), dict):
                own = field.get_default().model_dump(exclude_unset=True)
                merged[name] = {**own, **given[name]}
        return merged


class LidarRecipe(SensorRecipe):
    """Filters of a laser scan, in order."""

    octree_voxel_grid: OctreeVoxelGrid = OctreeVoxelGrid()
    low_outliers: LowOutliers = LowOutliers()
    cloth_simulation: ClothSimulation = ClothSimulation(class_threshold_m=0.09)
    """H = 0.09 m is the paper's; it exceeds 3 sigma of a scanner (about 2 cm) plus the slope."""
    curvature_weighted: CurvatureWeighted = CurvatureWeighted()
    clutter: Clutter = Clutter(action="off")
    pass_through: PassThrough = PassThrough()


class PhotogrammetryRecipe(SensorRecipe):
    """Filters of a drone cloud, in order."""

    statistical: Statistical = Statistical(spare_places=True)
    """The published filter, except where it would take whole places (a thinly seen facade)."""
    low_outliers: LowOutliers = LowOutliers()
    cloth_simulation: ClothSimulation = ClothSimulation(class_threshold_m=0.15)
    """H = 0.15 m: 3 sigma of 1-3 cm noise plus the slope under half a cloth cell."""
    clutter: Clutter = Clutter(action="off")
    pass_through: PassThrough = PassThrough()


class Recipe(Parameters):
    """Both recipes: the table ``[filter]`` of a project."""

    lidar: LidarRecipe = LidarRecipe()
    photogrammetry: PhotogrammetryRecipe = PhotogrammetryRecipe()


def filter_cloud(
    cloud: Cloud,
    kind: Kind,
    params: Recipe | None = None,
    progress: Progress | None = None,
) -> Filtered:
    """Run the recipe of `kind` on `cloud`.

    Parameters
    ----------
    cloud : Cloud
        Metres in any frame whose z is up.
    kind : "lidar" or "photogrammetry"
    params : Recipe, optional
    progress : Progress, optional
        Who hears the name of each stage.

    Raises
    ------
    InputError
        The cloud is empty, or the filters left no point of it.
    FrameError
        The cloud is in degrees or earth-centred coordinates.
    """
    require_metric(cloud)
    if len(cloud) == 0:
        msg = f"{cloud.name} has no points. Check the file with `dougong check`."
        raise InputError(msg)
    recipe = params or Recipe()
    bench = Bench(cloud, progress or Silent())
    for step in steps_of(kind, recipe):
        run_step(bench, step)
    return bench.result()


def steps_of(kind: Kind, recipe: Recipe) -> tuple[Step, ...]:
    """Return the filters of a sensor in order, whether in memory or on tiles."""
    if kind == "photogrammetry":
        flight = recipe.photogrammetry
        return (
            Step("statistical", flight.statistical),
            Step("low_outliers", flight.low_outliers),
            Step("cloth_simulation", flight.cloth_simulation),
            *_clutter(flight.clutter),
            Step("pass_through", flight.pass_through),
        )
    scan = recipe.lidar
    return (
        Step("octree_voxel_grid", scan.octree_voxel_grid),
        Step("low_outliers", scan.low_outliers),
        Step("cloth_simulation", scan.cloth_simulation),
        Step("curvature_weighted", scan.curvature_weighted, "off_ground"),
        *_clutter(scan.clutter),
        Step("pass_through", scan.pass_through),
    )


def _clutter(params: Clutter) -> tuple[Step, ...]:
    return () if params.action == "off" else (Step("clutter", params, "off_ground"),)
