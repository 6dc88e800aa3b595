"""What the commands do and what ``import dougong`` offers: one function per verb.

Everything heavy is imported inside the functions, so that ``dougong --help`` and ``import
dougong`` stay quick.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from dougong.errors import DougongError, InputError

if TYPE_CHECKING:
    from dougong.cloud import Cloud
    from dougong.evaluation.metrics import Truth
    from dougong.evaluation.survey import Scene
    from dougong.pipeline.memory import Room
    from dougong.pipeline.progress import Progress
    from dougong.pipeline.project import Project
    from dougong.pipeline.recipes import Recipe
    from dougong.pipeline.steps import Filtered
    from dougong.pipeline.store import Store
    from dougong.registration import Register
    from dougong.registration.result import Registration
    from dougong.report.server import ViewServer
    from dougong.report.streaming import Scene as Shown
    from dougong.typing import Kind

Document = dict[str, Any]


def filter_cloud(
    cloud: Cloud,
    kind: Kind,
    params: Recipe | None = None,
    progress: Progress | None = None,
) -> Filtered:
    """Run the recipe of `kind` on `cloud`; see `dougong.pipeline.recipes.filter_cloud`."""
    from dougong.pipeline.recipes import filter_cloud as verb

    return verb(cloud, kind, params, progress)


def register_clouds(
    source: Cloud,
    target: Cloud,
    params: Register | None = None,
    *,
    source_kind: Kind = "lidar",
    target_kind: Kind = "photogrammetry",
) -> Registration:
    """Register `source` onto `target`; see `dougong.pipeline.registering.register`."""
    from dougong.pipeline.registering import register

    return register(source, target, params, source_kind=source_kind, target_kind=target_kind)


def remove_unfinished() -> None:
    """Remove what a cancelled job had begun to write."""
    from dougong.pipeline.outputs import remove_unfinished as remove

    remove()


def info(files: Sequence[Path], *, progress: Progress) -> Document:
    """Return what is in each of `files`; one of several that is unreadable holds its error.

    Raises
    ------
    InputError
        No file is named.
    FormatError
        The only file cannot be read.
    """
    from dougong.formats import describe
    from dougong.pipeline.registrations import finite

    _need_files(files)
    found = []
    for file in files:
        progress.stage(f"describing {file.name}")
        try:
            found.append(finite(asdict(describe(file))))
        except DougongError as error:
            if len(files) == 1:
                raise
            said = {"type": type(error).__name__, "message": str(error)}
            found.append({"path": str(file), "error": said})
    return {"files": found, "is_readable": not any("error" in file for file in found)}


def check(files: Sequence[Path], *, progress: Progress) -> Document:
    """Return what is wrong with each of `files`; an unreadable one is an error among them."""
    from dougong.formats import check as check_file

    _need_files(files)
    found: list[Document] = []
    for file in files:
        progress.stage(f"checking {file.name}")
        try:
            findings = [{"severity": f.severity, "text": f.text} for f in check_file(file)]
        except DougongError as error:
            findings = [{"severity": "error", "text": str(error)}]
        found.append({"path": str(file), "findings": findings})
    bad = any(finding["severity"] == "error" for file in found for finding in file["findings"])
    return {"files": found, "is_usable": not bad}


def _need_files(files: Sequence[Path]) -> None:
    if not files:
        msg = "no file is named. Name one or more clouds."
        raise InputError(msg)


def init(folder: Path, *, overwrite: bool, progress: Progress) -> Document:
    """Write a commented project file for the clouds in `folder`."""
    from dougong.pipeline.guess import find_clouds, project_text
    from dougong.pipeline.outputs import refuse_existing, write_text

    path = folder / "project.toml"
    refuse_existing([path], overwrite)
    progress.stage(f"looking for clouds in {folder}")
    guesses, skipped = find_clouds(folder)
    write_text(path, project_text(folder.resolve().name, guesses, skipped))
    clouds = [{**asdict(guess), "file": str(guess.file)} for guess in guesses]
    return {"project": str(path), "clouds": clouds, "skipped": skipped}


def filter_file(
    input: Path,
    output: Path,
    *,
    kind: Kind | None,
    only: str | None,
    mark: bool,
    settings: Sequence[str],
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Filter one file into another; see `dougong.pipeline.jobs.filter_file`."""
    from dougong.pipeline import jobs

    _say_if_cold(progress)
    return jobs.filter_file(
        input,
        output,
        job=jobs.filter_job(kind, only, settings),
        mark=mark,
        overwrite=overwrite,
        memory_bytes=memory_bytes,
        progress=progress,
    )


