"""Around every command: threads, cancelling, errors, exit codes, and what is printed where."""

import ctypes
import json
import os
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from dougong import app, errors
from dougong.cli._common import Common
from dougong.cli._progress import Bars, Lines, Quiet, listener
from dougong.cli._signals import code_of
from dougong.threads import set_threads

DONE, FAILED, USAGE, UNSURE = 0, 1, 2, 3
_UNWIND_SECONDS = 0.6

Listener = Quiet | Lines | Bars


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a command says: the same facts for a machine and for a person."""

    document: Any
    text: str
    exit_code: int = DONE


@dataclass(slots=True)
class _Outcome:
    answer: Answer | None = None
    error: BaseException | None = None


def execute(common: Common, work: Callable[[Listener], Answer], kept: str = "") -> int:
    """Run `work`, print its answer, and return the exit code.

    Parameters
    ----------
    common : Common
        The global options.
    work : callable
        Does the job; told whom to report progress to.
    kept : str
        What a cancelled job leaves behind, in words.
    """
    progress: Listener = Quiet()
    try:
        common.check()
        if common.threads is not None:
            set_threads(common.threads)
        app.use_engine(common.engine)
        progress = listener(common.quiet)
        answer = _cancellable(work, progress)
    except KeyboardInterrupt as cancelled:
        progress.close()
        return _cancelled(common, kept, code_of(cancelled))
    except Exception as error:  # noqa: BLE001 - the last place: every failure gets its sentence
        progress.close()
        return fail(error, as_json=common.json, debug=common.debug)
    progress.close()
    text = answer.text
    if common.json:
        text = _as_json(answer.document)
    return answer.exit_code if _print(text) else FAILED


def fail(error: BaseException, *, as_json: bool, debug: bool) -> int:
    """Print one clear sentence about `error` and return its exit code."""
    if debug:
        traceback.print_exception(error)
    name, message, code = _described(error)
    if as_json:
        document = {"error": {"type": name, "message": message, "exit_code": code}}
        _print(_as_json(document))
    else:
        _say(f"error: {message}\n")
    return code


def _described(error: BaseException) -> tuple[str, str, int]:
    """Return the type, the sentence and the exit code of an error."""
    name = type(error).__name__
    message = " ".join(str(error).split())
    if isinstance(error, errors.InputError):
        return name, message, USAGE
    if isinstance(error, errors.DougongError):
        return name, message, FAILED
    if isinstance(error, MemoryError):
        text = "not enough memory for this cloud. Decimate it first or use a larger machine."
        return name, text, FAILED
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        return name, f"{place}{error.strerror or message}.", FAILED
    text = f"unexpected {name}: {message or 'no message'}. Run again with --debug and report it."
    return name, text, FAILED


def _cancellable(work: Callable[[Listener], Answer], progress: Listener) -> Answer:
    """Run `work` on a thread of its own, so that Ctrl-C and SIGTERM are heard while a kernel runs.

    Python delivers a signal to the main thread between two of its instructions; a main thread
    inside a long kernel would hear it only at the kernel's end.
    """
    outcome = _Outcome()

    def target() -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", errors.DataWarning)
                warnings.showwarning = lambda text, *_args, **_kwargs: progress.note(str(text))
                outcome.answer = work(progress)
        except BaseException as error:  # noqa: BLE001 - carried over to the main thread
            outcome.error = error

    thread = threading.Thread(target=target, name="job", daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.1)
    except KeyboardInterrupt:
        _stop(thread)
        raise
    if outcome.error is not None:
        raise outcome.error
    assert outcome.answer is not None
    return outcome.answer


def _stop(thread: threading.Thread) -> None:
    """Ask the job to unwind, wait a moment for it, and remove what it had not finished."""
    from dougong.app import remove_unfinished

    if thread.ident is not None:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(
            ctypes.c_ulong(thread.ident), ctypes.py_object(KeyboardInterrupt)
        )
    thread.join(_UNWIND_SECONDS)
    remove_unfinished()


def _cancelled(common: Common, kept: str, code: int) -> int:
    message = f"cancelled. {kept or 'Nothing was written.'}"
    if common.json:
        error = {"type": "Cancelled", "message": message, "exit_code": code}
        _print(_as_json({"error": error}))
    else:
        _say(message + "\n")
    return code


def _as_json(document: Any) -> str:
    """Return a document as JSON in ASCII: whatever stdout's encoding is, it arrives whole."""
    return json.dumps(document, indent=2, allow_nan=False)


def _print(text: str) -> bool:
    """Print the answer; say whether it could be, or nobody wants it."""
    if sys.stdout is None:  # closed by whoever started us (`>&-`)
        return True
    # A file name may hold what the terminal's encoding, or any, does not.
    encoding = sys.stdout.encoding or "utf-8"
    text = text.encode(encoding, "backslashreplace").decode(encoding)
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except OSError as error:
        # What is left in the buffer would fail again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return True  # the reader has gone (`dougong info ... | head`)
        _say(f"error: the answer could not be printed: {error.strerror}. Send it elsewhere.\n")
        return False
    return True


def _say(text: str) -> None:
    """Write to stderr, if there is one that takes it."""
    if sys.stderr is not None:
        with suppress(OSError):
            sys.stderr.write(text)
            sys.stderr.flush()
