"""``dougong bench``: our operations beside every installed peer."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dougong import app
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import Answer, Listener, execute


def command(
    *,
    out: Path = Path("dougong-bench"),
    only: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = (),
    points: Annotated[tuple[float, ...], Parameter(negative="", show_default=False)] = (1e5, 1e6),
    repeats: int = 3,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Measure our operations beside every installed peer, on the same work in one run.

    Prints seconds, memory and ratios, and writes bench.json. Peers are optional (pip install
    'dougong[bench]'); absent ones are named.

    Example: dougong bench --only sor --points 1e6 --out speed

    Parameters
    ----------
    out
        Folder for bench.json; what it holds already, of this code and machine, is kept.
    only
        Measure this operation: voxel, knn, radius, normals, sor, ror, curvature, cwasf, csf,
        csf-outliers or icp; may be given several times. Default: all.
    points
        Size of the generated clouds; may be given several times. Default: 1e5 and 1e6.
    repeats
        How often everyone is asked, in turn; seconds are medians.
    overwrite
        Measure anew what was measured already.
    """

    def work(progress: Listener) -> Answer:
        document, text = app.bench(
            out,
            operations=only,
            sizes=[round(size) for size in points],
            threads=common.threads,
            repeats=repeats,
            seed=common.seed,
            work=common.local_work(),
            overwrite=overwrite,
            progress=progress,
        )
        return Answer(document=document, text=text)

    return execute(common, work, "Groups measured so far are in bench.json.")
