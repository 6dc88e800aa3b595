"""The XML of an E57 file as a document to edit: everything that is not touched stays as it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from xml.dom import minidom
from xml.parsers.expat import ExpatError

import numpy as np
from numpy.typing import NDArray

from dougong.errors import FormatError
from dougong.formats.e57_fields import FieldSpec
from dougong.formats.e57_pose import Pose, matrix_of, still
from dougong.formats.units import as_wkt, is_same_crs, las_wkt

Node = Any
"""An element of `xml.dom.minidom`, which has no type of its own for elements of one kind."""


_VIEWS = ("pinholeRepresentation", "sphericalRepresentation", "cylindricalRepresentation")


def parse(text: bytes, name: str) -> Node:
    """Return the XML of an E57 file as a document.

    Raises
    ------
    FormatError
        It is damaged, or holds no scans.
    """
    try:
        document = minidom.parseString(text.rstrip(b"\0 \r\n\t"))
    except (ExpatError, ValueError) as error:
        raise FormatError(f"{name} has damaged E57 metadata: {error}. Copy it again.") from error
    if child(document.documentElement, "data3D") is None:
        raise FormatError(f"{name} holds no scans (no data3D). Export it again.")
    return document


def children(node: Node) -> Iterator[Node]:
    """Yield the elements right below `node`."""
    for below in node.childNodes:
        if below.nodeType == below.ELEMENT_NODE:
            yield below


def child(node: Node | None, *path: str) -> Node | None:
    """Return the element at `path` below `node`, None where one of them is missing."""
    for name in path:
        if node is None:
            return None
        node = next((below for below in children(node) if below.tagName == name), None)
    return node


def text_of(node: Node | None) -> str:
    """Return the text of an element; "" without one."""
    if node is None:
        return ""
    kinds = (node.TEXT_NODE, node.CDATA_SECTION_NODE)
    return "".join(part.data for part in node.childNodes if part.nodeType in kinds)


def number_of(node: Node | None) -> float | None:
    """Return the value of a Float, Integer or ScaledInteger element; None without one."""
    if node is None:
        return None
    value = float(text_of(node).strip() or 0.0)
    if node.getAttribute("type") == "ScaledInteger":
        value = value * attribute(node, "scale", 1.0) + attribute(node, "offset", 0.0)
    return value


def attribute(node: Node, name: str, default: float) -> float:
    """Return a number in an attribute of `node`."""
    return float(node.getAttribute(name) or default)


def words(number: float) -> str:
    """Return a double so that reading gives the same double."""
    return repr(float(number))


def put(
    parent: Node, name: str, kind: str, value: str | None = None, *, is_more: bool = False
) -> Node:
    """Return the child `name` of `parent`, made anew: of type `kind`, with `value` as its text.

    It takes the place of the child of that name, unless it is one `is_more` (of a vector).
    """
    document = parent.ownerDocument
    made = document.createElement(name)
    made.setAttribute("type", kind)
    if value:
        is_text = kind == "String" and "]]>" not in value
        make = document.createCDATASection if is_text else document.createTextNode
        made.appendChild(make(value))
    old = None if is_more else child(parent, name)
    if old is None:
        parent.appendChild(made)
    else:
        parent.replaceChild(made, old)
    return made


def pose_of(node: Node) -> Pose:
    """Return the pose of a scan or picture; without one its coordinates are the file's."""
    rotation, translation = still().rotation, still().translation
    turn, shift = child(node, "pose", "rotation"), child(node, "pose", "translation")
    if turn is not None:
        rotation = matrix_of(_numbers(turn, "wxyz"))
    if shift is not None:
        translation = _numbers(shift, "xyz")
    return Pose(rotation, translation)


def _numbers(node: Node, names: str) -> NDArray[np.float64]:
    return np.array([number_of(child(node, name)) or 0.0 for name in names])


def is_placed(picture: Node) -> bool:
    """Say whether a picture stands somewhere: it has a pose, or a view that implies one."""
    return any(child(picture, name) is not None for name in ("pose", *_VIEWS))


def set_pose(node: Node, pose: Pose) -> None:
    """Give a scan or picture a pose."""
    made = put(node, "pose", "Structure")
    turn = put(made, "rotation", "Structure")
    for axis, value in zip("wxyz", pose.quaternion, strict=True):
        put(turn, axis, "Float", words(value))
    shift = put(made, "translation", "Structure")
    for axis, value in zip("xyz", pose.translation, strict=True):
        put(shift, axis, "Float", words(value))


def set_crs(root: Node, crs: str | None, before: str) -> None:
    """State the reference system: in the words `before` where these mean it, else as WKT 1.

    Its axes must be metres, as all coordinates of E57 are.
    """
    same = is_same_crs(as_wkt(before) if before.strip() else None, crs)
    text = before if same else las_wkt(crs) if crs is not None else ""
    if text or child(root, "coordinateMetadata") is not None:
        put(root, "coordinateMetadata", "String", text)


def field_element(prototype: Node, name: str, spec: FieldSpec) -> None:
    """Add a field to a prototype."""
    kinds = {"integer": "Integer", "scaled": "ScaledInteger", "float": "Float"}
    # A prototype's own value must lie within its limits too.
    value = min(max(0, spec.low), spec.high)
    text = words(value) if spec.kind == "float" else str(int(value))
    node = put(prototype, name, kinds[spec.kind], text)
    if spec.kind == "float":
        if spec.is_single:
            node.setAttribute("precision", "single")
        if spec.has_limits:
            node.setAttribute("minimum", words(spec.low))
            node.setAttribute("maximum", words(spec.high))
        return
    node.setAttribute("minimum", str(int(spec.low)))
    node.setAttribute("maximum", str(int(spec.high)))
    if spec.kind == "scaled":
        node.setAttribute("scale", words(spec.scale))
        node.setAttribute("offset", words(spec.offset))
