"""The scans of one file as one cloud with the uint16 attribute `station`, whole or in chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dougong.cloud import Cloud, Records
from dougong.formats.stream import stem_of

_STATION = "<u2"


def joined_scans(clouds: Sequence[Cloud], path: Path) -> Cloud:
    """Return the scans of the file `path`, in one frame, as one cloud.

    It has the attributes of all, 0 where a scan has none, each scan's header, and where each
    scanner stood.
    """
    layout = _common_layout(clouds)
    records = np.zeros(sum(map(len, clouds)), dtype=layout)
    xyz = np.empty((len(records), 3))
    at = 0
    for cloud in clouds:
        part = slice(at, at + len(cloud))
        xyz[part] = cloud.xyz
        _fill(records[part], cloud)
        at += len(cloud)
    missing = {
        name
        for cloud in clouds
        for name in layout.names or ()
        if name != "station" and name not in (cloud.records.dtype.names or ())
    }
    notes = [f"{cloud.name}: {note}" for cloud in clouds for note in cloud.notes]
    notes += [f"{name} is 0 for stations without it." for name in sorted(missing)]
    headers = tuple(cloud.header for cloud in clouds)
    places = np.full((1 + max(cloud.header.station for cloud in clouds), 3), np.nan)
    for cloud in clouds:
        if cloud.viewpoints is not None:
            places[cloud.header.station] = cloud.viewpoints[0]
    return replace(
        clouds[0],
        xyz=xyz,
        records=records,
        viewpoints=places,
        name=stem_of(path),
        header=replace(headers[0], stations=headers),
        notes=tuple(notes),
    )


def chunks_as_one(chunks: Iterable[Cloud], scans: Sequence[Cloud], path: Path) -> Iterator[Cloud]:
    """Yield chunks of the scans of a file as chunks of the cloud of `joined_scans`.

    `scans` are all that come, without points.
    """
    whole = joined_scans(scans, path)
    for chunk in chunks:
        records = np.zeros(len(chunk), dtype=whole.records.dtype)
        _fill(records, chunk)
        yield replace(whole, xyz=chunk.xyz, records=records)


def _common_layout(clouds: Sequence[Cloud]) -> np.dtype[np.void]:
    layout: dict[str, Any] = {}
    for cloud in clouds:
        dtype = cloud.records.dtype
        fields: dict[str, Any] = {
            **{name: dtype[name] for name in dtype.names or ()},
            "station": _STATION,
        }
        for name, kind in fields.items():
            layout[name] = np.promote_types(layout[name], kind) if name in layout else kind
    return np.dtype(list(layout.items()))


def _fill(records: Records, cloud: Cloud) -> None:
    """Copy what the points of one scan have into their records of the joined cloud."""
    for name in cloud.records.dtype.names or ():
        records[name] = cloud.records[name]
    records["station"] = cloud.header.station
