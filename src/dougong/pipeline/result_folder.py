"""The folder of a result: it appears whole or not at all, and holds one result."""

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from dougong.errors import InputError, OutputError
from dougong.formats.unfinished import own_mark, refuse_another, removed_if_cancelled
from dougong.pipeline.exports import SUFFIXES
from dougong.pipeline.outputs import behind_link, refuse_existing
from dougong.pipeline.run_document import DISTANCES
from dougong.pipeline.writing import MERGED, REMOVED

RUN, REGISTRATION, REPORT, DEMO = "result.json", "registration.json", "report.html", "demo.json"


def refuse_other_result(out: Path, overwrite: bool) -> None:
    """Refuse a folder that holds the result of a run, a demo or a registration.

    Raises
    ------
    InputError
        It does, and `overwrite` is False.
    """
    refuse_existing([out / name for name in (RUN, REGISTRATION, REPORT)], overwrite)


def refuse_inputs_in_result(files: Sequence[Path], out: Path) -> None:
    """Refuse inputs that go with the earlier result in `out`.

    Raises
    ------
    InputError
        One of `files` does.
    """
    going = {path.resolve() for path in _earlier_files(out)}
    for file in files:
        if file.resolve() in going:
            msg = f"{file} is part of the result in {out} that is replaced. Choose another --out."
            raise InputError(msg)


@contextmanager
def result_folder(out: Path) -> Iterator[Path]:
    """Yield an empty folder; its files move into `out` when the block succeeds.

    It lies in `out` where that is there already, else beside it: on one disk, whatever is mounted
    or linked there, so that files move by renaming. All that an earlier result in `out` is known
    to have written goes, since beside the new one it would pass for a part of it; other files that
    the job does not write stay as they are. On any failure of the job the folder is removed and
    `out` is untouched; what cannot be moved at the end stays, and is said.

    Raises
    ------
    OutputError
        The folder cannot be made, or another process is writing to `out`.
    """
    if out.exists() and not out.is_dir():
        msg = f"{out} is a file, and the result is a folder. Choose another --out."
        raise OutputError(msg)
    inside, *beside = _heads(behind_link(out))
    for head in (inside, *beside):
        refuse_another(head, f"{out} is being written", "choose another --out")
    head = inside if out.exists() else beside[0]
    part = head.with_name(head.name + own_mark())
    try:
        part.mkdir(parents=True)
    except OSError as error:
        msg = f"{out} cannot be made: {error.strerror or error}. Choose another --out."
        raise OutputError(msg) from error
    with removed_if_cancelled(part):
        try:
            yield part
        except BaseException as error:
            shutil.rmtree(part, ignore_errors=True)
            if not isinstance(error, OutputError):
                raise
            # The user named `out`; where its files are made first is our own affair.
            raise OutputError(str(error).replace(str(part), str(out))) from error
    _move_into(part, out)


def _heads(place: Path) -> list[Path]:
    """Return how the names of unfinished results begin: in the folder, and (no root) beside it."""
    beside = [place.with_name(f".{place.name}.part-")] if place.name else []
    return [place / ".part-", *beside]


def _move_into(part: Path, out: Path) -> None:
    """Move a finished folder into place: by one rename where `out` is not there yet."""
    try:
        if not out.exists():
            part.rename(behind_link(out))
            return
        old = _earlier_files(out)
        for file in sorted(path for path in part.rglob("*") if path.is_file()):
            target = out / file.relative_to(part)
            target.parent.mkdir(parents=True, exist_ok=True)
            file.replace(target)
            old.discard(target)
        for file in old:
            file.unlink()
    except BaseException as error:
        kept = _kept(part, out)
        if not isinstance(error, OSError):
            raise
        msg = (
            f"{out} could not be written: {error.strerror or error}. The finished files that are "
            f"not in it yet are in {kept}: move them by hand."
        )
        raise OutputError(msg) from error
    shutil.rmtree(part, ignore_errors=True)


def _kept(part: Path, out: Path) -> Path:
    """Give a finished folder a name that the next job does not clear, and return it."""
    head, number = f"{out.name or 'result'}.finished", 2
    kept = part.with_name(head)
    while kept.exists():
        kept, number = part.with_name(f"{head}-{number}"), number + 1
    with suppress(OSError):
        part.rename(kept)
        return kept
    return part


def _earlier_files(out: Path) -> set[Path]:
    """Return the files in `out` that its result.json or registration.json says are theirs.

    Those of a demo's ``scene/`` stay: they are clouds to work with.
    """
    names = _names_of_run(_document(out / RUN)) + _names_of_pair(_document(out / REGISTRATION))
    inside = {Path(name) for name in names if ".." not in Path(name).parts}
    return {out / path for path in inside if not path.is_absolute() and (out / path).is_file()}


def _document(path: Path) -> dict[str, Any]:
    """Return a document of ours; an empty one where there is none that can be read."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def _names_of_run(result: dict[str, Any]) -> list[str]:
    try:
        clouds = [str(cloud["name"]) for cloud in result["clouds"]]
        again = (result.get("full_resolution") or {}).get("files", [])
        full = [f"{file['file']}{books}" for file in again for books in ("", ".json")]
    except (KeyError, TypeError, AttributeError):
        return []  # none of ours: nothing in the folder is known
    of_clouds = [
        name
        for cloud in clouds
        for name in (
            *(f"{folder}/{cloud}.laz" for folder in ("clouds", REMOVED, DISTANCES)),
            *(f"registrations/{cloud}{suffix}" for suffix in (".json", *SUFFIXES)),
        )
    ]
    return [RUN, REPORT, DEMO, MERGED, *full, *of_clouds]


def _names_of_pair(registration: dict[str, Any]) -> list[str]:
    if "matrix" not in registration:
        return []
    exports = [f"registration{suffix}" for suffix in SUFFIXES]
    return [REGISTRATION, REPORT, f"{DISTANCES}.laz", *exports]
