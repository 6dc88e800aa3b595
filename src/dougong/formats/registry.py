"""Which reader and writer a file gets: by its suffix, checked against its first bytes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from dougong.cloud import Cloud, Pieces, in_pieces, joined_pieces
from dougong.errors import FormatError, FrameError, InputError, OutputError
from dougong.formats.joined_scans import chunks_as_one, joined_scans
from dougong.formats.model import Hold, Written
from dougong.formats.remembered import Remembered
from dougong.formats.stream import (
    Scan,
    Survey,
    iterate_scans,
    opened,
    read_scans,
    scans_without_points,
    stem_of,
    survey_of,
)
from dougong.formats.units import is_same_crs, metre_form

SUFFIXES = {
    ".las": "las", ".laz": "las", ".e57": "e57", ".ply": "ply", ".pcd": "pcd",
    ".xyz": "text", ".pts": "text", ".csv": "text", ".txt": "text", ".asc": "text", ".ptx": "ptx",
}  # fmt: skip
_SIGNATURES = ((b"LASF", "las"), (b"ASTM-E57", "e57"), (b"ply", "ply"), (b"# .PCD", "pcd"))
_SHOWN = {"las": "LAS/LAZ", "e57": "E57", "ply": "PLY", "pcd": "PCD", "text": "text", "ptx": "PTX"}
BLOCK_ROWS = 1_000_000
WRITABLE = (".las", ".laz", ".copc.laz", ".e57", ".ply")


def kind_of(path: Path) -> str:
    """Return "las", "e57", "ply", "pcd", "ptx" or "text" for a file that can be opened.

    Raises
    ------
    FormatError
        Unknown suffix, a file that is not what its suffix says, missing, a folder, empty.
    """
    kind = SUFFIXES.get(path.suffix.lower())
    with opened(path) as file:
        head = file.read(128)
    found = next((name for start, name in _SIGNATURES if head.startswith(start)), None)
    if found is None and kind is not None:
        return kind
    if found is None:
        has = f"the suffix {path.suffix!r}" if path.suffix else "no suffix"
        msg = (
            f"{path.name} has {has}; point clouds that can be read "
            f"end in {', '.join(SUFFIXES)}. Rename or export it."
        )
        raise FormatError(msg)
    if found != kind:
        is_packed = found == "las" and len(head) > 104 and head[104] & 0x80
        suffix = ".laz" if is_packed else next(s for s, name in SUFFIXES.items() if name == found)
        other = f"not {_SHOWN[kind]}" if kind is not None else "which its name does not say"
        msg = (
            f"{path.name} is a {_SHOWN[found]} file by its first bytes, {other}. "
            f"Rename it to {path.with_suffix(suffix).name}."
        )
        raise FormatError(msg)
    return kind


def scans_of(path: Path, kind: str) -> list[Scan]:
    """Return the scans of a file that is not LAS."""
    if kind == "e57":
        from dougong.formats.e57 import open_e57

        return list(open_e57(path))
    if kind == "ply":
        from dougong.formats.ply import open_ply

        return [open_ply(path)]
    if kind == "pcd":
        from dougong.formats.pcd import open_pcd

        return [open_pcd(path)]
    if kind == "ptx":
        from dougong.formats.ptx import open_ptx

        return list(open_ptx(path))
    from dougong.formats.text import open_text

    return [open_text(path)]


class _Found(NamedTuple):
    """What one pass over a file finds."""

    survey: Survey
    notes: tuple[tuple[str, ...], ...]
    """Of each scan: some are known at the end of the pass only."""


_found: Remembered[_Found] = Remembered()


def file_survey(path: Path, scans: Sequence[Scan]) -> Survey:
    """Return what one pass over `scans`, all of the file, finds; the file is passed over once."""

    def ask() -> _Found:
        survey = survey_of(scans, BLOCK_ROWS)
        return _Found(survey, tuple(scan.notes for scan in scans))

    found = _found.of(path, ask)
    for scan, notes in zip(scans, found.notes, strict=True):
        if scan.notes != notes:
            scan.notes = notes
    return found.survey


def read_stations(path: Path | str) -> list[Cloud]:
    """Return one cloud per scan of an E57 or PTX file, poses applied, in one frame; else one cloud.

    Raises
    ------
    FormatError
        The file cannot be read, is empty or truncated; the message says which and what to do.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "las":
        from dougong.formats import las

        return [las.read(path)]
    scans = scans_of(path, kind)
    if kind == "text":
        from dougong.formats.text import TextScan

        for scan in scans:
            assert isinstance(scan, TextScan)
            scan.load(BLOCK_ROWS)  # its column types need a pass of their own: parse only once
    clouds = read_scans(scans, BLOCK_ROWS)
    return [replace(clouds[0], name=stem_of(path))] if len(scans) == 1 else clouds


