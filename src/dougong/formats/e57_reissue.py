"""Issue an E57 file again with new poses: points, pictures and all else stay as they are.

An E57 pose is a turn and a shift over points that lie in the scanner's own coordinates, so a
registered file needs new *poses* only. The file is copied page by page and its XML replaced: every
record, of whatever field or extension, keeps its bits. A pose has no scale; where a registration
has one, the points' own coordinates are scaled: for scaled integers the factor in the XML, for
floats the numbers themselves.
Memory: a few megabytes and the XML, whatever the size of the file.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dougong.errors import InputError
from dougong.formats.atomic import Sink, refuse_bad_target, replacing
from dougong.formats.e57_container import Appender, Layout, Pages, read_layout
from dougong.formats.e57_fields import LENGTHS
from dougong.formats.e57_floats import FloatFields, scale_floats
from dougong.formats.e57_pose import Motion, motion_of
from dougong.formats.e57_relocate import copy_section
from dougong.formats.e57_xml import (
    Node,
    attribute,
    child,
    children,
    is_placed,
    number_of,
    parse,
    pose_of,
    put,
    set_crs,
    set_pose,
    text_of,
    words,
)
from dougong.formats.model import PlacedStation, Written, as_triple
from dougong.formats.stream import opened
from dougong.formats.units import as_wkt
from dougong.typing import Transform

_BOUNDS = {
    "cartesianBounds": tuple(f"{a}{end}" for a in "xyz" for end in ("Minimum", "Maximum")),
    "sphericalBounds": ("rangeMinimum", "rangeMaximum"),
}
_NEGLIGIBLE_M = 1e-6


def reissue_e57(
    source: Path,
    output: Path,
    motions: Sequence[Transform | None],
    *,
    crs: str | None,
    overwrite: bool = False,
) -> Written:
    """Write `source` again with every scan moved.

    Parameters
    ----------
    source, output : Path
        E57 files.
    motions : sequence of ndarray (4, 4) or None
        For each scan of the file, in its order: from the file's coordinates to the output's, both
        metres. None leaves the scan out.
    crs : str or None
        Reference system of the output, WKT; its axes must be metres.

    Raises
    ------
    FormatError
        The input is damaged.
    OutputError
        The output exists, or the disk is full; nothing is left behind.
    """
    refuse_bad_target(output, overwrite=overwrite, source=source)
    with opened(source) as file:
        layout = read_layout(file, source)
        pages = Pages(file, layout, source.name)
        document = parse(pages.read(layout.xml_start, layout.xml_bytes), source.name)
        edit = _Edit(document.documentElement, motions, source.name)
        edit.run(crs)
        with replacing(output, expected_bytes=layout.file_bytes) as sink:
            if edit.is_whole:
                _copy_all(pages, sink, document, edit.floats, output.name)
            else:
                _copy_some(pages, sink, document, edit.floats, output.name)
    return Written(
        path=output,
        points=edit.points,
        bytes=output.stat().st_size,
        notes=tuple(edit.notes),
        stations=tuple(edit.stations),
    )


def scans_in(path: Path) -> tuple[int, str | None]:
    """Return how many scans an E57 file has, empty ones included, and its reference system.

    Raises
    ------
    FormatError
        Not an E57 file, or damaged.
    """
    with opened(path) as file:
        layout = read_layout(file, path)
        xml = Pages(file, layout, path.name).read(layout.xml_start, layout.xml_bytes)
    root = parse(xml, path.name).documentElement
    text = text_of(child(root, "coordinateMetadata")).strip()
    return len(list(children(child(root, "data3D")))), as_wkt(text) if text else None


def _copy_all(
    pages: Pages, sink: Sink, document: Node, floats: Sequence[FloatFields], name: str
) -> None:
    """Copy a file page by page, and put the new XML behind its points and pictures."""
    layout = pages.layout
    start = _points_end(document.documentElement, layout)
    pages.copy_into(sink, start)
    xml = document.toxml(encoding="utf-8")
    payload = layout.payload
    whole = -(-(start + len(xml)) // payload)
    layout = replace(layout, file_bytes=whole * layout.page, xml_start=start, xml_bytes=len(xml))
    new = Pages(sink, layout, name)
    new.write(start, xml + bytes(whole * payload - start - len(xml)))
    for fields in floats:
        scale_floats(new, fields)
    new.write(0, layout.packed())


def _points_end(root: Node, layout: Layout) -> int:
    """Return the logical position behind all that must be kept: the old XML goes if it is last."""
    places = [int(node.getAttribute("fileOffset")) for node in _with_bytes(root)]
    is_last = all(layout.logical(place) < layout.xml_start for place in places)
    return layout.xml_start if is_last else layout.logical(layout.file_bytes)


def _copy_some(
    pages: Pages, sink: Sink, document: Node, floats: Sequence[FloatFields], name: str
) -> None:
    """Copy only the points and pictures that the new XML names."""
    out = Appender(sink)
    moved: dict[int, int] = {}
    for node in _with_bytes(document.documentElement):
        place = int(node.getAttribute("fileOffset"))
        moved[place] = copy_section(pages, place, out)
        node.setAttribute("fileOffset", str(moved[place]))
    new = Pages(sink, out.finish(document.toxml(encoding="utf-8")), name)
    for fields in floats:
        scale_floats(new, replace(fields, place=moved[fields.place]))


def _with_bytes(root: Node) -> list[Node]:
    """Return the elements whose bytes lie outside the XML: tables of points, pictures."""
    return [node for node in root.getElementsByTagName("*") if node.getAttribute("fileOffset")]


class _Edit:
    """What one registration changes in the XML of a file."""

    def __init__(self, root: Node, motions: Sequence[Transform | None], name: str) -> None:
        self._root = root
        self._name = name
        self._scans = list(children(child(root, "data3D")))
        if len(motions) != len(self._scans):
            msg = f"{name} has {len(self._scans)} scans, got {len(motions)} motions. Pass one each."
            raise InputError(msg)
        if all(matrix is None for matrix in motions):
            raise InputError(f"{name}: every scan is left out, so there is nothing to write.")
        self._matrices = list(motions)
        self.is_whole = True
        """Nothing is left out."""
        self.notes: list[str] = []
        self.floats: list[FloatFields] = []
        self.stations: list[PlacedStation] = []
        self.points = 0

    def run(self, crs: str | None) -> None:
        """Change poses, scales, pictures, reference system and the file's own id."""
        by_guid: dict[str, Motion | None] = {}
        motions: list[Motion | None] = []
        for index, (scan, matrix) in enumerate(zip(self._scans, self._matrices, strict=True)):
            motion = None if matrix is None else self._move(index, scan, matrix)
            motions.append(motion)
            by_guid[text_of(child(scan, "guid")).strip()] = motion
            if motion is None:
                scan.parentNode.removeChild(scan)
                self.is_whole = False
        self._pictures(by_guid, motions)
        set_crs(self._root, crs, text_of(child(self._root, "coordinateMetadata")))
        self._new_guid()
        self.notes = list(dict.fromkeys(self.notes))

    def _move(self, index: int, scan: Node, matrix: Transform) -> Motion:
        label = text_of(child(scan, "name")).strip() or f"scan {index + 1}"
        old = pose_of(scan)
        middle, reach = _middle_of(scan)
        motion = motion_of(matrix, old.rotation @ middle + old.translation)
        if motion.residual_m * reach > _NEGLIGIBLE_M:
            self.notes.append(
                f"the matrix is a rotation only to {motion.residual_m:.1g}: {label} has the pose "
                "nearest to it."
            )
        new = motion.applied(old)
        if motion.scale != 1.0:
            self._scale(scan, motion.scale)
        set_pose(scan, new)
        w, x, y, z = (float(part) for part in new.quaternion)
        self.stations.append(
            PlacedStation(
                index=index,
                name=label,
                quaternion=(w, x, y, z),
                translation=as_triple(new.translation),
            )
        )
        points = child(scan, "points")
        self.points += int(points.getAttribute("recordCount") or 0) if points else 0
        return motion

    def _scale(self, scan: Node, scale: float) -> None:
        """Scale a scan's own coordinates, since its pose cannot."""
        floats = _scaled_fields(child(scan, "points"), scale)
        if floats is not None:
            self.floats.append(floats)
        for group, names in _BOUNDS.items():
            for name in names:
                value = number_of(child(scan, group, name))
                if value is not None:
                    put(child(scan, group), name, "Float", words(value * scale))
        how = (
            "they are floats, so the numbers themselves"
            if floats is not None
            else "of their integers only the factor in the header"
        )
        self.notes.append(
            f"the registration has a scale of {scale:.9g} and an E57 pose has none: the points' "
            f"own coordinates were scaled ({how})."
        )

    def _pictures(
        self, by_guid: dict[str, Motion | None], motions: Sequence[Motion | None]
    ) -> None:
        """Move each picture with its scan; leave out those of scans that are left out."""
        images = child(self._root, "images2D")
        common = _common_motion(self._matrices, motions)
        lost = 0
        if images is None:
            return
        for image in list(children(images)):
            guid = text_of(child(image, "associatedData3DGuid")).strip()
            has_pose = is_placed(image)
            motion = by_guid.get(guid, common)
            if motion is not None and has_pose:
                set_pose(image, motion.applied(pose_of(image)))
            elif motion is None and (has_pose or guid in by_guid):
                images.removeChild(image)
                self.is_whole = False
                lost += 1
        if lost:
            self.notes.append(
                f"{lost} pictures are left out: their scan is, or it is not said which scan they "
                "moved with."
            )

    def _new_guid(self) -> None:
        """Name the file anew, the same for the same content: an id stands for one version."""
        guid = child(self._root, "guid")
        if guid is None:
            return
        old = text_of(guid)
        content = self._root.toxml()
        made = uuid.uuid5(uuid.NAMESPACE_OID, f"dougong {old} {content}")
        put(self._root, "guid", "String", f"{{{str(made).upper()}}}")


