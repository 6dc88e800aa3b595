"""Who is measured: our operations and the peers' nearest equivalents, by operation and name."""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.bench import ours, peers, programs
from dougong.evaluation.bench.ours import (
    CLOTH_M,
    NEIGHBOURS,
    RADIUS_M,
    RELIEF_RADIUS_M,
    ROR_RADIUS_M,
    VOXEL_M,
    Arrays,
)

OURS = "dougong"
_ANY = 10**9


@dataclass(frozen=True, slots=True)
class Contender:
    """One implementation of an operation."""

    name: str
    run: Callable[[Arrays, int], Any]
    """Does the work on the scene's arrays with so many threads."""
    package: str = "dougong"
    """What must be installed: an importable package, or a program where `is_program`."""
    is_equal: bool = True
    """False: it answers a slightly different question and counts for no ratio."""
    most: int = _ANY
    """Largest number of points it is asked for: above, it takes minutes or too much memory."""
    is_program: bool = False

    @property
    def is_ours(self) -> bool:
        """Say whether this is one of ours."""
        return self.package == OURS

    @property
    def is_installed(self) -> bool:
        """Say whether it can run here."""
        if self.is_program:
            return programs.is_installed(self.package)
        return find_spec(self.package) is not None


@dataclass(frozen=True, slots=True)
class Operation:
    """One kind of work, asked of several contenders on one scene."""

    title: str
    scene: str
    contenders: tuple[Contender, ...]
    answer: Callable[[Any, Arrays], dict[str, float]] = field(repr=False)
    """Numbers that show that the work was done, and alike."""


def _kept(result: Any, arrays: Arrays) -> dict[str, float]:
    del arrays
    return {"kept": float(result)}


def _distances(result: Any, arrays: Arrays) -> dict[str, float]:
    del arrays
    return {"mean_last_distance_m": float(np.mean(np.asarray(result)[:, -1]))}


def _counts(result: Any, arrays: Arrays) -> dict[str, float]:
    return {"mean_count": float(np.sum(result)) / len(arrays["points"])}


def _normals(result: Any, arrays: Arrays) -> dict[str, float]:
    del arrays
    return {"mean_abs_z": float(np.mean(np.abs(np.asarray(result)[:, 2])))}


def _variation(result: Any, arrays: Arrays) -> dict[str, float]:
    del arrays
    return {"mean_variation": float(np.mean(result))}


def _ground(result: Any, arrays: Arrays) -> dict[str, float]:
    is_ground: NDArray[np.bool_] = np.zeros(len(arrays["points"]), bool)
    is_ground[result] = True
    label = arrays["label"]
    return {
        "recall": float(is_ground[label == 2].mean()),
        "false": float(is_ground[label == 0].mean()),
    }


