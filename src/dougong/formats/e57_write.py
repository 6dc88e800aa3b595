"""Write clouds as the scans of a new E57 file: poses, all fields in their types, block by block.

What the file a scan came from says of it (sensor, times, weather, limits, pictures, extensions)
is taken over from there. Encoded here and not by libe57's bindings: those take no integers of
more than 53 bits, write only to paths, and crash when the disk is full.
Source: ASTM E2807-11.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import minidom

from numpy.typing import NDArray

from dougong.formats.atomic import Sink
from dougong.formats.e57_container import Appender, Pages, read_layout
from dougong.formats.e57_fields import NORMALS_URI, OURS, OURS_URI, FieldSpec
from dougong.formats.e57_relocate import copy_section
from dougong.formats.e57_section import write_section
from dougong.formats.e57_stations import Station
from dougong.formats.e57_xml import (
    Node,
    child,
    children,
    field_element,
    is_placed,
    parse,
    pose_of,
    put,
    set_crs,
    set_pose,
    text_of,
    words,
)
from dougong.formats.stream import opened

E57_URI = "http://www.astm.org/COMMIT/E57/2010-e57-v1.0"
_OF_THE_FILE = {
    "data3D", "images2D", "guid", "coordinateMetadata", "formatName", "versionMajor",
    "versionMinor", "e57LibraryVersion",
}  # fmt: skip
_OF_THE_POINTS = {
    "points", "pose", "guid", "name", "originalGuids", "pointGroupingSchemes", "cartesianBounds",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Old:
    """The file that scans came from."""

    root: Node
    pages: Pages

    @property
    def scans(self) -> list[Node]:
        """Its scans, in order."""
        return list(children(child(self.root, "data3D")))


def write_scans(sink: Sink, stations: Sequence[Station], crs: str | None) -> list[str]:
    """Write `stations` as the scans of one new E57 file; return what is to be said about it.

    Memory: a block of records, the XML, and a few megabytes.
    """
    sources = {station.header.source for station in stations if station.header is not None}
    notes: list[str] = []
    with _sources(sources, notes) as olds:
        _Writer(Appender(sink), olds, notes).write(stations, crs)
    return notes


@contextmanager
def _sources(paths: set[Path], notes: list[str]) -> Iterator[dict[Path, _Old]]:
    """Yield the opened files that the scans came from, as far as they are still there."""
    with ExitStack() as stack:
        found = {}
        for path in sorted(paths):
            if not path.is_file():
                notes.append(
                    f"{path.name} is not there any more: what it said of its scans (sensor, times, "
                    "pictures) is not carried over."
                )
                continue
            file = stack.enter_context(opened(path))
            layout = read_layout(file, path)
            pages = Pages(file, layout, path.name)
            text = pages.read(layout.xml_start, layout.xml_bytes)
            found[path] = _Old(parse(text, path.name).documentElement, pages)
        yield found


class _Writer:
    """A new file while it is filled."""

    def __init__(self, out: Appender, olds: dict[Path, _Old], notes: list[str]) -> None:
        self._out = out
        self._olds = olds
        self._notes = notes
        self._document = minidom.Document()
        self._root = self._document.createElement("e57Root")
        self._document.appendChild(self._root)
        self._guids: dict[str, tuple[str, Station]] = {}
        self._is_still = True

    def write(self, stations: Sequence[Station], crs: str | None) -> None:
        """Fill the file."""
        root = self._root
        root.setAttribute("type", "Structure")
        root.setAttribute("xmlns", E57_URI)
        self._is_still = all(station.motion is None for station in stations)
        self._extensions(stations)
        put(root, "formatName", "String", "ASTM E57 3D Imaging Data File")
        put(root, "guid", "String")
        put(root, "versionMajor", "Integer", "1")
        put(root, "versionMinor", "Integer", "0")
        put(root, "e57LibraryVersion", "String", "dougong")
        put(root, "coordinateMetadata", "String")
        old = next(iter(self._olds.values())) if len(self._olds) == 1 else None
        before = text_of(child(old.root, "coordinateMetadata")) if old is not None else ""
        set_crs(root, crs, before)
        if old is not None:
            self._take_over(old, old.root, root, _OF_THE_FILE)
        scans, images = self._vector("data3D"), self._vector("images2D")
        made = [self._scan(scans, station) for station in stations]
        for old in self._olds.values():
            self._pictures(old, images)
        put(root, "guid", "String", _guid("dougong", crs or "", *made))
        self._out.finish(self._document.toxml(encoding="utf-8"))

    def _vector(self, name: str) -> Node:
        node = put(self._root, name, "Vector")
        node.setAttribute("allowHeterogeneousChildren", "1")
        return node

    def _extensions(self, stations: Sequence[Station]) -> None:
        """Declare every extension of the files that scans came from, and those of new fields."""
        known: dict[str, str] = {}
        for old in self._olds.values():
            for name, uri in old.root.attributes.items():
                if name.startswith("xmlns:"):
                    known.setdefault(name.removeprefix("xmlns:"), uri)
        used = {name.split(":")[0] for s in stations for name in s.fields if ":" in name}
        for prefix in sorted(used - known.keys()):
            # Without its source file, the id of a field's extension is not known any more.
            uris = {"nor": NORMALS_URI, OURS: OURS_URI}
            known[prefix] = uris.get(prefix, f"urn:unknown:{prefix}")
        for prefix, uri in known.items():
            self._root.setAttribute(f"xmlns:{prefix}", uri)

    def _take_over(self, old: _Old, source: Node, target: Node, but: set[str]) -> None:
        """Copy what lies below `source`, its pictures' bytes included, but not tables of points."""
        for node in children(source):
            if node.tagName in but or child(target, node.tagName) is not None:
                continue
            made = self._document.importNode(node, True)
            target.appendChild(made)
            self._bring_blobs(old, made)

    def _bring_blobs(self, old: _Old, node: Node) -> None:
        if node.getAttribute("type") == "CompressedVector":
            node.parentNode.removeChild(node)
        elif node.getAttribute("type") == "Blob":
            place = copy_section(old.pages, int(node.getAttribute("fileOffset")), self._out)
            node.setAttribute("fileOffset", str(place))
        else:
            for below in list(children(node)):
                self._bring_blobs(old, below)

    def _scan(self, scans: Node, station: Station) -> str:
        """Add one scan with its points; return its new id."""
        scan = put(scans, "vectorChild", "Structure", is_more=True)
        put(scan, "guid", "String")
        put(scan, "name", "String", station.name)
        set_pose(scan, station.pose)
        old = self._olds.get(station.header.source) if station.header is not None else None
        before = old.scans[station.header.station] if old and station.header else None
        if old is not None and before is not None:
            self._take_over(old, before, scan, _OF_THE_POINTS)
            if child(before, "pointGroupingSchemes") is not None:
                self._notes.append(
                    "the table of scan lines is left out: points may have gone from the lines."
                )
        is_scaled = station.motion is not None and station.motion.scale != 1.0
        _limits(scan, station.fields, has_own=before is not None, is_scaled=is_scaled)
        place = [*station.pose.quaternion, *station.pose.translation]
        content = self._points(scan, station), *map(words, place)
        guid = _guid("dougong", station.guid, *content)
        put(scan, "guid", "String", guid)
        if station.header is not None and station.guid:
            _originals(scan, child(before, "originalGuids"), station.guid)
            self._guids[station.guid] = guid, station
        return guid

    def _points(self, scan: Node, station: Station) -> str:
        """Write the records; return a hash of them."""
        digest = hashlib.blake2b(digest_size=16)

        points = put(scan, "points", "CompressedVector")
        points.setAttribute(
            "fileOffset", str(write_section(self._out, station.fields, digest.update))
        )
        points.setAttribute("recordCount", str(len(station)))
        prototype = put(points, "prototype", "Structure")
        for name, (spec, _) in station.fields.items():
            field_element(prototype, name, spec)
        put(points, "codecs", "Vector").setAttribute("allowHeterogeneousChildren", "1")
        return digest.hexdigest()

    def _pictures(self, old: _Old, images: Node) -> None:
        """Carry over the pictures of the scans that are written, moved as these are."""
        pictures = child(old.root, "images2D")
        lost = 0
        for picture in children(pictures) if pictures is not None else []:
            of = text_of(child(picture, "associatedData3DGuid")).strip()
            is_free = not of and (not is_placed(picture) or self._is_still)
            if of not in self._guids and not is_free:
                lost += 1
                continue
            made = put(images, "vectorChild", "Structure", is_more=True)
            self._take_over(old, picture, made, set())
            if is_free:
                continue
            guid, station = self._guids[of]
            put(made, "associatedData3DGuid", "String", guid)
            if station.motion is not None:
                set_pose(made, station.motion.applied(pose_of(picture)))
        if lost:
            self._notes.append(f"{lost} pictures that belong to none of the scans are left out.")


