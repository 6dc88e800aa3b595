"""``dougong demo``: a scene with known truth, through everything."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from dougong import app
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, UNSURE, Answer, Listener, execute


def command(
    *,
    scene: Literal["hall", "pagoda", "tulou", "wall", "cave"] = "hall",
    out: Path | None = None,
    size: Annotated[Literal["normal", "small"], Parameter(show=True)] = "normal",
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Make a scene with known truth, run everything on it, print the errors against truth.

    Needs nothing: no data, no network, no GPU.

    Example: dougong demo --scene pagoda --out demo

    Parameters
    ----------
    scene
        Timber hall, octagonal pagoda, round tulou, city wall or cliff temple.
    out
        Folder for the result; default: dougong-demo-SCENE in the current folder.
    size
        Scene size: small has a quarter of the points.
    overwrite
        Replace a result that exists already.
    """

    def work(progress: Listener) -> Answer:
        document = app.demo(
            scene,
            out,
            seed=common.seed,
            size=size,
            overwrite=overwrite,
            work=common.work,
            memory_bytes=common.memory_bytes(),
            progress=progress,
        )
        code = DONE if document["status"] == "ok" else UNSURE
        return Answer(document=document, text=_words(document), exit_code=code)

    return execute(common, work, kept="Finished filter steps are kept; run it again to go on.")


def _words(document: dict[str, Any]) -> str:
    lines = [f"{document['scene']} (seed {document['seed']}): {document['status']}"]
    if document["tre95_m"] is not None:
        lines += [
            f"  pose error, 95 % of the surface (TRE95): {_text.millimetres(document['tre95_m'])}",
            f"  rotation error: {document['rotation_error_deg']:.4f} deg",
            "  floor left by the drone cloud's bending (95 %): "
            f"{_text.millimetres(document['bending_floor95_m'])}",
            f"  {document['verdict']}",
        ]
    lines += [f"  {document['seconds']:.1f} s, report: {document['report']}"]
    return "\n".join(lines)
