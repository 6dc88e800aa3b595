"""Places where what one survey shows has a copy that it does not show, or where much has moved.

A scan of one corner of a house fits the opposite corner, a gallery of a cloister the next one, a
room the room beside it, a house its twin: each fit is as good as the truth and wrong. Scaffolding
and market stalls that stand elsewhere in the second survey fit each other, and so hold the
building at a wrong turn of itself. Every place can also be surveyed twice at the *same* part,
where the pose has an answer: what a verdict must not lose while it learns to doubt.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dougong.evaluation import drone, scanner
from dougong.evaluation.buildings.roofs import Slope, hipped
from dougong.evaluation.hard_trials import Trial, pose
from dougong.evaluation.mesh import CLUTTER, FINE, GROUND, SURFACE, Mesh, Tracer, join
from dougong.evaluation.metrics import Truth
from dougong.evaluation.site import foliage, trunks
from dougong.evaluation.solids import beam, block, box, lathe
from dougong.registration.overlap import apply, inverse
from dougong.typing import Points

Spots = NDArray[np.float64]
"""(k, 2) in plan."""
_EYE_M = 1.65
_BEFORE = 0.7
"""Cosine of the bearing, from what is built, up to which a camera is before a station."""
_APART_M = 0.6
"""Clear space between things, and between them and what is built."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Surveys:
    """What two surveys meet, and from where; coordinates of the site, z up."""

    worlds: tuple[Mesh, Mesh]
    stations: tuple[Points, Points]
    """(k, 3) each."""
    is_flown: bool = False
    """The second survey is a flight: its stations only say what it looks at."""
    is_flown_before: bool = False
    """Both are flights, before what their stations see: neither goes round."""
    is_one_place: bool = True
    """False: the worlds are two places, and no motion is true."""


Builder = Callable[[np.random.Generator, bool, int], Surveys]
"""(generator, whether a copy is surveyed instead of the same part, number of things about)."""


def make_trial(
    kind: str,
    seed: int,
    *,
    is_copy: bool,
    things: int,
    lidar_points: int = 150_000,
    photogrammetry_points: int = 100_000,
) -> Trial:
    """Return the pair of a place: its second survey of a copy, or of the same part.

    Parameters
    ----------
    kind : str
        One of `COPIES`.
    things : int
        How many small things stand about, unlike anywhere else.
    """
    rng = np.random.default_rng([seed, things, is_copy, *kind.encode()])
    seen = COPIES[kind](rng, is_copy, things)
    clouds = []
    for k, (world, stations) in enumerate(zip(seen.worlds, seen.stations, strict=True)):
        tracer = Tracer(world)
        if seen.is_flown_before:
            clouds.append(_flown(tracer, world, photogrammetry_points, rng, before=stations))
        elif k == 1 and seen.is_flown:
            clouds.append(_flown(tracer, world, photogrammetry_points, rng))
        else:
            params = scanner.Scanner(points=lidar_points)
            clouds.append(scanner.scan(tracer, stations, params, rng))
    T = pose(rng)
    source = apply(T, clouds[0].xyz)
    still = np.isin(clouds[0].labels, (SURFACE, FINE, GROUND))
    surface = clouds[0].xyz[still][::20]
    truth = Truth(
        T_target_source=inverse(T),
        T_best=inverse(T),
        surface_points=apply(T, surface),
        surface_bent=surface,
    )
    return Trial(
        source=source,
        target=clouds[1].xyz,
        truth=truth if seen.is_one_place else None,
        source_kind="photogrammetry" if seen.is_flown_before else "lidar",
        target_kind="photogrammetry" if seen.is_flown or seen.is_flown_before else "lidar",
    )


