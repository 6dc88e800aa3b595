"""The places the registration benchmarks survey: five generated ones and two meshes.

The meshes are read from the folder `DOUGONG_TEST_DATA` (by default `../shared/data`).
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Any

from dougong.evaluation.mesh import load_mesh
from dougong.evaluation.scenes import BUILDERS, Scene, make_scene, scan_mesh

DATA = Path(os.environ.get("DOUGONG_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
GENERATED = tuple(BUILDERS)
MESHES = {
    "nuyda": ("nuyda_house/nuyda.ply", False),
    "monastery": ("monastery_mesh/samurai_monastry.obj.gz", True),
}
"""File, and whether its y is up."""


@cache
def _mesh(name: str) -> Any:
    path, is_y_up = MESHES[name]
    if not (DATA / path).is_file():
        msg = f"no mesh at {DATA / path}; set DOUGONG_TEST_DATA or leave {name} out of --scenes."
        raise SystemExit(msg)
    return load_mesh(DATA / path, is_y_up=is_y_up)


def make(name: str, seed: int, *, site: bool = True, **options: Any) -> Scene:
    """Return the survey of a place; `site` False: the generated building alone."""
    if name not in MESHES:
        return make_scene(name, seed, site=site, **options)
    vertices, faces = _mesh(name)
    return scan_mesh(vertices, faces, seed=seed, name=name, ground=site, **options)
