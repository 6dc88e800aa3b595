"""What the clutter filter takes for what, on generated sites: people, cars, statues, columns ...

    python benchmarks/clutter.py [--seeds 100 101 102 103 104] [--points 1500000] [--json FILE]
    python benchmarks/clutter.py --drone [--seeds 100 101 102 103 104]
    python benchmarks/clutter.py --data FOLDER

Every building of the scenes with a forecourt of labelled people, vehicles, poles and wires, and of
the heritage that looks like them, scanned from its stations, filtered as a laser scan's recipe does
(low outliers, cloth, CWASF; no voxel grid), then `clutter`. Seeds 1 to 6 were looked at while the
limits were chosen; 100 and up were not. A thing counts where 50 points of it or more were left.
The second command takes drone clouds of the usual scenes through their own recipe; the third says
what is offered in real clouds and in scans of real buildings' meshes.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from dougong.evaluation.clutter_trials import (
    drone_trial,
    point_table,
    real_offers,
    summary,
    thing_table,
    trial,
)
from dougong.evaluation.scenes import BUILDERS
from dougong.evaluation.tabulate import as_text


def main() -> None:
    """Print the tables, and write the rows as JSON when asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 101, 102, 103, 104])
    parser.add_argument("--points", type=int, default=1_500_000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--drone", action="store_true", help="drone clouds instead")
    parser.add_argument("--data", type=Path, help="folder of real clouds and meshes")
    arguments = parser.parse_args()
    if arguments.drone:
        seen = [r for k in BUILDERS for seed in arguments.seeds for r in drone_trial(k, seed)]
        show(point_table(seen))
        return
    if arguments.data:
        show(list(real_offers(arguments.data)))
        return
    rows: list[dict[str, Any]] = []
    for seed in arguments.seeds:
        for kind in BUILDERS:
            rows += trial(kind, seed, arguments.points)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    # Wires have no clusters to be counted.
    for table in (summary(rows), thing_table(rows), point_table(rows)):
        show(table)
        print()


def show(table: list[dict[str, Any]]) -> None:
    """Print a table under the names of its columns."""
    print(as_text(table, {name: name for name in table[0]}))


if __name__ == "__main__":
    main()