def _flown(
    tracer: Tracer,
    world: Mesh,
    points: int,
    rng: np.random.Generator,
    before: Points | None = None,
) -> scanner.Returns:
    """Fly round what is built, or only `before` it: where stations (k, 3) stand."""
    built = world.vertices[world.faces[world.labels != GROUND]].reshape(-1, 3)
    low, high = built.min(axis=0), built.max(axis=0)
    radius = float(np.ptp(built[:, :2], axis=0).max()) / 2.0
    centre = np.array([*(low + high)[:2] / 2.0, 0.0])
    cameras = drone.flight(tracer, centre, radius, float(high[2]), rng)
    if before is not None:
        way = (before[:, :2] - centre[:2]).mean(axis=0)
        off = cameras.places[:, :2] - centre[:2]
        cosine = off @ way / (np.linalg.norm(off, axis=1) * np.linalg.norm(way))
        cameras = cameras.taken((cosine > _BEFORE) & (off @ way > radius * np.linalg.norm(way)))
    return drone.photograph(tracer, cameras, drone.Drone(points=points), rng)


def _corners(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Scan a house that equals itself turned by 180 degrees from before one corner."""
    half, house = _house(rng)
    # Every station sees both fronts; those of one survey stand metres apart.
    off = np.array([(8.0, 2.5), (2.5, 8.0), (4.5, 4.5), (9.0, 8.0)]) + rng.uniform(-1, 1, (4, 2))
    one, two = half + off[:2], half + off[2:]
    two = -two if is_copy else two
    count = int(rng.integers(1, 3))
    about = _things(rng, things, 6.0 + half.max(), [half], np.vstack([one, two]))
    world = join([house, _ground(60.0), about])
    return Surveys(worlds=(world, world), stations=(_eyes(one[:count]), _eyes(two[:count])))


def _flights(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Fly before one corner of a house that equals itself turned by 180 degrees."""
    half, house = _house(rng)
    off = rng.uniform(4.0, 8.0, (2, 2))
    one, two = half + off[:1], half + off[1:]
    two = -two if is_copy else two
    about = _things(rng, things, 6.0 + half.max(), [half], np.zeros((0, 2)))
    world = join([house, _ground(60.0), about])
    return Surveys(worlds=(world, world), stations=(_eyes(one), _eyes(two)), is_flown_before=True)


def _cloister(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Scan a square court between four equal galleries from within one of them."""
    court, deep, tall = rng.uniform(7.0, 10.0), rng.uniform(3.0, 4.2), rng.uniform(3.2, 4.2)
    side = _gallery(court, deep, tall, int(rng.integers(5, 8)))
    cloister = side.repeated((90.0 * k, (0, 0, 0)) for k in range(4))
    along = rng.uniform(-0.6, 0.6, 4) * court
    spots = np.column_stack([along, np.full(4, -court - deep / 2)])
    one, two = spots[:1], spots[1:2]
    # The things: half in the court, half along the galleries.
    inside = _things(rng, things // 2, 0.85 * court, [], np.zeros((0, 2)))
    down = []
    for k in range(things - things // 2):
        x = rng.uniform(-court, court)
        thing, _ = _thing(rng, most=0.9)
        down.append(thing.turned(0.0, (x, -court - deep + 0.7, 0)).turned(90.0 * (k % 4)))
    turn = 90.0 * int(rng.integers(1, 4)) if is_copy else 0.0
    two = _turned(two, turn)
    world = join([cloister, _ground(court + deep + 1.0), inside, *down])
    return Surveys(worlds=(world, world), stations=(_eyes(one), _eyes(two)))


def _rooms(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Scan one of a row of equal rooms, each furnished in its own way."""
    x, y, z = rng.uniform(5.0, 8.0), rng.uniform(4.0, 6.5), rng.uniform(2.6, 3.4)
    room = _room(x, y, z)
    row = room.repeated((0.0, ((x + 0.2) * k, 0.0, 0.0)) for k in range(4))
    clear = np.array([[-0.2 * x, 0.1 * y], [0.2 * x, -0.1 * y]])
    furnished = [
        _things(rng, things, min(x, y) / 2 - 0.5, [], clear).turned(0.0, ((x + 0.2) * k, 0.0, 0.0))
        for k in range(4)
    ]
    corridor = box((-x / 2, y / 2 + 2.2, 0), (4 * x, y / 2 + 2.4, z))
    world = join(
        [row, corridor, _ground(40.0), box((-x, -y, z), (5 * x, y + 3, z + 0.3)), *furnished]
    )
    one, two = clear[:1], clear[1:]
    if is_copy:
        two = two + [(x + 0.2) * int(rng.integers(1, 4)), 0.0]
    return Surveys(worlds=(world, world), stations=(_eyes(one), _eyes(two)))


def _twins(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Survey two equal houses, far from one another, with other things about them."""
    half, house = _house(rng)
    stands = [_round(half, rng) for _ in range(2)]
    every = np.vstack(stands)
    worlds = []
    for _ in range(2):
        about = _things(rng, things, 9.0 + half.max(), [half], every)
        worlds.append(join([house, _ground(half.max() + 25.0), about]))
    is_flown = bool(rng.random() < 0.5)
    return Surveys(
        worlds=(worlds[0], worlds[1] if is_copy else worlds[0]),
        stations=(_eyes(stands[0]), _eyes(stands[1])),
        is_flown=is_flown,
        is_one_place=not is_copy,
    )


def _scaffold(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Survey a house that equals itself turned by 180 degrees, scaffolding before one side.

    The copy: in the second survey it stands before the opposite side; else it has gone.
    """
    half, house = _house(rng)
    side = int(rng.integers(0, 2))
    up = _scaffolding(2 * half[side] * rng.uniform(0.6, 1.0), rng.uniform(4.0, 7.0), rng)
    before = up.turned(0.0, (rng.uniform(-1, 1), -half[1 - side] - 1.2, 0)).turned(90.0 * side)
    return _with_moved(rng, half, house, before, before.turned(180.0) if is_copy else None, things)


def _stalls(rng: np.random.Generator, is_copy: bool, things: int) -> Surveys:
    """Survey such a house with a market of stalls before one side, on the other side later."""
    half, house = _house(rng)
    parts = []
    for k in range(int(rng.integers(5, 10))):
        stall = join(
            [
                block((0, 0, 0), (rng.uniform(1.5, 2.5), 1.2, 0.9), "timber", CLUTTER),
                block((0, 0, 2.1), (rng.uniform(2.0, 3.0), 2.0, 0.1), "cloth", CLUTTER),
                *(
                    block((i * 0.9, j * 0.8, 0), (0.08, 0.08, 2.1), "timber", CLUTTER)
                    for i in (-1, 1)
                    for j in (-1, 1)
                ),
            ]
        )
        at = ((k % 5 - 2) * 3.2 + rng.uniform(-0.3, 0.3), -half[1] - 3.5 - 3.5 * (k // 5), 0)
        parts.append(stall.turned(rng.uniform(-15, 15), at))
    market = join(parts)
    return _with_moved(rng, half, house, market, market.turned(180.0) if is_copy else None, things)


def _with_moved(
    rng: np.random.Generator,
    half: NDArray[np.float64],
    house: Mesh,
    first: Mesh,
    second: Mesh | None,
    things: int,
) -> Surveys:
    """Return two surveys of a house between which `first` went, or became `second`."""
    stands = [_round(half + 3.0, rng) for _ in range(2)]
    about = _things(rng, things, 12.0 + half.max(), [half + 4.0], np.vstack(stands))
    still = [house, _ground(half.max() + 25.0), about]
    last = still if second is None else [*still, second]
    return Surveys(
        worlds=(join([*still, first]), join(last)),
        stations=(_eyes(stands[0]), _eyes(stands[1])),
        is_flown=bool(rng.random() < 0.5),
    )


COPIES: dict[str, Builder] = {
    "corners": _corners,
    "flights": _flights,
    "cloister": _cloister,
    "rooms": _rooms,
    "twins": _twins,
    "scaffold": _scaffold,
    "stalls": _stalls,
}


def _house(rng: np.random.Generator) -> tuple[NDArray[np.float64], Mesh]:
    """Return half the sizes (2,) of a house that equals itself turned by 180 degrees, and it."""
    half = np.array([rng.uniform(5.0, 9.0), rng.uniform(3.5, 5.0)])
    tall = rng.uniform(3.5, 6.5)
    parts = [box((*-half, -0.5), (*half, tall), "plaster")]
    for side in (0, 1):
        wide, out = half[side], half[1 - side]
        count = int(rng.integers(2, 5))
        places = np.sort(rng.uniform(-0.85, 0.85, count)) * wide
        front = []
        for k, x in enumerate(places):
            w, h, foot = rng.uniform(0.7, 1.3), rng.uniform(0.9, 1.6), rng.uniform(0.7, 1.3)
            if k == 0:
                w, h, foot = 1.2, 2.2, 0.0
            front.append(box((x - w / 2, -out - 0.12, foot), (x + w / 2, -out, foot + h), "timber"))
            front.append(
                box(
                    (x - w / 2 - 0.2, -out - 0.3, foot + h),
                    (x + w / 2 + 0.2, -out, foot + h + 0.15),
                )
            )
        one = join(front).turned(90.0 * side)
        parts += [one, one.turned(180.0)]
    slope = Slope.seated(tall, 0.6, rng.uniform(1.6, 2.6), float(half[1]) + 0.6)
    parts.append(hipped(float(half[0]) + 0.6, float(half[1]) + 0.6, slope))
    return half, join(parts)


def _gallery(court: float, deep: float, tall: float, count: int) -> Mesh:
    """Return one side of a cloister, on the side of -y: outer wall, arcade, roof."""
    outer = court + deep
    at = np.linspace(-court, court, count)
    parts = [
        box((-outer, -outer - 0.5, 0), (outer, -outer, tall + 1.5), "stone"),
        box((-court - 0.3, -court - 0.3, 0), (court, -court + 0.1, 0.7), "stone"),
        box((-court - 0.3, -court - 0.3, tall - 0.7), (court, -court + 0.1, tall), "stone"),
        box((-outer, -outer, tall), (outer - deep, -court + 0.5, tall + 0.25), "tile"),
    ]
    parts += [
        lathe([(0.2, 0.7), (0.16, tall - 0.7)], 10).turned(0, (x, -court - 0.1, 0)) for x in at
    ]
    door = at[count // 2]
    parts.append(box((door - 0.7, -outer, 0), (door + 0.7, -outer + 0.15, 2.4), "timber"))
    return join(parts)


def _room(x: float, y: float, z: float) -> Mesh:
    """Return a room about the origin, its door to +y, its two windows to -y."""
    wall = 0.1
    parts = [
        box((-x / 2 - wall, -y / 2, 0), (-x / 2, y / 2, z), "plaster"),
        box((x / 2, -y / 2, 0), (x / 2 + wall, y / 2, z), "plaster"),
        # Towards the corridor, with a door left of the middle.
        box((-x / 2, y / 2, 0), (-0.3 * x, y / 2 + wall, z), "plaster"),
        box((-0.3 * x + 0.95, y / 2, 0), (x / 2, y / 2 + wall, z), "plaster"),
        box((-0.3 * x, y / 2, 2.1), (-0.3 * x + 0.95, y / 2 + wall, z), "plaster"),
    ]
    sill, top = 0.9, 2.2
    parts += [
        box((-x / 2, -y / 2 - wall, 0), (x / 2, -y / 2, sill), "plaster"),
        box((-x / 2, -y / 2 - wall, top), (x / 2, -y / 2, z), "plaster"),
    ]
    for a, b in ((-0.5, -0.35), (-0.1, 0.15), (0.4, 0.5)):
        parts.append(box((a * x, -y / 2 - wall, sill), (b * x, -y / 2, top), "plaster"))
    return join(parts)


def _scaffolding(long: float, tall: float, rng: np.random.Generator) -> Mesh:
    """Return scaffolding along x, 1 m deep: posts, ledgers, decks of planks, a few sheets."""
    x = np.linspace(-long / 2, long / 2, max(3, round(long / 2.2)))
    parts = [
        lathe([(0.03, 0.0), (0.03, tall + 0.8)], 6, "paint", CLUTTER).turned(0, (a, b, 0))
        for a in x
        for b in (-0.5, 0.5)
    ]
    for level in np.arange(2.0, tall + 0.1, 2.0):
        parts.append(block((0, 0, level), (long, 0.9, 0.06), "timber", CLUTTER))
        parts.append(beam((-long / 2, -0.5, level + 1), (long / 2, -0.5, level + 1), (0.05, 0.05)))
    for a, b in pairwise(x):
        if rng.random() < 0.4:
            level = 2.0 * int(rng.integers(0, max(1, int(tall // 2))))
            parts.append(box((a, -0.55, level), (b, -0.52, level + 1.9), "cloth", CLUTTER))
    return join(parts).labelled(CLUTTER)


def _thing(rng: np.random.Generator, most: float = 2.4) -> tuple[Mesh, float]:
    """Return something small that stands on the ground, and its radius in plan."""
    size = rng.uniform(0.3, 1.0, 3) * most
    kind = rng.choice(["crate", "drum", "wall", "tree", "post"])
    if kind == "crate":
        crate = block((0, 0, -0.1), (size[0], size[1], size[2]), "timber")
        return crate.turned(rng.uniform(0, 90)), 0.7 * size[:2].max()
    if kind == "drum":
        radius = size[0] / 2
        return lathe([(radius, -0.1), (radius * 1.1, size[2] / 2), (radius, size[2])], 14), radius
    if kind == "wall":
        long = block((0, 0, -0.1), (2.0 * size[0], 0.3, 0.4 + 0.5 * size[2]), "brick")
        return long.turned(rng.uniform(0, 180)), size[0]
    if kind == "tree" and most > 2.0:
        tall = rng.uniform(3.0, 6.0)
        places = np.array([[0.0, 0.0, 0.0, tall]])
        return join([trunks(places), foliage(places, rng)]), 1.0
    return lathe([(0.12, -0.1), (0.1, 1.2 * size[2])], 10, "paint"), 0.15


def _things(
    rng: np.random.Generator,
    count: int,
    reach: float,
    built: Sequence[NDArray[np.float64]],
    clear: Spots,
) -> Mesh:
    """Strew `count` things within `reach` of the origin, off the half sizes `built` and `clear`."""
    parts: list[Mesh] = []
    taken: list[tuple[float, float, float]] = [(x, y, 1.2) for x, y in clear]
    for _ in range(60 * count):
        if len(parts) == count:
            break
        thing, radius = _thing(rng, min(2.4, reach / 2.5))
        x, y = rng.uniform(-reach, reach, 2)
        room = radius + _APART_M
        is_built = any(abs(x) < h[0] + room and abs(y) < h[1] + room for h in built)
        if is_built or any(np.hypot(x - a, y - b) < room + r for a, b, r in taken):
            continue
        taken.append((x, y, radius))
        parts.append(thing.turned(0.0, (x, y, 0.0)))
    return join(parts)


def _ground(reach: float) -> Mesh:
    return box((-reach, -reach, -0.6), (reach, reach, 0.0), "paving", GROUND)


def _round(half: NDArray[np.float64], rng: np.random.Generator) -> Spots:
    """Return four places (4, 2) round a house, before its corners, none exactly so."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    spots: Spots = signs * (half + rng.uniform(2.5, 5.5, (4, 2)))
    return spots


def _way(degrees: float) -> NDArray[np.float64]:
    turn = np.radians(degrees)
    return np.array([np.cos(turn), np.sin(turn)])


def _turned(spots: Spots, degrees: float) -> Spots:
    c, s = _way(degrees)
    turned: Spots = spots @ np.array([[c, s], [-s, c]])
    return turned


def _eyes(spots: Spots) -> Points:
    return np.column_stack([spots, np.full(len(spots), _EYE_M)])
