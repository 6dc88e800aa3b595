"""What the commands do and what ``import dougong`` offers: one function per verb.

Everything heavy is imported inside the functions, so that ``dougong --help`` and ``import
dougong`` stay quick.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dougong.errors import DougongError, InputError

if TYPE_CHECKING:
    from dougong.cloud import Cloud
    from dougong.pipeline.progress import Progress
    from dougong.pipeline.recipes import Recipe
    from dougong.pipeline.steps import Filtered
    from dougong.pipeline.store import Store
    from dougong.registration import Register
    from dougong.registration.result import Registration
    from dougong.report.viewing import Viewing as Viewing
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
    """Register `source` onto `target`; see `dougong.registration.register`."""
    from dougong.pipeline.registering import register

    return register(source, target, params, source_kind=source_kind, target_kind=target_kind)


def remove_unfinished() -> None:
    """Remove what a cancelled job had begun to write."""
    from dougong.formats.unfinished import remove_unfinished as remove

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
    from dougong.pipeline.outputs import finite

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


def use_engine(name: str) -> None:
    """Use an engine for tiles from now on; see `dougong.tiles.engine.set_engine`."""
    # The local one is there from the start: nothing is loaded for it.
    if name != "local" or "dougong.tiles.engine" in sys.modules:
        from dougong.tiles.engine import set_engine

        set_engine(name)


def filter_file(
    input: Path,
    output: Path,
    *,
    kind: Kind | None,
    only: str | None,
    mark: bool,
    settings: Sequence[str],
    crs: str | None = None,
    overwrite: bool,
    work: str | None = None,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Filter one file into another; see `dougong.pipeline.filtering.filter_file`."""
    from dougong.pipeline import filtering
    from dougong.tiles.shared import folder_of

    _say_if_cold(progress)
    return filtering.filter_file(
        input,
        output,
        job=filtering.filter_job(kind, only, settings, crs),
        mark=mark,
        overwrite=overwrite,
        memory_bytes=memory_bytes,
        progress=progress,
        work=None if work is None else folder_of(work),
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
    """Move one file by a registration; see `dougong.pipeline.moving.transform_file`."""
    from dougong.pipeline.moving import transform_file as verb

    return verb(
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
    from dougong.pipeline.registering_files import register_files as verb
    from dougong.pipeline.result_folder import (
        refuse_inputs_in_result,
        refuse_other_result,
        result_folder,
    )

    out = _named(out)
    refuse_other_result(out, overwrite)
    refuse_inputs_in_result([source, target], out)
    _say_if_cold(progress)
    with result_folder(out) as part:
        document = verb(
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
    work: str | None,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Filter, register, merge and report a whole project into the folder `out`.

    `merge`, "best" or "all", takes the place of the project's ``merge.mode``.
    """
    from dougong.pipeline.memory import Room
    from dougong.pipeline.project import all_files, asked_project
    from dougong.pipeline.refusals import refuse_full_disk, refuse_or_announce
    from dougong.pipeline.result_folder import refuse_other_result, result_folder
    from dougong.pipeline.run import run

    out = _named(out)
    refuse_other_result(out, overwrite)
    asked, folder = asked_project(project, lidar, photogrammetry, full_resolution, merge)
    files = all_files(asked, folder)
    _refuse_result_as_input(files, out)
    if asked.project.full_resolution:
        refuse_full_disk(files, out)
    _say_if_cold(progress)
    store, room = _store(out, work), Room.of(memory_bytes)
    refuse_or_announce(asked, folder, room, store.scratch, progress)
    with store.resumable(), result_folder(out) as part:
        document = run(asked, folder, part, store=store, progress=progress, room=room)
        _build_report(part, progress)
    store.finish()
    return document


def _refuse_result_as_input(files: Sequence[Path], out: Path) -> None:
    """Refuse files of an earlier result in `out`."""
    from dougong.pipeline.project import refuse_own_result
    from dougong.pipeline.result_folder import refuse_inputs_in_result

    refuse_own_result(files, out)
    refuse_inputs_in_result(files, out)


def plan(
    project: Path | None,
    out: Path | None = None,
    *,
    lidar: Sequence[Path],
    photogrammetry: Sequence[Path],
    full_resolution: bool,
    merge: str | None,
    overwrite: bool,
    memory_bytes: int | None,
    progress: Progress,
) -> Document:
    """Return what `run_project` would do: ways, memory, disk, time (see `pipeline.plan.Plan`).

    With `out` None it is not asked whether a result is there already.
    """
    from dougong.pipeline.memory import Room
    from dougong.pipeline.plan import plan_run
    from dougong.pipeline.project import all_files, asked_project
    from dougong.pipeline.result_folder import refuse_other_result

    asked, folder = asked_project(project, lidar, photogrammetry, full_resolution, merge)
    files = all_files(asked, folder)
    progress.stage("counting points")
    document = plan_run(asked, folder, Room.of(memory_bytes)).document()
    if out is not None and document["refusal"] is None:
        try:
            refuse_other_result(_named(out), overwrite)
            _refuse_result_as_input(files, _named(out))
        except InputError as error:
            document["refusal"] = str(error)
    return document


def demo(
    scene: str,
    out: Path | None,
    *,
    seed: int,
    size: str,
    overwrite: bool,
    work: str | None,
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
    from dougong.evaluation.demo import free_folder, refuse_too_large_demo, run_demo
    from dougong.pipeline.result_folder import refuse_other_result, result_folder

    folder = free_folder(scene) if out is None else _named(out)
    refuse_other_result(folder, overwrite)
    refuse_too_large_demo(size, memory_bytes)
    _say_if_cold(progress)
    store = _store(folder, work)
    with store.resumable(), result_folder(folder) as part:
        document = run_demo(
            scene, part, seed=seed, size=size, shown_as=folder, store=store, progress=progress
        )
        _build_report(part, progress)
    store.finish()
    return document


def _named(out: Path) -> Path:
    """Return a result folder by a path that ends in its name, so that another can lie beside it."""
    return out if out.name not in ("", "..") else out.resolve()


def _store(out: Path, work: str | None) -> Store:
    """Return where finished filter steps are kept: ``--work``, else a folder beside `out`."""
    from dougong.pipeline.store import Store
    from dougong.tiles.shared import folder_of

    if work is not None:
        return Store.kept(folder_of(work), out)
    return Store.beside(out)


def _say_if_cold(progress: Progress) -> None:
    """Say that the first run compiles, where it does."""
    from dougong.pipeline.provenance import kernels_are_compiled

    if not kernels_are_compiled():
        progress.note(
            "first run: the kernels are compiled now, once; this takes about a minute "
            "and later runs start at once"
        )


def evaluate(
    study: str,
    out: Path | None,
    *,
    seed: int,
    is_quick: bool,
    runs: int | None,
    points: int | None,
    data: Path | None,
    overwrite: bool,
    progress: Progress,
) -> tuple[Document, str]:
    """Run a study; return its document and its table in words (see `evaluation.studies`)."""
    from dougong.evaluation.studies import Setting
    from dougong.evaluation.studies import evaluate as verb

    if runs is not None and runs < 1:
        raise InputError(f"--runs must be 1 or more, got {runs}.")
    if points is not None and points < 10_000:
        raise InputError(f"--points must be 10,000 or more, got {points:,}.")
    setting = Setting(seed=seed, runs=runs, is_quick=is_quick, points=points, data=data)
    folder = Path(f"dougong-{study}") if out is None else _named(out)
    return verb(study, folder, setting, overwrite=overwrite, progress=progress)


def bench(
    out: Path,
    *,
    operations: Sequence[str],
    sizes: Sequence[int],
    threads: int | None,
    repeats: int,
    seed: int,
    work: Path | None,
    overwrite: bool,
    progress: Progress,
) -> tuple[Document, str]:
    """Measure ours beside the installed peers (see `evaluation.bench`).

    With `threads` None: with one thread, and with all that this process may use.
    """
    from dougong.evaluation.bench import Setting
    from dougong.evaluation.bench import bench as verb
    from dougong.threads import get_threads

    setting = Setting(
        operations=operations,
        sizes=sizes,
        threads=sorted({1, get_threads()}) if threads is None else [threads],
        repeats=repeats,
        seed=seed,
    )
    return verb(_named(out), setting, overwrite=overwrite, work=work, progress=progress)


def report(folder: Path, *, progress: Progress) -> Document:
    """Rebuild ``report.html`` in a result folder."""
    return {"report": str(_build_report(folder, progress, is_fresh=False))}


def view(
    paths: Sequence[Path],
    *,
    port: int,
    open_browser: bool,
    work: Path | None,
    progress: Progress,
    pairs: Path | None = None,
    memory_bytes: int | None = None,
) -> Viewing:
    """Serve clouds or result folders to the browser; see `dougong.report.viewing.open_view`."""
    from dougong.report.viewing import open_view

    return open_view(
        paths,
        port=port,
        open_browser=open_browser,
        work=work,
        progress=progress,
        pairs=pairs,
        memory_bytes=memory_bytes,
    )


def _build_report(folder: Path, progress: Progress, *, is_fresh: bool = True) -> Path:
    from dougong.report import build, rebuild
    from dougong.report.viewer import why_missing

    progress.stage("drawing the report")
    missing = why_missing()
    if missing is not None:
        progress.note(f"the report holds still pictures only, no 3-D view: {missing}")
    return build(folder) if is_fresh else rebuild(folder)
