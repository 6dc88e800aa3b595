"""What the clutter filter takes for what, on generated sites whose every point knows what it is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation.clutter_site import clutter_site
from dougong.evaluation.clutter_things import PERSON, POLE, THINGS, VEHICLE, WIRE
from dougong.evaluation.mesh import (
    CLUSTER,
    CLUTTER,
    FINE,
    MIXED,
    NEAR_NOISE,
    OUTLIER,
    SURFACE,
    VEGETATION,
    load_mesh,
)
from dougong.evaluation.scenes import make_scene, scan_mesh
from dougong.filters.cloth_simulation import GROUND, ClothSimulation, cloth_simulation
from dougong.filters.clutter import Clutter, clutter
from dougong.filters.clutter_kinds import ClutterKind
from dougong.filters.curvature_weighted import curvature_weighted
from dougong.filters.low_outliers import low_outliers
from dougong.filters.selection import Reason
from dougong.formats import read
from dougong.pipeline.recipes import PhotogrammetryRecipe, Recipe, filter_cloud
from dougong.typing import Index, Points, Values

MESHES = {
    "nuyda_house/nuyda.ply": False,
    "monastery_mesh/samurai_monastry.obj.gz": True,
}
"""Under the data folder, and whether y is up; those that are missing are left out."""
CLOUDS = (
    "lion_takanawa/lion_takanawa.copc.laz",
    "espacio_escultorico/espacio_escultorico_uav_lod3.laz",
    "street_pair/source.ply",
    "street_pair/target.ply",
)
LEAST_POINTS = 50
"""Things that fewer points were left of are not counted."""
TRUE_KIND = {
    PERSON: ClutterKind.PERSON,
    VEHICLE: ClutterKind.VEHICLE,
    POLE: ClutterKind.POLE,
    WIRE: ClutterKind.WIRE,
}
_NOISE = (OUTLIER, NEAR_NOISE, MIXED, CLUSTER)
_STILL = {"building": (SURFACE, FINE), "vegetation": (VEGETATION,), "noise": _NOISE}


def trial(
    kind: str, seed: int, points: int = 1_500_000, params: Clutter | None = None
) -> list[dict[str, Any]]:
    """Generate a site, filter it as a laser scan's recipe does, and say what was taken for what.

    Returns
    -------
    list of dict
        A row per thing that `LEAST_POINTS` or more points off the ground were left of (``thing``,
        ``points``, ``taken_for``: the kind that most of them got), and a row per sort of points
        (``points_on``, and under each kind how many were taken for it).
    """
    site = clutter_site(kind, seed, points)
    left, height = _off_ground(site.points)
    found = clutter(site.points[left], params, height_above_ground=height)
    kinds = found.attributes["clutter_kind"]
    labels, things = site.labels[left], site.things[left]
    about = {"building": kind, "seed": seed}
    rows: list[dict[str, Any]] = []
    for number in np.unique(things[things >= 0]):
        on = things == number
        if on.sum() < LEAST_POINTS:
            continue
        counts = np.bincount(kinds[on], minlength=len(ClutterKind))
        best = int(np.argmax(counts[1:])) + 1
        is_taken = 2 * counts[1:].sum() > on.sum()
        rows.append(
            {
                **about,
                "thing": THINGS[int(labels[on][0])],
                "points": int(on.sum()),
                "taken_for": ClutterKind(best if is_taken else 0).name.lower(),
            }
        )
    sorts: dict[str, tuple[int, ...]] = {**_STILL, **{name: (k,) for k, name in THINGS.items()}}
    for name, those in sorts.items():
        rows.append({**about, "points_on": name, **_taken(kinds[np.isin(labels, those)])})
    return rows


def _off_ground(points: Points) -> tuple[Index, Values]:
    """Return the points that the recipe leaves off the ground, and their heights."""
    left = np.flatnonzero(low_outliers(points).is_kept)
    cloth = cloth_simulation(points[left], ClothSimulation(class_threshold_m=0.09))
    is_off = cloth.attributes["ground_class"] != GROUND
    left, height = left[is_off], cloth.attributes["height_above_ground"][is_off]
    is_kept = curvature_weighted(points[left]).is_kept
    return left[is_kept], height[is_kept]


def drone_trial(kind: str, seed: int, points: int = 500_000) -> list[dict[str, Any]]:
    """Do the same on a drone cloud of `make_scene`, with its recipe: a row per sort of points.

    Its people and cars have one label; poles and wires there are none.
    """
    scene = make_scene(kind, seed, lidar_points=50_000, photogrammetry_points=points)
    cloud = scene.photogrammetry
    recipe = Recipe(photogrammetry=PhotogrammetryRecipe(clutter=Clutter()))
    filtered = filter_cloud(cloud, "photogrammetry", recipe)
    is_asked = (filtered.codes == Reason.KEPT) & (filtered.ground_class != GROUND)
    labels = cloud.attribute("truth_label")
    assert labels is not None
    kinds, labels = filtered.details["dougong_clutter"][is_asked], labels[is_asked]
    sorts = {**_STILL, "people and cars": (CLUTTER,)}
    return [
        {"building": kind, "seed": seed, "points_on": name, **_taken(kinds[np.isin(labels, those)])}
        for name, those in sorts.items()
    ]


def _taken(kinds: NDArray[np.uint8]) -> dict[str, int]:
    """Return how many points were taken for each kind."""
    counts = np.bincount(kinds, minlength=len(ClutterKind))
    return {k.name.lower(): int(counts[k]) for k in ClutterKind}


def real_offers(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield, for each of `MESHES` (scanned) and `CLOUDS` in a folder, what is offered: clusters.

    Nobody labelled them: look at what is found. Wires are counted in points.
    """
    for name, is_y_up in MESHES.items():
        if (folder / name).is_file():
            vertices, faces = load_mesh(folder / name, is_y_up=is_y_up)
            scene = scan_mesh(
                vertices, faces, seed=1, lidar_points=800_000, photogrammetry_points=20_000
            )
            yield _offers(f"{Path(name).parent}, scanned", scene.lidar.xyz)
    for name in CLOUDS:
        if (folder / name).is_file():
            yield _offers(str(Path(name).parent), read(folder / name).xyz)


