"""Files of points: read whole or in chunks, written atomically.

Formats by suffix: in .las .laz .copc.laz .e57 .ply .pcd .xyz .pts .csv .txt .asc; out .las .laz
.copc.laz .ply. The libraries behind them are loaded when a file is opened.
"""

from dougong.formats.atomic import part_of
from dougong.formats.check import check
from dougong.formats.describe import describe
from dougong.formats.faults import faults_of
from dougong.formats.merged import write_merged
from dougong.formats.model import FileInfo, Finding, Written
from dougong.formats.registry import SUFFIXES, WRITABLE, iterate, read, read_stations, write
from dougong.formats.units import is_same_crs, require_metric, units_of

__all__ = [
    "SUFFIXES",
    "WRITABLE",
    "FileInfo",
    "Finding",
    "Written",
    "check",
    "describe",
    "faults_of",
    "is_same_crs",
    "iterate",
    "part_of",
    "read",
    "read_stations",
    "require_metric",
    "units_of",
    "write",
    "write_merged",
]
