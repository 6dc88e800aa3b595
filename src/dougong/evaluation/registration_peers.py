"""Other programs' registration of a pair, at settings that their own documentation recommends.

Each is given float64 points near the origin (map coordinates break some of them) and answers with
one motion. `find` starts from nothing, `refine` from a pose some degrees off. Nothing is imported
before it is asked for; who is not installed is named.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import DougongError
from dougong.evaluation.bench.programs import write_ply
from dougong.registration import Register, refine, register
from dougong.registration.prepare import prepare
from dougong.threads import get_threads
from dougong.typing import Points, Transform

VOXEL_M = 1.0
"""Open3D's global registration: the edge of its voxels, from which its tutorial derives all else.
The tutorial takes 5 cm for a room of a few metres; a site of 60 m wants that many times more."""
NORMALS_M = 0.5
"""Radius of the normals that Open3D's ICP uses."""
KISS_VOXEL_M = 0.3
"""KISS-Matcher's default, meant for outdoor scans."""


class Answer(NamedTuple):
    """What a program says of a pair."""

    T_target_source: Transform
    says: str
    """In its own words or numbers, whether it believes it; empty: it does not say."""


class PeerFailedError(DougongError):
    """A program gave no pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """A program and one way to use it."""

    name: str
    package: str
    """Import name, or the name of the program."""
    task: Literal["find", "refine"]
    settings: str
    run: Callable[[Points, Points, Transform], Answer]
    is_program: bool = False

    @property
    def is_installed(self) -> bool:
        """Say whether it can be asked here."""
        if self.is_program:
            return shutil.which(self.package) is not None
        return importlib.util.find_spec(self.package) is not None


def _cloud(points: Points, name: str) -> Cloud:
    return Cloud.from_points(points, name=name)


def ours_find(source: Points, target: Points, _: Transform) -> Answer:
    """Register from nothing."""
    found = register(_cloud(source, "source"), _cloud(target, "target"), Register())
    if found.matrix is None:
        raise PeerFailedError(found.reason)
    return Answer(found.matrix, found.status)


def ours_refine(source: Points, target: Points, start: Transform) -> Answer:
    """Fit from a start."""
    one, two = _cloud(source, "source"), _cloud(target, "target")
    local = start.copy()
    local[:3, 3] += start[:3, :3] @ one.frame.origin - two.frame.origin
    found = refine(prepare(one, "lidar"), prepare(two, "photogrammetry"), local).T_target_source
    pose = found.copy()
    pose[:3, 3] += two.frame.origin - found[:3, :3] @ one.frame.origin
    return Answer(pose, "")


def _open3d(points: Points) -> Any:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(points)
    return cloud


def _featured(points: Points) -> tuple[Any, Any]:
    """Return a thinned cloud with normals, and its FPFH, as the tutorial makes them."""
    import open3d as o3d

    search = o3d.geometry.KDTreeSearchParamHybrid
    thinned = _open3d(points).voxel_down_sample(VOXEL_M)
    thinned.estimate_normals(search(radius=2 * VOXEL_M, max_nn=30))
    feature = o3d.pipelines.registration.compute_fpfh_feature(
        thinned, search(radius=5 * VOXEL_M, max_nn=100)
    )
    return thinned, feature


def _open3d_refined(source: Points, target: Points, start: Transform, reach_m: float) -> Answer:
    import open3d as o3d

    method = o3d.pipelines.registration
    fixed = _open3d(target)
    fixed.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=NORMALS_M, max_nn=30))
    found = method.registration_icp(
        _open3d(source), fixed, reach_m, start, method.TransformationEstimationPointToPlane()
    )
    return Answer(np.array(found.transformation), f"fitness {found.fitness:.2f}")


def open3d_ransac(source: Points, target: Points, _: Transform) -> Answer:
    """Match FPFH by RANSAC, then point-to-plane ICP."""
    import open3d as o3d

    method = o3d.pipelines.registration
    (one, first), (two, second) = _featured(source), _featured(target)
    reach = 1.5 * VOXEL_M
    o3d.utility.random.seed(0)
    found = method.registration_ransac_based_on_feature_matching(
        one,
        two,
        first,
        second,
        True,
        reach,
        method.TransformationEstimationPointToPoint(False),
        3,
        [
            method.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            method.CorrespondenceCheckerBasedOnDistance(reach),
        ],
        method.RANSACConvergenceCriteria(100_000, 0.999),
    )
    return _open3d_refined(source, target, found.transformation, 0.4 * VOXEL_M)


def open3d_fgr(source: Points, target: Points, _: Transform) -> Answer:
    """Match FPFH by fast global registration, then point-to-plane ICP."""
    import open3d as o3d

    method = o3d.pipelines.registration
    (one, first), (two, second) = _featured(source), _featured(target)
    option = method.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * VOXEL_M)
    found = method.registration_fgr_based_on_feature_matching(one, two, first, second, option)
    return _open3d_refined(source, target, found.transformation, 0.4 * VOXEL_M)


def open3d_icp(source: Points, target: Points, start: Transform) -> Answer:
    """Fit point-to-plane, bound 1 m."""
    return _open3d_refined(source, target, start, 1.0)


def _small_gicp(source: Points, target: Points, start: Transform, method: str) -> Answer:
    import small_gicp

    found = small_gicp.align(
        target, source, start, registration_type=method, num_threads=get_threads()
    )
    return Answer(np.array(found.T_target_source), "converged" if found.converged else "not yet")


def small_gicp_gicp(source: Points, target: Points, start: Transform) -> Answer:
    """Fit by generalised ICP at the package's defaults."""
    return _small_gicp(source, target, start, "GICP")


