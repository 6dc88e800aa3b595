"""Read E57: every scan with its pose applied, in blocks through libe57.

pye57's own readers load whole scans as float32 intensity and refuse unknown fields, so only its
libe57 bindings are used: any field, each in a type that holds it, a bounded block at a time.
Source: ASTM E2807-11.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import BitField, Records, transformed
from dougong.errors import FormatError
from dougong.formats.e57_fields import INVALID, NORMAL, FieldSpec, attribute_name, spec_of
from dougong.formats.e57_pose import Pose, matrix_of, still
from dougong.formats.stream import Block, opened, refuse_empty
from dougong.formats.units import METRES, as_wkt, metre_form, units_of
from dougong.typing import Mask, Points

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


@dataclass(frozen=True, eq=False)
class E57Header:
    """Where a cloud stands in its E57 file, and how the file holds its points."""

    station: int
    pose: Pose
    """Scanner to file coordinates."""
    name: str
    guid: str
    fields: Mapping[str, FieldSpec]
    """Every field of the scan's records but text, by its E57 name."""
    source: Path
    stations: tuple[E57Header, ...] = ()
    """Of several scans read as one cloud: the header of each."""

    @property
    def translation(self) -> NDArray[np.float64]:
        """(3,) metres, where the scanner stood if the file says so."""
        return self.pose.translation


