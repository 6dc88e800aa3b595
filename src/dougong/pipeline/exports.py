"""One registration as other programs read it: CloudCompare, PDAL, Metashape.

Written beside the JSON, for a registration that is sure only: a file that is applied blindly must
not hold a pose that may be wrong. All numbers have 17 significant digits, so that no bit of the
matrix is lost at map coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Frame
from dougong.pipeline.outputs import write_json, write_text
from dougong.typing import Transform

CLOUDCOMPARE, PDAL, METASHAPE = ".cloudcompare.txt", ".pdal.json", ".metashape.xml"
SUFFIXES = (CLOUDCOMPARE, PDAL, METASHAPE)
_LARGE = 1e4
"""CloudCompare holds coordinates as float32: larger ones it shifts, and so do we."""
_LOCAL_CS = (
    'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],'
    'UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """What is moved and where to."""

    source: str
    target: str
    source_frame: Frame
    target_frame: Frame
    files: Sequence[str] = ()
    """The source's files, where each moves as a whole; none: no pipeline can name them."""


def write_registration(folder: Path, stem: str, document: dict[str, Any], ends: Ends) -> None:
    """Write ``STEM.json`` and, where the pose is sure, its forms for other programs.

    Raises
    ------
    OutputError
        As `write_json`.
    """
    write_json(folder / f"{stem}.json", document)
    is_best = document["status"] == "ambiguous" and document["parameters"].get("accept_best")
    if document["matrix"] is None or not (document["status"] == "ok" or is_best):
        return
    matrix = np.array(document["matrix"], dtype=np.float64)
    write_text(folder / f"{stem}{CLOUDCOMPARE}", cloudcompare_text(matrix, ends))
    if ends.files:
        pipeline = pdal_pipeline(matrix, ends)
        write_text(folder / f"{stem}{PDAL}", json.dumps(pipeline, indent=2) + "\n")
    if ends.source_frame.unit_m == ends.target_frame.unit_m == (1.0, 1.0, 1.0):
        write_text(folder / f"{stem}{METASHAPE}", metashape_xml(matrix, ends))


def inverse(matrix: Transform) -> Transform:
    """Return the inverse (4, 4) of a similarity."""
    linear = matrix[:3, :3]
    back = np.eye(4)
    back[:3, :3] = linear.T / np.cbrt(np.linalg.det(linear)) ** 2
    back[:3, 3] = -back[:3, :3] @ matrix[:3, 3]
    return back


def _digits(values: Any) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def global_shift(frame: Frame) -> NDArray[np.float64]:
    """Return what CloudCompare is to add to file coordinates of `frame`, (3,): whole thousands."""
    corner = frame.origin / np.asarray(frame.unit_m)
    shift: NDArray[np.float64] = np.where(
        np.abs(corner) > _LARGE, -np.round(corner / 1000.0) * 1000.0, 0.0
    )
    return shift + 0.0  # no -0


def cloudcompare_text(matrix: Transform, ends: Ends) -> str:
    """Return the 4x4 rows that CloudCompare applies, then how to use them in words.

    It applies a matrix to the coordinates it holds, which are those of the file plus the global
    shift. These rows take the source under its shift to the target under the target's.
    """
    before, after = global_shift(ends.source_frame), global_shift(ends.target_frame)
    local = matrix.copy()
    local[:3, 3] = matrix[:3, 3] - matrix[:3, :3] @ before + after
    rows = "\n".join(_digits(row) for row in local)
    said = [
        f"{ends.source} onto {ends.target}, for CloudCompare (Edit > Apply transformation)",
        f"open {ends.source} with the global shift {_digits(before)}",
        f"open {ends.target} with the global shift {_digits(after)}",
        "apply the four rows above to the first; it then lies on the second",
    ]
    if not np.array_equal(before, after):
        said.append(
            f"before saving it: Edit > Edit global shift and scale, {_digits(after)}, keeping the "
            "local coordinates"
        )
    return rows + "\n" + "\n".join(f"# {line}" for line in said) + "\n"


def pdal_pipeline(matrix: Transform, ends: Ends) -> dict[str, Any]:
    """Return a PDAL pipeline that moves the source's files: ``pdal pipeline NAME.pdal.json``."""
    frame = ends.target_frame
    step = 1e-4 / float(frame.unit_m[0])
    writer: dict[str, Any] = {
        "type": "writers.las",
        "filename": f"{ends.source}_moved.laz",
        "minor_version": 4,
        "extra_dims": "all",
        **{f"scale_{axis}": step for axis in "xyz"},
        **{f"offset_{axis}": "auto" for axis in "xyz"},
    }
    if frame.crs is not None:
        writer["a_srs"] = frame.crs
    move = {"type": "filters.transformation", "matrix": _digits(matrix)}
    return {"pipeline": [*ends.files, move, writer]}


def metashape_xml(matrix: Transform, ends: Ends) -> str:
    """Return the transform of a Metashape chunk in local coordinates: turn, shift, scale."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    label = quoteattr(f"{ends.source} onto {ends.target}")
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0">
  <chunk label={label} enabled="true">
    <transform>
      <rotation locked="true">{_digits(matrix[:3, :3] / scale)}</rotation>
      <translation locked="true">{_digits(matrix[:3, 3])}</translation>
      <scale locked="true">{scale:.17g}</scale>
    </transform>
    <reference>{_LOCAL_CS}</reference>
  </chunk>
</document>
"""
