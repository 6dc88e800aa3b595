"""What ``dougong view`` shows: which clouds, where each lies, and what must be converted first."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dougong._words import counted
from dougong.errors import InputError
from dougong.formats import FileInfo, describe, read, write
from dougong.formats.model import Hold
from dougong.pipeline.memory import Room
from dougong.pipeline.tiled import decoded, is_too_large
from dougong.report.documents import load_registration, load_result, replaced_inputs
from dougong.report.layers import BLUE, COLOURS
from dougong.report.looks import SIGNED_TITLE, SIGNED_WORDS, Look, look_at
from dougong.report.payload import REACH_M
from dougong.report.picking import picking
from dougong.report.render import environment
from dougong.report.server import Served, Take
from dougong.report.viewer import STATIC, why_missing
from dougong.typing import Transform, Values

_FAR_M = 20_000.0

Note = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One file to be shown."""

    name: str
    path: Path
    T_shown_file: Transform = field(default_factory=lambda: np.eye(4))
    """(4, 4) from the file's coordinates to those shown."""
    sources: tuple[tuple[str, int], ...] = ()
    """Name and source_id of each cloud in a merged file; empty: the file is one cloud."""
    reference: str | None = None
    turns: dict[str, Transform] = field(default_factory=dict)
    """For a cloud that was registered: the matrix that did it."""
    removed_of: str | None = None
    """The file holds what was taken out of this source of the item before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A page and its clouds, ready to be served."""

    things: dict[str, Served]
    clouds: tuple[str, ...]
    points: int
    notes: tuple[str, ...]
    takes: dict[str, Take] = field(default_factory=dict)
    """What the page may send."""


def items_of(paths: Sequence[Path]) -> tuple[list[Item], list[str]]:
    """Return what is to be shown of files and result folders, and what is to be said about it.

    Raises
    ------
    InputError
        Nothing is named, a path is missing, or a folder holds no result.
    """
    if not paths:
        raise InputError("nothing is named to view. Name clouds or a result folder.")
    items: list[Item] = []
    notes: list[str] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist. Name clouds or a result folder.")
        if path.is_file():
            items.append(Item(name=path.name, path=path))
        elif (path / "result.json").is_file():
            items += _merged(path, notes)
        elif (path / "registration.json").is_file():
            items += _pair(path, notes)
        else:
            msg = (
                f"{path} holds no result.json and no registration.json. Name the --out folder of "
                "a run, a demo or a registration, or the clouds themselves."
            )
            raise InputError(msg)
    return items, notes


def _merged(folder: Path, notes: list[str]) -> list[Item]:
    """Return the merged cloud of a run, then what was taken out of its clouds."""
    result = load_result(folder)
    merged = result["merged"]
    left = [cloud["name"] for cloud in result["clouds"] if cloud["name"] not in merged["clouds"]]
    if left:
        notes.append(f"{', '.join(left)}: not merged (no sure pose), so not shown")
    ids = merged.get("source_ids") or {}
    matrices = {entry["source"]: entry["matrix"] for entry in result["registrations"]}
    whole = Item(
        name=result["project"],
        path=folder / merged["file"],
        sources=tuple((name, int(ids[name])) for name in merged["clouds"] if name in ids),
        reference=result["reference"],
        turns={name: np.array(matrix) for name, matrix in matrices.items() if matrix is not None},
    )
    removed = [(name, folder / "removed" / f"{name}.laz") for name in merged["clouds"]]
    return [whole] + [
        Item(name=f"removed from {name}", path=path, removed_of=name)
        for name, path in removed
        if path.is_file()
    ]


def _pair(folder: Path, notes: list[str]) -> list[Item]:
    """Return the two clouds of a registration, the source moved."""
    document = load_registration(folder)
    source, target = (Path(entry["path"]) for entry in document["inputs"])
    for path in (source, target):
        if not path.is_file():
            raise InputError(f"{path}, an input of {folder}, is not there any more.")
    notes += replaced_inputs(document)
    if document["matrix"] is None:
        return [Item(name=document["source"], path=source)]
    matrix = np.array(document["matrix"])
    moved = Item(
        name=document["source"],
        path=source,
        T_shown_file=matrix,
        turns={document["source"]: matrix},
    )
    return [moved, Item(name=document["target"], path=target, reference=document["target"])]


