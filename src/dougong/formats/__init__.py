"""Files of points: read whole or in chunks, written atomically.

Formats by suffix: in .las .laz .copc.laz .e57 .ply .pcd .xyz .pts .csv .txt .asc; out .las .laz
.copc.laz .e57 .ply. The libraries behind them are loaded when a file is opened.
"""

from dougong.formats.atomic import copy_file
from dougong.formats.check import check
from dougong.formats.describe import describe
from dougong.formats.faults import faults_of
from dougong.formats.merged import write_merged
from dougong.formats.model import FileInfo, Finding, PlacedStation, Written
from dougong.formats.registry import (
    SUFFIXES,
    WRITABLE,
    iterate,
    read,
    read_stations,
    write,
    write_stations,
)
from dougong.formats.reissue import can_reissue, reissue, scans_in, system_in
from dougong.formats.unfinished import part_of
from dougong.formats.units import (
    has_metric_format,
    in_system,
    is_same_crs,
    metric_problem,
    require_metric,
    units_of,
)

__all__ = [
    "SUFFIXES",
    "WRITABLE",
    "FileInfo",
    "Finding",
    "PlacedStation",
    "Written",
    "can_reissue",
    "check",
    "copy_file",
    "describe",
    "faults_of",
    "has_metric_format",
    "in_system",
    "is_same_crs",
    "iterate",
    "metric_problem",
    "part_of",
    "read",
    "read_stations",
    "reissue",
    "require_metric",
    "scans_in",
    "system_in",
    "units_of",
    "write",
    "write_merged",
    "write_stations",
]
