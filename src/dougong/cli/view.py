"""``dougong view``: clouds of any size in the browser."""

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dougong import app
from dougong._words import counted
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, Answer, Listener, execute
from dougong.cli._signals import Terminated, code_of

if TYPE_CHECKING:
    from dougong.app import Viewing


def command(
    *paths: Path,
    port: int = 0,
    pairs: Path | None = None,
    browser: Annotated[bool, Parameter(negative="--no-browser")] = True,
    common: Common = DEFAULT,
) -> int:
    """Open clouds or a result folder in the browser, at full size, until Ctrl-C.

    The page is served to this computer only (127.0.0.1). COPC files are streamed as they are;
    other formats are converted to temporary COPC files first, which takes time, and memory up
    to --memory.

    Example: dougong view result

    Example: dougong view merged.copc.laz scan.laz

    Example: dougong view scan.laz drone.laz --pairs pairs.csv

    Parameters
    ----------
    paths
        Clouds, or the --out folder of a run, a demo or a registration.
    port
        Port of the page; 0: a free one.
    pairs
        CSV file for places picked in both of two clouds, for `register --pairs`; what it holds
        already is shown.
    browser
        Open the browser; else only print the address.
    """
    opened: list[Viewing] = []

    def work(progress: Listener) -> Answer:
        viewing = app.view(
            paths,
            port=port,
            open_browser=browser,
            work=common.local_work(),
            progress=progress,
            pairs=pairs,
            memory_bytes=common.memory_bytes(),
        )
        opened.append(viewing)
        document = viewing.document
        lines = [f"{', '.join(document['clouds'])}: {counted(document['points'])}"]
        if browser and not document["is_browser_open"]:
            lines.append("NO BROWSER COULD BE OPENED here; open this address yourself:")
        lines.append(document["url"])
        if pairs is not None:
            lines.append(f"Pick pairs > Save writes {pairs}")
        lines.append("Ctrl-C ends it.")
        return Answer(document=document, text=_text.join(*lines, _text.notes(document["notes"])))

    code = execute(common, work)
    try:
        if code == DONE:
            sys.stdout.flush()
            threading.Event().wait()
    except KeyboardInterrupt as ended:
        # Ctrl-C is how a viewer is closed: nothing has failed.
        return code_of(ended) if isinstance(ended, Terminated) else DONE
    finally:
        for viewing in opened:
            viewing.close()
    return code
