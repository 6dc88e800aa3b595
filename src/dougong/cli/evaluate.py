"""``dougong evaluate``: reproduce a table or figure."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from dougong import app
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import Answer, Listener, execute


def command(
    study: Literal[
        "denoise",
        "probability",
        "hard",
        "buildings",
        "filtering",
        "storage",
        "coarse",
        "objects",
        "growth",
        "peers",
    ],
    /,
    *,
    out: Path | None = None,
    quick: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    runs: int | None = None,
    points: int | None = None,
    data: Path | None = None,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Reproduce a table or figure: run a study, print its table, write its numbers.

    Writes STUDY.json (every run), STUDY.csv (the table) and STUDY.png into a folder.

    Example: dougong evaluate denoise --quick --out study

    Parameters
    ----------
    study
        denoise: noise filters, noise removed against carving kept. probability: the verdict's
        probability against how often it is right. hard: hard and impossible pairs.
        buildings: five kinds of building through the whole program, against the truth.
        filtering: octree depth and cloth threshold, and what each costs. storage: bytes before
        and after, by format. coarse: coarse methods, precision, recall and convergence.
        objects: the same on objects that lie any way round. growth: errors, seconds and memory
        against the number of points. peers: the same pairs through other programs, as far as
        they are installed.
    out
        Folder for the files; default: dougong-STUDY in the current folder.
    quick
        Small samples, few runs: a look, not a measurement.
    runs
        How often each sample is drawn anew; default: as the study says.
    points
        Points of a scanner's cloud, of the largest where sizes are compared; default: as the
        study says.
    data
        Folder of real scans that the study also uses.
    overwrite
        Replace a result that exists already.
    """

    def work(progress: Listener) -> Answer:
        document, text = app.evaluate(
            study,
            out,
            seed=common.seed,
            is_quick=quick,
            runs=runs,
            points=points,
            data=data,
            overwrite=overwrite,
            progress=progress,
        )
        files = ", ".join(document["files"])
        return Answer(document=document, text=f"{text}\n\nwrote {files}")

    # The one that keeps no rows takes minutes.
    kept = "" if study == "denoise" else "Rows measured so far are kept; run it again to go on."
    return execute(common, work, kept)
