"""The options every command has, and what they mean."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from dougong.errors import InputError

GLOBAL = Group("Global options", sort_key=100)
_LEAST_BYTES = 100_000
"""Less memory than this is a forgotten unit."""


@Parameter(name="*")
@dataclass(frozen=True)
class Common:
    """Global options."""

    quiet: Annotated[bool, Parameter(group=GLOBAL, negative="", show_default=False)] = False
    """Say nothing on stderr but errors."""
    json: Annotated[bool, Parameter(group=GLOBAL, negative="", show_default=False)] = False
    """Print one JSON document on stdout and nothing else."""
    threads: Annotated[int | None, Parameter(group=GLOBAL)] = None
    """Threads to use; default: all this process may use."""
    memory: Annotated[
        str | None,
        Parameter(
            group=GLOBAL,
            help="Memory to stay under, for example 4GB: larger clouds are worked on in tiles on "
            "disk. Without effect on init, info, check, report, evaluate and bench.",
        ),
    ] = None
    """Memory to stay under."""
    engine: Annotated[str, Parameter(group=GLOBAL)] = "local"
    """Who works on tiles: local, dask (processes of this machine) or dask://HOST:PORT."""
    work: Annotated[str | None, Parameter(group=GLOBAL)] = None
    """Where finished steps stay: a folder or s3://BUCKET/PREFIX; default: beside the output."""
    seed: Annotated[int, Parameter(group=GLOBAL)] = 0
    """Seed of everything random."""
    debug: Annotated[bool, Parameter(group=GLOBAL, negative="", show_default=False)] = False
    """Show the traceback of an error."""

    def memory_bytes(self) -> int | None:
        """Return ``--memory`` in bytes.

        Raises
        ------
        InputError
            The text is not a number with a unit.
        """
        if self.memory is None:
            return None
        found = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*([KMGT]?)(i?)B?", self.memory.strip(), re.I)
        if not found or float(found[1]) <= 0:
            msg = f"--memory needs a size such as 4GB or 800MB, got {self.memory!r}."
            raise InputError(msg)
        power = "BKMGT".index((found[2] or "B").upper())
        size = int(float(found[1]) * (1024 if found[3] else 1000) ** power)
        if size < _LEAST_BYTES:
            msg = (
                f"--memory needs a size such as 4GB or 800MB, got {self.memory!r}, which is "
                f"{size:,} bytes."
            )
            raise InputError(msg)
        return size

    def local_work(self) -> Path | None:
        """Return ``--work`` for a command whose temporary files are on a disk.

        Raises
        ------
        InputError
            It is a URL.
        """
        if self.work is not None and "://" in self.work:
            msg = f"--work of this command is a folder on a disk, got {self.work!r}. Name a folder."
            raise InputError(msg)
        return None if self.work is None else Path(self.work)

    def check(self) -> None:
        """Refuse what this version cannot do.

        Raises
        ------
        InputError
            A thread count below one.
        """
        if self.threads is not None and self.threads < 1:
            msg = f"--threads must be 1 or more, got {self.threads}."
            raise InputError(msg)
        if self.seed < 0:
            msg = f"--seed must be 0 or more, got {self.seed}."
            raise InputError(msg)
        self.memory_bytes()


DEFAULT = Common()