def read(path: Path | str) -> Cloud:
    """Return a whole point cloud file.

    An E57 or PTX file with several scans becomes one cloud with the uint16 attribute `station`,
    counted from 0 in the order of the file; use `read_stations` to keep them apart.

    Raises
    ------
    FormatError
        The file cannot be read, is empty or truncated; the message says which and what to do.
    """
    path = Path(path)
    clouds = read_stations(path)
    return joined_scans(clouds, path) if _is_survey(clouds) else clouds[0]


def _is_survey(scans: Sequence[Cloud | Scan]) -> bool:
    """Say whether the one cloud of a file's scans tells them apart."""
    return len(scans) > 1 or any(getattr(scan.header, "station", 0) for scan in scans)


def iterate(
    path: Path | str, chunk_points: int = 1_000_000, *, as_one: bool = False
) -> Iterator[Cloud]:
    """Yield a file in clouds of at most `chunk_points` points that share one frame.

    The file is never held as a whole (PCD binary_compressed is one block by design: it is).
    All but LAS are passed over twice, once where that was done before and is remembered. Scans of
    an E57 or PTX file follow one another; `cloud.header.station` tells them apart. With `as_one`
    the chunks are those of the one cloud that `read` returns.

    Raises
    ------
    FormatError
        As `read`; a truncated file raises where it ends.
    """
    if chunk_points < 1:
        raise InputError(f"chunk_points must be at least 1, got {chunk_points}.")
    path = Path(path)
    kind = kind_of(path)
    if kind == "las":
        from dougong.formats import las

        return las.iterate(path, chunk_points)
    return _surveyed(path, scans_of(path, kind), chunk_points, as_one=as_one)


def _surveyed(path: Path, scans: list[Scan], rows: int, *, as_one: bool) -> Iterator[Cloud]:
    # A generator: the pass is made when the first cloud is asked for.
    survey = file_survey(path, scans)
    chunks = iterate_scans(scans, rows, survey)
    if len(scans) == 1:
        chunks = (replace(chunk, name=stem_of(path)) for chunk in chunks)
    empty = scans_without_points(scans, survey) if as_one and _is_survey(scans) else []
    yield from chunks_as_one(chunks, empty, path) if _is_survey(empty) else chunks


def family_of(path: Path) -> str:
    """Return the suffix a cloud is written by, or raise OutputError naming those there are."""
    name = path.name.lower()
    found = next((s for s in (".copc.laz", *WRITABLE) if name.endswith(s)), None)
    if found is None:
        msg = (
            f"{path.name} has the suffix {path.suffix or 'none'!r}; clouds are written as "
            f"{', '.join(WRITABLE)}. Choose one of these."
        )
        raise OutputError(msg)
    return found


def write(
    cloud: Cloud | Pieces,
    path: Path | str,
    *,
    overwrite: bool = False,
    notes: Sequence[str] | None = None,
    hold: Hold | None = None,
) -> Written:
    """Write a cloud as LAS, LAZ, COPC, E57 or PLY, chosen by suffix; all of it or nothing.

    An unmoved cloud keeps its records bit for bit where the format is of the same family; a
    moved one gets new coordinates, never at a coarser step, and keeps every other bit.

    Parameters
    ----------
    cloud : Cloud or Pieces
        A cloud that comes in pieces is never held as a whole, unless as E57.
    notes : sequence of str, optional
        Put in front of the notes returned.
    hold : Hold, optional
        What COPC may hold, and where the rest goes meanwhile.

    Raises
    ------
    OutputError
        `path` exists and `overwrite` is False, is the input itself, has an unknown suffix, the
        disk is full, or the coordinates do not fit.
    """
    path = Path(path)
    family = family_of(path)
    from dougong.formats.atomic import refuse_bad_target
    from dougong.formats.las_pieces import las_form

    pieces = in_pieces(cloud)
    first = next(iter(pieces()))
    refuse_bad_target(path, overwrite=overwrite, source=getattr(first.header, "source", None))
    if family == ".ply":
        return _write_ply(pieces, path, notes or ())
    if family == ".e57":
        whole = joined_pieces(pieces)
        if not len(whole):
            raise _none_left(whole.name, path)
        return _write_e57([whole], path, notes or ())
    form = las_form(pieces, modern=family == ".copc.laz", packed=family == ".laz")
    if not form.points:
        raise _none_left(form.name, path)
    records = (form.records(piece) for piece in pieces())
    write_las_records(path, family, form.header, records, points=form.points, hold=hold)
    return Written(
        path=path,
        points=form.points,
        bytes=path.stat().st_size,
        notes=(*(notes or ()), *form.notes),
    )


