"""A run killed at random moments, then let to its end, beside one that was left alone.

    python benchmarks/kill_run.py FOLDER --points 1.5e6 --memory 1GB --kills 10

Makes the site of `large_site.py`, runs it once undisturbed, then again and again with kill -9 at
moments drawn from the time that takes, until it has been killed so often; then lets it finish and
compares the result hash and every cloud written, byte for byte. Says at which stage each kill came.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from large_site import PROJECT, make


def command(project: Path, out: Path, memory: str) -> list[str]:
    """Return the command line of a run that keeps its steps beside `out`."""
    start = [sys.executable, "-m", "dougong", "run", str(project), "--out", str(out)]
    return [*start, "--memory", memory, "--work", str(out.with_name(f"{out.name}.work"))]


def result_of(out: Path) -> tuple[str, dict[str, str]]:
    """Return the result hash and a hash of every cloud in a result."""
    files = {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*.laz"))
    }
    return json.loads((out / "result.json").read_text())["result_hash"], files


def killed(tokens: list[str], after_s: float) -> str | None:
    """Run a command and kill it; return the last thing it said, None where it ended before."""
    child = subprocess.Popen(tokens, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        child.wait(after_s)
    except subprocess.TimeoutExpired:
        child.kill()
    said = child.communicate()[1].strip().splitlines()
    if child.returncode >= 0:
        return None
    return re.sub(r"^\[.*?\] *", "", said[-1]) if said else "starting"


def main() -> None:
    """Read the command line and do it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=float, default=1.5e6)
    parser.add_argument("--memory", default="1GB")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--voxel", type=float, default=0.1)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    make(asked.folder, int(asked.points))
    with TemporaryDirectory(dir=asked.folder) as work:
        project = Path(work) / "project.toml"
        text = PROJECT.format(folder=asked.folder.absolute(), voxel=asked.voxel)
        project.write_text(text)
        start = time.perf_counter()
        subprocess.run(
            [*command(project, Path(work) / "calm", asked.memory), "--quiet"], check=True
        )
        whole_s = time.perf_counter() - start
        print(f"undisturbed: {whole_s:.0f} s")
        draw = random.Random(asked.seed)
        tokens = command(project, Path(work) / "killed", asked.memory)
        for number in range(asked.kills):
            after_s = draw.uniform(0.5, whole_s)
            place = killed(tokens, after_s)
            print(f"kill {number + 1} after {after_s:.1f} s: {place or 'it had ended'}", flush=True)
            if place is None:
                # What is finished is not begun again: the next kill needs a new one.
                tokens = [*tokens, "--overwrite"] if "--overwrite" not in tokens else tokens
        start = time.perf_counter()
        tokens = tokens if "--overwrite" in tokens else [*tokens, "--overwrite"]
        subprocess.run([*tokens, "--quiet"], check=True)
        print(f"the rest: {time.perf_counter() - start:.0f} s")
        calm, other = result_of(Path(work) / "calm"), result_of(Path(work) / "killed")
        left = sorted(path.name for path in Path(work).iterdir())
    print(f"hash {calm[0]}")
    print("the same" if calm == other else f"DIFFERENT: {other[0]}")
    print(f"left beside the results: {left}")
    sys.exit(0 if calm == other else 1)


if __name__ == "__main__":
    main()
