"""The two recipes: which filters a sensor's cloud passes, in which order (METHOD.md section 1).

lidar: octree voxel grid -> low outliers -> cloth -> CWASF on what is not ground -> pass-through.
photogrammetry: statistical -> low outliers -> cloth -> pass-through.
The ground is a branch and is never thrown away: only noise below it and a crop take ground points.
"""

from typing import Any

from pydantic import model_validator

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters.cloth_simulation import ClothSimulation
from dougong.filters.curvature_weighted import CurvatureWeighted
from dougong.filters.low_outliers import LowOutliers
from dougong.filters.octree_voxel_grid import OctreeVoxelGrid
from dougong.filters.pass_through import PassThrough
from dougong.filters.statistical import Statistical
from dougong.formats import require_metric
from dougong.params import Parameters
from dougong.pipeline.progress import Progress, Silent
from dougong.pipeline.steps import (
    GROUND,
    Bench,
    Filtered,
    run_cloth,
    run_curvature_weighted,
    run_low_outliers,
    run_octree_voxel_grid,
    run_pass_through,
    run_statistical,
)
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
    pass_through: PassThrough = PassThrough()


class PhotogrammetryRecipe(SensorRecipe):
    """Filters of a drone cloud, in order."""

    statistical: Statistical = Statistical()
    low_outliers: LowOutliers = LowOutliers()
    cloth_simulation: ClothSimulation = ClothSimulation(class_threshold_m=0.15)
    """H = 0.15 m: 3 sigma of 1-3 cm noise plus the slope under half a cloth cell."""
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
    if kind == "lidar":
        _lidar(bench, recipe.lidar)
    else:
        _photogrammetry(bench, recipe.photogrammetry)
    return bench.result()


def _lidar(bench: Bench, recipe: LidarRecipe) -> None:
    run_octree_voxel_grid(bench, recipe.octree_voxel_grid)
    lidar_after_grid(bench, recipe)


def lidar_after_grid(bench: Bench, recipe: LidarRecipe) -> None:
    """Run what follows the voxel grid on a laser scan's decimated points."""
    run_low_outliers(bench, recipe.low_outliers)
    run_cloth(bench, recipe.cloth_simulation)
    left = bench.left()
    run_curvature_weighted(
        bench, recipe.curvature_weighted, among=left[bench.ground_class[left] != GROUND]
    )
    run_pass_through(bench, recipe.pass_through)


def _photogrammetry(bench: Bench, recipe: PhotogrammetryRecipe) -> None:
    run_statistical(bench, recipe.statistical)
    run_low_outliers(bench, recipe.low_outliers)
    run_cloth(bench, recipe.cloth_simulation)
    run_pass_through(bench, recipe.pass_through)
