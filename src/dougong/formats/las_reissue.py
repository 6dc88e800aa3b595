"""Issue a point cloud file again, moved, as LAS or LAZ: in chunks, nothing decimated.

Every attribute stays; coordinates are new integers at the input's own step or a finer one. What
must be the same for all chunks (offset, layout, how an attribute is stored) is settled by one
pass before, for LAS by its header.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dougong.cloud import Cloud, Frame
from dougong.formats.atomic import refuse_bad_target, replacing
from dougong.formats.las import waveform_channels
from dougong.formats.las_fields import Facts, facts_of
from dougong.formats.las_header import LasHeader
from dougong.formats.las_records import OutsideLattice, Whole, las_parts
from dougong.formats.las_write import LasWriter
from dougong.formats.model import Written
from dougong.typing import Points, Transform

_WAVEFORM_FORMATS = (9, 10)
Chunks = Callable[[], Generator[Cloud]]


def reissue_las(
    chunks: Chunks,
    source: Path,
    output: Path,
    matrices: Sequence[Transform | None],
    target: Frame,
    *,
    header: LasHeader | None,
    overwrite: bool = False,
) -> Written:
    """Write `source` again with every point moved.

    Parameters
    ----------
    chunks : callable
        Starts reading the file from its beginning; all its chunks share one frame.
    source, output : Path
    matrices : sequence of ndarray (4, 4) or None
        For each scan of the source: from its file coordinates to those of `target`; None leaves
        the scan out.
    target : Frame
    header : LasHeader or None
        Of the source where it is LAS: it says where the points lie.

    Raises
    ------
    FormatError
        The input is damaged.
    OutputError
        The output exists, the disk is full, or the coordinates do not fit; nothing is left behind.
    """
    refuse_bad_target(output, overwrite=overwrite, source=source)
    job = _Job(chunks, source, output, matrices, target)
    whole = matrices[0]
    is_plain = header is not None and header.point_format not in _WAVEFORM_FORMATS
    if header is not None and whole is not None and is_plain and header.has_box:
        # Offsets follow from where the header says the points lie: one that lies about it matters
        # only where they do not fit.
        try:
            return job.write(Whole(corners=_moved_box(header.extent, whole), facts={}))
        except OutsideLattice:
            pass
    return job.write(job.surveyed())


def _moved_box(box: Points, matrix: Transform) -> Points:
    """Return the (8, 3) corners of the box (2, 3) about some points, moved."""
    places = np.indices((2, 2, 2)).reshape(3, 8).T
    corners = np.where(places == 0, box[0], box[1])
    moved: Points = corners @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


@dataclass(frozen=True, slots=True)
class _Job:
    chunks: Chunks
    source: Path
    output: Path
    matrices: Sequence[Transform | None]
    target: Frame

    def station_of(self, chunk: Cloud) -> int:
        """Return which scan of the source a chunk belongs to."""
        return int(chunk.header.station) if len(self.matrices) > 1 else 0

    def pieces(self) -> Iterator[tuple[Cloud, Transform]]:
        """Yield the chunks that are written, each with its matrix."""
        for chunk in self.chunks():
            station = self.station_of(chunk)
            matrix = self.matrices[station]
            if matrix is None:
                continue
            if len(self.matrices) > 1:
                marks = np.full(len(chunk), station, dtype="<u2")
                chunk = chunk.with_attribute("station", marks)
            yield chunk, matrix

    def surveyed(self) -> Whole:
        """Pass over the file once for what all its chunks must share."""
        boxes: dict[int, tuple[Points, Transform]] = {}
        facts: dict[str, Facts] = {}
        channels: set[int] = set()
        for chunk, matrix in self.pieces():
            there = chunk.frame.to_file(chunk.xyz)
            box = np.stack([there.min(axis=0), there.max(axis=0)])
            station = self.station_of(chunk)
            low, high = boxes[station][0] if station in boxes else box
            box = np.stack([np.minimum(low, box[0]), np.maximum(high, box[1])])
            boxes[station] = box, matrix
            if isinstance(chunk.header, LasHeader):
                channels |= waveform_channels(chunk.records)
                continue
            for name, found in facts_of(chunk).items():
                facts[name] = found if name not in facts else facts[name].joined(found)
        return Whole(
            corners=np.concatenate([_moved_box(box, matrix) for box, matrix in boxes.values()]),
            facts=facts,
            has_mixed_channels=len(channels) > 1,
        )

    def write(self, whole: Whole) -> Written:
        """Write the file chunk by chunk."""
        is_packed = self.output.name.lower().endswith(".laz")
        notes: list[str] = []
        with replacing(self.output, expected_bytes=self.source.stat().st_size) as sink:
            writer: LasWriter | None = None
            for chunk, matrix in self.pieces():
                moved = chunk.moved(matrix, self.target)
                header, records, said = las_parts(moved, packed=is_packed, whole=whole)
                notes += [*chunk.notes, *said]
                if writer is None:
                    writer = LasWriter(sink, header, is_compressed=is_packed)
                writer.append(records)
            assert writer is not None, "a file without points is refused where it is opened"
            points = writer.close()
        return Written(
            path=self.output,
            points=points,
            bytes=self.output.stat().st_size,
            notes=tuple(dict.fromkeys(notes)),
        )
