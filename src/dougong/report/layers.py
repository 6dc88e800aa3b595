"""The clouds of a result folder as layers of a picture: thinned, in one frame, with a colour."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.formats import in_system, iterate, read
from dougong.typing import Points, Transform, Values

MAX_POINTS = 700_000
"""Points of one layer that are drawn."""
_TAKEN_FROM = 1.5
"""Core spacings within which a point takes the distance of a core point."""

# Okabe and Ito (2008), told apart with every common colour vision, in an order of their own:
# the reference is blue, the first cloud that moved is orange.
BLUE = (45, 125, 195)
COLOURS = ((230, 125, 30), (0, 158, 115), (204, 121, 167), (213, 94, 0), (140, 125, 30))


@dataclass(frozen=True, slots=True, kw_only=True)
class Removed:
    """Points that the filters took out of a cloud, where the cloud is now."""

    after: Points
    """(k, 3) as `Layer.after`."""
    reasons: NDArray[np.uint8]
    """(k,) `dougong.filters.selection.Reason`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cores:
    """Core points of a registration with their signed distances (M3C2)."""

    after: Points
    """(k, 3) as `Layer.after`."""
    distance_m: Values
    """(k,) the cloud minus the reference, along the outward normal."""
    reach_m: float
    """A point within this of a core point takes its distance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One cloud as it is drawn."""

    name: str
    colour: tuple[int, int, int]
    after: Points
    """(n, 3) in the frame of the reference, metres about a common origin."""
    before: Points
    """(n, 3) in its own coordinates, metres about some origin of its own."""
    is_reference: bool
    is_sure: bool
    is_placed: bool = True
    """False: there is no pose, so `after` means nothing."""
    origin: Values | None = None
    """(3,) file coordinates of the reference, metres, that `after` is about."""
    colours: NDArray[np.uint8] | None = None
    """(n, 3) colours or (n, 1) grey of the file."""
    classes: NDArray[np.uint8] | None = None
    """(n,) LAS classes."""
    removed: Removed | None = None
    cores: Cores | None = None
    """What this cloud's registration leaves, where it was measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Thinned:
    """Some of the points of a file."""

    xyz: Points
    """(n, 3) about `origin`."""
    origin: Values
    colours: NDArray[np.uint8] | None
    classes: NDArray[np.uint8] | None
    reasons: NDArray[np.uint8] | None


def read_thinned(path: Path, points: int, system: str | None = None) -> Thinned:
    """Return about `MAX_POINTS` points of a file, evenly taken.

    Parameters
    ----------
    path : Path
    points : int
        How many points the file has.
    system : str, optional
        The reference system, WKT, that was given for a file that names none.
    """
    stride = max(1, -(-points // MAX_POINTS))
    taken: list[Points] = []
    looks: list[tuple[NDArray[Any] | None, ...]] = []
    origin: Values | None = None
    seen = 0
    for stored in iterate(path):
        chunk = in_system(stored, system) if stored.frame.crs is None else stored
        if origin is None:
            origin = chunk.frame.origin
        chosen = np.arange((-seen) % stride, len(chunk), stride)
        taken.append(chunk.rebased(origin).xyz[chosen])
        codes = [_attribute(chunk, chosen, name) for name in ("classification", "dougong_reason")]
        looks.append((_colours(chunk, chosen), *codes))
        seen += len(chunk)
    assert origin is not None
    colours, classes, reasons = (_joined([look[index] for look in looks]) for index in range(3))
    return Thinned(
        xyz=np.concatenate(taken),
        origin=origin,
        colours=None if colours is None else _as_bytes(colours),
        classes=None if classes is None else classes.astype(np.uint8),
        reasons=None if reasons is None else reasons.astype(np.uint8),
    )


def _attribute(cloud: Cloud, chosen: NDArray[np.int64], name: str) -> NDArray[Any] | None:
    by_name = {known.lower(): known for known in cloud.attributes}
    values = cloud.attribute(by_name[name]) if name in by_name else None
    return None if values is None else values[chosen]


def _colours(cloud: Cloud, chosen: NDArray[np.int64]) -> NDArray[Any] | None:
    """Return (k, 3) colours, else (k, 1) intensities, as stored; None where there are neither."""
    for names in (("red", "green", "blue"), ("colorred", "colorgreen", "colorblue"),
                  ("diffuse_red", "diffuse_green", "diffuse_blue"), ("intensity",)):  # fmt: skip
        columns = [_attribute(cloud, chosen, name) for name in names]
        found = [column for column in columns if column is not None]
        if len(found) == len(names) and any(np.any(column) for column in found):
            return np.column_stack(found)
    return None


def _joined(parts: list[NDArray[Any] | None]) -> NDArray[Any] | None:
    """Return the chunks' values as one array; None where one has none, or another kind."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or len({part.shape[1:] for part in known}) > 1:
        return None
    return np.concatenate(known)


