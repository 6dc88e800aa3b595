"""``dougong init``: which clouds are here, which sensor made each, and a project file for them."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from dougong._words import counted
from dougong.errors import DougongError, InputError
from dougong.formats import SUFFIXES, FileInfo, describe, iterate
from dougong.formats.stream import stem_of
from dougong.pipeline.project import is_text
from dougong.typing import Kind

_COLOURS = {"red", "green", "blue"}
# A scanner's own frame starts at the first station; a map's easting and northing do not.
_MAP_COORDINATE_M = 20_000.0
_CHUNK_POINTS = 200_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """A cloud that was found, and which sensor seems to have made it."""

    name: str
    file: Path
    kind: Kind
    why: str
    stations: int
    points: int


def guess_kind_of(file: Path, info: FileInfo) -> tuple[Kind, str]:
    """Return the sensor that the contents of a described file speak for, and why in words.

    Points are read only where the intensity decides, and only until two of them differ in it.

    Raises
    ------
    FormatError
        The file is damaged.
    """
    kind, why = guess_kind(info)
    without = guess_kind(info, has_intensity=False)
    if without[0] == kind or _intensity_differs(file):
        return kind, why
    return without


def _intensity_differs(file: Path) -> bool:
    """Say whether two points of a file differ in intensity.

    Programs that make clouds of pictures write the field of their format and leave it 0.
    """
    first = None
    for chunk in iterate(file, _CHUNK_POINTS):
        name = next(name for name in chunk.attributes if name.lower() == "intensity")
        values = chunk.attribute(name)
        if values is None or not len(values):
            continue
        first = values[0] if first is None else first
        if (values != first).any():
            return True
    return False


def guess_kind(info: FileInfo, *, has_intensity: bool = True) -> tuple[Kind, str]:
    """Return the sensor that a file's attributes speak for, and why in words.

    `has_intensity` False: where the file has one, it is the same at every point and says nothing.
    """
    names = {name.lower() for name in info.attributes}
    has_colour = names >= _COLOURS
    low = info.extent_min or (0.0, 0.0, 0.0)
    is_map = info.crs_wkt is not None or max(abs(low[0]), abs(low[1])) > _MAP_COORDINATE_M
    if info.format in ("E57", "PTX"):
        scans = "1 scan" if info.stations == 1 else f"{info.stations} scans"
        return "lidar", f"{scans} in a file of {info.format}"
    if names & {"station", "scan_angle", "return_number"} and not has_colour:
        return "lidar", "scanner attributes and no colour"
    if has_colour and is_map:
        return "photogrammetry", "colour and map coordinates"
    if has_colour and "intensity" not in names:
        return "photogrammetry", "colour and no intensity"
    if has_colour and not has_intensity:
        return "photogrammetry", "colour, and one intensity throughout"
    if not has_colour:
        return "lidar", "no colour"
    return "lidar", "colour and intensity in the scanner's own coordinates"


def find_clouds(folder: Path) -> tuple[list[Guess], list[str]]:
    """Return the clouds in `folder` (and below), and what was left out and why.

    Earlier results of ours and hidden folders are left out: their clouds are no survey.

    Raises
    ------
    InputError
        There is no such folder, or no cloud in it.
    """
    if not folder.is_dir():
        msg = f"{folder} is no folder. Name the folder that holds the clouds."
        raise InputError(msg)
    results = _results_in(folder)
    skipped = [f"{result.relative_to(folder)}: a result of dougong" for result in results]
    files = sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and not any(result in path.parents for result in results)
    )
    guesses: list[Guess] = []
    for file in files:
        inside = file.relative_to(folder)
        if not is_text(inside):
            skipped.append(f"{inside}: its name is no UTF-8 text. Rename it")
            continue
        try:
            info = describe(file)
            kind, why = guess_kind_of(file, info)
        except DougongError as error:
            # The sentence names the file, not the folder that it is in.
            skipped.append(f"{inside}: {str(error).removeprefix(f'{file.name}: ')}")
            continue
        name = _free_name(stem_of(file).replace("\\", "-"), (guess.name for guess in guesses))
        guesses.append(
            Guess(
                name=name,
                file=inside,
                kind=kind,
                why=why,
                stations=info.stations,
                points=info.points,
            )
        )
    if not guesses:
        msg = f"{folder} holds no readable cloud ({', '.join(SUFFIXES)}). {' '.join(skipped)}"
        raise InputError(msg.strip())
    return guesses, skipped


def _results_in(folder: Path) -> list[Path]:
    """Return the folders below `folder` that a run, a demo or a registration wrote."""
    known = {"result.json": "clouds", "registration.json": "report.html"}
    return sorted(
        {
            path.parent
            for name, other in known.items()
            for path in folder.rglob(name)
            if path.parent != folder and (path.parent / other).exists()
        }
    )


def _free_name(name: str, taken: Iterable[str]) -> str:
    used, number, free = set(taken), 2, name
    while free in used:
        free, number = f"{name}-{number}", number + 1
    return free


def _quoted(text: str) -> str:
    # A TOML string escapes what a JSON string does, and the delete character besides.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def project_text(title: str, guesses: list[Guess], skipped: list[str]) -> str:
    """Return the commented project file."""
    drones = [guess.name for guess in guesses if guess.kind == "photogrammetry"]
    reference = drones[0] if drones else guesses[0].name
    lines = [
        "# A dougong project. Run it with: dougong run project.toml --out result",
        "# The kinds below were guessed from the files; correct them where they are wrong.",
        "",
        "[project]",
        f"name = {_quoted(title)}",
        f"reference = {_quoted(reference)}   # the cloud whose coordinates the result has",
        "# full_resolution = true   # also write every input file, undecimated, in that frame",
    ]
    for guess in guesses:
        lines += [
            "",
            "[[cloud]]",
            f"name = {_quoted(guess.name)}",
            f'kind = "{guess.kind}"   # guessed: {guess.why}',
            f"files = [{_quoted(guess.file.as_posix())}]   # {counted(guess.points)}; "
            "patterns such as *.laz work too",
        ]
        if guess.stations > 1:
            lines.append(
                "registered = true   # false: each of the "
                f"{guess.stations} stations is registered by itself"
            )
    lines += [f"# left out: {' '.join(text.split())}" for text in skipped]
    return "\n".join([*lines, *_SETTINGS]) + "\n"


_SETTINGS = (
    "",
    "# Settings below show the defaults; take the # away to change one.",
    "[filter.lidar.octree_voxel_grid]",
    "# voxel_m = 0.005   # edge of a voxel; in each, one original point is kept",
    "",
    "[filter.lidar.cloth_simulation]",
    "# class_threshold_m = 0.09   # H: nearer to the cloth than this is ground",
    "",
    "[filter.photogrammetry.cloth_simulation]",
    "# class_threshold_m = 0.15   # the drone's noise is larger, so its H is",
    "",
    "[register]",
    '# coarse = "auto"           # auto, plan, improved-pca, pca, sac-ia, 4pcs, none',
    '# fine = "point-to-plane"   # or point-to-point, none',
    '# dof = "auto"              # auto, 4 (levelled), 6 (rigid)',
    '# grid_scale = "auto"       # "off": the map is a site-calibrated ground system',
    "",
    "[merge]",
    '# mode = "best"             # per zone the better source; "all": every point',
)
