"""From a cloud to what the scans of an E57 file hold: fields, poses, limits.

Points that came from E57 or PTX keep their own numbers, in the scanner's coordinates; a motion
changes the pose, and a scale the numbers. Points from elsewhere are scaled integers about the
cloud's local origin, which becomes the pose: small numbers, so that readers in single precision
lose nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.errors import OutputError
from dougong.formats.e57 import E57Header
from dougong.formats.e57_fields import (
    INVALID,
    LENGTHS,
    NORMAL,
    FieldSpec,
    attribute_name,
    field_name,
    float_field,
    integer_field,
)
from dougong.formats.e57_pose import Motion, Pose, motion_of
from dougong.formats.las_fields import canonical, columns_of, coordinate_fields, shrunk_colours
from dougong.formats.las_header import LasHeader, las_attributes
from dougong.formats.ptx import PtxHeader
from dougong.formats.stream import decimals_of
from dougong.formats.units import units_of
from dougong.typing import Transform

FINEST_M = 1e-4
"""Step of coordinates whose own step is coarser: 0.1 mm."""
_MOST_STEPS = 2**52
_COLOURS = ("red", "green", "blue")


@dataclass(frozen=True, slots=True, kw_only=True)
class Station:
    """One scan to be written."""

    name: str
    guid: str
    """What the scan's new id is made from: that of the scan it came from."""
    pose: Pose
    fields: dict[str, tuple[FieldSpec, NDArray[Any]]]
    """E57 field to its type and values (n,)."""
    header: E57Header | None = None
    """Of the scan it came from."""
    motion: Motion | None = None

    def __len__(self) -> int:
        return len(next(iter(self.fields.values()))[1])


def stations_of(cloud: Cloud, notes: list[str]) -> list[Station]:
    """Return the scans that hold `cloud`; what is not kept as it was is added to `notes`."""
    if not isinstance(cloud.header, E57Header | PtxHeader):
        return [_foreign(cloud, notes)]
    headers = cloud.header.stations or (cloud.header,)
    station = cloud.attribute("station")
    if len(headers) == 1 or station is None:
        return [_posed(cloud, cloud.header, notes)]
    found = []
    for header in headers:
        chosen = np.flatnonzero(station == header.station)
        if len(chosen):
            own = _without_foreign(cloud.select(chosen), header, headers)
            found.append(_posed(own, header, notes))
    return found


def _without_foreign(
    cloud: Cloud, header: E57Header | PtxHeader, headers: tuple[E57Header | PtxHeader, ...]
) -> Cloud:
    """Return one scan's part of a survey without what only other scans have.

    Scans read as one cloud have the fields of all, 0 where a scan has none: channels that its
    scanner never had. What somebody set since is another number, and stays.
    """
    own = _attributes_of(header)
    foreign = {name for other in headers for name in _attributes_of(other)} - own
    if isinstance(header, PtxHeader):
        foreign = set(_COLOURS)  # four columns have none, and the header does not say how many
    names = [
        name
        for name in cloud.records.dtype.names or ()
        if name not in foreign or cloud.records[name].any()
    ]
    if len(names) == len(cloud.records.dtype.names or ()):
        return cloud
    return replace(cloud, records=repack_fields(cloud.records[names]))


def _attributes_of(header: E57Header | PtxHeader) -> set[str]:
    fields = header.fields if isinstance(header, E57Header) else ()
    return {attribute_name(name) for name in fields}


def _posed(cloud: Cloud, header: E57Header | PtxHeader, notes: list[str]) -> Station:
    if isinstance(header, E57Header):
        return _own(cloud, header, notes)
    return replace(_own(cloud, _as_e57(cloud, header), notes), header=None)


def _as_e57(cloud: Cloud, header: PtxHeader) -> E57Header:
    """Return how E57 would hold a scan of a PTX file: its decimals as scaled integers."""
    fields = {}
    for name in LENGTHS[:3]:
        values = cloud.records[name]
        decimals = decimals_of(values, 0) if len(values) else None
        fields[name] = float_field(is_single=False)
        if decimals is not None:
            step = 10.0**-decimals
            low, high = (int(np.rint(end / step)) for end in (values.min(), values.max()))
            fields[name] = FieldSpec(kind="scaled", low=low, high=high, scale=step)
    stem = header.source.stem if header.source is not None else cloud.name
    name = f"{stem}_{header.station + 1}"
    pose = Pose(header.rotation, header.translation)
    return E57Header(header.station, pose, name, name, fields, header.source or Path(cloud.name))


def _own(cloud: Cloud, header: E57Header, notes: list[str]) -> Station:
    """Return a scan whose points came from E57: own coordinates stay, the pose moves."""
    motion, pose, scale = None, header.pose, 1.0
    if cloud.motion is not None:
        motion = motion_of(in_metres(cloud.motion, cloud.frame.unit_m), _middle(cloud, header))
        pose, scale = motion.applied(header.pose), motion.scale
    if scale != 1.0:
        notes.append(
            f"the registration has a scale of {scale:.9g} and an E57 pose has none: the points "
            "were scaled in the scanners' own coordinates."
        )
    columns = {name: cloud.records[name] for name in cloud.records.dtype.names or ()}
    if set(NORMAL) <= set(columns):
        # Read as directions in file coordinates; the format wants the scanner's.
        own = np.stack([columns[axis] for axis in NORMAL], axis=1) @ pose.rotation
        columns |= {axis: own[:, k] for k, axis in enumerate(NORMAL)}
    fields: dict[str, tuple[FieldSpec, NDArray[Any]]] = {}
    for name, spec in header.fields.items():
        if name in INVALID:
            fields[name] = spec, np.zeros(len(cloud), dtype=np.uint8)
        elif scale != 1.0 and name in LENGTHS:
            fields[name] = spec.scaled(scale), columns[attribute_name(name)] * scale
        else:
            fields[name] = spec, columns[attribute_name(name)]
    known = {attribute_name(name) for name in header.fields} | {"station"}
    fields |= _added({n: v for n, v in columns.items() if n not in known}, notes)
    return Station(
        name=header.name, guid=header.guid, pose=pose, fields=fields, header=header, motion=motion
    )


