"""The ``dougong`` command. A command parses, calls one function of `app`, prints.

Nothing heavy is imported here before `main` listens for Ctrl-C and SIGTERM.
"""

import os
import sys
from collections.abc import Sequence

from dougong.cli._signals import CANCELLED, TERMINATED, code_of, listen


def call(tokens: Sequence[str]) -> int:
    """Run one command line and return its exit code (0, 1, 2, 3, 130 or 143)."""
    from dougong.cli import _commands

    return _commands.call(tokens)


def main() -> None:
    """Run the command line of this process and exit."""
    try:
        listen()
        code = call(sys.argv[1:])
    except KeyboardInterrupt as error:
        # Before a command began, or after it ended: there is nothing to clean up.
        code = code_of(error)
        _say_cancelled(code, as_json="--json" in sys.argv)
    if code in (CANCELLED, TERMINATED):
        # A kernel may still be running on a thread; a normal exit would wait for it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _say_cancelled(code: int, *, as_json: bool) -> None:
    if as_json:
        said = '"type": "Cancelled", "message": "cancelled.", "exit_code": '
        sys.stdout.write(f'{{"error": {{{said}{code}}}}}\n')
    else:
        sys.stderr.write("cancelled.\n")
