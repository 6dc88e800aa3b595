"""Keep what studies wrote as evidence: ``python docs/keep_evidence.py FOLDER STUDY...``.

Copies each study's document and figure into ``docs/evidence``, without the single measurements
where they are many: `dougong evaluate` makes them again from the seeds.
"""

import json
import shutil
import sys
from pathlib import Path

OUT = Path(__file__).parent / "evidence"
MOST_ROWS = 300


def main() -> None:
    """Copy the named studies."""
    folder = Path(sys.argv[1])
    for study in sys.argv[2:]:
        document = json.loads((folder / f"{study}.json").read_text(encoding="utf-8"))
        document["measurements"] = len(document["rows"])
        if len(document["rows"]) > MOST_ROWS:
            del document["rows"]
        text = json.dumps(document, indent=1, ensure_ascii=False)
        (OUT / f"{study}.json").write_text(text + "\n", encoding="utf-8")
        shutil.copyfile(folder / f"{study}.png", OUT / f"{study}.png")


if __name__ == "__main__":
    main()