def small_gicp_plane(source: Points, target: Points, start: Transform) -> Answer:
    """Fit by point-to-plane ICP at the package's defaults."""
    return _small_gicp(source, target, start, "PLANE_ICP")


def kiss_matcher(source: Points, target: Points, _: Transform) -> Answer:
    """Match by KISS-Matcher, then small_gicp as its own examples do, where that is installed."""
    import kiss_matcher as kiss

    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(KISS_VOXEL_M))
    found = matcher.estimate(source.astype(np.float32), target.astype(np.float32))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(found.rotation), np.ravel(found.translation)
    if importlib.util.find_spec("small_gicp") is not None:
        pose = _small_gicp(source, target, pose, "GICP").T_target_source
    return Answer(pose, "valid" if found.valid else "not valid")


def cloudcompare_icp(source: Points, target: Points, start: Transform) -> Answer:
    """Run the program's ICP on files; it reports the motion of the moved cloud."""
    moved = source @ start[:3, :3].T + start[:3, 3]
    with tempfile.TemporaryDirectory(prefix="dougong-study-") as folder:
        files = [Path(folder) / "source.ply", Path(folder) / "target.ply"]
        for file, points in zip(files, (moved, target), strict=True):
            write_ply(file, points)
        load = [word for file in files for word in ("-O", str(file))]
        command = ["CloudCompare", "-SILENT", "-NO_TIMESTAMP", *load, "-ICP", "-OVERLAP", "60"]
        command += ["-RANDOM_SAMPLING_LIMIT", "50000", "-ITER", "100"]
        _said(command)
        found = sorted(Path(folder).glob("*REGISTRATION_MATRIX*"))
        if not found:
            raise PeerFailedError("CloudCompare wrote no registration matrix.")
        step = _matrix(found[0].read_text(encoding="utf-8"))
    return Answer(step @ start, "")


def pdal_icp(source: Points, target: Points, start: Transform) -> Answer:
    """Run ``filters.icp`` on files."""
    moved = source @ start[:3, :3].T + start[:3, 3]
    with tempfile.TemporaryDirectory(prefix="dougong-study-") as folder:
        files = [Path(folder) / "target.ply", Path(folder) / "source.ply"]
        for file, points in zip(files, (target, moved), strict=True):
            write_ply(file, points)
        steps = [*(str(file) for file in files), {"type": "filters.icp", "max_iter": 100}]
        pipeline, told = Path(folder) / "icp.json", Path(folder) / "told.json"
        pipeline.write_text(json.dumps(steps), encoding="utf-8")
        _said(["pdal", "pipeline", str(pipeline), "--metadata", str(told)])
        stage = json.loads(told.read_text(encoding="utf-8"))["stages"]["filters.icp"]
    return Answer(_matrix(stage["composed"]) @ start, f"converged {stage['converged']}")


def _said(command: list[str]) -> str:
    """Run a program without a screen and return what it says."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    if done.returncode != 0:
        words = (done.stderr or done.stdout).strip().splitlines()
        raise PeerFailedError(words[-1] if words else f"exit code {done.returncode}")
    return done.stdout


def _matrix(text: str) -> Transform:
    """Return the first 16 numbers of a text as a matrix (4, 4)."""
    numbers = re.findall(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", text)
    if len(numbers) < 16:
        raise PeerFailedError(f"no matrix in {text[:60]!r}.")
    return np.array(numbers[:16], dtype=np.float64).reshape(4, 4)


_FPFH = f"voxels {VOXEL_M} m, normals 2 voxels (30), FPFH 5 voxels (100)"
PEERS: tuple[Peer, ...] = (
    Peer(name="dougong", package="dougong", task="find", settings="defaults", run=ours_find),
    Peer(
        name="Open3D FPFH + RANSAC + ICP",
        package="open3d",
        task="find",
        settings=f"tutorial: {_FPFH}, bound 1.5 voxels, 100,000 trials; ICP to plane 0.4 voxels",
        run=open3d_ransac,
    ),
    Peer(
        name="Open3D FPFH + FGR + ICP",
        package="open3d",
        task="find",
        settings=f"tutorial: {_FPFH}, bound 0.5 voxels; ICP to plane 0.4 voxels",
        run=open3d_fgr,
    ),
    Peer(
        name="KISS-Matcher + GICP",
        package="kiss_matcher",
        task="find",
        settings=f"default: voxels {KISS_VOXEL_M} m; then small_gicp's GICP at its defaults",
        run=kiss_matcher,
    ),
    Peer(name="dougong", package="dougong", task="refine", settings="defaults", run=ours_refine),
    Peer(
        name="Open3D ICP to plane",
        package="open3d",
        task="refine",
        settings=f"bound 1 m, normals {NORMALS_M} m (30), 30 iterations (default)",
        run=open3d_icp,
    ),
    Peer(
        name="small_gicp GICP",
        package="small_gicp",
        task="refine",
        settings="defaults: voxels 0.25 m, bound 1 m, 20 iterations",
        run=small_gicp_gicp,
    ),
    Peer(
        name="small_gicp ICP to plane",
        package="small_gicp",
        task="refine",
        settings="defaults: voxels 0.25 m, bound 1 m, 20 iterations",
        run=small_gicp_plane,
    ),
    Peer(
        name="CloudCompare ICP",
        package="CloudCompare",
        task="refine",
        settings="default 50,000 sampled points; overlap 60 %, 100 iterations",
        run=cloudcompare_icp,
        is_program=True,
    ),
    Peer(
        name="PDAL filters.icp",
        package="pdal",
        task="refine",
        settings="default: 100 iterations",
        run=pdal_icp,
        is_program=True,
    ),
)
