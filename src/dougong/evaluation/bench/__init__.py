"""``dougong bench``: our operations and every installed peer on the same work, side by side.

Each contender has a process of its own, bound to as many processors as it may have threads. All of
them are started, then asked in turn, so that what else the machine does hits everyone alike.
Seconds are medians over the repeats; CPU seconds hold on a loaded machine, wall seconds do not.
Memory is the peak of resident memory beyond what was held before, the points being held.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError, OutputError
from dougong.evaluation.bench.contenders import OPERATIONS, Contender, absent
from dougong.evaluation.bench.scenes import SCENES
from dougong.evaluation.bench.table import as_text
from dougong.evaluation.machine import code_hash, machine, version_of
from dougong.formats.unfinished import watched
from dougong.pipeline.outputs import write_json
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import software

_FEWEST, _MOST = 30_000, 1_000_000_000
_POOLS = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "VECLIB")
_ROOMS = ("kernels", "filters", "registration", "evaluation/bench")
"""What our figures depend on: a change there makes old ones void."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What is measured."""

    operations: Sequence[str]
    """Names of `OPERATIONS`; none: all."""
    sizes: Sequence[int]
    """Numbers of points."""
    threads: Sequence[int]
    repeats: int
    seed: int

    def check(self) -> None:
        """Refuse what cannot be measured.

        Raises
        ------
        InputError
            An unknown operation, or a number out of range.
        """
        for name in self.operations:
            if name not in OPERATIONS:
                msg = (
                    f"there is no operation {name!r} to measure; there are {', '.join(OPERATIONS)}."
                )
                raise InputError(msg)
        for size in self.sizes:
            if not _FEWEST <= size <= _MOST:
                msg = f"--points must be {_FEWEST:,} to {_MOST:,}, got {size:,}."
                raise InputError(msg)
        if self.repeats < 1:
            raise InputError(f"--repeats must be 1 or more, got {self.repeats}.")


def bench(
    out: Path, setting: Setting, *, overwrite: bool, work: Path | None, progress: Progress
) -> tuple[dict[str, Any], str]:
    """Measure and write ``bench.json`` into the folder `out`, after every group.

    A group is one operation at one size with one number of threads: all its contenders are
    measured in one go. Groups that the file holds already, measured by this code on this machine
    with the same seed and repeats, are not measured again.

    Returns
    -------
    document : dict
        What bench.json holds.
    text : str
        Tables for a terminal.

    Raises
    ------
    InputError
        The setting asks for what cannot be measured, or the file there is not of this machine.
    OutputError
        The folder cannot be written.
    """
    setting.check()
    file = out / "bench.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{out} cannot be made: {error.strerror or error}. Choose another --out."
        raise OutputError(msg) from error
    about = _about()
    groups = {} if overwrite else _measured(file, about)
    wanted = [
        (operation, size, threads)
        for size in setting.sizes
        for operation in setting.operations or OPERATIONS
        for threads in setting.threads
    ]
    for done, (operation, size, threads) in enumerate(wanted):
        key = f"{operation}/{size}/{threads}"
        progress.stage(f"{OPERATIONS[operation].title}: {size:,} points, {threads} threads")
        progress.fraction(done / len(wanted))
        asked = {"repeats": setting.repeats, "seed": setting.seed}
        if not asked.items() <= groups.get(key, {}).items():
            groups[key] = _group(operation, size, threads, setting, work, progress)
            with watched(file):
                write_json(file, {**about, "groups": _sorted(groups)})
    document = {**about, "groups": _sorted(groups)}
    return {**document, "file": str(file)}, as_text(document)


def _sorted(groups: dict[str, Any]) -> dict[str, Any]:
    order = list(OPERATIONS)
    return dict(
        sorted(
            groups.items(),
            key=lambda item: (
                order.index(item[1]["operation"]),
                item[1]["points"],
                item[1]["threads"],
            ),
        )
    )


