"""Register pairs that are hard or impossible, and say where the answer is not what it must be.

    python benchmarks/register_hard.py [--cases overlap30,mirror-x] [--scenes hall,nuyda]
                                       [--seeds 0] [--rows rows.jsonl]

The cases and the answer each must get: `dougong.evaluation.hard`; the whole matrix is
``dougong evaluate hard``. With --rows each row is kept in a file and not made again. Light
scenes: one pair takes about 15 CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from places import make

from dougong.evaluation.hard import CASES, COPY_CASES, OTHER_PLACE, PLACES, cases_on, run
from dougong.evaluation.hard_trials import Base
from dougong.evaluation.studies.hard import summary
from dougong.evaluation.studies.hard import text as in_words


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    tre = f"{1e3 * row['tre95_m']:.1f}" if "tre95_m" in row else "-"
    return (
        f"{row['case']:<16}{row['scene']:<10}{row['seed']:>4}  {row['expected']:<11}"
        f"{row['status']:<10}{tre:>9}{row['cpu_s']:>7.1f}  {row['verdict']}"
    )


def main() -> None:
    """Run what the command line asks for; exit 1 when any pair is WRONG."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", default=",".join([*CASES, *COPY_CASES, OTHER_PLACE]))
    parser.add_argument("--scenes", default=",".join(PLACES))
    parser.add_argument("--seeds", default="0", help="numbers, by commas")
    parser.add_argument("--rows", type=Path, help="JSON lines: read, not made again, added to")
    asked = parser.parse_args()
    rows: dict[Any, dict[str, Any]] = {}
    if asked.rows is not None and asked.rows.is_file():
        for text in asked.rows.read_text().splitlines():
            row = json.loads(text)
            rows[row["case"], row["scene"], row["seed"]] = row
    cache: dict[Any, Base] = {}
    chosen = []
    print("case            scene     seed  expected   status    TRE95 mm  CPU s  verdict")
    for kind in asked.scenes.split(","):
        for seed in (int(text) for text in asked.seeds.split(",")):
            for name in asked.cases.split(","):
                if name not in cases_on(kind):
                    continue
                key = (name, kind, seed)
                if key not in rows:
                    rows[key] = run(name, kind, seed, make, cache)
                    if asked.rows is not None:
                        with asked.rows.open("a") as file:
                            file.write(json.dumps(rows[key]) + "\n")
                chosen.append(rows[key])
                print(line(rows[key]), flush=True)
            cache.clear()
    print()
    print(in_words(summary(chosen)))
    sys.exit(1 if any(row["verdict"] == "WRONG" for row in chosen) else 0)


if __name__ == "__main__":
    main()
