"""Pairs that are hard or impossible, each with the answer that it must get.

Each case has its expected answer written down in `CASES` beside it:

    right       the pair has one answer: status ok within 50 mm; anything else is a miss
    honest      right or ambiguous (what decides may be little): a wrong pose is the only sin
    ambiguous   several poses are equally true: ok is wrong, whatever the pose
    refused     no rigid motion is true (other place, mirrored, other unit) or nothing could prove
                it (a room that shows the outside through its door): ok is wrong

Verdict: right, ambiguous, failed, or WRONG (status ok with TRE95 above 50 mm, or ok where the
case has no single answer).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dougong.cloud import Cloud
from dougong.errors import DougongError
from dougong.evaluation.copies import COPIES, make_trial
from dougong.evaluation.hard_trials import (
    Base,
    Trial,
    base_of,
    density,
    doorway,
    facade,
    halls,
    nothing_but,
    one_station,
    outliers,
    overlap,
    part,
    plain,
    sloping,
    spoilt,
    two_flights,
    two_scans,
    without,
)
from dougong.evaluation.mesh import GROUND, VEGETATION
from dougong.evaluation.metrics import pose_errors
from dougong.evaluation.scenes import BUILDERS, Scene
from dougong.registration import Register, register

Expected = Literal["right", "honest", "ambiguous", "refused"]
LIGHT = {"lidar_points": 150_000, "photogrammetry_points": 100_000}
GENERATED = tuple(BUILDERS)
MESHES = ("nuyda", "monastery")
SCENES = (*GENERATED, *MESHES)
PLACES = (*SCENES, *COPIES)
Maker = Callable[..., Scene]
"""(name, seed, site=, woods=, and numbers of points) -> the survey of a place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A trial to make of a scene, and the answer it must get."""

    make: Callable[[Base, np.random.Generator], Trial]
    expected: Expected
    honest_on: tuple[str, ...] = ()
    """Scenes on which the answer may be ambiguous though it is expected to be right elsewhere."""
    has_site: bool = True
    has_woods: bool = False
    scenes: tuple[str, ...] = SCENES

    def expected_on(self, scene: str) -> Expected:
        """Return the answer that a scene must get."""
        return "honest" if scene in self.honest_on else self.expected


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
    "only-trees": Case(make=nothing_but(VEGETATION), expected="honest", scenes=GENERATED),
    "woods": Case(make=plain, expected="right", has_woods=True),
    # One side of an octagon or a ring has equals; so have the houses of a compound.
    "facade": Case(make=facade, expected="right", honest_on=("pagoda", "tulou", "monastery")),
    "doorway": Case(make=doorway, expected="refused"),
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


@dataclass(frozen=True, slots=True, kw_only=True)
class CopyCase:
    """Two surveys of a place that repeats (`copies`), and the answer they must get."""

    is_copy: bool
    things: int
    expected: Expected
    refused_on: tuple[str, ...] = ()
    """Places whose copy is no part of the same site: no motion is true."""

    def expected_on(self, place: str) -> Expected:
        """Return the answer that a place must get."""
        return "refused" if place in self.refused_on else self.expected


COPY_CASES: dict[str, CopyCase] = {
    "copy": CopyCase(is_copy=True, things=8, expected="honest", refused_on=("twins",)),
    "copy-bare": CopyCase(is_copy=True, things=0, expected="honest", refused_on=("twins",)),
    "same-part": CopyCase(is_copy=False, things=12, expected="right"),
    "same-bare": CopyCase(is_copy=False, things=0, expected="honest"),
}
OTHER_PLACE = "other-place"
"""The scan of one seed against the flight over the next one (of a mesh: over another place)."""


def cases_on(scene: str) -> list[str]:
    """Return the names of the cases that a scene, or a place that repeats, is put through."""
    if scene in COPIES:
        return list(COPY_CASES)
    return [*(name for name, case in CASES.items() if scene in case.scenes), OTHER_PLACE]


def run(
    name: str, kind: str, seed: int, make: Maker, cache: dict[Any, Base], **points: int
) -> dict[str, Any]:
    """Return one row of the table: a case on a scene.

    Parameters
    ----------
    make : callable
        Surveys a place.
    cache : dict
        Keeps surveys from one call to the next; empty it after each scene and seed.
    **points : int
        How many points the clouds have; by default `LIGHT`.
    """
    size = {**LIGHT, **points}

    def base(number: int, site: bool = True, woods: bool = False) -> Base:
        key = (kind, number, site, woods)
        if key not in cache:
            cache[key] = base_of(make(kind, number, site=site, woods=woods, **size))
        return cache[key]

    rng = np.random.default_rng([seed, *name.encode()])
    if kind in COPIES:
        copied = COPY_CASES[name]
        expected: Expected = copied.expected_on(kind)
        trial = make_trial(kind, seed, is_copy=copied.is_copy, things=copied.things, **size)
    elif name == OTHER_PLACE:
        expected = "refused"
        other = SCENES[(SCENES.index(kind) + 1) % len(SCENES)] if kind in MESHES else kind
        flown = base_of(make(other, seed + 1, **size)).drone
        mixed = replace(base(seed), drone=flown)
        trial = replace(plain(mixed, rng), truth=None)
    else:
        case = CASES[name]
        expected = case.expected_on(kind)
        trial = case.make(base(seed, case.has_site, case.has_woods), rng)
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


def is_missed(row: Mapping[str, Any]) -> bool:
    """Say whether a row is not what its case expects."""
    is_miss = row["expected"] == "right" and row["verdict"] != "right"
    return bool(is_miss or row["verdict"] == "WRONG")