def _guid(*of: str) -> str:
    """Return an id that is the same for the same content: an id stands for one version."""
    return f"{{{str(uuid.uuid5(uuid.NAMESPACE_OID, ' '.join(of))).upper()}}}"


def _originals(scan: Node, earlier: Node | None, guid: str) -> None:
    """Say which scans the points came from, those before included."""
    vector = put(scan, "originalGuids", "Vector")
    vector.setAttribute("allowHeterogeneousChildren", "1")
    before = [text_of(node) for node in children(earlier)] if earlier is not None else []
    for text in (*before, guid):
        put(vector, "vectorChild", "String", text, is_more=True)


def _limits(
    scan: Node,
    fields: Mapping[str, tuple[FieldSpec, NDArray[Any]]],
    *,
    has_own: bool,
    is_scaled: bool,
) -> None:
    """Say within which bounds the points lie; and how bright and colourful they are, if new.

    Spherical bounds of the file that a scan came from hold for a part of its points too.
    """
    spherical = child(scan, "sphericalBounds")
    if spherical is not None and is_scaled:
        scan.removeChild(spherical)
        spherical = None

    def ends(group: Node, name: str, field: str) -> None:
        values = fields[field][1]
        put(group, f"{name}Minimum", "Float", words(values.min()))
        put(group, f"{name}Maximum", "Float", words(values.max()))

    if {"cartesianX", "cartesianY", "cartesianZ"} <= set(fields):
        bounds = put(scan, "cartesianBounds", "Structure")
        for axis in "xyz":
            ends(bounds, axis, f"cartesian{axis.upper()}")
    if "sphericalRange" in fields and spherical is None:
        bounds = put(scan, "sphericalBounds", "Structure")
        ends(bounds, "range", "sphericalRange")
        ends(bounds, "elevation", "sphericalElevation")
    if has_own:
        return
    if "intensity" in fields:
        ends(put(scan, "intensityLimits", "Structure"), "intensity", "intensity")
    colours = [f"color{name}" for name in ("Red", "Green", "Blue")]
    if set(colours) <= set(fields):
        limits = put(scan, "colorLimits", "Structure")
        most = "255" if all(fields[name][0].high <= 255 for name in colours) else "65535"
        for name in colours:
            put(limits, f"{name}Minimum", "Integer", "0")
            put(limits, f"{name}Maximum", "Integer", most)
