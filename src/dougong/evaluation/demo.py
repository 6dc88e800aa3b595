"""The demo: a generated scene goes through the whole program, and its truth judges the result."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dougong.errors import InputError
from dougong.evaluation.metrics import Truth, pose_errors
from dougong.evaluation.scenes import make_scene
from dougong.evaluation.survey import Scene
from dougong.formats import write
from dougong.pipeline.memory import estimated_bytes
from dougong.pipeline.outputs import write_json
from dougong.pipeline.progress import Progress
from dougong.pipeline.project import from_files
from dougong.pipeline.run import run
from dougong.pipeline.store import Store

DEMO_POINTS = {"normal": (1_000_000, 600_000), "small": (250_000, 150_000)}
"""Scanner and drone points of a demo scene."""


def run_demo(
    scene: str,
    out: Path,
    *,
    seed: int,
    size: str,
    shown_as: Path,
    store: Store,
    progress: Progress,
) -> dict[str, Any]:
    """Survey a scene, run everything on it, and compare the pose with the truth.

    Parameters
    ----------
    scene : str
        hall, pagoda, tulou, wall or cave.
    out : Path
        An empty folder: gets what a run writes, ``scene/`` and ``demo.json``.
    seed : int
    size : "normal" or "small"
    shown_as : Path
        How `out` is named in the results.
    store : Store
        Keeps finished filter steps.
    progress : Progress

    Returns
    -------
    dict
        The document of demo.json.
    """
    progress.stage(f"surveying the {scene} with a scanner and a drone (seed {seed})")
    lidar_points, drone_points = DEMO_POINTS[size]
    made = make_scene(scene, seed, lidar_points=lidar_points, photogrammetry_points=drone_points)
    files = _write_scene(out / "scene", made)
    project = from_files([files[0]], [files[1]])
    head = project.project.model_copy(update={"name": f"Demo: {scene}"})
    result = run(
        project.model_copy(update={"project": head}),
        out,
        out,
        store=store,
        progress=progress,
        shown=lambda path: str(shown_as / path.relative_to(out.resolve())),
    )
    document = _document(scene, seed, result, made.truth, shown_as)
    write_json(out / "demo.json", document)
    return document


def free_folder(scene: str) -> Path:
    """Return a folder name that is still free."""
    folder, number = Path(f"dougong-demo-{scene}"), 2
    while folder.exists():
        folder, number = Path(f"dougong-demo-{scene}-{number}"), number + 1
    return folder


def refuse_too_large_demo(size: str, memory_bytes: int | None) -> None:
    """Refuse a demo that needs more than ``--memory``.

    Raises
    ------
    InputError
        It does.
    """
    need = estimated_bytes(DEMO_POINTS[size])
    if memory_bytes is not None and need > memory_bytes:
        msg = (
            f"the demo needs about {need / 1e9:.1f} GB, more than --memory "
            f"{memory_bytes / 1e9:.1f} GB. Raise it or pass --size small."
        )
        raise InputError(msg)


def _write_scene(folder: Path, made: Scene) -> tuple[Path, Path]:
    """Write a scene's clouds as a survey would deliver them, and its truth beside them."""
    folder.mkdir()
    files = folder / "lidar.laz", folder / "drone.laz"
    for file, cloud in zip(files, (made.lidar, made.photogrammetry), strict=True):
        write(cloud, file)
    truth = made.truth
    write_json(
        folder / "truth.json",
        {"T_target_source": truth.T_target_source.tolist(), "T_best": truth.T_best.tolist()},
    )
    return files[0].resolve(), files[1].resolve()


def _document(
    scene: str, seed: int, result: Mapping[str, Any], truth: Truth, folder: Path
) -> dict[str, Any]:
    """Return the demo's answer: the status, and the pose's errors against the truth."""
    matrix = result["registrations"][0]["matrix"]
    document: dict[str, Any] = {
        "scene": scene,
        "seed": seed,
        "status": result["status"],
        "rotation_error_deg": None,
        "tre95_m": None,
        "bending_floor95_m": None,
        "total95_m": None,
        "verdict": "no pose was found",
        "seconds": result["seconds"]["total"],
        "peak_memory_bytes": result["peak_memory_bytes"],
        "report": str(folder / "report.html"),
    }
    if matrix is not None:
        errors = pose_errors(matrix, truth)
        accurate = "accurate (TRE95 <= 20 mm, rotation <= 0.02 deg)"
        correct = "correct (TRE95 <= 50 mm)"
        wrong = "WRONG (TRE95 > 50 mm)"
        document |= {
            "rotation_error_deg": errors.rotation_error_deg,
            "tre95_m": errors.tre95_m,
            "bending_floor95_m": errors.bending_floor95_m,
            "total95_m": errors.total95_m,
            "verdict": accurate if errors.is_accurate else correct if errors.is_correct else wrong,
        }
    return document
