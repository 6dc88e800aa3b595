"""``dougong report``: rebuild the report of a result folder."""

from pathlib import Path

from dougong import app
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import Answer, Listener, execute


def command(folder: Path, /, *, common: Common = DEFAULT) -> int:
    """Rebuild report.html of a result folder from the files in it.

    Example: dougong report result

    Parameters
    ----------
    folder
        The --out folder of an earlier run, demo or register.
    """

    def work(progress: Listener) -> Answer:
        document = app.report(folder, progress=progress)
        return Answer(document=document, text=f"wrote {document['report']}")

    return execute(common, work)
