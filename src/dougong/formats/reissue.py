"""Issue a file again in another frame: every point, at full resolution, in bounded memory."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud, Frame
from dougong.errors import InputError
from dougong.formats.model import Written
from dougong.formats.registry import iterate, kind_of, scans_of
from dougong.formats.stream import iterate_scans, survey_of
from dougong.formats.units import METRES, metre_form, units_of
from dougong.typing import Transform

CHUNK_POINTS = 1_000_000


def can_reissue(source: Path, output: Path) -> bool:
    """Say whether `reissue` makes a file of `output`'s suffix from `source`."""
    name = output.name.lower()
    if source.suffix.lower() == ".e57":
        return name.endswith(".e57")
    return name.endswith((".las", ".laz")) and not name.endswith(".copc.laz")


def scans_in(path: Path | str) -> tuple[int, str | None]:
    """Return how many scans a file keeps apart (E57, PTX; else 1) and its reference system, WKT.

    No point is read. Scans without points count too, as positions of `matrices`.

    Raises
    ------
    FormatError
        The file cannot be read.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "e57":
        from dougong.formats import e57_reissue

        return e57_reissue.scans_in(path)
    if kind == "las":
        from dougong.formats import las

        return 1, las.crs_of(las.read_las_header(path))
    scans = scans_of(path, kind)
    return getattr(scans[-1].header, "station", 0) + 1, scans[0].crs


def system_in(path: Path | str) -> tuple[str | None, tuple[float, float, float] | None]:
    """Return a file's reference system, WKT, and its metres per unit; None: it does not say.

    E57 and PTX are metres by definition. No point is read.

    Raises
    ------
    FormatError
        The file cannot be read.
    """
    crs = scans_in(path)[1]
    if kind_of(Path(path)) in ("e57", "ptx"):
        return (None if crs is None else metre_form(crs)), METRES
    return crs, None if crs is None else units_of(crs).unit_m


def reissue(
    source: Path | str,
    output: Path | str,
    matrices: Sequence[Transform | None],
    target: Frame,
    *,
    overwrite: bool = False,
    chunk_points: int = CHUNK_POINTS,
) -> Written:
    """Write a file again with every point moved into the frame of `target`.

    E57 becomes E57: records, pictures and all else keep their bits, only poses change (and, where
    a matrix has a scale, the scanners' own coordinates). Any other file becomes LAS or LAZ: every
    attribute stays, coordinates are new integers. Memory: a chunk, whatever the file's size.

    Parameters
    ----------
    matrices : sequence of ndarray (4, 4) or None
        One for each scan of the file (see `scans_in`), in its order: from its file coordinates to
        the target's. None leaves the scan out. Several scans of one LAS file are told apart by the
        extra dimension `station`.
    target : Frame
        Its reference system and units are those of the output; E57 has metres always.
    chunk_points : int
        Points in memory at a time (E57: pages of a fixed size instead).

    Raises
    ------
    InputError
        The number of matrices is wrong, or the output's suffix does not go with the input.
    FormatError
        The input is damaged.
    OutputError
        The output exists, or the disk is full; nothing is left behind.
    """
    source, output = Path(source), Path(output)
    kind = kind_of(source)
    if not can_reissue(source, output):
        msg = (
            f"{output.name} cannot be made from {source.name} in chunks: E57 is issued again as "
            ".e57, any other file as .las or .laz. Name such an output."
        )
        raise InputError(msg)
    if kind == "e57":
        from dougong.formats.e57_reissue import reissue_e57

        to_metres = np.diag([*target.unit_m, 1.0])
        motions = [None if matrix is None else to_metres @ matrix for matrix in matrices]
        crs = None if target.crs is None else metre_form(target.crs)
        return reissue_e57(source, output, motions, crs=crs, overwrite=overwrite)
    count = scans_in(source)[0]
    if len(matrices) != count or all(matrix is None for matrix in matrices):
        given = sum(matrix is not None for matrix in matrices)
        msg = (
            f"{source.name} keeps {count} scans apart, got a list of {len(matrices)} with {given} "
            "matrices. Pass one for each scan, and None for those to leave out."
        )
        raise InputError(msg)
    from dougong.formats.las_reissue import reissue_las

    if kind == "las":
        from dougong.formats.las import read_las_header

        header, scans, survey = read_las_header(source), [], None
    else:
        # The same scans again: what only a whole pass finds is among their notes then.
        header, scans = None, scans_of(source, kind)
        survey = survey_of(scans, chunk_points)

    def chunks() -> Generator[Cloud]:
        if survey is None:
            yield from iterate(source, chunk_points)
        else:
            yield from iterate_scans(scans, chunk_points, survey)

    return reissue_las(chunks, source, output, matrices, target, header=header, overwrite=overwrite)
