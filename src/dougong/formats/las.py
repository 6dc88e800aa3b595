"""Read LAS 1.0-1.4, LAZ and COPC, whole or in chunks, records kept as they are."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud, Frame, Records
from dougong.errors import FormatError
from dougong.formats.geotiff import read_geokeys
from dougong.formats.las_header import PROJECTION, LasHeader, bits_of, read_header
from dougong.formats.laz import (
    Undecodable,
    damaged,
    decode,
    open_decoder,
    packed_points,
    readable_points,
)
from dougong.formats.model import FileInfo, Triple, as_triple
from dougong.formats.stream import opened, refuse_empty, stem_of, unit_notes
from dougong.formats.units import as_wkt, units_of


def read_las_header(path: Path) -> LasHeader:
    """Return the header and records of a file, no point read."""
    with opened(path) as file:
        return read_header(file, path)


def crs_of(header: LasHeader) -> str | None:
    """Return the reference system of a header as WKT 2: its WKT record, else its GeoTIFF keys."""
    records = [vlr for vlr in (*header.vlrs, *header.evlrs) if vlr.key[0] == PROJECTION]
    for vlr in records:
        if vlr.record_id == 2112:
            wkt = as_wkt(vlr.data.decode("utf-8", "replace"))
            if wkt is not None:
                return wkt
    keys = read_geokeys(records)
    return keys.crs if keys is not None else None


def frame_of(header: LasHeader) -> Frame:
    """Return the frame of a file: its origin is on the file's own lattice, near its low corner.

    Only the header decides, so chunks and the whole share it. A header whose corner cannot be
    an integer coordinate (NaN, outside int32) puts the origin at the file's offset.
    """
    crs = crs_of(header)
    unit_m = unit_of(header, crs)
    origin = (header.offset + lattice_origin(header) * header.scale) * np.asarray(unit_m)
    return Frame(
        origin=origin,
        crs=crs,
        unit_m=unit_m,
        step=(float(header.scale[0]), float(header.scale[1]), float(header.scale[2])),
    )


def unit_of(header: LasHeader, crs: str | None) -> Triple:
    """Return metres per unit of x, y, z of a header whose reference system is `crs`."""
    units = units_of(crs)
    x, y, z = units.unit_m
    keys = read_geokeys(header.vlrs)
    if keys is not None and crs is None and keys.horizontal_m is not None:
        x = y = z = keys.horizontal_m
    if keys is not None and not units.has_vertical and keys.vertical_m is not None:
        z = keys.vertical_m
    return x, y, z


def lattice_origin(header: LasHeader) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the (3,) integer coordinates that become local zero."""
    with np.errstate(all="ignore"):
        low = np.rint((header.extent[0] - header.offset) / header.scale)
    return np.where(np.isfinite(low) & (np.abs(low) < 2**31), low, 0.0)


def local_xyz(records: Records, header: LasHeader, frame: Frame) -> Any:
    """Return (n, 3) local metres: (X - X0) x scale x unit, exact integers until the product.

    A file shifted by any whole number of steps gives the same digits.
    """
    xyz = np.empty((len(records), 3))
    low = lattice_origin(header)
    for axis, name in enumerate("XYZ"):
        np.subtract(records[name], low[axis], out=xyz[:, axis], dtype=np.float64)
        xyz[:, axis] *= header.scale[axis] * frame.unit_m[axis]
    return xyz


@contextmanager
def _points(path: Path) -> Iterator[tuple[LasHeader, Any]]:
    """Yield the header and a function that returns the next n records as an array."""
    with opened(path) as file:
        header = read_header(file, path)
        if not header.is_compressed:
            there = max(0, file.seek(0, 2) - header.points_start) // header.point_bytes
            if there < header.count:
                raise damaged(path, header, there, about=False)
        file.seek(header.points_start)
        is_packed = header.is_compressed and header.count > 0
        decoder = open_decoder(file, header, path) if is_packed else None
        done = 0

        def take(count: int) -> Records:
            nonlocal done
            try:
                # Not zeroed, unlike a bytearray, which costs a tenth of decoding.
                buffer = np.empty(count * header.point_bytes, dtype=np.uint8)
            except (MemoryError, ValueError) as error:
                raise _too_large(path, header) from error
            if decoder is None:
                got = file.readinto(buffer) // header.point_bytes  # type: ignore[attr-defined]
                if got < count:
                    raise damaged(path, header, done + got, about=False)
            else:
                try:
                    decode(decoder, buffer)
                except Undecodable as error:
                    raise damaged(path, header, readable_points(path, header)) from error
            done += count
            records: Records = buffer.view(header.dtype)
            return records

        yield header, take


def waveform_channels(records: Records) -> set[int]:
    """Return the scanner channels of waveform records (point format 9, 10); none of others.

    lazrs 0.8 does not keep the waveform fields of points of several channels: packing and unpacking
    changes them. One channel, and the older formats 4 and 5, survive bit for bit.
    """
    names = records.dtype.names or ()
    if not {"wavepacket_index", "classification_flags"} <= set(names):
        return set()
    channels = (records["classification_flags"] & 0b110000) >> 4
    return set(np.flatnonzero(np.bincount(channels)).tolist())


def has_mixed_channels(records: Records) -> bool:
    """Say whether waveform records hold several scanner channels."""
    return len(waveform_channels(records)) > 1


