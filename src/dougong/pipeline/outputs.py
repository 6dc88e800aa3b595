"""Results appear whole or not at all: files and folders are made beside and then renamed."""

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from dougong.errors import InputError, OutputError
from dougong.formats.atomic import refuse_bad_target
from dougong.formats.registry import family_of
from dougong.formats.unfinished import clear_parts, part_of


def refuse_existing(paths: Sequence[Path], overwrite: bool) -> None:
    """Refuse to go on when a result exists already.

    Raises
    ------
    InputError
        One of `paths` exists and `overwrite` is False.
    """
    found = [path for path in paths if path.exists()]
    if found and not overwrite:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        msg = f"{found[0]} exists already{more}. Choose another name or pass --overwrite."
        raise InputError(msg)


def refuse_output(input: Path, output: Path, files: Sequence[Path], overwrite: bool) -> None:
    """Refuse an output that could not be written, before any work is done.

    Raises
    ------
    InputError
        It is the input, one of `files` exists already, the folder is missing, or the suffix is
        not one that is written.
    OutputError
        The folder may not be written.
    """
    try:
        refuse_bad_target(output, overwrite=True, source=input)
        family_of(output)
    except OutputError as error:
        # The same to the writers, but here it is a word of the command that is wrong.
        raise InputError(str(error)) from error
    refuse_existing(files, overwrite)
    if not os.access(output.parent, os.W_OK):
        msg = f"{output.parent} may not be written by this user. Change its permissions."
        raise OutputError(msg)


_OURS = ".dougong-scratch"
"""The file that marks a folder as one that we made, and may delete."""


def behind_link(out: Path) -> Path:
    """Return where `out` lies itself, so that what is made beside it is on its disk."""
    return out.resolve() if out.is_symlink() else out


def claim_folder(folder: Path) -> None:
    """Make `folder` and mark it as ours; one that we made before stays as it is.

    Raises
    ------
    OutputError
        It cannot be made, or somebody else's files are in it.
    """
    try:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / _OURS).exists():
            msg = (
                f"{folder} is needed for work in progress, but has files in it that dougong did "
                "not put there. Move it away, or pass another --out or --work."
            )
            raise OutputError(msg)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _OURS).touch()
    except OSError as error:
        msg = f"{folder} cannot be made: {error.strerror or error}. Pass another --work."
        raise OutputError(msg) from error


def leave_folder(folder: Path) -> None:
    """Delete a claimed folder if nothing to go on from was left in it."""
    if [path.name for path in folder.glob("*")] in ([], [_OURS]):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """Make `folder`, empty, and delete it in the end; what a killed run left there goes too.

    Raises
    ------
    OutputError
        It cannot be made, or somebody else's files are in it.
    """
    had_parent = folder.parent.exists()
    claim_folder(folder)
    shutil.rmtree(folder, ignore_errors=True)
    claim_folder(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if not had_parent:
            with suppress(OSError):  # something to go on from was left in it
                folder.parent.rmdir()


def write_text(path: Path, text: str) -> None:
    r"""Write a text file so that it is there whole or not at all.

    Bytes of a file name that are no UTF-8 (a name of an old archive) become ``\udc..``, which JSON
    reads back as the same name.

    Raises
    ------
    OutputError
        The disk is full or the folder cannot be written.
    """
    part = part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_parts(path)
        with part.open("w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        # The first error is the one to tell, not that of cleaning up after it.
        with suppress(OSError):
            part.unlink()
        msg = (
            f"{path} could not be written: {error.strerror or error}. "
            "Free some space, or write elsewhere."
        )
        raise OutputError(msg) from error


def finite(value: Any) -> Any:
    """Return `value` as JSON can hold it: arrays as lists, NaN and infinity as null."""
    if isinstance(value, np.ndarray):
        return finite(value.tolist())
    if isinstance(value, np.generic):
        return finite(value.item())
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def write_json(path: Path, document: Any) -> None:
    """Write one JSON document; NaN and infinity are refused, since JSON has neither."""
    write_text(path, json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
