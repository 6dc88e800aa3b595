"""Register pairs that are hard or impossible, and say where the answer is not what it must be.

    python benchmarks/register_hard.py [--cases overlap30,mirror-x] [--scenes hall,pagoda]
                                       [--seeds 0]

Each case has its expected answer written down in `CASES` beside it:

    right       the pair has one answer: status ok within 50 mm; anything else is a miss
    honest      right or ambiguous (what decides may be little): a wrong pose is the only sin
    ambiguous   several poses are equally true: ok is wrong, whatever the pose
    refused     no rigid motion is true (other place, mirrored, other unit): ok is wrong

Verdict: right, ambiguous, failed, or WRONG (status ok with TRE95 above 50 mm, or ok where the
case has no single answer). Light scenes: one pair takes about 15 CPU seconds.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dougong.cloud import Cloud
from dougong.errors import DougongError
from dougong.evaluation.mesh import GROUND, VEGETATION
from dougong.evaluation.metrics import Truth, pose_errors
from dougong.evaluation.scenes import Scene, make_scene
from dougong.evaluation.survey import rotation
from dougong.registration import Register, register

Points = NDArray[np.float64]
Expected = Literal["right", "honest", "ambiguous", "refused"]
LIGHT = {"lidar_points": 250_000, "photogrammetry_points": 125_000}


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """A scene with both clouds about the drone cloud's middle: the true motion is the identity."""

    lidar: Points
    drone: Points
    lidar_label: NDArray[np.uint8]
    drone_label: NDArray[np.uint8]
    station: NDArray[np.int64]
    surface: Points
    """What both saw, scan coordinates; `bent` is where the drone cloud has it."""
    bent: Points
    T_best: Points


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One pair to register. `truth` None: no motion is true."""

    source: Points
    target: Points
    truth: Truth | None
    source_kind: Literal["lidar", "photogrammetry"] = "lidar"
    target_kind: Literal["lidar", "photogrammetry"] = "photogrammetry"


def base_of(scene: Scene) -> Base:
    """Bring the scan onto the map, and both near zero."""
    drone = scene.photogrammetry.frame.to_file(scene.photogrammetry.xyz)
    origin = np.round(drone.mean(axis=0))
    T, best = scene.truth.T_target_source.copy(), scene.truth.T_best.copy()
    T[:3, 3] -= origin
    best[:3, 3] -= origin
    labels = [cloud.attribute("truth_label") for cloud in (scene.lidar, scene.photogrammetry)]
    return Base(
        lidar=moved(T, scene.lidar.frame.to_file(scene.lidar.xyz)),
        drone=drone - origin,
        lidar_label=np.asarray(labels[0]),
        drone_label=np.asarray(labels[1]),
        station=np.asarray(scene.lidar.attribute("station"), dtype=np.int64),
        surface=moved(T, scene.truth.surface_points),
        bent=scene.truth.surface_bent - origin,
        T_best=best @ inverse(T),
    )


def moved(T: Points, points: Points) -> Points:
    """Return `points` (n, 3) moved by the affine `T` (4, 4)."""
    result: Points = points @ T[:3, :3].T + T[:3, 3]
    return result


def inverse(T: Points) -> Points:
    """Return the inverse of the rigid `T`."""
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def pose(rng: np.random.Generator, tilt_deg: float = 0.4) -> Points:
    """Draw a scanner frame: any yaw, `tilt_deg` off level, metres away."""
    towards = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(tilt_deg) * np.array([np.cos(towards), np.sin(towards), 0.0])
    T = np.eye(4)
    T[:3, :3] = rotation(tilt) @ rotation((0.0, 0.0, rng.uniform(0, 2 * np.pi)))
    T[:3, 3] = rng.uniform(-20, 20, 3) * [1, 1, 0.2]
    return T


def truth_of(base: Base, T: Points, inside: Callable[[Points], Any] | None = None) -> Truth:
    """Return the truth for a source that `T` moved away, judged on the surface `inside`."""
    chosen = np.ones(len(base.surface), bool) if inside is None else inside(base.surface)
    return Truth(
        T_target_source=inverse(T),
        T_best=base.T_best @ inverse(T),
        surface_points=moved(T, base.surface[chosen]),
        surface_bent=base.bent[chosen],
    )


def exact(base: Base, T: Points) -> Truth:
    """Return the truth where both clouds are one sensor's: nothing bends between them."""
    return replace(truth_of(base, T), T_best=inverse(T), surface_bent=base.surface)


def plain(base: Base, rng: np.random.Generator, tilt_deg: float = 0.4) -> Trial:
    """Take both whole clouds, the scanner off level by `tilt_deg`."""
    T = pose(rng, tilt_deg)
    return Trial(source=moved(T, base.lidar), target=base.drone, truth=truth_of(base, T))


