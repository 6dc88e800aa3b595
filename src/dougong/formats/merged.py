"""Write several clouds of one frame as one LAS, LAZ or COPC file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud, Frame, Pieces, Records, in_pieces
from dougong.errors import FrameError, InputError, OutputError
from dougong.formats.atomic import refuse_bad_target
from dougong.formats.las_header import POINT_FORMATS, LasHeader, Vlr, new_header
from dougong.formats.las_pieces import Finish, LasForm, las_form
from dougong.formats.las_records import (
    describe_extras,
    descriptions_of,
    extra_type,
    scaling_for,
    set_integers,
)
from dougong.formats.las_system import with_system
from dougong.formats.model import Hold, Written
from dougong.formats.registry import family_of, write_las_records
from dougong.formats.units import is_same_crs

_HISTORY = {b"LASF_Projection", b"LASF_Spec", b"copc", b"laszip encoded"}


def write_merged(
    clouds: Sequence[Cloud | Pieces],
    path: Path | str,
    *,
    source_ids: Sequence[int],
    overwrite: bool = False,
    hold: Hold | None = None,
    finish: Sequence[Finish | None] | None = None,
) -> Written:
    """Write clouds that share a reference system as one file of point format 6, 7 or 8.

    Every attribute of every cloud is kept, 0 where a cloud has none; the extra dimension
    `source_id` tells the clouds apart. Each axis has the finest step of all clouds. Memory: a piece
    of a cloud, and what COPC holds.

    Parameters
    ----------
    clouds : sequence of Cloud or Pieces
        At least one; empty ones are passed over.
    source_ids : sequence of int
        One per cloud, 0..65535; `source_id` is uint8 where all are below 256, else uint16.
    hold : Hold, optional
        What COPC may hold, and where the rest goes meanwhile.
    finish : sequence of callable or None, optional
        One per cloud: gives a piece attributes that LAS has no field for, as it is written.

    Raises
    ------
    FrameError
        The clouds have different reference systems or units.
    OutputError
        As `write`.
    """
    path = Path(path)
    family = family_of(path)
    if family in (".ply", ".e57"):
        raise OutputError(f"{path.name}: merged clouds are written as .las, .laz or .copc.laz.")
    if len(source_ids) != len(clouds) or not clouds:
        msg = f"write_merged needs one source id per cloud, got {len(source_ids)}, {len(clouds)}."
        raise InputError(msg)
    if min(source_ids) < 0 or max(source_ids) > 65535:
        raise InputError(f"source ids must lie in 0..65535, got {list(source_ids)}.")
    sources = [in_pieces(cloud) for cloud in clouds]
    firsts = [next(iter(pieces())) for pieces in sources]
    for first in firsts:
        refuse_bad_target(path, overwrite=overwrite, source=getattr(first.header, "source", None))
    _refuse_mixed_frames(firsts)
    parts = [
        _Part(pieces, form, ident, first.frame)
        for pieces, first, ident, last in zip(
            sources, firsts, source_ids, finish or [None] * len(clouds), strict=True
        )
        if (form := las_form(pieces, modern=True, finish=last)).points
    ]
    if not parts:
        raise OutputError(f"no cloud has a point left, so {path.name} was not written.")
    notes: list[str] = []
    parts = _with_one_time(parts, notes)
    header = _joined_header(parts, notes)
    points = sum(part.form.points for part in parts)
    write_las_records(path, family, header, _records(parts, header), points=points, hold=hold)
    return Written(
        path=path, points=points, bytes=path.stat().st_size, notes=tuple(dict.fromkeys(notes))
    )


class _Part(NamedTuple):
    """One cloud on its way into the merged file."""

    pieces: Pieces
    form: LasForm
    ident: int
    frame: Frame
    has_time: bool = True
    """False: its GPS times are not those of the file, and become 0."""


def _with_one_time(parts: Sequence[_Part], notes: list[str]) -> list[_Part]:
    """Return the parts; beside standard times those that count the seconds of a week are dropped.

    The kind of time is one flag for the file, and which week it was is written nowhere.
    """
    weekly = {part.form.name for part in parts if part.form.has_week_time}
    if not any(part.form.has_standard_time for part in parts):
        return list(parts)
    notes += [
        f"{name}: its GPS times count the seconds of a week, those of other clouds are standard "
        "times, and a file holds one kind: they are 0 here."
        for name in sorted(weekly)
    ]
    return [part._replace(has_time=not part.form.has_week_time) for part in parts]


def _refuse_mixed_frames(clouds: Sequence[Cloud]) -> None:
    first = clouds[0]
    for other in clouds[1:]:
        if not is_same_crs(other.frame.crs, first.frame.crs) or not np.allclose(
            other.frame.unit_m, first.frame.unit_m, rtol=1e-12
        ):
            msg = (
                f"{other.name} and {first.name} are in different reference systems or units. "
                "Move them into one frame before merging."
            )
            raise FrameError(msg)


def _joined_header(parts: Sequence[_Part], notes: list[str]) -> LasHeader:
    forms = [part.form for part in parts]
    notes += [f"{form.name}: {note}" for form in forms for note in form.notes]
    point_format = max(form.header.point_format for form in forms)
    scale = np.min([form.header.scale for form in forms], axis=0)
    bounds = np.concatenate([form.corners for form in forms])
    scale, offset = scaling_for(bounds, scale, "the merged cloud")
    first = forms[0].header
    if all(np.array_equal(form.header.offset, first.offset) for form in forms):
        offset = _kept_offset(first.offset, bounds, scale, offset)
    wide = max(part.ident for part in parts) > 255
    extras = _union([form.layout for form in forms], notes)
    notes += [
        f"{form.name}: its own source_id is replaced, by the number that it has in this file."
        for form in forms
        if "source_id" in (form.layout.names or ())
    ]
    extras["source_id"] = np.dtype("<u2" if wide else "u1")
    known = _descriptions([form.header for form in forms], extras, notes)
    timed = [form for form in forms if form.last_time is not None] or forms[:1]
    is_standard = any(form.header.raw[6] & 1 for form in timed)
    header = describe_extras(_base(first, point_format, is_standard), extras, known)
    return with_system(header, parts[0].frame, notes).with_scaling(scale, offset)


def _records(parts: Sequence[_Part], header: LasHeader) -> Iterator[Records]:
    """Yield the merged records, piece by piece."""
    for part in parts:
        for piece in part.pieces():
            own = part.form.records(piece)
            merged = np.zeros(len(own), dtype=header.dtype)
            _fill(merged, part.form.header, own, header)
            merged["source_id"] = part.ident
            if not part.has_time:
                merged["gps_time"] = 0.0
            yield merged


def _base(first: LasHeader, point_format: int, is_standard: bool) -> LasHeader:
    """Return a fresh header that carries on the first cloud's foreign records."""
    header = new_header(point_format)
    kept: tuple[Vlr, ...] = tuple(vlr for vlr in first.vlrs if vlr.key[0] not in _HISTORY)
    return replace(header, vlrs=kept).patched("H", 6, 0b10000 | is_standard)


