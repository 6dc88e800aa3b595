"""Say what is in a file: from its header where that is enough, else in one pass."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dougong.formats.model import FileInfo, as_triple
from dougong.formats.registry import file_survey, kind_of, scans_of
from dougong.formats.remembered import Remembered
from dougong.formats.stream import Scan, Survey
from dougong.formats.units import units_of

_ROWS = 1_000_000
_described: Remembered[FileInfo] = Remembered()


def describe(path: Path | str) -> FileInfo:
    """Return what a point cloud file holds.

    LAS, LAZ and COPC headers tell everything. The others are passed over once in blocks for
    their extent, which no header of theirs promises, and for the rows that have no coordinates;
    asked again, the answer is remembered until the file is changed.

    Raises
    ------
    FormatError
        The file cannot be read.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "las":
        from dougong.formats import las

        return las.describe(path)

    def asked() -> FileInfo:
        scans = scans_of(path, kind)
        return _info(path, kind, scans, file_survey(path, scans))

    return replace(_described.of(path, asked), path=path)


def _info(path: Path, kind: str, scans: list[Scan], survey: Survey) -> FileInfo:
    first: Any = scans[0]
    units = units_of(first.crs)
    dtype = first.dtype(_ROWS) if kind == "text" else first.dtype
    attributes: dict[str, str] = {name: _type_of(dtype[name]) for name in dtype.names}
    packed = {bit.field for bit in first.bits.values()}
    attributes = {n: t for n, t in attributes.items() if n not in packed}
    attributes |= {name: dtype[bit.field].str for name, bit in first.bits.items()}
    notes = [note for scan in scans for note in scan.notes]
    return FileInfo(
        path=path,
        format={"e57": "E57", "ply": "PLY", "pcd": "PCD", "text": "text", "ptx": "PTX"}[kind],
        version=_version(kind, first),
        points=survey.rows,
        bytes=path.stat().st_size,
        is_compressed=getattr(first, "encoding", "") == "binary_compressed",
        stations=len(scans),
        extent_min=as_triple(survey.low) if survey.kept else None,
        extent_max=as_triple(survey.high) if survey.kept else None,
        crs_wkt=first.crs,
        crs_name=units.name or None,
        unit_names=units.names,
        unit_m=units.unit_m,
        attributes=attributes,
        notes=(*dict.fromkeys(notes), *survey.notes()),
    )


def _type_of(kind: np.dtype[Any]) -> str:
    return kind.str if kind.subdtype is None else f"{kind.shape}{kind.base.str}"


def _version(kind: str, scan: Any) -> str:
    if kind == "ply":
        return f"1.0 {scan.header.encoding}"
    if kind == "pcd":
        words = dict(scan.header.lines)
        return f"{' '.join(words.get('VERSION', ('?',)))} {scan.encoding}"
    if kind == "ptx":
        return f"{scan.columns} columns"
    return "1.0" if kind == "e57" else f"{len(scan.names)} columns"