def _common_motion(
    matrices: Sequence[Transform | None], motions: Sequence[Motion | None]
) -> Motion | None:
    """Return the motion of what belongs to no scan: that of all scans, None where they differ."""
    first = matrices[0]
    is_common = first is not None and all(
        matrix is not None and np.array_equal(matrix, first) for matrix in matrices
    )
    return motions[0] if is_common else None


def _middle_of(scan: Node) -> tuple[NDArray[np.float64], float]:
    """Return the middle of a scan's bounds in its own coordinates and half their diagonal.

    The scanner itself and 100 m where no bounds are given.
    """
    bounds = child(scan, "cartesianBounds")
    ends = [number_of(child(bounds, name)) for name in _BOUNDS["cartesianBounds"]]
    values = np.array([np.nan if value is None else value for value in ends]).reshape(3, 2)
    if not np.isfinite(values).all():
        return np.zeros(3), 100.0
    return values.mean(axis=1), float(np.linalg.norm(np.ptp(values, axis=1))) / 2


def _scaled_fields(points: Node, scale: float) -> FloatFields | None:
    """Scale the coordinates in a prototype; return the fields whose numbers must follow."""
    leaves = list(_leaves(child(points, "prototype")))
    chosen: dict[int, str] = {}
    for place, leaf in enumerate(leaves):
        if leaf.tagName not in LENGTHS:
            continue
        kind = leaf.getAttribute("type")
        if kind == "Float":
            is_single = leaf.getAttribute("precision") == "single"
            chosen[place] = "<f4" if is_single else "<f8"
            for end in ("minimum", "maximum"):
                if leaf.hasAttribute(end):
                    leaf.setAttribute(end, words(attribute(leaf, end, 0.0) * scale))
            if leaf.firstChild is not None:  # its own value must stay within its limits
                leaf.firstChild.data = words((number_of(leaf) or 0.0) * scale)
            continue
        leaf.setAttribute("type", "ScaledInteger")
        leaf.setAttribute("scale", words(attribute(leaf, "scale", 1.0) * scale))
        if leaf.hasAttribute("offset"):
            leaf.setAttribute("offset", words(attribute(leaf, "offset", 0.0) * scale))
    if not chosen:
        return None
    return FloatFields(
        place=int(points.getAttribute("fileOffset")),
        records=int(points.getAttribute("recordCount") or 0),
        streams=len(leaves),
        chosen=chosen,
        factor=scale,
    )


def _leaves(prototype: Node) -> list[Node]:
    """Return the fields of a prototype in the order of their byte streams."""
    found: list[Node] = []
    for node in children(prototype):
        if node.getAttribute("type") in ("Structure", "Vector"):
            found += _leaves(node)
        else:
            found.append(node)
    return found
