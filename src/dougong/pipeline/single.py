"""One filter alone: ``dougong filter --only NAME``."""

from collections.abc import Mapping
from typing import Any

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.filters import FILTERS
from dougong.filters.cloth_simulation import ClothSimulation
from dougong.filters.clutter import Clutter
from dougong.filters.pass_through import PassThrough
from dougong.formats import require_metric
from dougong.params import Parameters
from dougong.pipeline.progress import Progress, Silent
from dougong.pipeline.settings import module_name, suggestion, validated
from dougong.pipeline.steps import Bench, Filtered, Step, run_step


def filter_name(text: str) -> str:
    """Return the module name of a filter, however it was spelled.

    Raises
    ------
    InputError
        There is no such filter.
    """
    name = module_name(text)
    if name not in FILTERS:
        msg = (
            f"there is no filter {text!r}{suggestion(name, FILTERS)} Filters: {', '.join(FILTERS)}."
        )
        raise InputError(msg)
    return name


def single_fields(name: str) -> list[str]:
    """Return the fields of filter `name`."""
    return list(FILTERS[name].params.model_fields)


def single_parameters(name: str, values: Mapping[str, Any]) -> Parameters:
    """Return the parameters of filter `name` with `values` set."""
    return validated(FILTERS[name].params, values, name)


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
    for step in single_steps(name, params):
        run_step(bench, step)
    return bench.result()


def single_steps(name: str, params: Parameters) -> tuple[Step, ...]:
    """Return one filter as steps, with what it needs before it."""
    if isinstance(params, Clutter):
        return Step("cloth_simulation", ClothSimulation()), Step(name, params, "off_ground")
    step = Step(name, params)
    if isinstance(params, PassThrough) and params.needs_height:
        # Heights are counted from the ground, which only the cloth knows.
        return Step("cloth_simulation", ClothSimulation()), step
    return (step,)
