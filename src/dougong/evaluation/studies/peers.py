"""The same pairs through other programs, each at settings that its own documents recommend.

Two tasks: `find` starts from nothing (any turn, metres away), `refine` from the true pose turned by
5 degrees about the vertical and moved by 0.5 m. Everyone gets the same raw points near the origin.
Programs that are not installed are named, not measured.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.apart import apart
from dougong.evaluation.building_runs import DRONE_SHARE
from dougong.evaluation.hard_trials import Trial, base_of, plain
from dougong.evaluation.machine import memory_beyond, version_of
from dougong.evaluation.metrics import Truth, pose_errors
from dougong.evaluation.registration_peers import PEERS, Peer
from dougong.evaluation.scenes import BUILDERS, make_scene
from dougong.evaluation.studies import Findings, Setting, measured
from dougong.evaluation.survey import rotation
from dougong.evaluation.tabulate import as_text, chosen, distinct, new_figure, spread
from dougong.pipeline.progress import Progress
from dougong.registration.overlap import apply
from dougong.threads import get_threads, set_threads
from dougong.typing import Transform

RUNS, QUICK_RUNS = 3, 1
POINTS, QUICK_POINTS = 250_000, 40_000
QUICK_KINDS = ("hall",)
WARM_UP = 10_000
START_DEG, START_M = 5.0, 0.5
AGAINST = (
    "the generator's exact pose: correct is TRE95 of at most 50 mm over the noise-free surface "
    "that both sensors saw"
)
COLUMNS = {
    "task": "task",
    "program": "program",
    "n": "n",
    "correct": "correct",
    "said_wrongly": "wrong, not said",
    "pose95_mm": "TRE95 mm",
    "pose95_mm_max": "max",
    "rotation_error_deg": "turn deg",
    "seconds": "seconds",
    "cpu_s": "CPU s",
    "memory_bytes": "memory bytes",
    "version": "version",
}
DOUBTS = ("ambiguous", "failed", "not valid", "not yet", "converged False")
"""What a program says of a pose that it does not stand for."""


def study(setting: Setting, progress: Progress) -> Findings:
    """Ask everyone about every building; quick: one building, few points."""
    kinds = QUICK_KINDS if setting.is_quick else tuple(BUILDERS)
    points = setting.points or (QUICK_POINTS if setting.is_quick else POINTS)
    present = [peer for peer in PEERS if peer.is_installed]
    absent = sorted({peer.name for peer in PEERS if not peer.is_installed})
    pair = cache(surveyed)

    def measure(kind: str, seed: int, points: int, task: str, name: str) -> dict[str, Any]:
        if pair.cache_info().currsize > 2:
            pair.cache_clear()
        peer = next(p for p in present if (p.task, p.name) == (task, name))
        about = {"building": kind, "seed": seed, "points": points, "task": task, "program": name}
        trials = pair(kind, seed, WARM_UP), pair(kind, seed, points)
        return {**about, **apart_asked(peer, *trials, seed)}

    keys = [
        (kind, seed, points, peer.task, peer.name)
        for seed in setting.seeds(RUNS, QUICK_RUNS)
        for kind in kinds
        for peer in present
    ]
    rows = measured(setting, keys, measure, progress)
    table = [*summary(rows), *(_missing(peer) for peer in PEERS if not peer.is_installed)]
    for name in absent:
        progress.note(f"{name} is not installed: not measured")
    text = (
        "Correct: TRE95 of at most 50 mm. Wrong, not said: pose is not correct and the program "
        "does not doubt it. Medians\nover n pairs; memory beyond the points, of a process that had "
        "answered a small pair before.\n\n"
        + as_text(table, COLUMNS)
        + (f"\n\nNot installed: {', '.join(absent)}." if absent else "")
    )
    return Findings(
        rows=rows,
        table=table,
        against=AGAINST,
        text=text,
        draw=lambda path: draw_peers(rows, path),
    )


def apart_asked(peer: Peer, small: Trial, trial: Trial, seed: int) -> dict[str, Any]:
    """Return what a program answers in a process of its own; a crash is an answer too."""
    number = PEERS.index(peer)
    try:
        return apart(warm_asked, number, small, trial, seed, get_threads())
    except BrokenProcessPool as error:
        return {**_about(peer), "failed": f"its process ended: {error}", "is_correct": False}


def warm_asked(number: int, small: Trial, trial: Trial, seed: int, threads: int) -> dict[str, Any]:
    """Return what program `number` answers once it is loaded: it is asked about a `small` pair."""
    set_threads(threads)
    asked(PEERS[number], small, seed)
    return asked(PEERS[number], trial, seed)


def _about(peer: Peer) -> dict[str, Any]:
    version = version_of(peer.package)
    return {"settings": peer.settings, "program_version": version, "failed": None}


def surveyed(kind: str, seed: int, points: int) -> Trial:
    """Return the clouds of a scanner and a drone, both near the origin, and their truth."""
    flown = round(DRONE_SHARE * points)
    scene = make_scene(kind, seed, lidar_points=points, photogrammetry_points=flown)
    return plain(base_of(scene), np.random.default_rng([seed, 3]))


def start_of(truth: Truth, seed: int) -> Transform:
    """Return the true pose turned by 5 degrees about its place and moved by 0.5 m."""
    rng = np.random.default_rng([seed, 5])
    middle = apply(truth.T_best, truth.surface_points).mean(axis=0)
    way = rng.normal(size=3)
    turn = rotation((0.0, 0.0, np.radians(START_DEG) * rng.choice([-1.0, 1.0])))
    step = np.eye(4)
    step[:3, :3] = turn
    step[:3, 3] = middle - turn @ middle + START_M * way / np.linalg.norm(way)
    return step @ truth.T_best


def asked(peer: Peer, trial: Trial, seed: int) -> dict[str, Any]:
    """Return what a program answers, how far it is from the truth, and what it took."""
    assert trial.truth is not None
    row = _about(peer)
    start = start_of(trial.truth, seed)
    wall, cpu = time.perf_counter(), time.process_time()
    with memory_beyond() as memory:
        try:
            answer = peer.run(trial.source, trial.target, start)
        # Whatever a peer raises is its answer: it found no pose.
        except Exception as error:  # noqa: BLE001
            return {**row, "failed": f"{type(error).__name__}: {error}", "is_correct": False}
    row["seconds"] = time.perf_counter() - wall
    if not peer.is_program:
        row |= {"cpu_s": time.process_time() - cpu, "memory_bytes": memory["bytes"]}
    errors = pose_errors(_rigid(answer.T_target_source), trial.truth)
    return row | {
        "says": answer.says,
        "is_doubted": answer.says in DOUBTS,
        "pose95_mm": 1e3 * errors.tre95_m,
        "rotation_error_deg": errors.rotation_error_deg,
        "is_correct": errors.is_correct,
    }


def _rigid(pose: Transform) -> Transform:
    """Return the nearest rigid motion: some programs round, or answer in single precision."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, pose[:3, 3]
    return rigid


