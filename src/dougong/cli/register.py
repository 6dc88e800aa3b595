"""``dougong register``: find the transform from one cloud to another."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, validators

from dougong import app
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, FAILED, UNSURE, Answer, Listener, execute

_EXIT = {"ok": DONE, "ambiguous": UNSURE, "failed": FAILED}
_Sensor = Literal["lidar", "photogrammetry"]
_Flag = Annotated[bool, Parameter(negative="", show_default=False)]
_Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1))]


def command(
    source: Path,
    target: Path,
    *,
    out: Path,
    source_kind: _Sensor | None = None,
    target_kind: _Sensor | None = None,
    coarse: Literal["auto", "plan", "improved-pca", "pca", "sac-ia", "4pcs", "none"] = "auto",
    fine: Literal["point-to-plane", "point-to-point", "none"] = "point-to-plane",
    dof: Literal["auto", "4", "5", "6", "7"] = "auto",
    filtered: _Flag = False,
    yaw_hint: float | None = None,
    pairs: Path | None = None,
    control: Path | None = None,
    grid_scale: str = "auto",
    least_overlap: _Share | None = None,
    source_crs: str | None = None,
    target_crs: str | None = None,
    accept_best: _Flag = False,
    overwrite: _Flag = False,
    common: Common = DEFAULT,
) -> int:
    """Find the transform from SOURCE's coordinates to TARGET's.

    Always writes registration.json. Exit code 0: ok; 1: no pose was found;
    3: several poses explain the data equally well.

    Example: dougong register scan.laz drone.laz --out result

    Parameters
    ----------
    source
        The cloud that moves; raw or filtered, in any coordinates.
    target
        The cloud that stays.
    out
        Folder for registration.json and report.html.
    source_kind
        Sensor of the source; guessed where it is not given.
    target_kind
        Sensor of the target; guessed where it is not given.
    coarse
        How a first pose is found; sac-ia: alike features, 4pcs: congruent sets of four points;
        none: SOURCE is in place to a few decimetres already.
    fine
        How the pose is refined.
    dof
        4: levelled, 6: rigid, 5 and 7: the same with a free scale; auto: 6 with a gravity prior,
        and the scale of photogrammetry that declares no unit.
    filtered
        The inputs are clean already; nothing is dropped as far, alone or below the ground.
    yaw_hint
        About how far SOURCE is turned about the vertical, degrees: picks among equal poses.
    pairs
        Places picked in both clouds with `dougong view SOURCE TARGET --pairs FILE`: their pose is
        one more for the proof to hear, and never ok by itself.
    control
        CSV file of places surveyed in both frames: control points are adjusted with the clouds by
        their sigmas, check points are held out and give the error.
    grid_scale
        Combined factor (grid / ground) of a cloud in a map projection; auto: from its system and
        height; off: the map is true to scale, as site-calibrated ground systems are; or a number.
    least_overlap
        Refuse a pose under which neither cloud has this share of itself within reach of the
        other; 0.2 where it is not given.
    source_crs
        Coordinate system of a SOURCE that names none, such as EPSG:32650; mm for local coordinates
        in millimetres.
    target_crs
        The same for TARGET.
    accept_best
        Exit with 0 and take the best pose where several are possible; the status stays.
    overwrite
        Replace a result that exists already.
    """

    def work(progress: Listener) -> Answer:
        document = app.register_files(
            source,
            target,
            out,
            options={
                "coarse": coarse,
                "fine": fine,
                "dof": dof,
                "filtered": filtered,
                "yaw_hint_deg": yaw_hint,
                "grid_scale": grid_scale,
                "accept_best": accept_best,
                **({} if least_overlap is None else {"verdict": {"least_overlap": least_overlap}}),
            },
            crs=(source_crs, target_crs),
            source_kind=source_kind,
            target_kind=target_kind,
            overwrite=overwrite,
            memory_bytes=common.memory_bytes(),
            progress=progress,
            pairs=pairs,
            control=control,
        )
        return _answer(document, out, accept_best=accept_best)

    return execute(common, work)


def _answer(document: dict[str, Any], out: Path, *, accept_best: bool) -> Answer:
    code = _EXIT[document["status"]]
    if accept_best and code == UNSURE:
        code = DONE
    text = _text.join(
        _text.registration(document),
        _text.notes(document["notes"]),
        f"wrote {out / 'registration.json'} and {out / 'report.html'}",
    )
    return Answer(document=document, text=text, exit_code=code)
