"""The ``dougong`` command. A command parses, calls one function of `app`, prints.

Nothing is imported here before `main` listens for Ctrl-C.
"""

import os
import sys
from collections.abc import Sequence

_CANCELLED = 130


def call(tokens: Sequence[str]) -> int:
    """Run one command line and return its exit code (0, 1, 2, 3 or 130)."""
    from dougong.cli import _commands

    return _commands.call(tokens)


def main() -> None:
    """Run the command line of this process and exit."""
    try:
        code = call(sys.argv[1:])
    except KeyboardInterrupt:
        # Before a command began, or after it ended: there is nothing to clean up.
        _say_cancelled(as_json="--json" in sys.argv)
        code = _CANCELLED
    if code == _CANCELLED:
        # A kernel may still be running on a thread; a normal exit would wait for it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _say_cancelled(*, as_json: bool) -> None:
    if as_json:
        said = '"type": "Cancelled", "message": "cancelled.", "exit_code": '
        sys.stdout.write(f'{{"error": {{{said}{_CANCELLED}}}}}\n')
    else:
        sys.stderr.write("cancelled.\n")