def _none_left(name: str, path: Path) -> OutputError:
    return OutputError(f"{name} has no points left, so {path.name} was not written.")


def _write_ply(pieces: Pieces, path: Path, notes: Sequence[str]) -> Written:
    from dougong.formats.atomic import replacing
    from dougong.formats.ply_write import ply_parts, whole_of, write_vertices

    whole, sample = whole_of(pieces)
    if not whole.points:
        raise _none_left(sample.name, path)
    head, (vertex,), said = ply_parts(sample, whole)
    expected = len(head) + whole.points * vertex.dtype.itemsize
    with replacing(path, expected_bytes=expected) as sink:
        sink.write(head)
        for piece in pieces():
            _, records, more = ply_parts(piece, whole)
            write_vertices(sink, records)
            said += more
    found = tuple(dict.fromkeys([*notes, *said]))
    return Written(path=path, points=whole.points, bytes=path.stat().st_size, notes=found)


def write_stations(
    clouds: Sequence[Cloud], path: Path | str, *, overwrite: bool = False
) -> Written:
    """Write clouds of one frame as the scans of one E57 file: what `read_stations` reads.

    Raises
    ------
    FrameError
        The clouds have different reference systems.
    OutputError
        As `write`; or the suffix is another than ``.e57``.
    """
    path = Path(path)
    from dougong.formats.atomic import refuse_bad_target

    if family_of(path) != ".e57":
        raise OutputError(f"{path.name}: scans are kept apart in E57 only. Name it .e57.")
    for cloud in clouds:
        refuse_bad_target(path, overwrite=overwrite, source=getattr(cloud.header, "source", None))
    filled = [cloud for cloud in clouds if len(cloud)]
    if not filled:
        raise OutputError(f"no cloud has a point left, so {path.name} was not written.")
    for cloud in filled:
        if not is_same_crs(cloud.frame.crs, filled[0].frame.crs):
            msg = (
                f"{cloud.name} and {filled[0].name} are in different reference systems. "
                "Move them into one frame first."
            )
            raise FrameError(msg)
    return _write_e57(filled, path, ())


def _write_e57(clouds: Sequence[Cloud], path: Path, notes: Sequence[str]) -> Written:
    from dougong.formats.atomic import replacing
    from dougong.formats.e57_stations import stations_of
    from dougong.formats.e57_write import write_scans

    said: list[str] = []
    stations = [station for cloud in clouds for station in stations_of(cloud, said)]
    crs = clouds[0].frame.crs
    if crs is not None and metre_form(crs) != crs:
        said.append("E57 coordinates are metres: the reference system is written in metres too.")
    expected = sum(cloud.records.nbytes for cloud in clouds)
    with replacing(path, expected_bytes=expected) as sink:
        said += write_scans(sink, stations, metre_form(crs) if crs is not None else None)
    return Written(
        path=path,
        points=sum(len(station) for station in stations),
        bytes=path.stat().st_size,
        notes=tuple(dict.fromkeys([*notes, *said])),
    )


def write_las_records(
    path: Path,
    family: str,
    header: Any,
    pieces: Iterable[Any],
    *,
    points: int,
    hold: Hold | None = None,
) -> None:
    """Write a LAS header and its records as `family` (".las", ".laz", ".copc.laz")."""
    from dougong.formats.atomic import replacing
    from dougong.formats.copc import HELD_POINTS, CopcWriter
    from dougong.formats.las_write import LasWriter
    from dougong.formats.unfinished import passing_folder
    from dougong.threads import ahead

    # Compressed points take about half; only named in the message of a full disk.
    expected = header.point_bytes * points // (1 if family == ".las" else 2)
    most, place = hold or (HELD_POINTS, path.parent)
    with (
        replacing(path, expected_bytes=expected + 65536) as sink,
        passing_folder(place / f"copc-{path.name}-") as scratch,
    ):
        writer: CopcWriter | LasWriter
        if family == ".copc.laz":
            writer = CopcWriter(sink, header, scratch=scratch, most_points=most)
        else:
            writer = LasWriter(sink, header, is_compressed=family == ".laz")
        for records in ahead(pieces):
            writer.append(records)
        writer.close()
