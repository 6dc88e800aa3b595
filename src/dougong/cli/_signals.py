"""Ctrl-C and SIGTERM: both end a command the same way, with an exit code of their own."""

import signal
from types import FrameType

CANCELLED, TERMINATED = 130, 143


class Terminated(KeyboardInterrupt):
    """Somebody told the process to end: `kill`, a batch scheduler, a machine that shuts down."""


def code_of(error: KeyboardInterrupt) -> int:
    """Return the exit code of a command that was ended so."""
    return TERMINATED if isinstance(error, Terminated) else CANCELLED


def listen() -> None:
    """Have SIGTERM end this process as Ctrl-C does, unless whoever started it has it ignored."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, _frame: FrameType | None) -> None:
    # Once is enough: a second one would break off the cleaning up.
    signal.signal(number, signal.SIG_IGN)
    raise Terminated
