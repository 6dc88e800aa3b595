"""``dougong transform``: apply a registration to a cloud."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dougong import app
from dougong._words import counted
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import Answer, Listener, execute


def command(
    input: Path,
    output: Path,
    *,
    matrix: Path,
    accept_best: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Move a cloud by the matrix of a registration.

    Refuses a registration whose status is not ok, unless --accept-best is given.

    Example: dougong transform scan.laz moved.laz --matrix result/registration.json

    Parameters
    ----------
    input
        The cloud to move: the registration's source, or another in the same coordinates.
    output
        Where to write it: .las, .laz, .copc.laz, .e57 or .ply.
    matrix
        A registration.json.
    accept_best
        Apply the best pose of an ambiguous registration.
    overwrite
        Replace an output that exists already.
    """

    def work(progress: Listener) -> Answer:
        document = app.transform_file(
            input,
            output,
            matrix,
            accept_best=accept_best,
            overwrite=overwrite,
            memory_bytes=common.memory_bytes(),
            progress=progress,
        )
        text = f"wrote {output}: {counted(document['points'])}"
        return Answer(document=document, text=_text.join(text, _text.notes(document["notes"])))

    return execute(common, work)