def _pose(result: Any, arrays: Arrays) -> dict[str, float]:
    truth = arrays["truth"]
    turn = result[:3, :3] @ truth[:3, :3].T
    sine = np.linalg.norm(turn - turn.T) / np.sqrt(8.0)
    ends = arrays["source"][:: max(1, len(arrays["source"]) // 20_000)]
    apart = ends @ (result - truth)[:3, :3].T + (result - truth)[:3, 3]
    return {
        "rotation_error_deg": float(np.degrees(np.arcsin(min(1.0, sine)))),
        "displacement_p95_mm": 1e3 * float(np.quantile(np.linalg.norm(apart, axis=1), 0.95)),
    }


OPERATIONS: dict[str, Operation] = {
    "voxel": Operation(
        f"voxel grid {VOXEL_M} m, the point nearest the centre",
        "site",
        (
            Contender(OURS, ours.voxel),
            Contender("numpy", peers.voxel_numpy, "numpy"),
            Contender("open3d", peers.voxel_open3d, "open3d", is_equal=False),
            Contender("small_gicp", peers.voxel_small_gicp, "small_gicp", is_equal=False),
            Contender("pdal", programs.pdal_voxel, "pdal", is_program=True),
        ),
        _kept,
    ),
    "knn": Operation(
        f"{NEIGHBOURS} nearest others of every point",
        "site",
        (
            Contender(OURS, ours.knn),
            Contender("scipy", peers.knn_scipy, "scipy"),
            Contender("pykdtree", peers.knn_pykdtree, "pykdtree"),
            Contender("pgeof", peers.knn_pgeof, "pgeof"),
            Contender("small_gicp", peers.knn_small_gicp, "small_gicp"),
            Contender("open3d", peers.knn_open3d, "open3d", most=1_000_000),
        ),
        _distances,
    ),
    "radius": Operation(
        f"neighbours within {RADIUS_M} m of every point, counted",
        "site",
        (
            Contender(OURS, ours.radius),
            Contender("scipy", peers.radius_scipy, "scipy", most=1_000_000),
            Contender("open3d", peers.radius_open3d, "open3d", most=1_000_000),
        ),
        _counts,
    ),
    "normals": Operation(
        f"normals from {NEIGHBOURS} neighbours",
        "site",
        (
            Contender(OURS, ours.normals),
            Contender("small_gicp", peers.normals_small_gicp, "small_gicp"),
            Contender("open3d", peers.normals_open3d, "open3d"),
            Contender("pgeof", peers.normals_pgeof, "pgeof"),
        ),
        _normals,
    ),
    "sor": Operation(
        f"statistical outlier removal, {NEIGHBOURS} neighbours, 2 sigma",
        "site",
        (
            Contender(OURS, ours.sor),
            Contender("open3d", peers.sor_open3d, "open3d"),
            Contender("pykdtree", peers.sor_pykdtree, "pykdtree"),
            Contender("scipy", peers.sor_scipy, "scipy"),
            Contender("pdal", programs.pdal_sor, "pdal", is_program=True),
            Contender("CloudCompare", programs.cloudcompare_sor, "CloudCompare", is_program=True),
        ),
        _kept,
    ),
    "ror": Operation(
        f"radius outlier removal, 4 others within {ROR_RADIUS_M} m",
        "site",
        (
            Contender(OURS, ours.ror),
            Contender("open3d", peers.ror_open3d, "open3d"),
            Contender("scipy", peers.ror_scipy, "scipy"),
            Contender("pdal", programs.pdal_ror, "pdal", is_program=True),
        ),
        _kept,
    ),
    "curvature": Operation(
        f"surface variation in balls of {RELIEF_RADIUS_M} m at 5 mm spacing",
        "facade",
        (
            Contender(OURS, ours.curvature),
            Contender("jakteristics", peers.curvature_jakteristics, "jakteristics", most=100_000),
            Contender("open3d", peers.curvature_open3d, "open3d", most=100_000),
            Contender("scipy", peers.curvature_scipy, "scipy", most=100_000),
        ),
        _variation,
    ),
    "cwasf": Operation(
        f"curvature-weighted filter (rule paper), {RELIEF_RADIUS_M} m at 5 mm spacing",
        "facade",
        (
            Contender(OURS, ours.cwasf),
            Contender("dougong fast balls", ours.cwasf_fast, is_equal=False),
            Contender("dougong protective", ours.cwasf_protective, is_equal=False),
        ),
        _kept,
    ),
    "csf": Operation(
        f"cloth simulation, {CLOTH_M} m, no outliers",
        "clean_site",
        (
            Contender(OURS, ours.csf),
            Contender("dougong with guard", ours.csf_guarded, is_equal=False),
            Contender("cloth-simulation-filter", peers.csf_published, "CSF"),
            Contender("pdal", programs.pdal_csf, "pdal", is_program=True),
        ),
        _ground,
    ),
    "csf-outliers": Operation(
        f"cloth simulation, {CLOTH_M} m, 1.5 % outliers left in",
        "site",
        (
            Contender(OURS, ours.csf_guarded),
            Contender("cloth-simulation-filter", peers.csf_published, "CSF"),
        ),
        _ground,
    ),
    "icp": Operation(
        "ICP from 5 degrees and 0.5 m, everything included",
        "pair",
        (
            Contender(OURS, ours.icp),
            Contender("small_gicp plane", peers.icp_small_gicp_plane, "small_gicp", most=1_000_000),
            Contender("small_gicp GICP", peers.icp_small_gicp, "small_gicp", most=1_000_000),
            Contender("open3d plane", peers.icp_open3d, "open3d", most=1_000_000),
        ),
        _pose,
    ),
}


def absent() -> list[str]:
    """Return the packages and programs that are not installed, sorted."""
    everyone = (c for operation in OPERATIONS.values() for c in operation.contenders)
    return sorted({c.package for c in everyone if not c.is_installed})
