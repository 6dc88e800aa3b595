"""Keep what ``dougong bench`` measured: ``python docs/keep_bench.py FOLDER``.

Copies FOLDER/bench.json into ``docs/evidence`` and writes the README's table of speeds from it.
"""

import json
import sys
from pathlib import Path

from dougong.evaluation.bench.table import as_markdown

HERE = Path(__file__).parent
KEPT = HERE / "evidence" / "bench.json"
README = HERE.parent / "README.md"
BEGIN, END = "<!-- bench: made by docs/keep_bench.py -->", "<!-- end of bench -->"
THREADS = 2
"""The README shows the largest size only, with this many threads."""


def readme_table() -> str:
    """Return the README's table, as the kept measurements have it."""
    document = json.loads(KEPT.read_text(encoding="utf-8"))
    groups = document["groups"]
    most = {group["operation"]: 0 for group in groups.values()}
    for group in groups.values():
        most[group["operation"]] = max(most[group["operation"]], group["points"])
    shown = {
        key: group
        for key, group in groups.items()
        if group["threads"] == THREADS and group["points"] == most[group["operation"]]
    }
    return as_markdown({**document, "groups": shown})


def main() -> None:
    """Copy the measurements and write the table."""
    measured = Path(sys.argv[1]) / "bench.json"
    KEPT.write_text(measured.read_text(encoding="utf-8"), encoding="utf-8")
    text = README.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    README.write_text(f"{head}{BEGIN}\n{readme_table()}\n{END}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
