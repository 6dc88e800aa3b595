"""``dougong run``: the main job."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from dougong import app
from dougong._words import counted
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, UNSURE, Answer, Listener, execute


def command(
    project: Path | None = None,
    *,
    out: Path,
    lidar: Annotated[list[Path] | None, Parameter(negative="")] = None,
    photogrammetry: Annotated[list[Path] | None, Parameter(negative="")] = None,
    full_resolution: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    merge: Literal["best", "all"] | None = None,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Filter every cloud, register it onto the reference, merge, report.

    The reference is the first photogrammetry cloud, else the first lidar one.
    A project file may name another. One cloud alone is only filtered.

    Example: dougong run --lidar scan.laz --photogrammetry drone.laz --out result

    Parameters
    ----------
    project
        Project file; `dougong init DIR` writes one.
    out
        Folder for the result: merged.copc.laz, clouds, registrations, result.json, report.html.
    lidar
        A laser scan; may be given several times.
    photogrammetry
        A drone cloud; may be given several times.
    full_resolution
        Also write every input file, undecimated, in the frame of the reference, into full/.
    merge
        best: where laser and drone saw the same surface, only the better source goes into the
        merged cloud (default); all: every point does.
    overwrite
        Replace a result that exists already.
    """

    def work(progress: Listener) -> Answer:
        document = app.run_project(
            project,
            out,
            lidar=lidar or (),
            photogrammetry=photogrammetry or (),
            full_resolution=full_resolution,
            merge=merge,
            overwrite=overwrite,
            work=common.work,
            memory_bytes=common.memory_bytes(),
            progress=progress,
        )
        code = DONE if document["is_settled"] else UNSURE
        return Answer(document=document, text=_words(document, out), exit_code=code)

    return execute(common, work, kept="Finished filter steps are kept; run it again to go on.")


def _left_out(merged: dict[str, Any]) -> str:
    count = merged["left_out"]
    return f" ({_text.count(count)} left out: a better source has them)" if count else ""


def _words(document: dict[str, Any], out: Path) -> str:
    parts = []
    for cloud in document["clouds"]:
        parts += [f"{cloud['name']} ({_text.origin(cloud)})", _text.stages(cloud["stages"])]
    parts += [_text.registration(entry) for entry in document["registrations"]]
    merged = document["merged"]
    spent = f"{document['seconds']['total']:.1f} s"
    parts.append(
        f"merged {counted(merged['points'])} of {', '.join(merged['clouds'])}"
        f"{_left_out(merged)} in {spent}; report: {out / 'report.html'}"
    )
    full = document["full_resolution"]
    if full is not None:
        points = sum(file["points"] for file in full["files"])
        parts.append(
            f"full resolution: {counted(points)} in {counted(len(full['files']), 'file')} in "
            f"{out / 'full'}"
        )
    return _text.join(*parts, _text.notes(document["notes"]))
