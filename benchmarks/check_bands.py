"""Compare the headline figures of studies with the bands that they must stay in.

    dougong evaluate buildings --quick --out studies     # and the others
    python benchmarks/check_bands.py studies

Bands are in ``bands.toml`` beside this file: per study, rows of its table (`where`), a column and
the least or most that every such row may have. Prints a line per band and fails when a figure is
out of its band, when a band has no row, or when a study is missing.
"""

import argparse
import json
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

BANDS = Path(__file__).with_name("bands.toml")


def check(band: Mapping[str, Any], table: list[dict[str, Any]]) -> list[str]:
    """Return what is wrong with the rows of a study's table that a band is about."""
    where, key = band["where"], band["key"]
    rows = [row for row in table if all(row.get(name) == value for name, value in where.items())]
    if not rows:
        return ["the table has no such row"]
    wrong = []
    for row in rows:
        value = row.get(key)
        if value is None:
            wrong.append("there is no figure")
        elif "least" in band and value < band["least"]:
            wrong.append(f"{value:g} is less than {band['least']:g}")
        elif "most" in band and value > band["most"]:
            wrong.append(f"{value:g} is more than {band['most']:g}")
    return wrong


def judged(folder: Path, bands: Mapping[str, Any]) -> tuple[list[str], int]:
    """Return a line per band, and how many are broken."""
    lines, broken = [], 0
    for study, asked in bands.items():
        path = folder / f"{study}.json"
        table = None
        if path.is_file():
            table = json.loads(path.read_text(encoding="utf-8"))["table"]
        for band in asked:
            rows = ", ".join(f"{name} {value}" for name, value in band["where"].items())
            name = f"{study}: {band['key']}" + (f" ({rows})" if rows else "")
            wrong = [f"{path} is missing"] if table is None else check(band, table)
            broken += bool(wrong)
            lines.append("; ".join([f"{'BROKEN' if wrong else 'ok':7}{name}", *wrong]))
    return lines, broken


def main() -> None:
    """Check every band; exit code 1 when one is broken."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="where dougong evaluate wrote its documents")
    parser.add_argument("--bands", type=Path, default=BANDS)
    arguments = parser.parse_args()
    bands = tomllib.loads(arguments.bands.read_text(encoding="utf-8"))
    lines, broken = judged(arguments.folder, bands)
    print("\n".join(lines))
    if broken:
        sys.exit(f"{broken} of {len(lines)} figures are out of their bands")


if __name__ == "__main__":
    main()
