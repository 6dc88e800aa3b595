"""The one table of filters that the commands and the recipes read.

A row names a module; the module is imported when its model or its verb is asked for, so reading
the table costs nothing.
"""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal

from dougong.errors import InputError
from dougong.filters.selection import Reason, Selection
from dougong.params import Parameters

FilterKind = Literal["local", "two-pass", "global"]


@dataclass(frozen=True, slots=True)
class FilterSpec:
    """One filter: where its parts are, and what it declares."""

    name: str
    """The module's name, which is also the verb's, the TOML section's and ``--only``'s."""
    model: str
    """Name of the parameters model in the module."""
    reason: Reason
    """Why a point that it takes out is out."""
    kind: FilterKind
    """*local*: halo known from parameters; *two-pass*: a small reduction first; *global*."""
    inputs: tuple[str, ...] = ()
    """Keyword inputs of the verb besides points and parameters: per-point arrays."""

    @property
    def params(self) -> type[Parameters]:
        """The parameters model."""
        model: type[Parameters] = getattr(self._module, self.model)
        return model

    @property
    def verb(self) -> Callable[..., Selection]:
        """The array function: ``verb(points, params, **inputs) -> Selection``."""
        verb: Callable[..., Selection] = getattr(self._module, self.name)
        return verb

    def halo_m(self, params: Parameters) -> float:
        """Return how far outside a tile a point can matter, metres; inf: no distance is safe."""
        return float(self._module.halo_m(params))

    @property
    def _module(self) -> Any:
        return import_module(f"dougong.filters.{self.name}")


FILTERS = MappingProxyType(
    {
        spec.name: spec
        for spec in (
            FilterSpec(
                "octree_voxel_grid", "OctreeVoxelGrid", Reason.DECIMATED, "two-pass", ("records",)
            ),
            FilterSpec("low_outliers", "LowOutliers", Reason.LOW_OUTLIER, "two-pass"),
            FilterSpec("cloth_simulation", "ClothSimulation", Reason.CLOTH, "two-pass"),
            FilterSpec(
                "curvature_weighted",
                "CurvatureWeighted",
                Reason.CURVATURE_WEIGHTED,
                "local",
                ("voxel_count",),
            ),
            FilterSpec("statistical", "Statistical", Reason.STATISTICAL, "two-pass"),
            FilterSpec("radius", "Radius", Reason.RADIUS, "local"),
            FilterSpec("clutter", "Clutter", Reason.CLUTTER, "two-pass", ("height_above_ground",)),
            FilterSpec(
                "pass_through",
                "PassThrough",
                Reason.PASS_THROUGH,
                "two-pass",
                ("height_above_ground",),
            ),
        )
    }
)
"""Every filter by its name, in the order in which a recipe would run them."""


def find(name: str) -> FilterSpec:
    """Return the filter called `name`; hyphens and underscores are the same.

    Raises
    ------
    InputError
        No filter has that name.
    """
    wanted = name.strip().lower().replace("-", "_")
    if wanted in FILTERS:
        return FILTERS[wanted]
    near = difflib.get_close_matches(wanted, FILTERS, 1)
    advice = f"Did you mean {near[0]}?" if near else "Choose one of these."
    raise InputError(f"no filter is called {name!r}; there are {', '.join(FILTERS)}. {advice}")