def _as_bytes(colours: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours as bytes in steps of 4: 16-bit ones by their high byte, grey stretched."""
    values = colours.astype(np.float64)
    if values.shape[1] == 1:
        low, high = np.percentile(values, [1, 99])
        values = 30 + 215 * np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    elif values.max() > 255:
        values = values / 256
    return np.clip(np.round(values), 0, 255).astype(np.uint8) & np.uint8(0xFC)


def rigid_inverse(matrix: Transform, origin: Values) -> tuple[Transform, Values]:
    """Return the 3x3 and the shift that take points about `origin` back through `matrix`."""
    back: Transform = np.linalg.inv(matrix[:3, :3]).astype(np.float64)
    shift: Values = back @ (origin - matrix[:3, 3])
    return back, shift


def run_layers(folder: Path, result: dict[str, Any]) -> list[Layer]:
    """Return the layers of a run: its filtered clouds, the reference last.

    `result` has its matrices in metres (`dougong.report.documents.in_metres`).
    """
    links = {entry["source"]: entry for entry in result["registrations"]}
    layers = []
    common: Values | None = None
    entries = sorted(result["clouds"], key=lambda cloud: cloud["name"] != result["reference"])
    colours = iter(COLOURS * len(entries))
    for entry in entries:
        name = entry["name"]
        read = read_thinned(folder / "clouds" / f"{name}.laz", entry["points_out"])
        xyz, origin = read.xyz, read.origin
        common = origin if common is None else common
        is_reference = name == result["reference"]
        is_sure = is_reference or name in result["merged"]["clouds"]
        before, after = xyz, xyz + (origin - common)
        taken = _removed(folder, entry, common)
        matrix = None if is_reference else links[name]["matrix"]
        if matrix is not None and is_sure:
            before = _taken_back(xyz, origin, np.array(matrix))
        elif matrix is not None:
            after = _brought(xyz, origin, np.array(matrix), common)
            taken = None if taken is None else _moved_there(taken, np.array(matrix), common)
        layers.append(
            Layer(
                name=name,
                removed=taken,
                cores=None if is_reference else cores_of(folder, links[name], common),
                colour=BLUE if is_reference else next(colours),
                after=after,
                before=before,
                is_reference=is_reference,
                is_sure=is_sure,
                is_placed=is_reference or matrix is not None,
                origin=common,
                colours=read.colours,
                classes=read.classes,
            )
        )
    return layers[1:] + layers[:1]


def cores_of(folder: Path, document: Mapping[str, Any], common: Values) -> Cores | None:
    """Return the core points of a registration in a result folder, about `common`, if there are.

    Parameters
    ----------
    folder : Path
    document : mapping
        The registration, as `registration.json` has it.
    common : ndarray, shape (3,)
    """
    told = document.get("distances") or {}
    path = folder / str(told.get("file", ""))
    if not told or not path.is_file():
        return None
    cloud = read(path)
    found = cloud.attribute("m3c2_distance")
    if found is None:
        return None
    is_known = np.isfinite(found)
    return Cores(
        after=(cloud.xyz + (cloud.frame.origin - common))[is_known],
        distance_m=found[is_known].astype(np.float64),
        reach_m=_TAKEN_FROM * float(told["scales"]["core_spacing_m"]),
    )


def _removed(folder: Path, entry: dict[str, Any], common: Values) -> Removed | None:
    """Return what was taken out of a cloud of a run, about `common`; None where nothing was."""
    path, count = folder / "removed" / f"{entry['name']}.laz", entry.get("removed_shown", 0)
    if not count or not path.is_file():
        return None
    read = read_thinned(path, count)
    if read.reasons is None:
        return None
    return Removed(after=read.xyz + (read.origin - common), reasons=read.reasons)


def _moved_there(removed: Removed, matrix: Transform, common: Values) -> Removed:
    """Return points that lie in their own coordinates, about `common`, moved by a matrix."""
    return replace(removed, after=_brought(removed.after, common, matrix, common))


def _brought(xyz: Points, origin: Values, matrix: Transform, common: Values) -> Points:
    """Return points about `origin` moved by a matrix, about `common`."""
    moved: Points = xyz @ matrix[:3, :3].T + (matrix[:3, :3] @ origin + matrix[:3, 3] - common)
    return moved


def _taken_back(xyz: Points, origin: Values, matrix: Transform) -> Points:
    back, shift = rigid_inverse(matrix, origin)
    own: Points = xyz @ back.T
    # The origin of a cloud's own coordinates is of no interest to the picture.
    return own + (shift - np.floor(shift))


def pair_layers(document: dict[str, Any], folder: Path | None = None) -> list[Layer]:
    """Return the layers of a single registration, from its input files; none if they are gone.

    `folder` is where the registration's own files are: its distances are shown with it. `document`
    has its matrices in metres (`dougong.report.documents.in_metres`).
    """
    source, target = document["inputs"]
    paths = [Path(source["path"]), Path(target["path"])]
    if not all(path.is_file() for path in paths):
        return []
    frames = (document.get(name) or {} for name in ("source_frame", "target_frame"))
    first_read, second_read = (
        read_thinned(path, entry["points"], frame.get("crs_wkt"))
        for path, entry, frame in zip(paths, (source, target), frames, strict=True)
    )
    own, origin = first_read.xyz, first_read.origin
    fixed, common = second_read.xyz, second_read.origin
    layers = [
        Layer(
            name=document["target"],
            colour=BLUE,
            after=fixed,
            before=fixed,
            is_reference=True,
            is_sure=True,
            origin=common,
            colours=second_read.colours,
            classes=second_read.classes,
        )
    ]
    moved = own
    if document["matrix"] is not None:
        moved = _brought(own, origin, np.array(document["matrix"]), common)
    first = Layer(
        name=document["source"],
        colour=COLOURS[0],
        after=moved,
        before=own,
        is_reference=False,
        is_sure=document["status"] == "ok",
        is_placed=document["matrix"] is not None,
        cores=None if folder is None else cores_of(folder, document, common),
        origin=common,
        colours=first_read.colours,
        classes=first_read.classes,
    )
    return [first, *layers]


def near(layers: Iterable[Layer], centre: Values, radius: float, heights: Values) -> list[Layer]:
    """Return the layers cut to a cylinder in the reference's frame."""
    cut = []
    for layer in layers:
        plan = np.hypot(layer.after[:, 0] - centre[0], layer.after[:, 1] - centre[1])
        is_in = plan <= radius
        is_in &= (layer.after[:, 2] >= heights[0]) & (layer.after[:, 2] <= heights[1])
        cut.append(replace(layer, after=layer.after[is_in]))
    return cut
