"""Register pairs that are hard or impossible, and say where the answer is not what it must be.

    python benchmarks/register_hard.py [--cases overlap30,mirror-x] [--scenes hall,nuyda]
                                       [--seeds 0]

Each case has its expected answer written down in `CASES` beside it:

    right       the pair has one answer: status ok within 50 mm; anything else is a miss
    honest      right or ambiguous (what decides may be little): a wrong pose is the only sin
    ambiguous   several poses are equally true: ok is wrong, whatever the pose
    refused     no rigid motion is true (other place, mirrored, other unit) or nothing could prove
                it (a room that shows the outside through its door): ok is wrong

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
from hard_trials import (
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
from places import GENERATED, MESHES, make

from dougong.cloud import Cloud
from dougong.errors import DougongError
from dougong.evaluation.mesh import GROUND, VEGETATION
from dougong.evaluation.metrics import pose_errors
from dougong.registration import Register, register

Expected = Literal["right", "honest", "ambiguous", "refused"]
LIGHT = {"lidar_points": 250_000, "photogrammetry_points": 125_000}
SCENES = (*GENERATED, *MESHES)


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
OTHER_PLACE = "other-place"
"""The scan of one seed against the flight over the next one (of a mesh: over another place)."""


def run(name: str, kind: str, seed: int, cache: dict[Any, Base]) -> dict[str, Any]:
    """Return one row of the table."""

    def base(number: int, site: bool = True, woods: bool = False) -> Base:
        key = (kind, number, site, woods)
        if key not in cache:
            cache[key] = base_of(make(kind, number, site=site, woods=woods, **LIGHT))
        return cache[key]

    rng = np.random.default_rng([seed, *name.encode()])
    if name == OTHER_PLACE:
        expected: Expected = "refused"
        other = SCENES[(SCENES.index(kind) + 1) % len(SCENES)] if kind in MESHES else kind
        flown = base_of(make(other, seed + 1, **LIGHT)).drone
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


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    tre = f"{1e3 * row['tre95_m']:.1f}" if "tre95_m" in row else "-"
    return (
        f"{row['case']:<16}{row['scene']:<10}{row['seed']:>4}  {row['expected']:<11}"
        f"{row['status']:<10}{tre:>9}{row['cpu_s']:>7.1f}  {row['verdict']}"
    )


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the table of verdicts per case, and per case the scenes that missed what is expected.

    A miss: not right where the case has one answer, or WRONG.
    """
    verdicts = ("right", "ambiguous", "failed", "WRONG")
    lines = ["", "case            pairs  right  ambiguous  failed  WRONG  missed"]

    def counted(name: str, chosen: list[dict[str, Any]]) -> str:
        missed = [f"{row['scene']}/{row['seed']}" for row in chosen if is_missed(row)]
        count = [sum(row["verdict"] == v for row in chosen) for v in verdicts]
        return (
            f"{name:<16}{len(chosen):>5}{count[0]:>7}{count[1]:>11}{count[2]:>8}{count[3]:>7}"
            f"  {len(missed)} {' '.join(missed[:8])}"
        )

    for name in dict.fromkeys(row["case"] for row in rows):
        lines.append(counted(name, [row for row in rows if row["case"] == name]))
    return "\n".join([*lines, counted("all", rows)])


def is_missed(row: dict[str, Any]) -> bool:
    """Say whether a row is not what its case expects."""
    is_miss = row["expected"] == "right" and row["verdict"] != "right"
    return is_miss or row["verdict"] == "WRONG"


def main() -> None:
    """Run what the command line asks for; exit 1 when any pair is WRONG."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", default=",".join([*CASES, OTHER_PLACE]))
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--seeds", default="0", help="numbers, by commas")
    asked = parser.parse_args()
    cache: dict[Any, Base] = {}
    rows = []
    print("case            scene     seed  expected   status    TRE95 mm  CPU s  verdict")
    for kind in asked.scenes.split(","):
        for seed in (int(text) for text in asked.seeds.split(",")):
            for name in asked.cases.split(","):
                if name != OTHER_PLACE and kind not in CASES[name].scenes:
                    continue
                rows.append(run(name, kind, seed, cache))
                print(line(rows[-1]), flush=True)
            cache.clear()
    print(summary(rows))
    sys.exit(1 if any(row["verdict"] == "WRONG" for row in rows) else 0)


if __name__ == "__main__":
    main()