def _middle(cloud: Cloud, header: E57Header) -> NDArray[np.float64]:
    """Return a place amid the scan, in the coordinates of the file it came from (metres)."""
    columns = [cloud.records[name] for name in LENGTHS[:3] if name in header.fields]
    if len(columns) < 3 or not len(cloud):
        return header.pose.translation
    own = np.array([(float(c.min()) + float(c.max())) / 2 for c in columns])
    middle: NDArray[np.float64] = header.pose.rotation @ own + header.pose.translation
    return middle


def in_metres(matrix: Transform, unit_m: tuple[float, float, float]) -> Transform:
    """Return a motion into coordinates of `unit_m` as one into metres, which E57 always has."""
    return np.diag([*unit_m, 1.0]) @ matrix


def _foreign(cloud: Cloud, notes: list[str]) -> Station:
    """Return a scan whose points came from another format.

    Raises
    ------
    OutputError
        The cloud is in degrees, and E57 holds metres.
    """
    if units_of(cloud.frame.crs).is_geographic:
        msg = (
            f"{cloud.name} is in degrees ({units_of(cloud.frame.crs).name}), and E57 holds metres. "
            "Reproject it, or write another format."
        )
        raise OutputError(msg)
    fields: dict[str, tuple[FieldSpec, NDArray[Any]]] = {}
    for axis, name in enumerate(LENGTHS[:3]):
        fields[name] = _coordinate(cloud, axis), cloud.xyz[:, axis]
    if all(spec.kind == "float" for spec, _ in fields.values()):
        notes.append("coordinates are written as doubles, as they lie on no decimal step.")
    dropped = coordinate_fields(cloud)
    columns = {n: v for n, v in columns_of(cloud).items() if n not in dropped}
    if isinstance(cloud.header, LasHeader):
        # Every LAS point has every field of its format: what is zero throughout is not in use.
        unused = [n for n in las_attributes(cloud.header) if n in columns and not columns[n].any()]
        columns = {n: v for n, v in columns.items() if n not in unused}
    named: dict[str, NDArray[Any]] = {}
    for name, values in shrunk_colours(columns, notes).items():
        target = canonical(name)
        known = target in ("intensity", "red", "green", "blue") and values.ndim == 1
        named[target if known and target not in named else name] = values
    fields |= _added(named, notes)
    return Station(
        name=cloud.name,
        guid=cloud.name,
        pose=Pose(np.eye(3), np.array(cloud.frame.origin)),
        fields=fields,
    )


def _coordinate(cloud: Cloud, axis: int) -> FieldSpec:
    """Return how one local coordinate is stored: on a step of 0.1 mm or the cloud's finer one."""
    step = cloud.frame.step
    if step is None:
        return float_field(is_single=False)
    finest = min(step[axis] * cloud.frame.unit_m[axis], FINEST_M)
    low, high = float(cloud.xyz[:, axis].min()), float(cloud.xyz[:, axis].max())
    first, last = np.floor(low / finest) - 1, np.ceil(high / finest) + 1
    if max(abs(first), abs(last)) > _MOST_STEPS:
        return float_field(is_single=False)
    return FieldSpec(kind="scaled", low=int(first), high=int(last), scale=finest)


def _added(
    columns: Mapping[str, NDArray[Any]], notes: list[str]
) -> dict[str, tuple[FieldSpec, NDArray[Any]]]:
    """Return attributes as fields: under the standard's name where it has one, else under ours."""
    fields: dict[str, tuple[FieldSpec, NDArray[Any]]] = {}
    ours = []
    for name, values in columns.items():
        parts = {name: values}
        if values.ndim == 2:
            parts = {f"{name}_{k}": values[:, k] for k in range(values.shape[1])}
        for key, column in parts.items():
            spec = _spec_for(key, column, notes)
            if spec is None:
                continue
            field = field_name(key)
            while field in fields:
                field += "_"
            fields[field] = spec, column
            if ":" in field and field != f"nor:normal{key[-1:].upper()}":
                ours.append(key)
    if ours:
        notes.append(
            f"E57 has no field for {', '.join(ours)}: kept in an extension, which programs that "
            "do not know it pass over."
        )
    return fields


def _spec_for(name: str, values: NDArray[Any], notes: list[str]) -> FieldSpec | None:
    kind = values.dtype.kind
    if kind == "f":
        return float_field(is_single=values.dtype.itemsize <= 4)
    if kind not in "iub":
        notes.append(f"{name} has type {values.dtype}, which E57 does not have: left out.")
        return None
    if kind == "u" and len(values) and values.max() > np.iinfo(np.int64).max:
        notes.append(
            f"{name} has integers of more than 63 bits, which E57 does not have: left out."
        )
        return None
    return integer_field(values)
