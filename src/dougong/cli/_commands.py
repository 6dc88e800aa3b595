"""Every command by its name, and one command line run."""

import inspect
from collections.abc import Sequence

from cyclopts import App, CycloptsError, MissingArgumentError, UnusedCliTokensError

import dougong
from dougong.cli import (
    bench,
    check,
    demo,
    evaluate,
    filter,
    info,
    init,
    plan,
    register,
    report,
    run,
    transform,
    view,
)
from dougong.cli._shell import fail
from dougong.errors import InputError

app = App(
    name="dougong",
    version=dougong.__version__,
    help=(
        "Laser scans and drone photogrammetry of a historic building in; one clean, registered, "
        "proven point cloud out.\n\nStart with: dougong demo"
    ),
    help_format="plaintext",
)


def unwrapped(text: str) -> str:
    """Return a docstring with each paragraph on one line: the terminal's width breaks it anew."""
    lines: list[str] = []
    is_parameters = False
    for line in inspect.cleandoc(text).splitlines():
        is_parameters = is_parameters or line == "Parameters"
        before = lines[-1] if lines else ""
        # Among the parameters only their descriptions, which are indented, are paragraphs.
        is_text = line.startswith("    ") if is_parameters else True
        if line and before and is_text and before.startswith("    ") == line.startswith("    "):
            lines[-1] = f"{before} {line.strip()}"
        else:
            lines.append(line)
    return "\n".join(lines)


# In the order of a survey, which --help keeps.
_COMMANDS = (
    demo,
    run,
    plan,
    init,
    info,
    check,
    filter,
    register,
    transform,
    report,
    view,
    evaluate,
    bench,
)
for _place, _command in enumerate(_COMMANDS):
    _command.command.__doc__ = unwrapped(_command.command.__doc__ or "")
    _name = _command.__name__.rsplit(".", 1)[1]
    app.command(_command.command, name=_name, sort_key=_place)


_FLAGS = frozenset({"--quiet", "--json", "--debug"})
_VALUES = frozenset({"--threads", "--memory", "--engine", "--work", "--seed"})


def command_first(tokens: Sequence[str]) -> list[str]:
    """Return `tokens` with global options that stand before the command moved behind all else."""
    rest, leading = list(tokens), []
    while rest and rest[0].split("=")[0] in _FLAGS | _VALUES:
        takes_next = rest[0] in _VALUES
        leading += rest[: 1 + takes_next]
        rest = rest[1 + takes_next :]
    return rest + leading


def call(tokens: Sequence[str]) -> int:
    """Run one command line and return its exit code (0, 1, 2, 3, 130 or 143)."""
    try:
        code = app(
            command_first(tokens),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except CycloptsError as error:
        said = InputError(_told(error, tokens))
        return fail(said, as_json="--json" in tokens, debug=False)
    return int(code or 0)


def _told(error: CycloptsError, tokens: Sequence[str]) -> str:
    """Return what is wrong with a command line, and what to do, in one sentence."""
    if isinstance(error, UnusedCliTokensError):
        unused = error.unused_tokens or [""]
        more = f" and {len(unused) - 1} more" if len(unused) > 1 else ""
        return (
            f"{unused[0]!r}{more}: more than this command takes. Quote a name with blanks, and see "
            f"`dougong {tokens[0]} --help`."
        )
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        command = " ".join(("dougong", *(error.command_chain or ())))
        argument = error.argument
        if error.keyword is not None:
            return f"{error.keyword} is given without a value; see `{command} --help`."
        is_placed = argument.field_info.is_positional
        name = argument.name.lstrip("-").upper() if is_placed else argument.name
        return f"`{command}` needs {name}, which is missing; see `{command} --help`."
    return str(error)