def _kept_offset(
    shared: NDArray[np.float64],
    bounds: NDArray[np.float64],
    scale: NDArray[np.float64],
    other: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the offset that all clouds share where int32 allows it: integers then stay."""
    reach = np.abs(bounds - shared).max(axis=0) / scale
    return np.where(reach < 2**31 - 1, shared, other)


def _union(layouts: Sequence[np.dtype[np.void]], notes: list[str]) -> dict[str, np.dtype[Any]]:
    """Return every extra dimension, in the wider type where two clouds differ."""
    standard = {name for name, _ in POINT_FORMATS[8]} | {"source_id"}
    found: dict[str, np.dtype[Any]] = {}
    mixed: set[str] = set()
    for layout in layouts:
        for name in layout.names or ():
            if name in standard or name in mixed:
                continue
            kind = layout[name]
            if name in found and found[name] != kind:
                try:
                    kind = np.promote_types(found[name], kind)
                except TypeError:
                    notes.append(f"{name} has types that do not go together: left out.")
                    mixed.add(name)
                    del found[name]
                    continue
            if kind.kind == "V" and kind.subdtype is None:
                notes.append(f"{name} (bytes without a description) is left out.")
                continue
            found[name] = kind
    return found


def _descriptions(
    headers: Sequence[LasHeader], extras: dict[str, np.dtype[Any]], notes: list[str]
) -> dict[str, bytes]:
    """Return how the inputs describe their extra dimensions; the first description counts."""
    found: dict[str, bytes] = {}
    for header in headers:
        for name, text in descriptions_of(header).items():
            if name not in extras or text[2] != extra_type(extras[name]):
                continue
            first = found.setdefault(name, text)
            # Scale and offset stand behind the options and the statistics (LAS 1.4 R15, table 25).
            if first[112:160] != text[112:160] or first[3] & 0b11000 != text[3] & 0b11000:
                notes.append(f"{name} has different scales in the clouds; the first one's counts.")
    return found


def _fill(out: Records, own: LasHeader, records: Records, header: LasHeader) -> None:
    """Copy one cloud's records into its part of the merged ones, on their lattice."""
    for name in records.dtype.names or ():
        if name in (out.dtype.names or ()) and name not in ("X", "Y", "Z"):
            out[name] = records[name]
    is_same = np.array_equal(own.scale, header.scale) and np.array_equal(own.offset, header.offset)
    if is_same:
        for name in "XYZ":
            out[name] = records[name]
        return
    coordinates = np.stack([records[name] for name in "XYZ"], axis=1) * own.scale + own.offset
    set_integers(out, coordinates, header.scale, header.offset)
