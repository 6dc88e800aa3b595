"""An E57 file as plain data through libe57 alone: a reader that ignores nothing."""

import numpy as np
from pye57 import libe57


def tree(path):
    """Return every node of a file: {path: value}, points and pictures included."""
    image = libe57.ImageFile(str(path), "r")
    found = {}
    try:
        for k in range(image.extensionsCount()):
            found[f"extension {image.extensionsPrefix(k)}"] = image.extensionsUri(k)
        _walk(image, image.root(), "", found)
    finally:
        image.close()
    return found


def _walk(image, node, at, found):
    kind = type(node).__name__
    if kind == "StructureNode":
        found[at or "/"] = kind
        for k in range(node.childCount()):
            name = node.get(k).elementName()
            _walk(image, node[name], f"{at}/{name}", found)
    elif kind == "VectorNode":
        found[at] = kind, node.allowHeteroChildren(), len(node)
        for k in range(len(node)):
            _walk(image, node[k], f"{at}/{k}", found)
    elif kind == "CompressedVectorNode":
        prototype = libe57.StructureNode(node.prototype())
        found[at] = kind, node.childCount()
        names = []
        for k in range(prototype.childCount()):
            names.append(prototype.get(k).elementName())
            _walk(image, prototype[names[-1]], f"{at}/prototype/{names[-1]}", found)
        for name, values in columns(image, node, names).items():
            found[f"{at}/{name}"] = values
    elif kind == "BlobNode":
        found[at] = kind, bytes(node.read_buffer())
    elif kind == "StringNode":
        found[at] = kind, node.value()
    elif kind == "FloatNode":
        found[at] = kind, node.value(), node.precision(), node.minimum(), node.maximum()
    elif kind == "IntegerNode":
        found[at] = kind, node.value(), node.minimum(), node.maximum()
    elif kind == "ScaledIntegerNode":
        found[at] = (
            kind, node.rawValue(), node.minimum(), node.maximum(), node.scale(), node.offset()
        )  # fmt: skip
    else:
        raise AssertionError(kind)


def columns(image, points, names):
    """Return every field of a compressed vector as raw numbers: integers stay unscaled."""
    count = points.childCount()
    arrays = {name: np.zeros(count) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, count, True, False))
    if count:
        reader = points.reader(buffers)
        assert reader.read() == count
        reader.close()
    return arrays


def differing(one, other):
    """Return the paths at which two trees differ, bit for bit."""
    return sorted(
        path for path in one.keys() | other.keys() if not _same(one.get(path), other.get(path))
    )


def _same(a, b):
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.tobytes() == b.tobytes()
    return type(a) is type(b) and a == b


def rotation_of(w, x, y, z):
    """Return the matrix of a unit quaternion by turning the three axes: q v q*."""

    def product(p, q):
        a, b = p[0], np.array(p[1:])
        c, d = q[0], np.array(q[1:])
        return np.array([a * c - b @ d, *(a * d + c * b + np.cross(b, d))])

    turned = [product(product((w, x, y, z), (0, *axis)), (w, -x, -y, -z))[1:] for axis in np.eye(3)]
    return np.array(turned).T


def pose(found, at):
    """Return rotation (3, 3) and translation (3,) of the node at `at`; identity without one."""
    turn = [found.get(f"{at}/pose/rotation/{axis}", (0, float(axis == "w")))[1] for axis in "wxyz"]
    shift = [found.get(f"{at}/pose/translation/{axis}", (0, 0.0))[1] for axis in "xyz"]
    return rotation_of(*turn), np.array(shift)


def world(found, scan):
    """Return the (n, 3) file coordinates of a scan's points and which of them are invalid."""
    at = f"/data3D/{scan}"
    own = np.stack([_value(found, at, f"cartesian{axis}") for axis in "XYZ"], axis=1)
    rotation, translation = pose(found, at)
    state = found.get(f"{at}/points/cartesianInvalidState", np.zeros(len(own)))
    return own @ rotation.T + translation, state != 0


def _value(found, at, name):
    node = found[f"{at}/points/prototype/{name}"]
    raw = found[f"{at}/points/{name}"]
    return raw * node[4] + node[5] if node[0] == "ScaledIntegerNode" else raw
