"""Generated E57 surveys with all a scanner's software puts into them, written with libe57 alone."""

import numpy as np
from pye57 import libe57

STEP = 1e-5
NORMALS = "http://www.libe57.org/E57_NOR_surface_normals.txt"


def turn(yaw, pitch=0.0, roll=0.0):
    """Return the unit quaternion (w, x, y, z) of three turns."""
    cy, sy = np.cos(yaw / 2), np.sin(yaw / 2)
    cp, sp = np.cos(pitch / 2), np.sin(pitch / 2)
    cr, sr = np.cos(roll / 2), np.sin(roll / 2)
    return np.array([
        cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy,
    ])  # fmt: skip


POSES = (
    (turn(0.7, 0.01, -0.02), (500_000.25, 4_000_000.5, 21.5)),
    (turn(np.pi, 0.0, 0.0), (500_012.0, 3_999_990.0, 20.0)),
    (None, None),  # its own coordinates are the map's
    (turn(-2.1, 1.4, 3.0), (-499_000.0, 5_300_000.0, -12.0)),
)


def survey(path, *, kind="scaled", scans=4, rows=40, columns=30, crs="EPSG:32650"):
    """Write an E57 survey; `kind` of coordinates: scaled, double, single, integer, spherical."""
    image = libe57.ImageFile(str(path), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    image.extensionsAdd("nor", NORMALS)
    image.extensionsAdd("acme", "http://example.com/acme")
    root = image.root()
    _strings(image, root, formatName="ASTM E57 3D Imaging Data File", guid="{FILE}")
    _integers(image, root, versionMajor=1, versionMinor=0)
    _strings(image, root, coordinateMetadata=crs, e57LibraryVersion="acme 1.0")
    root.set("acme:project", libe57.StringNode(image, 'Hall <of> & "Harmony" ]] 太和殿'))
    data, images = libe57.VectorNode(image, True), libe57.VectorNode(image, True)
    root.set("data3D", data)
    root.set("images2D", images)
    for index in range(scans):
        _scan(image, data, index, kind, rows, columns)
        _picture(image, images, index)
    image.close()
    return path


def _strings(image, node, **values):
    for name, value in values.items():
        node.set(name, libe57.StringNode(image, value))


def _integers(image, node, **values):
    for name, value in values.items():
        node.set(name, libe57.IntegerNode(image, value))


def _floats(image, node, **values):
    for name, value in values.items():
        node.set(name, libe57.FloatNode(image, float(value)))


def _structure(image, parent, name):
    node = libe57.StructureNode(image)
    parent.set(name, node)
    return node


def set_pose(image, node, quaternion, translation):
    pose = _structure(image, node, "pose")
    turned = _structure(image, pose, "rotation")
    _floats(image, turned, **dict(zip("wxyz", quaternion, strict=True)))
    shift = _structure(image, pose, "translation")
    _floats(image, shift, **dict(zip("xyz", translation, strict=True)))


def _scan(image, data, index, kind, rows, columns):
    scan = libe57.StructureNode(image)
    data.append(scan)
    _strings(
        image, scan, guid=f"{{SCAN-{index}}}", name=f"station {index}", description="north gate",
        sensorVendor="Acme", sensorModel="S1", sensorSerialNumber="0815",
    )  # fmt: skip
    originals = libe57.VectorNode(image, True)
    originals.append(libe57.StringNode(image, "{ORIGINAL}"))
    scan.set("originalGuids", originals)
    _floats(image, scan, temperature=21.5, relativeHumidity=55.0, atmosphericPressure=101_300)
    for name, seconds in (("acquisitionStart", 1.3e9 + index), ("acquisitionEnd", 1.3e9 + 60)):
        node = _structure(image, scan, name)
        _floats(image, node, dateTimeValue=seconds)
        _integers(image, node, isAtomicClockReferenced=1)
    quaternion, translation = POSES[index]
    if quaternion is not None:
        set_pose(image, scan, quaternion, translation)
    fields = _fields(index, kind, rows, columns)
    _limits(image, scan, fields, rows, columns)
    _points(image, scan, "points", fields, kind)
    _line_groups(image, scan, rows, columns)


def _fields(index, kind, rows, columns):
    """Return one scan's fields: a bumpy sphere on a grid of rows and columns, some cells empty."""
    rng = np.random.default_rng(index)
    row, column = np.divmod(np.arange(rows * columns), columns)
    azimuth = (column / columns - 0.5) * 2 * np.pi
    elevation = (row / rows - 0.5) * 2.5
    reach = rng.uniform(2.0, 40.0, rows * columns)
    count = len(row)
    state = np.zeros(count)
    state[rng.integers(0, count, count // 10)] = 2
    state[rng.integers(0, count, count // 20)] = 1
    fields = {}
    if kind == "spherical":
        fields |= {
            "sphericalRange": reach, "sphericalAzimuth": azimuth, "sphericalElevation": elevation,
            "sphericalInvalidState": state,
        }  # fmt: skip
    else:
        own = reach[:, None] * np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=1,
        )
        if POSES[index][0] is None and kind != "single":
            own += [500_020.0, 4_000_010.0, 19.0]
        if kind in ("scaled", "integer"):
            step = STEP if kind == "scaled" else 1.0
            own = np.rint(own / step) * step
        own[state == 2] = 0.0
        fields |= {f"cartesian{axis}": own[:, k] for k, axis in enumerate("XYZ")}
        fields["cartesianInvalidState"] = state
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return fields | {
        "intensity": rng.integers(0, 4096, count) / 4095.0,
        "colorRed": rng.integers(0, 256, count).astype("f8"),
        "colorGreen": rng.integers(0, 256, count).astype("f8"),
        "colorBlue": rng.integers(0, 256, count).astype("f8"),
        "isColorInvalid": (state > 0).astype("f8"),
        "rowIndex": row.astype("f8"),
        "columnIndex": column.astype("f8") + 70_000,
        "returnIndex": np.zeros(count),
        "returnCount": np.ones(count),
        "timeStamp": np.arange(count) * 1.25e-6,
        "nor:normalX": normal[:, 0],
        "nor:normalY": normal[:, 1],
        "nor:normalZ": normal[:, 2],
        "acme:temperature": rng.uniform(-20, 40, count),
    }


def _limits(image, scan, fields, rows, columns):
    node = _structure(image, scan, "intensityLimits")
    _floats(image, node, intensityMinimum=0.0, intensityMaximum=1.0)
    node = _structure(image, scan, "colorLimits")
    for colour in ("Red", "Green", "Blue"):
        _integers(image, node, **{f"color{colour}Minimum": 0, f"color{colour}Maximum": 255})
    node = _structure(image, scan, "indexBounds")
    _integers(
        image, node, rowMinimum=0, rowMaximum=rows - 1, columnMinimum=70_000,
        columnMaximum=70_000 + columns - 1, returnMinimum=0, returnMaximum=0,
    )  # fmt: skip
    if "cartesianX" in fields:
        is_ok = fields["cartesianInvalidState"] == 0
        node = _structure(image, scan, "cartesianBounds")
        for axis in "XYZ":
            values = fields[f"cartesian{axis}"][is_ok]
            _floats(
                image, node,
                **{f"{axis.lower()}Minimum": values.min(), f"{axis.lower()}Maximum": values.max()},
            )  # fmt: skip
    else:
        node = _structure(image, scan, "sphericalBounds")
        reach = fields["sphericalRange"]
        _floats(image, node, rangeMinimum=reach.min(), rangeMaximum=reach.max())


def _node(image, name, kind):
    is_length = (name.startswith("cartesian") and name[-1] in "XYZ") or name == "sphericalRange"
    if is_length and kind == "scaled":
        return libe57.ScaledIntegerNode(image, 0, -(2**40), 2**40, STEP, 0.0)
    if is_length and kind == "integer":
        return libe57.IntegerNode(image, 0, -(2**31), 2**31 - 1)
    if is_length:
        precision = libe57.E57_SINGLE if kind == "single" else libe57.E57_DOUBLE
        return libe57.FloatNode(image, 0.0, precision, -1e7, 1e7)
    if name == "intensity":
        return libe57.ScaledIntegerNode(image, 0, 0, 4095, 1 / 4095, 0.0)
    if name == "timeStamp" or (name.startswith("spherical") and name.endswith(("h", "n"))):
        return libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9)
    if name.startswith(("nor:", "acme:")):
        return libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1e3, 1e3)
    most = {"rowIndex": 2**20, "columnIndex": 2**20, "returnCount": 7, "returnIndex": 7}.get(
        name, 255
    )
    return libe57.IntegerNode(image, 0, 0, most)


def _points(image, parent, name, fields, kind):
    prototype = libe57.StructureNode(image)
    for field in fields:
        prototype.set(field, _node(image, field, kind))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    parent.set(name, points)
    _write(image, points, fields)


def _write(image, points, fields):
    held = {n: np.ascontiguousarray(v, dtype="f8") for n, v in fields.items()}
    count = len(next(iter(held.values())))
    buffers = libe57.VectorSourceDestBuffer()
    for field, values in held.items():
        buffers.append(libe57.SourceDestBuffer(image, field, values, count, True, True))
    writer = points.writer(buffers)
    writer.write(count)
    writer.close()


def _line_groups(image, scan, rows, columns):
    """Say which points form a row, as scanner software does: a second table of the scan."""
    line = _structure(image, _structure(image, scan, "pointGroupingSchemes"), "groupingByLine")
    _strings(image, line, idElementName="rowIndex")
    prototype = libe57.StructureNode(image)
    for name in ("idElementValue", "startPointIndex", "pointCount"):
        prototype.set(name, libe57.IntegerNode(image, 0, 0, 2**20))
    groups = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    line.set("groups", groups)
    numbers = np.arange(rows, dtype="f8")
    _write(
        image, groups,
        {"idElementValue": numbers, "startPointIndex": numbers * columns,
         "pointCount": np.full(rows, float(columns))},
    )  # fmt: skip


def _picture(image, images, index):
    node = libe57.StructureNode(image)
    images.append(node)
    _strings(image, node, guid=f"{{PICTURE-{index}}}", associatedData3DGuid=f"{{SCAN-{index}}}")
    set_pose(image, node, turn(0.3, 0.2, 0.1 * index), (1.0 + index, 2.0, 3.0))
    pinhole = _structure(image, node, "pinholeRepresentation")
    pixels = bytes(range(256)) * (5 + index)
    blob = libe57.BlobNode(image, len(pixels))
    pinhole.set("jpegImage", blob)
    blob.write(np.frombuffer(pixels, dtype="u1").copy(), 0, len(pixels))
    _integers(image, pinhole, imageWidth=16, imageHeight=16)
    _floats(image, pinhole, focalLength=0.02, pixelWidth=1e-5, pixelHeight=1e-5)
    _floats(image, pinhole, principalPointX=8.0, principalPointY=8.0)
