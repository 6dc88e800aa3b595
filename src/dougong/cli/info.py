"""``dougong info``: what is in a cloud."""

from pathlib import Path
from typing import Any

from dougong import app
from dougong.cli import _text
from dougong.cli._common import DEFAULT, Common
from dougong.cli._shell import DONE, FAILED, Answer, Listener, execute


def command(*files: Path, common: Common = DEFAULT) -> int:
    """Say what is in each cloud: points, extent, coordinate system, attributes, stations.

    Exit code 1 when one of them cannot be read; the others are described all the same.

    Example: dougong info scan.laz drone.laz

    Parameters
    ----------
    files
        LAS, LAZ, COPC, E57, PLY, PCD, XYZ, PTS, PTX or CSV files.
    """

    def work(progress: Listener) -> Answer:
        document = app.info(files, progress=progress)
        code = DONE if document["is_readable"] else FAILED
        text = "\n".join(_words(file) for file in document["files"])
        return Answer(document=document, text=text, exit_code=code)

    return execute(common, work)


def _words(file: dict[str, Any]) -> str:
    if "error" in file:
        return f"{file['path']}\n  error: {file['error']['message']}"
    rows = [row for row in _rows(file) if row[1]]
    width = max(len(key) for key, _ in rows)
    return "\n".join([file["path"], *(f"  {key.ljust(width)}  {value}" for key, value in rows)])


def _rows(file: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what a person reads; the rest is in --json."""
    form = f"{file['format']} {file['version']}".strip()
    if file["point_format"] is not None:
        form += f", point format {file['point_format']}"
    low, high = file["extent_min"], file["extent_max"]
    return [
        ("format", f"{form}{', compressed' if file['is_compressed'] else ''}"),
        ("points", _text.count(file["points"])),
        ("file size", _text.size(file["bytes"])),
        ("stations", _text.count(file["stations"]) if file["stations"] > 1 else ""),
        ("crs", _crs(file)),
        ("units", _units(file)),
        ("low corner", _triple(low)),
        ("high corner", _triple(high)),
        ("extent", _triple(_span(low, high))),
        ("coordinate step", _triple(file["scale"])),
        ("offset", _triple(file["offset"])),
        ("attributes", ", ".join(_attributes(file["attributes"]))),
        *(("note", note) for note in file["notes"]),
    ]


def _crs(file: dict[str, Any]) -> str:
    if file["crs_wkt"] is None:
        return "none; the numbers are taken as metres"
    return str(file["crs_name"] or "one that is not understood")


def _units(file: dict[str, Any]) -> str:
    names = file["unit_names"]
    shown = names[0] if len(set(names)) == 1 else ", ".join(names)
    factors = ", ".join(f"{factor:.10g}" for factor in dict.fromkeys(file["unit_m"]))
    return shown if shown == "metre" or factors == "1" else f"{shown} ({factors} m)"


def _span(low: list[float] | None, high: list[float] | None) -> list[float] | None:
    return None if low is None or high is None else [b - a for a, b in zip(low, high, strict=True)]


def _triple(values: list[float] | None) -> str:
    return "" if values is None else "  ".join(_number(value) for value in values)


def _number(value: float) -> str:
    """Return a coordinate to the tenth of a millimetre, without a tail of zeros."""
    plain = f"{value:.4f}".rstrip("0").rstrip(".") if abs(value) >= 1e-4 else f"{value:.6g}"
    return plain


def _attributes(types: dict[str, str]) -> list[str]:
    """Return the names of what is stored besides coordinates."""
    return [name for name in types if name.lower() not in _COORDINATES]


_COORDINATES = {
    "x", "y", "z", "cartesianx", "cartesiany", "cartesianz",
    "sphericalrange", "sphericalazimuth", "sphericalelevation",
}  # fmt: skip
