"""``run --full-resolution``: every input file again, undecimated, in the frame of the reference."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dougong.cloud import Frame
from dougong.formats import PlacedStation, Written, copy_file, is_same_crs, reissue, scans_in
from dougong.formats.stream import stem_of
from dougong.pipeline.outputs import finite, write_json
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import software
from dougong.typing import Transform

FOLDER = "full"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where a file goes, or one scan of it."""

    mover: str
    """Name of what moved as one; its registration is registrations/MOVER.json."""
    entry: str
    """Name of the project's cloud."""
    file: Path
    station: int
    """The scan's place in an E57 or PTX file; -1: the whole file."""
    status: str
    """reference, ok, ambiguous or failed."""
    matrix: Transform | None
    """(4, 4) file coordinates to those of the reference; None: not sure enough to move it."""


def output_names(files: Sequence[tuple[str, Path]]) -> list[str]:
    """Return a name, without suffix, for each (cloud's name, file): the file's own if it is alone.

    Files of the same stem get their cloud's name in front, and a number where that is not enough.
    """
    stems = [stem_of(path) for _, path in files]
    names: list[str] = []
    for (entry, _), own in zip(files, stems, strict=True):
        name = own if stems.count(own) == 1 else f"{entry}-{own}"
        number, base = 2, name
        while name in names:
            name, number = f"{base}-{number}", number + 1
        names.append(name)
    return names


def write_full_resolution(
    places: Sequence[Place],
    target: Frame,
    out: Path,
    *,
    reference: str,
    inputs: Mapping[Path, Mapping[str, Any]],
    require_unchanged: Callable[[Path], None],
    shown: Callable[[Path], str],
    progress: Progress,
) -> dict[str, Any]:
    """Write ``full/NAME.e57`` or ``full/NAME.laz`` for each input file, and its books beside it.

    Parameters
    ----------
    places : sequence of Place
    target : Frame
        Of the reference.
    out : Path
        Result folder.
    reference : str
    inputs : mapping
        What is known of each file: path, sha256, points.
    require_unchanged : callable
        Refuses a file that is not the one that was registered any more.
    shown : callable
        How a path is named in the results.

    Returns
    -------
    dict
        ``files`` as in the books, and ``left_out``: what was not moved, and why.
    """
    groups: dict[tuple[str, Path], list[Place]] = {}
    for place in places:
        groups.setdefault((place.entry, place.file), []).append(place)
    names = output_names(list(groups))
    folder = out / FOLDER
    folder.mkdir()
    files: list[dict[str, Any]] = []
    left_out = [
        {"cloud": place.mover, "file": shown(place.file), "status": place.status}
        for place in places
        if place.matrix is None
    ]
    for ((_, file), mine), name in zip(groups.items(), names, strict=True):
        if all(place.matrix is None for place in mine):
            continue
        progress.stage(f"writing {FOLDER}/{name} at full resolution")
        require_unchanged(file)
        written = _write(file, folder / name, mine, target)
        require_unchanged(file)
        document: dict[str, Any] = {
            "file": f"{FOLDER}/{written.path.name}",
            "input": inputs[file],
            "points": written.points or inputs[file]["points"],
            "bytes": written.bytes,
            "reference": reference,
            "target_frame": {"crs_wkt": target.crs, "unit_m": target.unit_m},
            "moved": [_moved(place) for place in mine if place.matrix is not None],
            "stations": [_station(station) for station in written.stations],
            "notes": list(written.notes),
        }
        files.append(document)
        books = written.path.with_name(f"{written.path.name}.json")
        write_json(books, finite({**document, "software": software()}))
    return {"files": files, "left_out": left_out}


def _write(file: Path, output: Path, places: Sequence[Place], target: Frame) -> Written:
    """Write one file under the name `output` and the suffix that suits it."""
    suffix = "".join(file.suffixes[-2:]) if file.name.endswith(".copc.laz") else file.suffix
    is_reference = all(place.status == "reference" for place in places)
    # A system that the user gave and the file does not name has to be written.
    if is_reference and is_same_crs(scans_in(file)[1], target.crs):
        output = output.with_name(output.name + suffix)
        copy_file(file, output)
        return Written(path=output, points=0, bytes=output.stat().st_size)
    is_e57 = file.suffix.lower() == ".e57"
    matrices: list[Transform | None] = [None] * scans_in(file)[0]
    for place in places:
        if place.station < 0:
            matrices = [place.matrix] * len(matrices)
        else:
            matrices[place.station] = place.matrix
    output = output.with_name(output.name + (".e57" if is_e57 else ".laz"))
    return reissue(file, output, matrices, target)


def _moved(place: Place) -> dict[str, Any]:
    is_reference = place.status == "reference"
    return {
        "cloud": place.mover,
        "station": None if place.station < 0 else place.station,
        "status": place.status,
        "registration": None if is_reference else f"registrations/{place.mover}.json",
        "matrix": place.matrix,
    }


def _station(station: PlacedStation) -> dict[str, Any]:
    """Return where a scan of an E57 file stands now."""
    return {
        "station": station.index,
        "name": station.name,
        "rotation_wxyz": station.quaternion,
        "translation_m": station.translation,
    }


def full_notes(document: Mapping[str, Any] | None) -> list[str]:
    """Return what is to be said of the files at full resolution: what was left out, and changed."""
    if document is None:
        return []
    said = [f"{file['file']}: {note}" for file in document["files"] for note in file["notes"]]
    for left in document["left_out"]:
        why = "failed" if left["status"] == "failed" else f"is {left['status']}"
        said.append(
            f"{Path(left['file']).name}: {left['cloud']} is not written at full resolution, as its "
            f"registration {why}"
        )
    return said
