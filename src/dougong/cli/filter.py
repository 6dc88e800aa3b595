"""``dougong filter``: one cloud's recipe, or one filter alone."""

from pathlib import Path
from typing import Annotated, Any, Literal

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
    kind: Literal["lidar", "photogrammetry"] | None = None,
    only: str | None = None,
    mark: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    settings: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
    crs: str | None = None,
    overwrite: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    common: Common = DEFAULT,
) -> int:
    """Filter one cloud with its sensor's recipe, or with one filter alone.

    Writes OUTPUT and OUTPUT.json (counts and reduction per stage, parameters, reasons).

    Example: dougong filter scan.laz clean.laz --kind lidar --set octree_voxel_grid.voxel_m=0.01

    Example: dougong filter scan.laz marked.laz --only statistical --mark

    Parameters
    ----------
    input
        The cloud to filter.
    output
        Where to write it: .las, .laz, .copc.laz, .e57 or .ply.
    kind
        The sensor; needed for the recipe.
    only
        One filter by name instead of the recipe: octree_voxel_grid, cloth_simulation,
        curvature_weighted, statistical, radius, pass_through, low_outliers, clutter.
    mark
        Keep every point; class 2 ground, 7 noise, 64 clutter, the reason in dougong_reason, the
        old class in classification_in.
    settings
        NAME.FIELD=VALUE, for example curvature_weighted.rule=paper; may be given several times.
    crs
        Coordinate system of an INPUT that names none, such as EPSG:32650; mm for local coordinates
        in millimetres.
    overwrite
        Replace an output that exists already.
    """

    def work(progress: Listener) -> Answer:
        document = app.filter_file(
            input,
            output,
            kind=kind,
            only=only,
            mark=mark,
            settings=settings or (),
            crs=crs,
            overwrite=overwrite,
            work=common.work,
            memory_bytes=common.memory_bytes(),
            progress=progress,
        )
        text = _text.join(
            _text.stages(document["stages"]),
            f"wrote {output}: {_written(document)}",
            _text.notes(document["notes"]),
        )
        return Answer(document=document, text=text)

    kept = ""
    if common.work is not None:
        kept = (
            f"Finished tiles of a cloud larger than memory are kept in {common.work}; run it again "
            "to go on."
        )
    return execute(common, work, kept)


def _written(document: dict[str, Any]) -> str:
    points = counted(document["points_written"])
    reduction = f"reduction {_text.percent(document['reduction'])}"
    if not document["is_marked"]:
        return f"{points}, {reduction}"
    kept = _text.count(document["points_kept"])
    return f"all {points} with their marks, {kept} of them kept by the filters ({reduction})"