def prepare(
    paths: Sequence[Path],
    scratch: Path,
    say: Note,
    pairs: Path | None = None,
    room: Room | None = None,
) -> Scene:
    """Return the page for some clouds; those that are no COPC files are converted into `scratch`.

    Parameters
    ----------
    paths : sequence of Path
    scratch : Path
        A folder for temporary files; needs about as much room as the clouds have as LAZ.
    say : callable
        Told what takes time.
    pairs : Path, optional
        The CSV file that pairs picked in two clouds go to; what it holds already is shown.
    room : Room, optional
        Memory: a larger cloud is converted without ever holding it.

    Raises
    ------
    InputError
        See `items_of`; or this installation has no viewer; or pairs cannot be picked here.
    FormatError
        A file cannot be read.
    """
    missing = why_missing()
    if missing is not None:
        raise InputError(f"this installation has no viewer: {missing}.")
    items, notes = items_of(paths)
    picked, takes = _picking(items, pairs)
    room = room or Room.of(None)
    files = [
        _streamable(item, scratch / f"{index}.copc.laz", room, say, notes)
        for index, item in enumerate(items)
    ]
    origin, placed = _placed(items, files, notes)
    sources, clouds, looks = _listed(items, files, placed)
    things = {
        cloud["url"]: Served(kind="application/octet-stream", body=path.resolve())
        for cloud, path in zip(clouds, files, strict=True)
    }
    scene = _scene(sources, clouds, looks, origin)
    scene["pairs"] = picked
    return Scene(
        things=things | _page(", ".join(item.name for item in items[:3]), scene),
        clouds=tuple(source["name"] for source in sources),
        points=sum(cloud["points"] for cloud in clouds),
        notes=tuple(notes),
        takes=takes,
    )


def _listed(
    items: Sequence[Item], files: Sequence[Path], placed: Sequence[Transform]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[Look]]:
    """Return what the page lists, the files it draws, and how each of these is coloured."""
    sources: list[dict[str, Any]] = []
    clouds: list[dict[str, Any]] = []
    looks: list[Look] = []
    for index, (item, path) in enumerate(zip(items, files, strict=True)):
        look = look_at(path)
        looks.append(look)
        first = len(sources)
        if item.removed_of is None:
            added = _sources(item, first)
            # Where a cloud is shown far from its own place, its coordinates are still its own.
            shift = _origin_of(placed[index], item, path)
            sources += [{**source, "origin": shift.tolist()} for source in added]
            ids = {code: first + n for n, (_, code) in enumerate(item.sources)} or None
        else:
            named = [source["name"] for source in sources]
            first, ids = named.index(item.removed_of), None
        clouds.append(
            {
                "name": item.name,
                "url": f"cloud/{index}",
                "points": describe(path).points,
                "to_local": placed[index].ravel().tolist(),
                "source": first,
                "source_ids": ids,
                **_drawn(look),
            }
        )
    return sources, clouds, looks


def _drawn(look: Look) -> dict[str, Any]:
    """Return what the page must know of a file to colour it."""
    return {
        "grey": look.grey,
        "colour_bits": look.colour_bits,
        "residual": look.residual,
        "code_max_m": REACH_M,
    }


def _scene(
    sources: list[dict[str, Any]],
    clouds: list[dict[str, Any]],
    looks: list[Look],
    origin: Values,
) -> dict[str, Any]:
    colours = {"source", "height"}.union(*(look.colours for look in looks))
    spread = [look.residual_shown_m for look in looks if look.residual is not None]
    return {
        "sources": sources,
        "clouds": clouds,
        "origin": origin.tolist(),
        "yaw_deg": 0.0,
        "colours": _order(colours, len(sources)),
        "natural": "colours of the files; grey is intensity",
        "precision_m": None,
        "reasons": sorted({0}.union(*(look.reasons for look in looks))),
        "residual": {
            "shown_m": max(spread, default=0.05),
            "reach_m": None,
            "code_max_m": REACH_M,
            "is_signed": True,
            "title": SIGNED_TITLE,
            "signs": SIGNED_WORDS,
        },
    }


def _picking(
    items: list[Item], pairs: Path | None
) -> tuple[dict[str, Any] | None, dict[str, Take]]:
    """Return what the page must know to pick pairs (None: it cannot), and what it may send."""
    own = [item.path for item in items if not item.sources and item.removed_of is None]
    if len(own) == len(items) == 2:
        return picking(own[0], own[1], pairs)
    if pairs is None:
        return None, {}
    msg = (
        f"--pairs needs two clouds to pick in, the source and the target, got {len(own)}. "
        "Name two clouds, or the folder of a registration."
    )
    raise InputError(msg)