@dataclass
class E57Scan:
    """One scan of an E57 file."""

    path: Path
    name: str
    header: E57Header
    count: int
    crs: str | None = None
    notes: tuple[str, ...] = ()
    bits: dict[str, BitField] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Record layout: every field of the scan, invalid states apart."""
        fields = self.header.fields.items()
        return np.dtype([(attribute_name(n), _dtype_of(f)) for n, f in fields if n not in INVALID])

    def blocks(self, rows: int) -> Iterator[Block]:
        """Yield the scan in blocks, pose applied."""
        from pye57 import libe57

        rows = max(1, min(rows, self.count))
        with image_of(self.path) as image:
            buffers = libe57.VectorSourceDestBuffer()
            arrays: dict[str, NDArray[Any]] = {}
            for name, spec in self.header.fields.items():
                dtype = _dtype_of(spec)
                arrays[name] = np.zeros(rows, dtype=_BUFFER.get(dtype, dtype))
                buffers.append(libe57.SourceDestBuffer(image, name, arrays[name], rows, True, True))
            reader, done = None, 0
            try:
                points = image.root()["data3D"][self.header.station]["points"]
                reader = points.reader(buffers)
                while done < self.count:
                    got = int(reader.read())
                    if got == 0:
                        raise _damaged(self.path, self.name, self.count, done)
                    yield self._block({n: a[:got] for n, a in arrays.items()})
                    done += got
            except libe57.E57Exception as error:
                raise _damaged(self.path, self.name, self.count, done) from error
            finally:
                if reader is not None:
                    reader.close()

    def _block(self, columns: dict[str, NDArray[Any]]) -> Block:
        size = len(next(iter(columns.values())))
        records: Records = np.empty(size, dtype=self.dtype)
        is_invalid: Mask = np.zeros(size, dtype=bool)
        for name, values in columns.items():
            if name in INVALID:
                is_invalid |= _is_unusable(values)
            else:
                records[attribute_name(name)] = values
        local = _cartesian(columns)
        pose = self.header.pose
        if np.array_equal(pose.rotation, np.eye(3)):
            local += pose.translation
        else:
            local = transformed(local, pose.rotation, pose.translation)
            if set(NORMAL) <= set(records.dtype.names or ()):
                normals = np.stack([records[axis] for axis in NORMAL], axis=1, dtype=np.float64)
                turned = transformed(normals, pose.rotation, np.zeros(3))
                for k, axis in enumerate(NORMAL):
                    records[axis] = turned[:, k]
        return Block(records, local, is_invalid)


# pye57 0.4 fills 8-byte integer buffers at the wrong stride, and knows no 4-byte ones: doubles
# hold these exactly up to 2^53.
_BUFFER = {"u4": "f8", "i4": "f8", "i8": "f8"}


def _is_unusable(values: NDArray[Any]) -> Mask:
    """Return which points have no position: 1 keeps a direction only, 2 has nothing."""
    is_unusable: Mask = values != 0
    return is_unusable


def _cartesian(columns: dict[str, NDArray[Any]]) -> Points:
    if set(_CARTESIAN) <= set(columns):
        return np.stack([columns[name] for name in _CARTESIAN], axis=1, dtype=np.float64)
    distance, azimuth, elevation = (columns[name].astype(np.float64) for name in _SPHERICAL)
    level = distance * np.cos(elevation)
    return np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )


def _damaged(path: Path, scan: str, promised: int, found: int) -> FormatError:
    return FormatError(
        f"{path.name}: scan {scan!r} should hold {promised:,} points, the file is damaged or ends "
        f"after about {found:,}. Copy it again."
    )


@contextmanager
def image_of(path: Path) -> Iterator[Any]:
    """Open a file with libe57, or say in one sentence why not.

    Raises
    ------
    FormatError
        Not an E57 file, or damaged.
    """
    from pye57 import libe57

    with opened(path) as file:
        signature = file.read(8)
    if signature != b"ASTM-E57":
        msg = f"{path.name} is not an E57 file: it starts with {signature!r}, expected b'ASTM-E57'."
        raise FormatError(msg)
    try:
        image = libe57.ImageFile(str(path), "r")
    except libe57.E57Exception as error:
        reason = str(error).strip().splitlines()[0]
        msg = f"{path.name} cannot be read as E57: {reason}. It may be truncated; copy it again."
        raise FormatError(msg) from error
    try:
        yield image
    finally:
        image.close()


def open_e57(path: Path) -> list[E57Scan]:
    """Read the headers of an E57 file; one scan object for each scan that has points.

    Raises
    ------
    FormatError
        Not an E57 file, damaged, or without any point.
    """
    from pye57 import libe57

    with image_of(path) as image:
        try:
            root = image.root()
            crs, said = _crs_of(root)
            nodes = [root["data3D"][i] for i in range(len(root["data3D"]))]
            scans = [_scan(path, node, i, crs, said) for i, node in enumerate(nodes)]
            has_pose = [node.isDefined("pose") for node in nodes]
        except libe57.E57Exception as error:
            reason = str(error).strip().splitlines()[0]
            raise FormatError(f"{path.name} has a damaged E57 header: {reason}.") from error
    filled = [scan for scan in scans if scan.count]
    refuse_empty(len(filled), path)
    _say_unposed(filled, [scan for scan, has in zip(scans, has_pose, strict=True) if not has])
    return filled


def _say_unposed(filled: list[E57Scan], bare: list[E57Scan]) -> None:
    """Note of several scans which of them lie as they were scanned; `bare` ones state no pose.

    One that is moved by nothing may be that in whose frame the others are; of two, one is not.
    """
    unmoved = [scan for scan in filled if scan in bare or scan.header.pose.is_still]
    if len(filled) < 2 or (len(unmoved) < 2 and not any(scan in bare for scan in filled)):
        return
    is_one = len(unmoved) == 1
    note = (
        f"{len(unmoved)} of the {len(filled)} scans of {filled[0].path.name} "
        f"{'states' if is_one else 'state'} no pose, or one that moves nothing, and "
        f"{'is' if is_one else 'are'} taken to lie in the file's frame: wrongly, if in a scanner's "
        "own. Export them registered, or let each move by itself (in a project registered = false)."
    )
    unmoved[0].notes += (note,)


def _crs_of(root: Any) -> tuple[str | None, tuple[str, ...]]:
    """Return the reference system and what is to be said about it.

    Coordinates and poses of an E57 file are metres whatever unit its system has (ASTM E2807-11,
    8.4): a system in feet is taken over with its axes in metres, so that numbers and system agree.
    """
    if not root.isDefined("coordinateMetadata"):
        return None, ()
    text = str(root["coordinateMetadata"].value()).strip()
    wkt = as_wkt(text) if text else None
    if wkt is None:
        return None, ("its coordinate metadata were not understood.",) if text else ()
    units = units_of(wkt)
    if units.unit_m == METRES:
        return wkt, ()
    said = (
        f"its reference system ({units.name}) is in {units.names[0]}, but E57 coordinates are "
        "metres by definition: taken as metres."
    )
    return metre_form(wkt), (said,)


def _scan(path: Path, node: Any, index: int, crs: str | None, said: tuple[str, ...]) -> E57Scan:
    from pye57 import libe57

    points = node["points"]
    prototype = libe57.StructureNode(points.prototype())
    fields: dict[str, FieldSpec] = {}
    left_out = []
    for k in range(prototype.childCount()):
        name = prototype.get(k).elementName()
        spec = spec_of(prototype[name])
        if spec is None:
            left_out.append(name)
        else:
            fields[name] = spec
    label = str(node["name"].value()) if node.isDefined("name") else ""
    label = label.strip() or f"{path.stem}_{index + 1}"
    if not (set(_CARTESIAN) <= set(fields) or set(_SPHERICAL) <= set(fields)):
        msg = f"{path.name}: scan {label!r} has no coordinates, only {', '.join(fields)}."
        raise FormatError(msg)
    notes = (f"text fields were not read: {', '.join(left_out)}.",) if left_out else ()
    pose = pose_of_node(node)
    if pose is None:
        msg = (
            f"{path.name}: scan {label!r} has a pose that is none: its rotation is 0 0 0 0, "
            "expected a quaternion. Export it again."
        )
        raise FormatError(msg)
    guid = str(node["guid"].value()) if node.isDefined("guid") else ""
    header = E57Header(index, pose, label, guid, fields, source=path)
    return E57Scan(path, label, header, int(points.childCount()), crs, (*said, *notes))


def _dtype_of(spec: FieldSpec) -> str:
    """Return the smallest dtype that holds a field exactly."""
    if spec.kind == "float":
        return "f4" if spec.is_single else "f8"
    if spec.kind == "scaled":
        return "f8"
    for dtype in ("u1", "u2", "u4") if spec.low >= 0 else ("i1", "i2", "i4"):
        if np.iinfo(dtype).min <= spec.low and spec.high <= np.iinfo(dtype).max:
            return dtype
    return "i8"


def pose_of_node(node: Any) -> Pose | None:
    """Return the pose of a scan, None where its rotation is none.

    Without one its coordinates are the file's.
    """
    pose = still()
    if not node.isDefined("pose"):
        return pose
    rotation, translation = pose.rotation, pose.translation
    if node["pose"].isDefined("rotation"):
        quaternion = [float(node["pose"]["rotation"][axis].value()) for axis in "wxyz"]
        if not any(quaternion):
            return None
        rotation = matrix_of(np.array(quaternion))
    if node["pose"].isDefined("translation"):
        translation = np.array([float(node["pose"]["translation"][a].value()) for a in "xyz"])
    return Pose(rotation, translation)