def _measured(file: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Return the groups of an earlier run that still hold; the others are measured again."""
    if not file.exists():
        return {}
    try:
        held = json.loads(file.read_text(encoding="utf-8"))
        groups = dict(held["groups"])
    except (OSError, ValueError, KeyError) as error:
        msg = f"{file} is not what `dougong bench` writes. Choose another --out, or --overwrite."
        raise InputError(msg) from error
    if held.get("machine") != about["machine"]:
        msg = (
            f"{file} was measured on another machine ({held.get('machine', {}).get('processor')}). "
            "Choose another --out, or --overwrite."
        )
        raise InputError(msg)
    return groups if held.get("code") == about["code"] else {}


def _about() -> dict[str, Any]:
    """Return who and where: versions, machine, and the hash of our own code."""
    everyone = [c for operation in OPERATIONS.values() for c in operation.contenders]
    peers = sorted({c.package for c in everyone if c.is_installed and not c.is_program})
    return {
        "machine": machine(),
        "code": code_hash(_ROOMS),
        "software": software(),
        "peers": {name: version_of(name) for name in peers if name != "dougong"},
        "absent": absent(),
    }


def _group(
    operation: str,
    size: int,
    threads: int,
    setting: Setting,
    work: Path | None,
    progress: Progress,
) -> dict[str, Any]:
    """Measure all contenders of an operation side by side."""
    asked = OPERATIONS[operation]
    present = [c for c in asked.contenders if c.is_installed and size <= c.most]
    with tempfile.TemporaryDirectory(prefix="dougong-bench-", dir=work) as folder:
        for key, values in SCENES[asked.scene](size, setting.seed).items():
            np.save(Path(folder) / f"{key}.npy", values)
        runs: dict[str, list[dict[str, Any]]] = {c.name: [] for c in present}
        failed: dict[str, str] = {}
        for repeat in range(setting.repeats):
            # Who goes first changes, so that nobody always finds the cache warm or cold.
            for contender in present if repeat % 2 == 0 else present[::-1]:
                if contender.name in failed:
                    continue
                try:
                    with _worker(operation, contender, folder, threads) as ask:
                        runs[contender.name].append(ask())
                except _NoAnswerError as error:
                    failed[contender.name] = str(error)
                    progress.note(f"{contender.name} failed: {error}")
    return {
        "operation": operation,
        "title": asked.title,
        "points": size,
        "threads": threads,
        "repeats": setting.repeats,
        "seed": setting.seed,
        "rows": [_row(c, runs[c.name], failed.get(c.name)) for c in present],
    }


class _NoAnswerError(Exception):
    """A worker ended without an answer."""


@contextmanager
def _worker(operation: str, contender: Contender, folder: str, threads: int) -> Iterator[Any]:
    """Start a contender's process; yields what asks it to work once and returns its measures."""
    pools = {f"{pool}_NUM_THREADS": str(threads) for pool in _POOLS}
    command = [sys.executable, "-m", "dougong.evaluation.bench.worker"]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [*command, operation, contender.name, folder, str(threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            cwd=folder,
            env={**os.environ, **pools},
        )
        asking, answering = process.stdin, process.stdout
        assert asking is not None
        assert answering is not None

        def ask() -> dict[str, Any]:
            try:
                asking.write("work\n")
                asking.flush()
                line = answering.readline()
            except BrokenPipeError:
                line = ""
            if not line:
                process.wait()
                said.seek(0)
                words = said.read().decode(errors="replace").strip().splitlines()
                raise _NoAnswerError(words[-1] if words else f"exit code {process.returncode}")
            answer: dict[str, Any] = json.loads(line)
            return answer

        try:
            yield ask
        finally:
            asking.close()
            answering.close()
            process.kill()
            process.wait()


def _row(contender: Contender, runs: list[dict[str, Any]], failed: str | None) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": contender.name,
        "is_ours": contender.is_ours,
        "is_equal": contender.is_equal,
        "failed": failed,
    }
    if failed is None:
        for key in ("wall_s", "cpu_s"):
            row[key] = statistics.median(run[key] for run in runs)
            row[f"{key}_all"] = [round(run[key], 4) for run in runs]
        row["bytes"] = max(run["bytes"] for run in runs)
        row["answer"] = runs[-1]["answer"]
    return row
