"""``dougong plan``: what a run would do."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from dougong import app
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, USAGE, Answer, Listener, execute


def command(
    project: Path | None = None,
    *,
    out: Path | None = None,
    lidar: Annotated[list[Path] | None, Parameter(negative="")] = None,
    photogrammetry: Annotated[list[Path] | None, Parameter(negative="")] = None,
    full_resolution: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    merge: Literal["best", "all"] | None = None,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Say what `dougong run` would do with the same arguments: tiles, memory, disk, time.

    Exit code 2 when the run would be refused.

    Example: dougong plan --lidar scan.laz --photogrammetry drone.laz --memory 8GB

    Parameters
    ----------
    project
        Project file; `dougong init DIR` writes one.
    out
        Folder for the result: says whether the run would be refused for what is in it.
    lidar
        A laser scan; may be given several times.
    photogrammetry
        A drone cloud; may be given several times.
    full_resolution
        Count in that every input file is written again, undecimated.
    merge
        As of run: best or all.
    overwrite
        A result that exists already would be replaced.
    """

    def work(progress: Listener) -> Answer:
        document = app.plan(
            project,
            out,
            lidar=lidar or (),
            photogrammetry=photogrammetry or (),
            full_resolution=full_resolution,
            merge=merge,
            overwrite=overwrite,
            memory_bytes=common.memory_bytes(),
            progress=progress,
        )
        code = DONE if document["refusal"] is None else USAGE
        return Answer(document=document, text=_words(document), exit_code=code)

    return execute(common, work)


def _words(document: dict[str, Any]) -> str:
    rows = [
        (file["cloud"], file["path"], _text.count(file["points"]), _way(file))
        for file in document["files"]
    ]
    limit = document["memory_limit_bytes"]
    facts = [
        f"memory: about {_text.size(document['memory_bytes'])} at the peak"
        + (f" of {_text.size(limit)} that may be used" if limit is not None else ""),
        f"disk: at most {_text.size(document['out_bytes'])} for the result, "
        f"{_text.size(document['work_bytes'])} meanwhile",
        f"time: about {document['duration']} (rough: rates of one machine)",
        f"frame of the result: that of {document['reference']}",
    ]
    if document["refusal"] is not None:
        facts.append(f"would be refused: {document['refusal']}")
    stages = [
        (
            stage["name"],
            f"about {stage['tiles']} tiles" if stage["tiles"] else "in memory",
            _text.size(stage["memory_bytes"]),
            _text.size(stage["work_bytes"]),
            f"{stage['seconds']:.0f} s",
        )
        for stage in document["stages"]
    ]
    return "\n".join(
        [
            _text.table(rows, ("cloud", "file", "points", "how")),
            _text.table(stages, ("stage", "how", "memory", "disk meanwhile", "CPU time")),
            *facts,
        ]
    )


def _way(file: dict[str, Any]) -> str:
    if file["tile_points"] is None:
        return str(file["way"])
    return f"on tiles of at most {_text.count(file['tile_points'])} points"
