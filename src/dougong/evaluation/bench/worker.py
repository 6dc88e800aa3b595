"""The process in which one contender works.

Started anew for each, so that nobody's threads, memory or settings meet another's.

    python -m dougong.evaluation.bench.worker OPERATION NAME FOLDER THREADS

Reads the scene from FOLDER, does the work once on a small part of it (loads, compiles), then once
for every line on stdin, and answers each with a line of JSON.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from dougong.evaluation.bench.contenders import OPERATIONS
from dougong.evaluation.bench.ours import Arrays
from dougong.evaluation.bench.programs import Cost
from dougong.evaluation.machine import forget_peak, resident_bytes
from dougong.threads import set_threads

_WARM_UP = 20_000


def measure(operation: str, name: str, arrays: Arrays, threads: int) -> dict[str, Any]:
    """Do the work once; return seconds, bytes beyond what was held before, and the answer."""
    work = OPERATIONS[operation]
    contender = next(c for c in work.contenders if c.name == name)
    forget_peak()
    held = resident_bytes("VmRSS")
    wall, cpu = time.perf_counter(), time.process_time()
    result = contender.run(arrays, threads)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if isinstance(result, Cost):
        return {
            "wall_s": result.wall_s,
            "cpu_s": result.cpu_s,
            "bytes": result.peak_bytes,
            "answer": {},
        }
    beyond = max(0, resident_bytes("VmHWM") - held)
    return {"wall_s": wall, "cpu_s": cpu, "bytes": beyond, "answer": work.answer(result, arrays)}


def _part(arrays: Arrays) -> Arrays:
    """Return a small part of a scene; matrices stay whole."""
    return {
        key: np.ascontiguousarray(value[:_WARM_UP]) if len(value) > 4 else value
        for key, value in arrays.items()
    }


def main() -> None:
    """Serve one contender until stdin ends."""
    operation, name, folder, threads = sys.argv[1:]
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    # Some peers print; nothing but answers may go where answers go.
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    set_threads(int(threads))
    if hasattr(os, "sched_setaffinity"):
        # Some peers (TBB) look at nothing but the processors they may use.
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(threads)])
    arrays = {path.stem: np.load(path) for path in sorted(Path(folder).glob("*.npy"))}
    measure(operation, name, _part(arrays), int(threads))
    for _ in sys.stdin:
        answers.write(json.dumps(measure(operation, name, arrays, int(threads))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
