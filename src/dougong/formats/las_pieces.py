"""A cloud that comes in pieces, as LAS records that are alike in every piece."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dougong._boxes import corners_of
from dougong.cloud import Cloud, Pieces, Records
from dougong.errors import InputError
from dougong.formats.las import waveform_channels
from dougong.formats.las_fields import Facts, canonical, facts_of
from dougong.formats.las_header import LasHeader
from dougong.formats.las_records import Whole, las_parts, set_integers
from dougong.typing import Points

_WEEK_S = 7 * 86_400.0

Finish = Callable[[Cloud], Cloud]
"""Gives a piece attributes that LAS has no field for; nothing else of it changes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LasForm:
    """How the pieces of one cloud become LAS records."""

    name: str
    points: int
    header: LasHeader
    layout: np.dtype[np.void]
    """Of the records; the header's own layout, or one that a packer turns into it."""
    corners: Points
    """(2, 3) lowest and highest coordinates as they are written, file units."""
    notes: tuple[str, ...]
    modern: bool
    packed: bool
    whole: Whole
    finish: Finish | None
    """What a piece goes through as it is written, and only then: it may be dear."""
    last_time: float | None
    """Latest GPS time in seconds; None: there is none, or all are 0."""

    @property
    def has_standard_time(self) -> bool:
        """Say whether its GPS times are adjusted standard ones (LAS 1.4 R15, table 4)."""
        return self.last_time is not None and bool(self.header.raw[6] & 1)

    @property
    def has_week_time(self) -> bool:
        """Say whether its GPS times count the seconds of a week.

        Programs forget to flag standard times: those that no week has are none.
        """
        is_flagged = self.has_standard_time
        return self.last_time is not None and not is_flagged and self.last_time <= _WEEK_S

    def records(self, piece: Cloud) -> Records:
        """Return the records of one piece."""
        piece = piece if self.finish is None else self.finish(piece)
        return las_parts(piece, modern=self.modern, packed=self.packed, whole=self.whole)[1]


@dataclass(slots=True)
class _Survey:
    """What one pass over all pieces finds."""

    points: int = 0
    box: Points = field(default_factory=lambda: np.array([[np.inf] * 3, [-np.inf] * 3]))
    """(2, 3) file coordinates."""
    steps: NDArray[np.int64] = field(
        default_factory=lambda: np.array([[2**31] * 3, [-(2**31)] * 3])
    )
    """(2, 3) integer coordinates of records that stay as they are."""
    facts: dict[str, Facts] = field(default_factory=dict)
    channels: set[int] = field(default_factory=set)
    last_time: float | None = None

    def add(self, piece: Cloud) -> None:
        self.points += len(piece)
        if not len(piece):
            return
        self._look_at_times(piece)
        if isinstance(piece.header, LasHeader):
            self.channels |= waveform_channels(piece.records)
        else:
            for name, found in facts_of(piece).items():
                known = self.facts.get(name)
                self.facts[name] = found if known is None else known.joined(found)
        if _keeps_integers(piece):
            columns = [piece.records[name] for name in "XYZ"]
            lowest, highest = [c.min() for c in columns], [c.max() for c in columns]
            self.steps[0] = np.minimum(self.steps[0], lowest)
            self.steps[1] = np.maximum(self.steps[1], highest)
            return
        there = piece.frame.to_file(piece.xyz)
        low, high = corners_of(there)
        self.box[0] = np.minimum(self.box[0], low)
        self.box[1] = np.maximum(self.box[1], high)

    def _look_at_times(self, piece: Cloud) -> None:
        for name in piece.attributes:
            values = piece.attribute(name) if canonical(name) == "gps_time" else None
            if values is None or values.dtype.kind != "f":
                continue
            known = values[np.isfinite(values)]
            if not known.any():
                continue
            latest = float(known.max())
            self.last_time = latest if self.last_time is None else max(self.last_time, latest)


def _keeps_integers(piece: Cloud) -> bool:
    return isinstance(piece.header, LasHeader) and not piece.is_moved


def las_form(
    pieces: Pieces, *, modern: bool = False, packed: bool = False, finish: Finish | None = None
) -> LasForm:
    """Pass over a cloud once and return how each piece of it becomes LAS records.

    Parameters
    ----------
    modern, packed : bool
        As `las_parts`.
    finish : callable, optional
        Of the pieces, as they will be written.

    Raises
    ------
    InputError
        There is no piece.
    OutputError
        The coordinates do not fit 32-bit integers at the step they need.
    """
    survey, sample = _Survey(), None
    for piece in pieces():
        if sample is None or (not len(sample) and len(piece)):
            sample = piece.select(np.arange(min(1, len(piece))))
        survey.add(piece)
    if sample is None:
        raise InputError("a cloud in pieces needs at least one piece, got none.")
    if finish is not None:
        sample = finish(sample)
    is_empty = not survey.points
    is_kept = _keeps_integers(sample)
    whole = Whole(
        corners=survey.box[:0] if is_empty or is_kept else survey.box,
        facts=survey.facts,
        has_mixed_channels=len(survey.channels) > 1,
    )
    header, records, notes = las_parts(sample, modern=modern, packed=packed, whole=whole)
    if is_empty:
        corners = survey.box[:0]
    elif is_kept:
        corners = survey.steps * header.scale + header.offset
    else:
        steps = np.zeros(2, dtype=[(name, "<i4") for name in "XYZ"])
        set_integers(steps, survey.box, header.scale, header.offset)
        rounded = np.stack([steps[name] for name in "XYZ"], axis=1)
        corners = rounded * header.scale + header.offset
    return LasForm(
        name=sample.name,
        points=survey.points,
        header=header,
        layout=records.dtype,
        corners=corners,
        notes=tuple(notes),
        modern=modern,
        packed=packed,
        whole=whole,
        finish=finish,
        last_time=survey.last_time,
    )