def _offers(name: str, points: Points) -> dict[str, Any]:
    left, height = _off_ground(points)
    found = clutter(points[left], height_above_ground=height).found
    kinds = {kind: found.get(f"{kind}_clusters", 0) for kind in ("person", "vehicle", "pole")}
    return {
        "cloud": name,
        "off the ground": len(left),
        **kinds,
        "wire points": found.get("wire_points", 0),
    }


def thing_table(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per sort of thing: how many there were, and what they were taken for."""
    table = []
    own = [row for row in rows if "thing" in row]
    for name in THINGS.values():
        some = [row["taken_for"] for row in own if row["thing"] == name]
        if name == "wire":
            continue
        line: dict[str, Any] = {"thing": name, "n": len(some)}
        line |= {k.name.lower(): some.count(k.name.lower()) for k in ClutterKind}
        table.append(line)
    return table


def point_table(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per sort of points: how many there were, and what they were taken for."""
    own = [row for row in rows if "points_on" in row]
    table = []
    for name in dict.fromkeys(row["points_on"] for row in own):
        some = [row for row in own if row["points_on"] == name]
        sums = {k.name.lower(): sum(row[k.name.lower()] for row in some) for k in ClutterKind}
        table.append({"points on": name, "n": sum(sums.values()), **sums})
    return table


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return recall and precision, percent, per kind.

    By things: of the true ones, those found; of the things taken for it, true ones. By points: the
    same of points, noise apart. Wires are counted by points alone.
    """
    things, points = thing_table(rows), point_table(rows)
    table = []
    for label, kind in TRUE_KIND.items():
        name = kind.name.lower()
        of_it = {line["thing"]: line[name] for line in things}
        there = {line["thing"]: line["n"] for line in things}
        on_it = {line["points on"]: line[name] for line in points if line["points on"] != "noise"}
        all_on = next(line["n"] for line in points if line["points on"] == THINGS[label])
        table.append(
            {
                "kind": name,
                "n": there.get(name),
                "recall %": _share(of_it[name], there[name]) if name in there else None,
                "precision %": (
                    _share(of_it[name], sum(of_it.values())) if name in there else None
                ),
                "points": all_on,
                "point recall %": _share(on_it[name], all_on),
                "point precision %": _share(on_it[name], sum(on_it.values())),
            }
        )
    return table


def _share(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else float("nan")
