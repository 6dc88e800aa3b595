"""``dougong check``: what is wrong with a cloud, and how to fix it."""

from pathlib import Path

from dougong import app
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, FAILED, Answer, Listener, execute


def command(*files: Path, common: Common = DEFAULT) -> int:
    """Say what is wrong with each cloud and how to fix it.

    Exit code 0: nothing, or only warnings; 1: a cloud cannot be used as it is.

    Example: dougong check scan.laz

    Parameters
    ----------
    files
        LAS, LAZ, COPC, E57, PLY, PCD, XYZ, PTS, PTX or CSV files.
    """

    def work(progress: Listener) -> Answer:
        document = app.check(files, progress=progress)
        lines = []
        for file in document["files"]:
            found = [f"  {item['severity']}: {item['text']}" for item in file["findings"]]
            lines += [file["path"], *(found or ["  nothing wrong found"])]
        code = DONE if document["is_usable"] else FAILED
        return Answer(document=document, text="\n".join(lines), exit_code=code)

    return execute(common, work)