def _placed(
    items: list[Item], paths: Sequence[Path], notes: list[str]
) -> tuple[Values, list[Transform]]:
    """Return the origin of what is shown, and each file's (4, 4) map to metres about it."""
    origin: Values | None = None
    placed = []
    for item, path in zip(items, paths, strict=True):
        info = describe(path)
        matrix: Transform = np.diag([*info.unit_m, 1.0]) @ item.T_shown_file
        middle = (matrix @ np.append(_middle(info), 1.0))[:3]
        origin = np.floor(middle) if origin is None else origin
        shift = origin
        away = float(np.linalg.norm(middle - origin))
        if away > _FAR_M:
            shift = np.floor(middle)
            notes.append(
                f"{item.name} lies {away / 1000:.0f} km from {items[0].name}: both are shown about "
                "one middle; coordinates that are read from either are its own"
            )
        matrix[:3, 3] -= shift
        placed.append(matrix)
    assert origin is not None
    return origin, placed


def _origin_of(placed: Transform, item: Item, path: Path) -> Values:
    """Return what must be added to metres as shown to get those of the frame that is shown."""
    unit = np.array(describe(path).unit_m)
    origin: Values = unit * item.T_shown_file[:3, 3] - placed[:3, 3]
    return origin


def _order(colours: set[str], sources: int) -> list[str]:
    """Return the colourings on offer, the first one first."""
    order = ["source", "height", "natural", "residual", "class", "reason"]
    if sources == 1:
        order = ["natural", "height", "residual", "class", "reason", "source"]
    return [name for name in order if name in colours]


def _page(title: str, scene: dict[str, Any]) -> dict[str, Served]:
    style = (STATIC / "viewer.css").read_text(encoding="utf-8")
    page = environment().get_template("view.html").render(title=title, scene=scene, style=style)
    return {
        "": Served(kind="text/html; charset=utf-8", body=page.encode()),
        "view.js": Served(
            kind="text/javascript; charset=utf-8", body=(STATIC / "view.js").read_bytes()
        ),
    }


def _middle(info: FileInfo) -> Values:
    """Return the middle (3,) of a file's extent, in its coordinates and units."""
    if info.extent_min is None or info.extent_max is None:
        raise InputError(f"{info.path.name} has no point with finite coordinates to show.")
    middle: Values = (np.array(info.extent_min) + np.array(info.extent_max)) / 2
    return middle


def _shown_name(item: Item) -> str:
    """Return what a person calls the points of an item."""
    return item.path.name if item.removed_of is None else f"what was {item.name}"


def _streamable(item: Item, converted: Path, room: Room, say: Note, notes: list[str]) -> Path:
    """Return the path of a COPC file with these points: its own, or `converted`."""
    path = item.path
    info = describe(path)
    if info.format == "COPC":
        return path
    say(f"converting {_shown_name(item)} ({info.format}, {counted(info.points)}) to COPC")
    cloud = partial(decoded, path) if is_too_large(path, room, 0) else read(path)
    written = write(cloud, converted, hold=Hold(room.held_points(), converted.parent))
    if item.removed_of is not None:
        return converted
    notes.append(
        f"{path.name} is {info.format}, which cannot be streamed: a temporary COPC copy is shown "
        f"({written.bytes / 1e6:.1f} MB, removed at the end)"
    )
    notes += [f"{path.name}: {note}" for note in written.notes]
    return converted


def _sources(item: Item, first: int) -> list[dict[str, Any]]:
    """Return the clouds of one file as the viewer lists them."""
    names = [name for name, _ in item.sources] or [item.name]
    listed = []
    for number, name in enumerate(names):
        is_reference = name == item.reference
        colour = COLOURS[(first + number) % len(COLOURS)]
        turn = None
        if name in item.turns:
            # The rotation nearest to the inverse: units and scale are no motion.
            u, _, v = np.linalg.svd(np.linalg.inv(item.turns[name][:3, :3]))
            turn = (u @ v).ravel().tolist()
        listed.append(
            {
                "name": name,
                "colour": list(BLUE if is_reference else colour),
                "role": "reference" if is_reference else None,
                "motion": None,
                "turn": turn,
            }
        )
    return listed