def _too_large(path: Path, header: LasHeader) -> FormatError:
    return FormatError(
        f"{path.name}: header says {header.count:,} points of {header.point_bytes} bytes, "
        "which memory cannot hold. If that is right read it in chunks, else copy it again."
    )


def _cloud(
    records: Records, header: LasHeader, frame: Frame, path: Path, notes: tuple[str, ...]
) -> Cloud:
    if header.is_compressed and has_mixed_channels(records):
        warning = (
            "the waveform fields of its several scanner channels may be unpacked wrongly; "
            "use the uncompressed LAS for them."
        )
        notes = (*notes, warning)
    return Cloud(
        xyz=local_xyz(records, header, frame),
        records=records,
        frame=frame,
        name=stem_of(path),
        bits=bits_of(header.point_format),
        header=header,
        notes=notes,
    )


def _surplus(header: LasHeader, path: Path) -> str | None:
    """Return in words what lies behind the points that the header counts, None where nothing."""
    if header.is_compressed:
        left = packed_points(path, header) - header.count
        return f"its chunks hold at least {left:,} more" if left > 0 else None
    ends = [path.stat().st_size]
    if header.evlr_place[1]:
        ends.append(header.evlr_place[0])
    if header.waveforms_start:
        ends.append(header.waveforms_start)
    left = min(ends) - header.points_start - header.count * header.point_bytes
    if left < header.point_bytes:
        return None
    return f"{left:,} bytes (of {header.point_bytes} a point) follow behind them"


def _refuse_empty(header: LasHeader, path: Path) -> None:
    """Raise FormatError where the header counts no points, and say what is there all the same."""
    surplus = None if header.count else _surplus(header, path)
    if surplus is not None:
        msg = (
            f"{path.name} holds no points by its header, but {surplus}: its writer may have been "
            "stopped. Export it again."
        )
        raise FormatError(msg)
    refuse_empty(header.count, path)


def _notes(header: LasHeader, frame: Frame, path: Path) -> tuple[str, ...]:
    found = list(unit_notes(frame))
    if header.is_compressed != path.suffix.lower().endswith("laz"):
        kind = "compressed (LAZ)" if header.is_compressed else "not compressed (LAS)"
        found.append(f"{kind}, against its suffix; read as what it is.")
    has_record = any(vlr.key[0] == PROJECTION for vlr in (*header.vlrs, *header.evlrs))
    if frame.crs is None and has_record:
        found.append("the reference system it names could not be understood.")
    if header.count and not header.has_box:
        (x, y, z), (x_high, y_high, z_high) = header.extent
        found.append(
            f"its header states no usable box (x {x:g} to {x_high:g}, y {y:g} to {y_high:g}, z "
            f"{z:g} to {z_high:g}), wrongly; the points themselves count."
        )
    surplus = _surplus(header, path) if header.count else None
    if surplus is not None:
        found.append(
            f"its header declares {header.count:,} points, wrongly: {surplus}, and are not read. "
            "Export it again."
        )
    return tuple(found)


def read(path: Path) -> Cloud:
    """Return the whole file. Memory: the records and 24 bytes per point."""
    with _points(path) as (header, take):
        _refuse_empty(header, path)
        frame = frame_of(header)
        return _cloud(take(header.count), header, frame, path, _notes(header, frame, path))


def iterate(path: Path, chunk_points: int) -> Iterator[Cloud]:
    """Yield the file in clouds of `chunk_points` that share one frame."""
    with _points(path) as (header, take):
        _refuse_empty(header, path)
        frame = frame_of(header)
        notes = _notes(header, frame, path)
        for start in range(0, header.count, chunk_points):
            records = take(min(chunk_points, header.count - start))
            yield _cloud(records, header, frame, path, notes)


def describe(path: Path) -> FileInfo:
    """Return what the header says."""
    header = read_las_header(path)
    frame = frame_of(header)
    units = units_of(frame.crs)
    kind = "COPC" if header.is_copc else "LAZ" if header.is_compressed else "LAS"
    packed = {bit.field for bit in bits_of(header.point_format).values()}
    attributes = {
        name: header.dtype[name].str for name in header.dtype.names or () if name not in packed
    }
    attributes |= dict.fromkeys(bits_of(header.point_format), "|u1")
    return FileInfo(
        path=path,
        format=kind,
        version=f"1.{header.minor}",
        points=header.count,
        bytes=path.stat().st_size,
        is_compressed=header.is_compressed,
        extent_min=as_triple(header.extent[0]) if header.count and header.has_box else None,
        extent_max=as_triple(header.extent[1]) if header.count and header.has_box else None,
        crs_wkt=frame.crs,
        crs_name=units.name or None,
        unit_names=units.names,
        unit_m=frame.unit_m,
        attributes=attributes,
        scale=frame.step,
        offset=as_triple(header.offset),
        point_format=header.point_format,
        notes=(*_notes(header, frame, path), *_shortfall(header, path)),
    )


def _shortfall(header: LasHeader, path: Path) -> tuple[str, ...]:
    """Return a note where the file cannot hold what its header promises; no point is read."""
    size = path.stat().st_size
    needed = header.points_start + header.count * header.point_bytes
    if header.is_compressed and header.count:
        with opened(path) as file:
            file.seek(header.points_start)
            place = file.read(8)
        # -1 stands for a table at the end of a file that was written as a stream.
        needed = int.from_bytes(place, "little", signed=True)
    if needed <= size:
        return ()
    return (f"truncated: its points need {needed:,} bytes, the file ends at {size:,}.",)