def overlap(share: float) -> Callable[[Base, np.random.Generator], Trial]:
    """Let each cloud end along x; `share` of the shared surface's length is in both."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        low, high = np.quantile(base.surface[:, 0], [0.02, 0.98])
        a, b = low + np.array([0.5 - share / 2, 0.5 + share / 2]) * (high - low)
        T = pose(rng)
        return Trial(
            source=moved(T, base.lidar[base.lidar[:, 0] < b]),
            target=base.drone[base.drone[:, 0] > a],
            truth=truth_of(base, T, lambda x: (x[:, 0] > a) & (x[:, 0] < b)),
        )

    return make


def density(base: Base, rng: np.random.Generator) -> Trial:
    """Keep one drone point in ten."""
    trial = plain(base, rng)
    return replace(trial, target=trial.target[rng.random(len(trial.target)) < 0.1])


def part(base: Base, rng: np.random.Generator) -> Trial:
    """Pair the scan within 13 m of one corner of the site with the whole drone cloud."""
    corner = np.quantile(base.surface[:, :2], 0.3, axis=0)

    def near(x: Points) -> Any:
        return np.hypot(*(x[:, :2] - corner).T) < 13.0

    T = pose(rng)
    source = moved(T, base.lidar[near(base.lidar)])
    return Trial(source=source, target=base.drone, truth=truth_of(base, T, near))


def one_station(base: Base, rng: np.random.Generator) -> Trial:
    """Take a single station, which sees one facade."""
    trial = plain(base, rng)
    first = base.station == base.station[base.station >= 0].min()
    return replace(trial, source=trial.source[first])


def outliers(base: Base, rng: np.random.Generator) -> Trial:
    """Add ten per cent of points anywhere in either cloud's box."""

    def dirty(x: Points) -> Points:
        box = rng.uniform(x.min(axis=0), x.max(axis=0), (len(x) // 10, 3))
        return np.vstack([x, box])

    trial = plain(base, rng)
    return replace(trial, source=dirty(trial.source), target=dirty(trial.target))


def sloping(base: Base, rng: np.random.Generator) -> Trial:
    """Shear the whole site upright so that its terrain slopes 15 %; walls stay upright."""
    shear = np.eye(4)
    shear[2, :2] = 0.12, 0.09
    clouds = ("lidar", "drone", "surface", "bent")
    # T_best stays: bending shears along, by less than a millimetre.
    changed = {name: moved(shear, getattr(base, name)) for name in clouds}
    return plain(replace(base, **changed), rng)


def without(label: int, of: Literal["source", "target"]) -> Callable[..., Trial]:
    """Take a class out of one cloud."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        trial = plain(base, rng)
        if of == "source":
            return replace(trial, source=trial.source[base.lidar_label != label])
        return replace(trial, target=trial.target[base.drone_label != label])

    return make


def nothing_but(label: int) -> Callable[..., Trial]:
    """Leave one class only in both clouds."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        trial = plain(base, rng)
        return replace(
            trial,
            source=trial.source[base.lidar_label == label],
            target=trial.target[base.drone_label == label],
        )

    return make


def spoilt(change: Callable[[Points], Points]) -> Callable[..., Trial]:
    """Mirror the source, turn it over or change its unit: no rigid motion is true."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        trial = plain(base, rng)
        return replace(trial, source=change(trial.source), truth=None)

    return make


def two_flights(base: Base, rng: np.random.Generator) -> Trial:
    """Pair two halves of the drone cloud, a centimetre of noise added to one."""
    T, first = pose(rng), rng.random(len(base.drone)) < 0.5
    rest = base.drone[~first]
    return Trial(
        source=moved(T, base.drone[first]),
        target=rest + rng.normal(0.0, 0.01, rest.shape),
        truth=exact(base, T),
        source_kind="photogrammetry",
    )


def two_scans(base: Base, rng: np.random.Generator) -> Trial:
    """Pair even stations with odd ones."""
    T, even = pose(rng), base.station % 2 == 0
    return Trial(
        source=moved(T, base.lidar[even]),
        target=base.lidar[~even],
        truth=exact(base, T),
        target_kind="lidar",
    )


def halls(of_source: int, of_target: int) -> Callable[..., Trial]:
    """Build a compound: the site's middle repeated at equal spacing along x."""

    def make(base: Base, rng: np.random.Generator) -> Trial:
        x = base.lidar[base.lidar_label != GROUND][:, 0]
        low, high = np.quantile(x, [0.02, 0.98])
        step = 1.2 * (high - low)

        def row(points: Points, count: int) -> Points:
            one = points[np.abs(points[:, 0] - (low + high) / 2) < step / 2]
            return np.vstack([one + [k * step, 0.0, 0.0] for k in range(count)])

        T = pose(rng)
        return Trial(
            source=moved(T, row(base.lidar, of_source)),
            target=row(base.drone, of_target),
            truth=truth_of(base, T),
        )

    return make


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A trial to make of a scene, and the answer it must get."""

    make: Callable[[Base, np.random.Generator], Trial]
    expected: Expected
    has_site: bool = True
    scenes: tuple[str, ...] = ("hall", "pagoda", "tulou", "wall", "cave")


CASES: dict[str, Case] = {
    "plain": Case(make=plain, expected="right"),
    "overlap30": Case(make=overlap(0.3), expected="honest"),
    "density10": Case(make=density, expected="right"),
    "part": Case(make=part, expected="honest"),
    "one-station": Case(make=one_station, expected="honest"),
    "tilt1.5": Case(make=lambda b, r: plain(b, r, 1.5), expected="right"),
    "tilt3": Case(make=lambda b, r: plain(b, r, 3.0), expected="right"),
    "tilt5": Case(make=lambda b, r: plain(b, r, 5.0), expected="right"),
    "outliers10": Case(make=outliers, expected="right"),
    "slope15": Case(make=sloping, expected="right"),
    "no-ground-scan": Case(make=without(GROUND, "source"), expected="right"),
    "no-ground-drone": Case(make=without(GROUND, "target"), expected="right"),
    "only-ground": Case(make=nothing_but(GROUND), expected="honest"),
    "only-trees": Case(make=nothing_but(VEGETATION), expected="honest"),
    "mirror-x": Case(make=spoilt(lambda x: x * [-1, 1, 1]), expected="refused"),
    "mirror-y": Case(make=spoilt(lambda x: x * [1, -1, 1]), expected="refused"),
    "flip-z": Case(make=spoilt(lambda x: x * [1, 1, -1]), expected="refused"),
    "y-up": Case(make=spoilt(lambda x: x[:, [0, 2, 1]] * [1, -1, 1]), expected="refused"),
    "millimetres": Case(make=spoilt(lambda x: x * 1000.0), expected="refused"),
    "feet": Case(make=spoilt(lambda x: x / 0.3048), expected="refused"),
    "two-flights": Case(make=two_flights, expected="right"),
    "two-scans": Case(make=two_scans, expected="right"),
    "alone": Case(make=plain, expected="ambiguous", has_site=False, scenes=("pagoda", "tulou")),
    "halls-1-of-3": Case(make=halls(1, 3), expected="ambiguous", has_site=False, scenes=("hall",)),
    "halls-2-of-3": Case(make=halls(2, 3), expected="ambiguous", has_site=False, scenes=("hall",)),
}
OTHER_PLACE = "other-place"
"""The scan of one seed against the flight over the next one: refused."""


def run(name: str, kind: str, seed: int, cache: dict[Any, Base]) -> dict[str, Any]:
    """Return one row of the table."""

    def base(number: int, site: bool) -> Base:
        key = (kind, number, site)
        if key not in cache:
            cache[key] = base_of(make_scene(kind, number, site=site, **LIGHT))
        return cache[key]

    rng = np.random.default_rng([seed, *name.encode()])
    if name == OTHER_PLACE:
        expected: Expected = "refused"
        mixed = replace(base(seed, True), drone=base(seed + 1, True).drone)
        trial = replace(plain(mixed, rng), truth=None)
    else:
        case = CASES[name]
        expected = case.expected
        trial = case.make(base(seed, case.has_site), rng)
    row = {"case": name, "scene": kind, "seed": seed, "expected": expected}
    return row | _registered(trial, expected)


def _registered(trial: Trial, expected: Expected) -> dict[str, Any]:
    start = time.process_time()
    try:
        result = register(
            Cloud.from_points(trial.source, name="source"),
            Cloud.from_points(trial.target, name="target"),
            Register(),
            source_kind=trial.source_kind,
            target_kind=trial.target_kind,
        )
    except DougongError as error:
        status, reason, matrix = "failed", str(error), None
    else:
        status, reason, matrix = result.status, result.reason, result.matrix
    row = {"status": status, "cpu_s": time.process_time() - start, "reason": reason}
    is_correct = False
    if matrix is not None and trial.truth is not None:
        errors = pose_errors(matrix, trial.truth)
        row["tre95_m"], is_correct = errors.tre95_m, errors.is_correct
    verdict = status
    if status == "ok":
        verdict = "right" if is_correct and expected in ("right", "honest") else "WRONG"
    return row | {"verdict": verdict}


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    tre = f"{1e3 * row['tre95_m']:.1f}" if "tre95_m" in row else "-"
    return (
        f"{row['case']:<16}{row['scene']:<8}{row['seed']:>4}  {row['expected']:<11}"
        f"{row['status']:<10}{tre:>9}{row['cpu_s']:>7.1f}  {row['verdict']}"
    )


def main() -> None:
    """Run what the command line asks for; exit 1 when any pair is WRONG."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", default=",".join([*CASES, OTHER_PLACE]))
    parser.add_argument("--scenes", default="hall,pagoda,tulou,wall,cave")
    parser.add_argument("--seeds", default="0", help="numbers, by commas")
    asked = parser.parse_args()
    cache: dict[Any, Base] = {}
    rows = []
    print("case            scene   seed  expected   status    TRE95 mm  CPU s  verdict")
    for kind in asked.scenes.split(","):
        for seed in (int(text) for text in asked.seeds.split(",")):
            for name in asked.cases.split(","):
                if name != OTHER_PLACE and kind not in CASES[name].scenes:
                    continue
                rows.append(run(name, kind, seed, cache))
                print(line(rows[-1]), flush=True)
            cache.clear()
    counts = {v: sum(r["verdict"] == v for r in rows) for v in ("right", "ambiguous", "failed")}
    wrong = sum(r["verdict"] == "WRONG" for r in rows)
    print({**counts, "WRONG": wrong})
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
