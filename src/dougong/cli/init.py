"""``dougong init``: a commented project file for the clouds in a folder."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dougong import app
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import Answer, Listener, execute


def command(
    folder: Path,
    /,
    *,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Write a commented project file for the clouds found in a folder.

    Each cloud's kind is guessed from what its file holds; the guess is said in a comment.

    Example: dougong init survey

    Parameters
    ----------
    folder
        Where the clouds are; the file is written there as project.toml.
    overwrite
        Replace a project file that exists already.
    """

    def work(progress: Listener) -> Answer:
        document = app.init(folder, overwrite=overwrite, progress=progress)
        lines = [f"wrote {document['project']}"]
        lines += [
            f"  {cloud['name']}: {cloud['kind']} ({cloud['why']})" for cloud in document["clouds"]
        ]
        lines += [f"  left out: {text}" for text in document["skipped"]]
        lines.append(f"read it, correct it, then: dougong run {document['project']} --out result")
        return Answer(document=document, text="\n".join(lines))

    return execute(common, work)
