"""Picking pairs of places in two clouds: what the page is told, and where its pairs go."""

import shlex
from pathlib import Path
from typing import Any

from dougong.errors import InputError
from dougong.formats.stream import stem_of
from dougong.pipeline.pairs import HEADER, PickedSet, read_pairs, write_pairs
from dougong.pipeline.settings import validated
from dougong.report.server import Take


def picking(
    source: Path, target: Path, file: Path | None
) -> tuple[dict[str, Any], dict[str, Take]]:
    """Return what the page must know to pick pairs, and what it may send then.

    Parameters
    ----------
    source, target : Path
    file : Path, optional
        The CSV file that the page's pairs are saved in; what it holds already is shown. Without
        it the page offers its pairs as a download.

    Raises
    ------
    InputError
        The file holds something else, or its folder is missing.
    """
    cloud = stem_of(source)
    known = None
    if file is not None and file.exists():
        known = read_pairs(file, cloud)
    elif file is not None and not file.absolute().parent.is_dir():
        msg = f"{file.absolute().parent} is no folder, so {file.name} cannot be written there."
        raise InputError(msg)
    words = [shlex.quote(str(value)) for value in (source, target, file or "pairs.csv")]
    told: dict[str, Any] = {
        "cloud": cloud,
        "header": ",".join(HEADER),
        "url": None if file is None else "pairs",
        "command": f"dougong register {words[0]} {words[1]} --pairs {words[2]} --out result",
        "list": [],
    }
    if known is not None:
        told["list"] = [
            {"name": name, "source": one.tolist(), "target": two.tolist()}
            for name, one, two in zip(known.names, known.source, known.target, strict=True)
        ]
    if file is None:
        return told, {}

    def take(sent: Any) -> dict[str, Any]:
        picked = validated(PickedSet, sent if isinstance(sent, dict) else {}, "pairs")
        write_pairs(file, cloud, picked.pairs)
        return {"pairs": len(picked.pairs), "path": str(file.absolute())}

    return told, {"pairs": take}
