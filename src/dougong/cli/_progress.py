"""Progress on stderr: a bar on a terminal, plain lines otherwise."""

import sys
import time
from contextlib import suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


class Quiet:
    """Says nothing (``--quiet``)."""

    def stage(self, text: str) -> None:
        """Ignore the stage."""

    def fraction(self, done: float) -> None:
        """Ignore the share done."""

    def note(self, text: str) -> None:
        """Ignore the note."""

    def close(self) -> None:
        """Nothing to end."""


class Lines:
    """One plain line when a stage begins: for logs and pipes."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def stage(self, text: str) -> None:
        """Print the stage with the seconds since the start."""
        self._print(f"[{time.perf_counter() - self._start:6.1f} s] {text}")

    def fraction(self, done: float) -> None:
        """Ignore the share done: lines would flood a log."""

    def note(self, text: str) -> None:
        """Print the note."""
        self._print(f"note: {text}")

    def close(self) -> None:
        """Nothing to end."""

    def _print(self, text: str) -> None:
        # A log whose reader has gone, or a full disk under it, must not end the job.
        with suppress(OSError):
            sys.stderr.write(text + "\n")
            sys.stderr.flush()


class Bars:
    """One live line per stage, on a terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24, pulse_style="cyan"),
            TimeElapsedColumn(),
            console=self._console,
            transient=False,
        )
        self._bars.start()
        self._task: TaskID | None = None

    def stage(self, text: str) -> None:
        """End the bar before and begin one for `text`."""
        self._finish()
        self._task = self._bars.add_task(text, total=None)

    def fraction(self, done: float) -> None:
        """Move the bar."""
        if self._task is not None:
            self._bars.update(self._task, total=1.0, completed=min(max(done, 0.0), 1.0))

    def note(self, text: str) -> None:
        """Print the note above the bars."""
        self._console.print(f"note: {text}", markup=False)

    def close(self) -> None:
        """End the last bar and leave the terminal as it was."""
        self._finish()
        self._bars.stop()

    def _finish(self) -> None:
        if self._task is not None:
            self._bars.update(self._task, total=1.0, completed=1.0)
            self._bars.stop_task(self._task)


def listener(quiet: bool) -> Quiet | Lines | Bars:
    """Return who listens to the job: nobody, a terminal, or a log."""
    if quiet or sys.stderr is None:
        return Quiet()
    return Bars() if sys.stderr.isatty() else Lines()