def transform_file(
    input: Path,
    output: Path,
    matrix: Path,
    *,
    accept_best: bool,
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Move one file by a registration; see `dougong.pipeline.jobs.transform_file`."""
    from dougong.pipeline import jobs

    return jobs.transform_file(
        input,
        output,
        matrix,
        accept_best=accept_best,
        overwrite=overwrite,
        memory_bytes=memory_bytes,
        progress=progress,
    )


def register_files(
    source: Path,
    target: Path,
    out: Path,
    *,
    options: Document,
    source_kind: Kind | None,
    target_kind: Kind | None,
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
    pairs: Path | None = None,
    control: Path | None = None,
    crs: tuple[str | None, str | None] = (None, None),
) -> Document:
    """Register one file onto another and write registration.json and report.html into `out`.

    Parameters
    ----------
    source, target : Path
    out : Path
    options : dict
        Fields of `Register`.
    source_kind, target_kind : optional
        The sensors; guessed from the files where they are not given.
    pairs : Path, optional
        A CSV file of places picked in both clouds.
    control : Path, optional
        A CSV file of control and check points.
    crs : pair of str, optional
        Reference systems of a source and a target whose files name none.
    """
    from dougong.pipeline import jobs
    from dougong.pipeline.outputs import refuse_existing, result_folder

    out = _named(out)
    refuse_existing([out / "registration.json"], overwrite)
    _say_if_cold(progress)
    with result_folder(out) as part:
        document = jobs.register_files(
            source,
            target,
            part,
            options=options,
            source_kind=source_kind,
            target_kind=target_kind,
            memory_bytes=memory_bytes,
            progress=progress,
            pairs=pairs,
            control=control,
            crs=crs,
        )
        _build_report(part, progress)
    return document


def run_project(
    project: Path | None,
    out: Path,
    *,
    lidar: Sequence[Path],
    photogrammetry: Sequence[Path],
    full_resolution: bool,
    merge: str | None,
    overwrite: bool,
    work: Path | None,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Filter, register, merge and report a whole project into the folder `out`.

    `merge`, "best" or "all", takes the place of the project's ``merge.mode``.
    """
    from dougong.pipeline.full_resolution import refuse_full_disk
    from dougong.pipeline.memory import Room
    from dougong.pipeline.outputs import refuse_existing, result_folder
    from dougong.pipeline.project import files_of
    from dougong.pipeline.run import run

    out = _named(out)
    refuse_existing([out / "result.json"], overwrite)
    asked, folder = _asked_project(project, lidar, photogrammetry, full_resolution, merge)
    files = [file for entry in asked.cloud for file in files_of(entry, folder)]
    if asked.project.full_resolution:
        refuse_full_disk(files, out)
    _say_if_cold(progress)
    store, room = _store(out, work), Room.of(memory_bytes)
    _refuse_or_announce(asked, folder, files, room, store.folder, progress)
    with result_folder(out) as part:
        document = run(asked, folder, part, store=store, progress=progress, room=room)
        _build_report(part, progress)
    store.finish()
    return document


def _asked_project(
    project: Path | None,
    lidar: Sequence[Path],
    photogrammetry: Sequence[Path],
    full_resolution: bool,
    merge: str | None = None,
) -> tuple[Project, Path]:
    """Return the project and the folder that its paths are relative to."""
    from dougong.pipeline.project import from_files, read_project

    if project is not None and (lidar or photogrammetry):
        msg = "a project file and --lidar or --photogrammetry were given. Pass one or the other."
        raise InputError(msg)
    asked = from_files(lidar, photogrammetry) if project is None else read_project(project)
    if merge is not None:
        asked = asked.model_copy(update={"merge": asked.merge.model_copy(update={"mode": merge})})
    if full_resolution:
        head = asked.project.model_copy(update={"full_resolution": True})
        asked = asked.model_copy(update={"project": head})
    return asked, Path() if project is None else project.parent


LONG_SECONDS = 120.0
"""A run that may take longer is announced with its plan."""
_QUICK_BYTES = 100_000_000


def _refuse_or_announce(
    project: Project,
    folder: Path,
    files: Sequence[Path],
    room: Room,
    work: Path,
    progress: Progress,
) -> None:
    """Plan a run whose files are many bytes: refuse what cannot be, say what takes long."""
    from dougong.pipeline.plan import plan_run, refuse_full_work_disk

    size = sum(file.stat().st_size for file in files if file.is_file())
    if not room.is_asked and size < _QUICK_BYTES:
        return  # counting the points of some formats takes a pass over them
    plan = plan_run(project, folder, room)
    if plan.refusal is not None:
        raise InputError(plan.refusal)
    refuse_full_work_disk(plan, work)
    if plan.seconds > LONG_SECONDS:
        progress.note(plan.in_words())


def plan(
    project: Path | None,
    *,
    lidar: Sequence[Path],
    photogrammetry: Sequence[Path],
    full_resolution: bool,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Return what `run_project` would do: ways, memory, disk, time (see `pipeline.plan.Plan`)."""
    from dougong.pipeline.memory import Room
    from dougong.pipeline.plan import plan_run

    asked, folder = _asked_project(project, lidar, photogrammetry, full_resolution)
    progress.stage("counting points")
    return plan_run(asked, folder, Room.of(memory_bytes)).document()


def demo(
    scene: str,
    out: Path | None,
    *,
    seed: int,
    size: str,
    overwrite: bool,
    work: Path | None,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Make a scene with known truth, run everything on it, and compare with the truth.

    Parameters
    ----------
    scene : str
        hall, pagoda, tulou, wall or cave.
    out : Path or None
        None: a free name in the current folder.
    seed : int
    size : "normal" or "small"
    """
    from dougong.evaluation.scenes import make_scene
    from dougong.pipeline.outputs import refuse_existing, result_folder, write_json
    from dougong.pipeline.project import from_files
    from dougong.pipeline.run import run

    folder = _demo_folder(scene) if out is None else _named(out)
    refuse_existing([folder / "result.json"], overwrite)
    _refuse_large_demo(size, memory_bytes)
    _say_if_cold(progress)
    store = _store(folder, work)
    with result_folder(folder) as part:
        progress.stage(f"surveying the {scene} with a scanner and a drone (seed {seed})")
        lidar_points, drone_points = DEMO_POINTS[size]
        made = make_scene(
            scene, seed, lidar_points=lidar_points, photogrammetry_points=drone_points
        )
        files = _write_scene(part / "scene", made)
        plan = from_files([files[0]], [files[1]])
        plan = plan.model_copy(
            update={"project": plan.project.model_copy(update={"name": f"Demo: {scene}"})}
        )
        result = run(
            plan,
            part,
            part,
            store=store,
            progress=progress,
            shown=lambda path: str(folder / path.relative_to(part.resolve())),
        )
        document = _demo_document(scene, seed, result, made.truth, folder)
        write_json(part / "demo.json", document)
        _build_report(part, progress)
    store.finish()
    return document


DEMO_POINTS = {"normal": (1_000_000, 600_000), "small": (250_000, 150_000)}
"""Scanner and drone points of a demo scene."""


def _demo_folder(scene: str) -> Path:
    """Return a folder name that is still free."""
    folder, number = Path(f"dougong-demo-{scene}"), 2
    while folder.exists():
        folder, number = Path(f"dougong-demo-{scene}-{number}"), number + 1
    return folder


def _refuse_large_demo(size: str, memory_bytes: int | None) -> None:
    from dougong.pipeline.memory import estimated_bytes

    need = estimated_bytes(DEMO_POINTS[size])
    if memory_bytes is not None and need > memory_bytes:
        msg = (
            f"the demo needs about {need / 1e9:.1f} GB, more than --memory "
            f"{memory_bytes / 1e9:.1f} GB. Raise it or pass --size small."
        )
        raise InputError(msg)


def _write_scene(folder: Path, made: Scene) -> tuple[Path, Path]:
    """Write a scene's clouds as a survey would deliver them, and its truth beside them."""
    from dougong.formats import write
    from dougong.pipeline.outputs import write_json

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


def _demo_document(scene: str, seed: int, result: Document, truth: Truth, folder: Path) -> Document:
    """Return the demo's answer: the status, and the pose's errors against the truth."""
    from dougong.evaluation.metrics import pose_errors

    matrix = result["registrations"][0]["matrix"]
    document: Document = {
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


def _named(out: Path) -> Path:
    """Return a result folder by a path that ends in its name, so that another can lie beside it."""
    return out if out.name not in ("", "..") else out.resolve()


def _store(out: Path, work: Path | None) -> Store:
    """Return where finished filter steps are kept: ``--work``, else a folder beside `out`."""
    from dougong.pipeline.store import Store

    if work is not None:
        return Store(work, is_temporary=False)
    return Store(out.with_name(f"{out.name}.work"), is_temporary=True)


def _say_if_cold(progress: Progress) -> None:
    """Say that the first run compiles, where it does."""
    from dougong.pipeline.provenance import kernels_are_compiled

    if not kernels_are_compiled():
        progress.note(
            "first run: the kernels are compiled now, once; this takes about a minute "
            "and later runs start at once"
        )


def report(folder: Path, *, progress: Progress) -> Document:
    """Rebuild ``report.html`` in a result folder."""
    return {"report": str(_build_report(folder, progress))}


@dataclass(frozen=True, slots=True)
class Viewing:
    """An open viewer: what to say about it, and how to end it."""

    document: Document
    server: ViewServer
    scratch: TemporaryDirectory[str]

    def close(self) -> None:
        """Stop serving and remove the temporary files."""
        self.server.close()
        self.scratch.cleanup()


def view(
    paths: Sequence[Path],
    *,
    port: int,
    open_browser: bool,
    work: Path | None,
    progress: Progress,
    pairs: Path | None = None,
) -> Viewing:
    """Serve clouds or result folders to the browser of this computer.

    `pairs` is the CSV file that places picked in two clouds go to.

    Raises
    ------
    InputError
        Nothing is named, a folder holds no result, or the port is taken.
    FormatError
        A file cannot be read.
    """
    import webbrowser

    from dougong.report.server import ViewServer
    from dougong.report.streaming import prepare

    if work is not None:
        work.mkdir(parents=True, exist_ok=True)
    scratch = TemporaryDirectory(prefix="dougong-view-", dir=work, ignore_cleanup_errors=True)
    try:
        scene = prepare(paths, Path(scratch.name), progress.stage, pairs)
        server = _view_server(ViewServer, scene, port)
    except BaseException:
        scratch.cleanup()
        raise
    document = {
        "url": server.url,
        "clouds": list(scene.clouds),
        "points": scene.points,
        "notes": list(scene.notes),
        "is_browser_open": open_browser and webbrowser.open(server.url),
    }
    return Viewing(document, server, scratch)


def _view_server(make: type[ViewServer], scene: Shown, port: int) -> ViewServer:
    try:
        return make(scene.things, port, scene.takes)
    except (OSError, OverflowError) as error:
        msg = f"port {port} cannot be used ({error}). Pass another --port, or none."
        raise InputError(msg) from error


def _build_report(folder: Path, progress: Progress) -> Path:
    from dougong.report import build
    from dougong.report.viewer import why_missing

    progress.stage("drawing the report")
    missing = why_missing()
    if missing is not None:
        progress.note(f"the report holds still pictures only, no 3-D view: {missing}")
    return build(folder)