def summary(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per task and program, over all pairs."""
    table = []
    for task, name in distinct(rows, "task", "program"):
        group = chosen(rows, task=task, program=name)
        wrong = [row for row in group if not row["is_correct"] and row["failed"] is None]
        line: dict[str, Any] = {
            "task": task,
            "program": name,
            "is_installed": True,
            "settings": group[0]["settings"],
            "version": group[0]["program_version"],
            "n": len(group),
            "seeds": " ".join(str(seed) for (seed,) in distinct(group, "seed")),
            "correct": sum(row["is_correct"] for row in group),
            "failed": sum(row["failed"] is not None for row in group),
            "said_wrongly": sum(not row["is_doubted"] for row in wrong),
        }
        for key in ("pose95_mm", "rotation_error_deg", "seconds", "cpu_s", "memory_bytes"):
            line |= spread(group, key, 4)
        table.append(line)
    return table


def _missing(peer: Peer) -> dict[str, Any]:
    """Return the row of a program that is not installed."""
    keys = ("pose95_mm", "rotation_error_deg", "seconds", "cpu_s", "memory_bytes")
    nothing = {key: None for name in keys for key in spread([], name)}
    about = {"task": peer.task, "program": peer.name, "is_installed": False}
    about |= {"settings": peer.settings, "version": "not installed", "n": 0, "seeds": ""}
    return {**about, "correct": None, "failed": None, "said_wrongly": None, **nothing}


def draw_peers(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the error of every answer, a line per program, as PNG."""
    groups = distinct(rows, "task", "program")
    kinds = [kind for (kind,) in distinct(rows, "building")]
    figure = new_figure(9.0, 0.42 * len(groups) + 1.6)
    panel = figure.subplots()
    for number, (task, name) in enumerate(groups):
        for row in chosen(rows, task=task, program=name):
            error = row.get("pose95_mm")
            colour = f"C{kinds.index(row['building'])}"
            marker = "x" if error is None else "v" if row["is_doubted"] else "o"
            panel.scatter(1e6 if error is None else error, number, color=colour, marker=marker)
    panel.axvline(50.0, color="0.4", linewidth=0.9)
    panel.set_yticks(range(len(groups)), [f"{name} ({task})" for task, name in groups], fontsize=8)
    panel.invert_yaxis()
    panel.set_xscale("log")
    panel.set_xlabel("TRE95, mm; line: 50 mm; triangle: doubted by the program; x: no answer")
    for number, kind in enumerate(kinds):
        panel.scatter([], [], color=f"C{number}", label=kind)
    figure.legend(loc="outside upper center", ncols=5, fontsize=9)
    figure.savefig(path, dpi=130)
