"""Studies: each reproduces one table or figure. One module per study, called as the command does.

A study's module has ``study(setting, progress) -> Findings``. Add a module, its line in `STUDIES`
and its name in ``cli/evaluate.py``, and ``dougong evaluate NAME`` runs it. Every row it measures
names its ``seed``; what it is measured against and the version are added to all rows here.
"""

import csv
import io
import json
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import dougong
from dougong.errors import InputError, OutputError
from dougong.evaluation.machine import code_hash, machine
from dougong.evaluation.tabulate import new_figure
from dougong.formats.unfinished import watched
from dougong.pipeline.outputs import finite, refuse_existing, write_json, write_text
from dougong.pipeline.progress import Progress
from dougong.pipeline.provenance import software
from dougong.threads import get_threads

STUDIES: Mapping[str, str] = {
    "denoise": "noise filters: noise removed against carving kept",
    "probability": "the verdict's probability against how often it is right",
    "hard": "hard and impossible pairs: right, ambiguous, failed, wrong",
    "buildings": "five kinds of building through the whole program, against the truth",
    "filtering": "octree depth and cloth threshold: reduction, and what it costs",
    "storage": "bytes on disk before and after, by format",
    "coarse": "coarse methods: precision, recall, convergence",
    "objects": "objects of unknown attitude: precision, recall, errors, by level",
    "growth": "errors, seconds and memory against the number of points",
    "peers": "the same pairs through other programs",
}
"""Every study by its name, with what it measures."""

_ROOMS = ("kernels", "filters", "formats", "tiles", "registration", "pipeline", "evaluation")
"""What the figures depend on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What the user may choose of any study."""

    seed: int = 0
    """The first run's; the others count on from it."""
    runs: int | None = None
    """How often each sample is drawn anew; None: as many as the study says."""
    is_quick: bool = False
    """Small samples and few runs: a look, not a measurement."""
    points: int | None = None
    """Points of a scanner's cloud (the largest, where sizes are compared); None: as the study
    says."""
    data: Path | None = None
    """Folder of real scans."""
    kept: Path | None = None
    """File in which a long study keeps its rows as they are measured; see `measured`."""

    def seeds(self, usual: int, quick: int) -> range:
        """Return the seeds of the runs."""
        runs = self.runs or (quick if self.is_quick else usual)
        return range(self.seed, self.seed + runs)

    def of_rows(self) -> dict[str, Any]:
        """Return what a row depends on beside its key; which rows there are is no part of it."""
        data = None if self.data is None else str(self.data.resolve())
        facts = {"is_quick": self.is_quick, "points": self.points, "data": data}
        return {**facts, "threads": get_threads()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What a study found."""

    rows: Sequence[Mapping[str, Any]]
    """Every single measurement, plain."""
    table: Sequence[Mapping[str, Any]]
    """What is read: means and spreads. Becomes the CSV file; all rows have the same keys."""
    against: str
    """What the figures are measured against: one sentence that goes into every row."""
    text: str
    """The table for a terminal."""
    draw: Callable[[Path], None]
    """Writes the figure as PNG."""


def measured(
    setting: Setting,
    keys: Iterable[tuple[Any, ...]],
    measure: Callable[..., Mapping[str, Any]],
    progress: Progress,
) -> list[Mapping[str, Any]]:
    """Return `measure(*key)` of every key; a row that was kept by a stopped run is not made again.

    Rows are kept one per line, with their key, the setting, the program's version and the hash of
    its source, as soon as they are measured. Rows of another setting or source are made again: the
    document names one.
    """
    made_by = {"setting": setting.of_rows(), "software": software(), "code": _code()}
    rows: dict[str, Mapping[str, Any]] = {}
    if setting.kept is not None and setting.kept.is_file():
        for text in setting.kept.read_text(encoding="utf-8").splitlines():
            line = _line(text)
            if line is not None and made_by.items() <= line.items():
                rows[json.dumps(line["key"])] = line["row"]
    chosen = []
    for key in keys:
        name = json.dumps(key)
        if name not in rows:
            progress.stage(", ".join(str(part) for part in key))
            rows[name] = finite(dict(measure(*key)))
            if setting.kept is not None:
                line = {"key": key, **made_by, "row": rows[name]}
                with setting.kept.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
        chosen.append(rows[name])
    return chosen


@cache
def _code() -> str:
    """Return the hash of our source as it is when a study begins, not when it has ended."""
    return code_hash(_ROOMS)


def _line(text: str) -> dict[str, Any] | None:
    """Return a kept line; None for the last one of a run that was stopped while writing it."""
    try:
        line: dict[str, Any] = json.loads(text)
    except json.JSONDecodeError:
        return None
    return line


def evaluate(
    name: str, out: Path, setting: Setting, *, overwrite: bool, progress: Progress
) -> tuple[dict[str, Any], str]:
    """Run a study and write ``NAME.json``, ``NAME.csv`` and ``NAME.png`` into the folder `out`.

    Returns
    -------
    document : dict
        What NAME.json holds, without the single rows, and where the files are.
    text : str
        The table for a terminal.

    Raises
    ------
    InputError
        No study has that name, a file exists already, or the data folder is missing.
    OutputError
        The folder cannot be written.
    """
    if name not in STUDIES:
        raise InputError(f"there is no study {name!r}; there are {', '.join(STUDIES)}.")
    if setting.data is not None and not setting.data.is_dir():
        raise InputError(f"--data {setting.data} is not a folder. Leave it out for none.")
    files = [out / f"{name}.{suffix}" for suffix in ("json", "csv", "png")]
    refuse_existing(files, overwrite)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{out} cannot be made: {error.strerror or error}. Choose another --out."
        raise OutputError(msg) from error
    kept = out / f"{name}.rows.jsonl"
    if overwrite:
        kept.unlink(missing_ok=True)
    setting = replace(setting, kept=kept)
    _code()
    # Without what draws the figure a study would fail after hours of work.
    new_figure(1.0, 1.0)
    found: Findings = import_module(f"dougong.evaluation.studies.{name}").study(setting, progress)
    document = finite(_document(name, setting, found))
    with watched(*files):
        told = {"measured_against": found.against, "version": dougong.__version__}
        rows = [{**told, **row} for row in found.rows]
        write_json(files[0], {**document, "rows": finite(rows)})
        write_text(files[1], _csv(found.table))
        part = files[2].with_name(f".{name}.part.png")
        try:
            found.draw(part)
            part.replace(files[2])
        except OSError as error:
            msg = (
                f"{files[2]} could not be written: {error.strerror or error}. Choose another --out."
            )
            raise OutputError(msg) from error
        finally:
            part.unlink(missing_ok=True)
    kept.unlink(missing_ok=True)
    return {**document, "files": [str(file) for file in files]}, found.text


def _document(name: str, setting: Setting, found: Findings) -> dict[str, Any]:
    """Return what NAME.json says beside the single rows."""
    return {
        "study": name,
        "about": STUDIES[name],
        "measured_against": found.against,
        "version": dougong.__version__,
        "code": _code(),
        "machine": {**machine(), "system": platform.platform()},
        "software": software(),
        "seeds": sorted({row["seed"] for row in found.rows if "seed" in row}),
        "runs": setting.runs,
        "is_quick": setting.is_quick,
        "points": setting.points,
        "data": None if setting.data is None else setting.data.name,
        "table": [dict(row) for row in found.table],
    }


def _csv(table: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()
